"""Solvers of normal matrices: direct and by CG, with held and surplus control points, with derivatives."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from test_normal_matrices import surface_of, system_of

from jaxfit._normal_equations import (
    BlockCholesky,
    NormalOperator,
    Stencil,
    TensorPreconditionedCG,
    free_points,
)
from jaxfit._normal_equations._block_cholesky import factorise, substitute
from jaxfit._normal_equations._coupled_preconditioner import inverse_roots


@pytest.fixture(scope="module")
def stencil():
    system, _, _ = system_of(surface_of((4, 4), extra=(3, 5)))
    return jax.jit(lambda system: system.stencil())(system)


def held_of(stencil):
    held = np.random.default_rng(3).random(stencil.diagonal.shape) < 0.2
    held[0] = True
    return held


def dense(stencil, free):
    free = np.asarray(free).ravel()
    matrix = np.asarray(stencil.dense())
    return np.where(np.outer(free, free), matrix, np.diag(~free).astype(float))


@jax.jit
def solved(stencil, free, right):
    return lx.linear_solve(NormalOperator(stencil, free, right.shape[2]), right, BlockCholesky()).value


@pytest.mark.parametrize("solver", [BlockCholesky(), TensorPreconditionedCG(rtol=1e-13)])
def test_the_solution_is_that_of_the_dense_system(stencil, solver):
    free = ~held_of(stencil)
    right = np.random.default_rng(4).normal(size=(*free.shape, 3))
    operator = NormalOperator(stencil, free, 3)
    net = jax.jit(lambda operator, right: lx.linear_solve(operator, right, solver).value)(operator, right)
    expected = np.linalg.solve(dense(stencil, free), right.reshape(-1, 3))
    assert np.abs(np.asarray(net).reshape(-1, 3) - expected).max() < 1e-10 * np.abs(expected).max()
    assert np.abs(np.asarray(net)[~free] - right[~free]).max() < 1e-10


def test_directions_may_be_exchanged(stencil):
    free = jnp.asarray(~held_of(stencil))
    right = jnp.asarray(np.random.default_rng(4).normal(size=(*free.shape, 3)))
    turned = solved(stencil.with_directions_swapped(), free.T, right.transpose(1, 0, 2))
    assert np.abs(np.asarray(turned.transpose(1, 0, 2) - solved(stencil, free, right))).max() < 1e-10


def test_control_points_without_data_are_not_free(stencil):
    some = np.asarray(stencil.entries).copy()
    some[:, :, -1] = some[:, :, :, -1] = 0.0
    free = np.asarray(free_points(Stencil(some), held_of(stencil)))
    assert not free[-1].any()
    assert not free[:, -1].any()
    assert not free[0].any()
    assert free.any()


def test_the_operator_is_a_lineax_operator(stencil):
    free = ~held_of(stencil)
    operator = NormalOperator(stencil, free, 1)
    matrix = np.asarray(operator.as_matrix())
    assert np.abs(matrix - dense(stencil, free)).max() < 1e-13
    assert np.abs(np.asarray(lx.diagonal(operator)) - np.diag(matrix)).max() < 1e-13
    assert lx.is_symmetric(operator)
    assert not lx.is_diagonal(operator)


def test_derivatives_go_through_the_solution(stencil):
    free = jnp.asarray(~held_of(stencil))
    rng = np.random.default_rng(5)
    right, change, pull = (jnp.asarray(rng.normal(size=(*free.shape, 3))) for _ in range(3))
    bump = Stencil(1e-2 * stencil.entries * jnp.asarray(rng.random(stencil.entries.shape)))

    def value(x):
        return jnp.sum(pull * solved(stencil.plus(bump.times(x)), free, right + x * change))

    step = 1e-5
    difference = (value(jnp.asarray(step)) - value(jnp.asarray(-step))) / (2 * step)
    slope = jax.jit(jax.grad(value))(jnp.asarray(0.0))
    assert abs(float(slope - difference)) < 1e-6 * abs(float(difference))


@pytest.mark.float32_too
def test_factors_in_single_precision_keep_large_shapes():
    count, stiff = 40, 3e3
    bends = np.diff(np.eye(count), 2, axis=0)
    bending, unit = bends.T @ bends, np.eye(count)
    matrix = np.kron(unit, unit) + stiff * (np.kron(bending, unit) + np.kron(unit, bending))
    entries = np.zeros((3, 3, count, count))
    for a in range(3):
        entries[a, 0, : count - a] += stiff * np.diagonal(bending, a)[:, None]
        entries[0, a, :, : count - a] += stiff * np.diagonal(bending, a)[None]
    entries[0, 0] += 1.0
    right = np.sin(np.linspace(0, 3, count))[:, None] * np.cos(np.linspace(0, 2, count))
    exact = np.linalg.solve(matrix, right.ravel()).reshape(count, count)
    factors = factorise(Stencil(jnp.asarray(entries, jnp.float32)), jnp.ones((count, count), bool))
    found = substitute(factors, jnp.asarray(right[None], jnp.float32))[0]
    assert float(factors.shift) == 0.0
    assert np.linalg.norm(found - exact) < 0.02 * np.linalg.norm(exact)


@pytest.mark.parametrize("shape", [(4, 9), (9, 4)])
def test_inverse_roots_are_those_of_each_block_of_wide_and_of_tall_nets(shape):
    factors = np.random.default_rng(5).normal(size=(*shape, 3, 3))
    blocks = factors @ factors.swapaxes(2, 3) + np.eye(3)
    roots = np.moveaxis(np.asarray(inverse_roots(jnp.asarray(blocks))), (0, 1), (2, 3))
    np.testing.assert_allclose(roots, roots.swapaxes(2, 3), atol=1e-12)
    np.testing.assert_allclose(roots @ roots @ blocks, np.broadcast_to(np.eye(3), blocks.shape), atol=1e-10)
