"""Compiled programs on disk, whole: who finds one there neither traces, nor lowers, nor compiles it.

JAX's own cache is asked for a program only after it has been traced and lowered, which takes three times as
long as loading it.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import os
import pickle
import platform
import sys
import zlib
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

from jaxfit._interrupt import at_last

SUFFIX = "-cache"
TRACED_WITH = ("jax", "jaxlib", "numpy", "equinox", "lineax", "optimistix", "jaxopt")
_WORDS = (str, bytes, bool, int, float, complex, type(None), type(Ellipsis))

folder: Path | None = None
_loaded: dict[Path, Any] = {}


class NoStableName(Exception):
    """A value has no name that means the same in every process."""


def call_kept(jitted: Any, static: int, args: tuple[Any, ...]) -> Any:
    """`jitted(*args)`, of which the first `static` are static, by the program that this process or the folder
    holds, else by one that is compiled and put there.

    An ordinary call where no program can be kept: no folder is set, there are several devices, or an argument
    holds what can't be named, such as a function of the user's, which might do something else tomorrow.
    """
    path, taken = path_of(jitted, static, args), args[static:]
    if path is None:
        return jitted(*args)
    if path not in _loaded and (program := _read(path, taken)) is not None:
        # What XLA can't link, it finds out only when the program runs.
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            results = jax.block_until_ready(program(*taken))
            _loaded[path] = program
            return results
    if path not in _loaded:
        _loaded[path] = _compiled(path, jitted.lower(*args))
    return _loaded[path](*taken)


def path_of(jitted: Any, static: int, args: tuple[Any, ...]) -> Path | None:
    """The file of the program of a call, None if it can't be kept."""
    key = _key(f"{jitted.__module__}.{jitted.__qualname__}", args[:static], args[static:])
    return None if folder is None or key is None else folder / f"{jitted.__name__}-{key}{SUFFIX}"


def is_kept(path: Path) -> bool:
    """Whether the program of this file is there."""
    return path in _loaded or path.exists()


def compile_kept(path: Path, lowered: Any) -> None:
    """Compile for `call_kept`, which then finds the program of this file loaded."""
    _loaded[path] = _compiled(path, lowered)


def _key(name: str, static: tuple[Any, ...], taken: tuple[Any, ...]) -> str | None:
    """What tells one program from every other one, None if that can't be said."""
    if folder is None or jax.device_count() > 1 or jax.config.values["jax_disable_jit"]:
        return None
    try:
        about = (_spelled(static), _spelled(taken, arrays=True))
    except NoStableName:
        return None
    words = (version_of_code(), _machine(), _settings(), name, *about)
    return hashlib.sha256("\n".join(words).encode()).hexdigest()


def _read(path: Path, args: tuple[Any, ...]) -> Any:
    """The program in a file; None if there is no such file, or it is not whole."""
    try:
        program, results = pickle.loads(zlib.decompress(path.read_bytes()))
        _register_linear_algebra()
        trees = jax.tree.structure((args, {})), jax.tree.structure(results)
        loaded = serialize_executable.deserialize_and_load(program, *trees)
    except FileNotFoundError:
        return None
    except Exception:  # whatever a file holds that is torn, or of another version
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # what was not used for longest is removed first
    return loaded


def _compiled(path: Path, lowered: Any) -> Any:
    """The program, compiled now and put into the file, if that is possible."""
    before = _hits_of_jax()[0]
    program = lowered.compile()
    if _hits_of_jax()[0] > before:  # what XLA has loaded, it can't write again as a whole on a CPU
        return program
    with contextlib.suppress(Exception):  # not every program can be kept, nor every folder be written
        found, _, tree = serialize_executable.serialize(program)
        # The tree of the results, as results: of those pickle knows the classes.
        results = jax.tree.unflatten(tree, range(tree.num_leaves))
        unfinished = path.with_name(f"{path.name}.{os.getpid()}{SUFFIX}")
        with at_last(functools.partial(unfinished.unlink, missing_ok=True)):
            unfinished.write_bytes(zlib.compress(pickle.dumps((found, results)), 1))
            os.replace(unfinished, path)
    return program


