"""Points divided among devices, and among processes, have the fits of one device."""

import json
import os
import socket
import subprocess
import sys

import pytest
from helpers import CHECKOUT

TESTS = CHECKOUT / "tests"
SECONDS = 600  # a machine that others use, too
METHODS = ("geometric", "standard", "orthogonal")
pytestmark = pytest.mark.slow
MOST_REDUCTIONS = 3  # in an iteration


def environment(devices):
    paths = os.pathsep.join(map(str, (CHECKOUT, TESTS)))
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    session = {"JAX_ENABLE_X64": "1", "JAX_NUMPY_RANK_PROMOTION": "raise", "JAX_PLATFORMS": "cpu"}
    session |= {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": flags.strip(), "PYTHONPATH": paths}
    return {**os.environ, **session}


@pytest.fixture(scope="module")
def eight():
    """What the program found on eight devices."""
    program = [sys.executable, str(TESTS / "devices_program.py")]
    done = subprocess.run(
        program, env=environment(8), capture_output=True, text=True, timeout=SECONDS, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", METHODS)
def test_points_on_eight_devices_have_the_fit_of_one(eight, name):
    found = eight[name]
    assert found["result"]
    for part in ("net", "errors", "feet", "averages"):
        assert found[part] < 1e-10, part


def test_a_large_net_on_eight_devices_comes_to_an_end(eight):
    assert eight["large"]["net"] < 1e-10


@pytest.mark.parametrize("name", [*METHODS, "large"])
def test_only_sums_of_the_size_of_the_net_go_between_devices(eight, name):
    sent = eight[name]["sent"]
    in_loop = [size for size, repeated in sent if repeated]
    assert 0 < len(in_loop) <= MOST_REDUCTIONS
    control_points = 42 * 42 if name == "large" else 7 * 6
    assert max(size for size, _ in sent) < 150 * control_points  # moments of its cells


@pytest.mark.parametrize("name", METHODS)
def test_what_belongs_to_points_stays_on_their_devices(eight, name):
    assert eight[name]["rows"] == [2501] * 3


def test_each_device_fits_its_own_clouds_in_a_shard_map_of_the_user(eight):
    assert eight["batch"] < 1e-12


SENTENCES = {
    "adjoint": "adjoint must be None where points are divided among devices; ",
    "progress": "progress must be None where points are divided among devices; ",
    "insertion": "the method's insertion must be None where points are divided among devices, but is ",
    "loss": "the method's loss must be Tukey(scale) where points are divided among devices, but is ",
    "weights": "weights must not be negative and not all zero; ",
    "number of weights": "weights must hold one number for each of the 20008 points, but has shape (20001,)",
    "length of start": "start must hold a u and a v for each of the 20008 points, but their shapes are (80,)",
    "start": "start v must lie in the domain [0, 1] of the base surface, but reaches from 0 to 5; ",
    "points": "points and weights must be finite, but 20008 points have an entry that is not; ",
}


@pytest.mark.parametrize("name", SENTENCES)
def test_what_needs_all_points_together_is_refused_in_a_sentence(eight, name):
    assert eight["refused"][name].startswith(SENTENCES[name])


def test_two_processes_have_the_fit_of_one():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    program = [sys.executable, str(TESTS / "processes_program.py")]
    running = [
        subprocess.Popen(
            [*program, str(k), address],
            env=environment(2),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(2)
    ]
    try:
        said = [process.communicate(timeout=SECONDS) for process in running]
    finally:
        for process in running:
            process.kill()
    for process, (_, wrong) in zip(running, said, strict=True):
        assert process.returncode == 0, wrong[-3000:]
    for out, _ in said:
        for found in json.loads(out.splitlines()[-1]):
            assert found["apart"] < 1e-10
            assert (found["rows"], found["devices"]) == (4 * 751, 4)
