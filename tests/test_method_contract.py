"""A new method of approximation, written from public names alone, runs wherever the library's own do."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CHECKOUT, wavy_cloud

import jaxfit as jf


class HeavyBall(jf.AbstractIterativeMethod):
    """Algorithm 1 with a constant momentum; a step after which the average error has risen starts anew."""

    momentum: float = 0.5
    stall_window: int = 40
    stall_gain: float = 1e-3
    stall_since = 0
    finds_feet = True

    class State(eqx.Module):
        sums: Any
        velocity: jax.Array

    def init(self, problem, surface, projection):
        net = surface.control_points
        still = np.zeros_like(net) if isinstance(net, np.ndarray) else jnp.zeros_like(net)
        return surface, self.State(jf.ControlPointSums().zeros(net), still)

    def measure(self, problem, iterate, exact):
        before = iterate.projection
        feet, found = jf.update_feet(
            jf.Newton(),
            iterate.surface.pieces,
            problem.target,
            before.u,
            before.v,
            1e-12 * problem.diagonal,
            idle=~jnp.asarray(problem.real),
            sums=jf.ControlPointSums(),
            weight=problem.weight,
        )
        active = jnp.sum(problem.counted, dtype=jnp.int32)
        parts = feet.u, feet.v, feet.error, feet.evaluations, feet.converged
        here = jf.FootPoints(*parts, active, jnp.asarray(True))
        return here, self.State(found, iterate.state.velocity)

    def accept(self, problem, old, new):
        return new

    def move(self, problem, iterate, history):
        surface, state = iterate.surface, iterate.state
        risen = history.has_risen(iterate.step)
        velocity = jnp.where(risen, 0.0, self.momentum * state.velocity) + state.sums.means
        held = jf.held_points(jf.FixedBorder(), velocity.shape, surface.used)
        velocity = jnp.where(held[..., None], 0.0, velocity)
        surface = surface.moved_to(surface.control_points + velocity)
        state = self.State(state.sums, velocity)
        return jf.Iterate(surface, iterate.projection, state, iterate.step + 1), history

    def postprocess(self, problem, iterate, stopped_early):
        return iterate, {"speed": jnp.sqrt(jnp.sum(iterate.state.velocity**2))}


POINTS, EDGES = wavy_cloud(300)
OPTIONS = dict(tol_average=2e-4, max_steps=60)


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(7, 6))


@pytest.fixture(scope="module")
def fit(base):
    return jf.approximate(POINTS, base, HeavyBall(), **OPTIONS)


def test_it_fits_with_a_history_and_a_reason(base, fit):
    plain = jf.GeometricApproximation(relaxation=1.0, acceleration=None)
    assert bool(fit.converged)
    assert fit.message == "all tolerances are met."
    steps = int(fit.stats["num_steps"])
    assert fit.history.average.shape == (steps + 1,)
    assert steps < int(jf.approximate(POINTS, base, plain, **OPTIONS).stats["num_steps"])
    assert fit.stats["method"] == "HeavyBall"
    assert float(fit.stats["speed"]) > 0


def test_it_runs_the_whole_way_from_a_cloud(fit):
    whole = jf.fit_points(POINTS, jf.Boundary(**EDGES), net=(7, 6), method=HeavyBall(), **OPTIONS)
    assert bool(whole.converged)


@pytest.mark.slow
def test_reports_of_progress_change_nothing(base, monkeypatch):
    """What a method would end with is not what it goes on with."""

    def halfway(self, problem, old, new):
        net = 0.5 * (old.surface.control_points + new.surface.control_points)
        return jf.Iterate(new.surface.moved_to(net), new.projection, new.state, new.step)

    def shifted(self, problem, iterate, stopped_early):
        surface = iterate.surface.moved_to(iterate.surface.control_points + 0.5)
        return jf.Iterate(surface, iterate.projection, iterate.state, iterate.step), {}

    monkeypatch.setattr(HeavyBall, "accept", halfway)
    monkeypatch.setattr(HeavyBall, "postprocess", shifted)
    method, options = HeavyBall(stall_window=41), dict(tol_average=0.0, max_steps=9)
    quiet, reported = (
        jf.approximate(POINTS, base, method, **options, progress=x) for x in (None, lambda *_: None)
    )
    np.testing.assert_array_equal(quiet.surface.control_points, reported.surface.control_points)


def test_it_runs_in_jit_and_vmap(base, fit):
    def net(points):
        return jf.approximate(points, base, HeavyBall(), **OPTIONS).surface.control_points

    batch = jax.jit(jax.vmap(net))(jnp.stack([POINTS, POINTS + 0.01]))
    assert np.abs(np.asarray(batch[0] - fit.surface.control_points)).max() < 1e-12
    assert np.abs(np.asarray(batch[1] - jax.jit(net)(jnp.asarray(POINTS) + 0.01))).max() < 1e-12


@pytest.mark.slow
def test_its_iterations_have_a_derivative(base):
    def corner(points):
        fit = jf.approximate(points, base, HeavyBall(), max_steps=3, adjoint=jf.UnrolledAdjoint())
        return fit.surface(0.3, 0.6)[2] + jnp.sum(fit.errors)

    points = jnp.asarray(POINTS)
    along = jnp.asarray(np.random.default_rng(1).normal(size=points.shape))
    slope = (float(corner(points + 1e-6 * along)) - float(corner(points - 1e-6 * along))) / 2e-6
    assert float(jnp.vdot(jax.grad(corner)(points), along)) == pytest.approx(slope, rel=1e-5)


def test_the_loop_names_no_method():
    names = "Geometric|Standard|Orthogonal|Nesterov|momentum|fairing|damping|insertion|smoothing|isinstance"
    for name in ("_loop.py", "_method.py"):
        source = (CHECKOUT / "jaxfit" / "_fit" / name).read_text()
        assert not re.search(names, source, re.IGNORECASE) or name == "_method.py"
    drivers = ("_approximate.py", "_fit_points.py", "_checked_arguments.py")
    for name in drivers:
        assert "isinstance(method" not in (CHECKOUT / "jaxfit" / "_approximation" / name).read_text()