@functools.cache
def _hits_of_jax() -> list[int]:
    """How many programs JAX has found in its own cache from now on."""
    hits = [0]

    def count(event: str, **_: Any) -> None:
        hits[0] += event == "/jax/compilation_cache/cache_hits"

    jax.monitoring.register_event_listener(count)
    return hits


@functools.cache
def _register_linear_algebra() -> None:
    """Have XLA know LAPACK's functions, which otherwise the first program that uses them sees to."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.eye(2))


def _settings() -> str:
    """JAX's settings, those of this thread included."""
    values = [getattr(jax.config, x, None) for x in jax.config.values if "cache" not in x]
    return ",".join(map(str, (*values, jax.sharding.get_abstract_mesh())))


@functools.cache
def version_of_code() -> str:
    """A name for our code and the packages that it is traced with."""
    code = hashlib.sha256(sys.version.encode())
    for name in TRACED_WITH:
        code.update(f"{name} {metadata.version(name)}".encode())
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        code.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return code.hexdigest()[:32]


@functools.cache
def _machine() -> str:
    device = jax.devices()[0]
    about = [platform.machine(), device.platform, device.device_kind, device.client.platform_version]
    with contextlib.suppress(OSError, StopIteration), open("/proc/cpuinfo") as lines:
        about.append(next(line for line in lines if line.startswith(("flags", "Features"))))
    return "\n".join((*about, os.environ.get("XLA_FLAGS", "")))


def _spelled(value: Any, arrays: bool = False) -> str:
    """`value` in words; of leaves only type, shape and dtype if they are `arrays` that a program takes."""
    if arrays and isinstance(value, (np.ndarray, np.generic, jax.Array, bool, int, float, complex)):
        if isinstance(value, jax.Array) and (value.devices() != set(jax.devices()) or _has_mesh(value)):
            raise NoStableName
        kind = jax.typeof(value)
        return f"{kind.dtype}{kind.shape}{kind.weak_type}"
    if isinstance(value, enum.Enum):
        return f"{_name(type(value))}.{value.name}"
    if type(value) in _WORDS:
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, np.dtype):
        return f"dtype {value.str}"
    if isinstance(value, np.generic | np.ndarray):
        return f"{value.dtype}{value.shape}{np.asarray(value).tobytes().hex()}"
    if isinstance(value, type | FunctionType | functools._lru_cache_wrapper):
        return _name(value)
    if isinstance(value, functools.partial):
        return f"partial{_spelled((value.func, value.args, value.keywords), arrays)}"
    if isinstance(value, tuple | list):
        return f"{_name(type(value))}({','.join(_spelled(x, arrays) for x in value)})"
    if isinstance(value, dict):
        return f"dict({','.join(f'{_spelled(k)}:{_spelled(x, arrays)}' for k, x in value.items())})"
    if dataclasses.is_dataclass(value):
        return f"{_name(type(value))}({','.join(_fields(value, arrays))})"
    raise NoStableName


def _has_mesh(value: jax.Array) -> bool:
    return not isinstance(value.sharding, jax.sharding.SingleDeviceSharding)


def _fields(value: Any, arrays: bool) -> list[str]:
    """The fields of a dataclass, static ones by their values."""
    of = [(field.name, arrays and not field.metadata.get("static")) for field in dataclasses.fields(value)]
    return [f"{name}={_spelled(getattr(value, name, None), leaves)}" for name, leaves in of]


def _name(value: Any) -> str:
    """Where a class or function is defined, if that is in code whose versions we tell apart."""
    module, name = getattr(value, "__module__", None) or "", getattr(value, "__qualname__", "<")
    if "<" in name or module.split(".")[0] not in ("builtins", "jaxfit", *TRACED_WITH):
        raise NoStableName
    return f"{module}.{name}"
