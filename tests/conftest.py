"""The strict session: x64 on, no silent broadcasting, shapes and dtypes checked on every call.

`--slow` is the second pass: the tests marked `slow`, which are left out otherwise. `--float32` is the third:
x64 off, and only the tests marked `float32_too`.
"""

import gc
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Rooms whose functions are called for every array that a program computes with. Their annotations are checked
# by the passes --slow and --float32; in the first pass that would take a seventh of its time.
KERNELS = {"_splines", "_cells", "_closest", "_normal_equations"}

settings.register_profile(
    "jaxfit", database=None, deadline=None, derandomize=True, max_examples=20, print_blob=False
)
settings.load_profile("jaxfit")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests marked slow, and no others")
    parser.addoption(
        "--float32",
        action="store_true",
        help="run the tests marked float32_too in single precision, and no others",
    )


# The short code generator, which halves what compiling costs, and one module a program instead of many.
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"


def compile_quickly():
    """Pass XLA the flags in QUICK where it knows them: an unknown flag would end the process."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {QUICK}".strip()
    trial = [sys.executable, "-c", "import jax; jax.devices()"]
    known = subprocess.run(trial, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True, check=False)
    if known.returncode == 0:
        os.environ["XLA_FLAGS"] = flags


def check_annotations(kernels):
    """Every function of jaxfit, or of all rooms but KERNELS, checks what it is given and what it returns."""
    package = Path(__file__).parents[1] / "jaxfit"
    names = {path.stem for path in package.iterdir() if not path.stem.startswith("__")}
    rooms = ["jaxfit"] if kernels else [f"jaxfit.{name}" for name in names - KERNELS]
    install_import_hook(rooms, "beartype.beartype")


def pytest_configure(config):
    if config.getoption("--slow") and config.getoption("--float32"):
        raise pytest.UsageError("--slow and --float32 are two passes: run one after the other")
    check_annotations(kernels=config.getoption("--slow") or config.getoption("--float32"))
    # The pass in single precision runs the code that users get.
    if not config.getoption("--float32") and not hasattr(config, "workerinput"):
        compile_quickly()
    jax.config.update("jax_enable_x64", not config.getoption("--float32"))
    jax.config.update("jax_numpy_rank_promotion", "raise")
    # Most of the session is compiling tiny problems; unoptimised code is as correct and compiles faster.
    jax.config.update("jax_disable_most_optimizations", True)
    # Tracing makes many small objects that live as long as their program. Python looks for cycles among them
    # after every 700; and compiled code needs no note of the source lines that it comes from.
    gc.set_threshold(50_000, 20, 50)
    jax.config.update("jax_traceback_in_locations_limit", 0)


def pytest_collection_finish(session):
    gc.freeze()  # what is imported lives as long as the session


def pytest_collection_modifyitems(config, items):
    if config.getoption("--float32"):
        kept = [item for item in items if item.get_closest_marker("float32_too")]
    else:
        wanted = config.getoption("--slow")
        kept = [item for item in items if bool(item.get_closest_marker("slow")) == wanted]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


# Linux gives a process 65,530 memory mappings, and every compiled kernel takes some: without this a worker
# would be ended by the system somewhere in the second half of the session.
MOST_MAPPINGS = 25_000


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    # Tests of one file may count on what the file has compiled.
    maps = Path("/proc/self/maps")
    if (nextitem is not None and nextitem.path == item.path) or not maps.exists():
        return
    if maps.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
        from jaxfit import _compile_ahead  # not before its annotations are checked

        # Without this no program that is gone would be compiled ahead a second time.
        _compile_ahead._begun.clear()
        _compile_ahead._asked.clear()
