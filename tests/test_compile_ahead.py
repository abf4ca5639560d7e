"""Programs are compiled by threads ahead of their calls: once, and as the calls will need them."""

from concurrent.futures import Future

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, slow_except, wavy_cloud, wavy_grid

import jaxfit as jf
from jaxfit import _compile, _compile_ahead
from jaxfit._compile import compiled
from jaxfit._compile_ahead import compile_ahead, wait_for_program
from jaxfit._fit import _loop

X = np.linspace(0.0, 1.0, 7)


def made_of(x, factor):
    return factor * jnp.sin(x) @ jnp.cos(x)


def test_the_call_takes_what_was_compiled_ahead():
    program = compiled(made_of, kept=True)
    with count_compilations() as found:
        program.ahead(np.zeros(7), 1.0)
        program.ahead(np.ones(7), 2.0)
        result = program(X, 3.0)
    assert found.count == 1
    assert float(result) == pytest.approx(3.0 * np.sin(X) @ np.cos(X))
    with count_compilations() as found:
        program(np.zeros(8), 1.0)
    assert found.count > 0


def test_xla_knows_our_options():
    program = jax.jit(made_of, compiler_options=_compile.FOR_CPUS).lower(X, 1.0).compile()  # or it raises
    assert float(program(X, 3.0)) == pytest.approx(3.0 * np.sin(X) @ np.cos(X))


def test_what_goes_wrong_in_the_thread_is_raised_by_the_call():
    impossible = jax.jit(made_of, compiler_options={"xla_of_another_world": True})
    compile_ahead(impossible, 0, (X, 1.0))
    wait_for_program(impossible, 0, (X, 1.0))
    with pytest.raises(jax.errors.JaxRuntimeError, match=_compile.UNKNOWN):
        impossible(X, 1.0)


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(_compile, "_options", lambda _: {"xla_of_another_world": True})
    program = compiled(made_of, kept=True)
    program.ahead(X, 1.0)
    assert float(program(X, 1.0)) == pytest.approx(np.sin(X) @ np.cos(X))
    program.ahead(X, 2.0)


POINTS, BOUNDARY = wavy_cloud(310)[0], jf.Boundary.from_grid(wavy_grid(30, 30))
CHEBYSHEV = jf.GeometricInterpolation(acceleration=jf.Chebyshev())
CALLS = {
    "a net given": lambda: jf.fit_points(POINTS, BOUNDARY, net=(7, 11), max_steps=7),
    "Meshless": lambda: jf.fit_points(POINTS, BOUNDARY, net=(11, 7), base=jf.Meshless(), order=(3, 4)),
    "a grid": lambda: jf.interpolate(wavy_grid(13, 5), order=(3, 4)),
    "Chebyshev": lambda: jf.interpolate(wavy_grid(5, 13), CHEBYSHEV),
}
LARGE = ("_advance", "_advanced", "_run", "linearisation", "_along_inputs", "_program")


@pytest.mark.parametrize("name", slow_except(CALLS, "a net given", "a grid"))
def test_fits_compile_ahead_and_no_program_in_vain(name, monkeypatch):
    waited = []
    monkeypatch.setattr(_compile_ahead, "wait", lambda futures: waited.append(futures[0].result()))
    with count_compilations() as found:
        CALLS[name]()
    large = [program for program in found.names if any(name in program for name in LARGE)]
    assert 0 < len(large) == len(set(large)) == len(waited)


@pytest.mark.slow
def test_a_gradient_compiles_ahead_and_no_zeros(monkeypatch):
    def error(points):
        options = dict(net=(7, 6), method=jf.OrthogonalDistance(smoothing=1e-4), tol_average=1e-12)
        return jf.fit_points(points, BOUNDARY, **options).average_error

    waited = []
    monkeypatch.setattr(_compile_ahead, "wait", lambda futures: waited.append(futures[0].result()))
    with count_compilations() as found:
        jax.grad(error)(jnp.asarray(POINTS))
    large = [program for program in found.names if any(name in program for name in LARGE)]
    assert len(large) == len(set(large)) == len(waited) == len(LARGE)
    assert sum("broadcast_in_dim" in program for program in found.names) < 5


def test_a_method_without_a_derivative_says_so_before_its_loop_compiles():
    options = dict(net=(7, 10), method=jf.GeometricApproximation.paper(insertion=None), max_steps=9)

    def error(points):
        return jf.fit_points(points, BOUNDARY, **options).average_error

    with count_compilations() as found, pytest.raises(TypeError, match="has no derivative"):
        jax.grad(error)(jnp.asarray(POINTS))
    assert "jit(_advance)" not in found.names
    assert not _compile_ahead._coming


def test_a_grid_without_extent_is_refused_before_its_loop_compiles():
    flat = np.repeat(wavy_grid(12, 6)[:1], 12, axis=0)
    with count_compilations() as found, pytest.raises(ValueError, match="grid must extend along its first"):
        jf.interpolate(flat)
    assert "jit(_advance)" not in found.names
    assert not _compile_ahead._coming


def test_a_method_that_takes_no_feet_made_up_is_fitted_all_the_same(monkeypatch):
    begun, begin = [], _loop.begin

    def not_at_first(*args):
        begun.append(args)
        if len(begun) == 1:
            raise ValueError("not from there")
        return begin(*args)

    monkeypatch.setattr(_loop, "begin", not_at_first)
    method = jf.StandardApproximation(parameter_correction=False)
    fit = jf.fit_points(POINTS, BOUNDARY, net=(8, 9), method=method)
    assert begun
    assert float(fit.average_error) < 1e-2


def test_a_forked_process_waits_for_no_thread_of_its_parent(monkeypatch):
    monkeypatch.setattr(_compile_ahead, "_coming", {"never": Future()})
    before = _compile_ahead._threads()
    _compile_ahead._forget()
    assert not _compile_ahead._coming
    assert _compile_ahead._threads() is not before
    before.shutdown()


def test_without_jit_nothing_is_compiled():
    with count_compilations() as found, jax.disable_jit():
        compile_ahead(jax.jit(made_of), 0, (X[:5], 1.0))
    assert found.count == 0
