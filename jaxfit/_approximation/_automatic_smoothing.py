r"""`GeneralizedCrossValidation` and `Discrepancy`: lambda chosen from the data.

With the parameters of the points held, the fit is linear in the data, $A P = H(\lambda) Q$. Each lambda takes
one factorisation of $S + \lambda A_{fair}$, S being the normal matrix of the data. It gives two numbers: the
residual sum of squares $|Q - A P|^2$, in space along the normals only, since parameter correction removes the
tangential part; and the effective number of parameters,
$\operatorname{tr} H = \operatorname{tr} S (S + \lambda A_{fair})^{-1}$, estimated from random signs.
"""

from abc import abstractmethod
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._approximation._linear_least_squares import least_squares_problem
from jaxfit._cells import evaluate_jet, row_coefficients
from jaxfit._checks import check_number
from jaxfit._compile import compiled
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import BlockCholesky, NormalOperator, RegularisedSystem, free_points
from jaxfit._splines._pieces import pieces_on

DECADES = (-9.0, 3.0)  # around where both parts of the matrix have the same trace
# A surface with so many points for each effective parameter does not follow noise. Where feet on it have a
# lambda that is FOLLOWS times as large, those on the given surface follow noise.
FEW, FOLLOWS = 128.0, 10.0


class SmoothingCandidates(eqx.Module):
    """Several lambdas in increasing order, each with its residual and its effective number of parameters."""

    smoothing: Float[Array, " lambdas"]
    remaining: Float[Array, " lambdas"]  # weighted sum of squared residuals
    effective: Float[Array, " lambdas"]  # number of parameters, for each coordinate
    points: Float[Array, ""]


class AbstractSmoothing(eqx.Module):
    """A rule that selects lambda."""

    @abstractmethod
    def best(self, candidates: SmoothingCandidates) -> Float[Array, ""]:
        """The lambda to take."""


class GeneralizedCrossValidation(AbstractSmoothing):
    r"""The lambda that would predict left-out points best.

    It minimises $|Q - A P|^2 / (N - \operatorname{tr} H)^2$ over N points.

    The noise need not be known. It must be independent from point to point, and the parameters must not
    follow it. They do follow it on a base made with the points (`Meshless`) where the noise is as large as
    the distances between points. Therefore lambda is also selected at closest points on a surface with one
    effective parameter for 128 points, and taken where it is ten times as large. In the derivative of a fit
    the lambda that was found counts as a constant. Golub, Heath and Wahba, Technometrics 21 (1979).

    Parameters
    ----------
    candidates : int
        The number of lambdas (default 17), spaced evenly in their logarithm over twelve decades. A parabola
        through the best three gives the minimum.
    rounds : int
        The number of selections (default 2): at the first parameters, then at corrected ones. With 1 no
        smoother surface is tried.

    Raises
    ------
    ValueError
        If there are fewer than 3 candidates, or fewer than 1 round.
    TypeError
        If one of them is no number.

    Examples
    --------
    >>> jf.StandardApproximation(smoothing=jf.GeneralizedCrossValidation(candidates=9)).smoothing.rounds
    2
    """

    candidates: int = 17
    rounds: int = 2

    def __check_init__(self) -> None:
        _check_counts(self)

    def best(self, candidates: SmoothingCandidates) -> Float[Array, ""]:
        """The interpolated minimum."""
        return _cross_validated(candidates)


class Discrepancy(AbstractSmoothing):
    """The largest lambda whose residual does not exceed the noise: Morozov's discrepancy principle.

    Where even the smallest lambda leaves a larger residual, the net and not lambda limits the fit. The rule
    of `GeneralizedCrossValidation` then applies.

    Parameters
    ----------
    noise : float
        Standard deviation of the distance between a point of weight 1 and the true surface, as a fraction of
        the diagonal of the data's bounding box: of noise that is alike in all directions, that of one
        coordinate.
    candidates, rounds : int
        As for GeneralizedCrossValidation.

    Raises
    ------
    ValueError
        If `noise` is negative or not finite, or there are fewer than 3 candidates or fewer than 1 round.
    TypeError
        If one of them is no number.

    Notes
    -----
    V. A. Morozov, On the solution of functional equations by the method of regularization, Soviet Mathematics
    Doklady 7, 1966.

    Examples
    --------
    >>> jf.StandardApproximation(smoothing=jf.Discrepancy(noise=1e-3)).smoothing.noise
    0.001
    """

    noise: float
    candidates: int = 17
    rounds: int = 2

    def __check_init__(self) -> None:
        check_number("noise", self.noise, 0.0)
        _check_counts(self)

    def best(self, candidates: SmoothingCandidates) -> Float[Array, ""]:
        """The lambda at which the residual sum of squares equals that of the noise."""
        goal = jnp.log(candidates.points) + 2.0 * np.log(max(self.noise, 1e-30))
        remaining = lax.cummax(jnp.log(candidates.remaining))
        passed = jnp.exp(jnp.interp(goal, remaining, jnp.log(candidates.smoothing)))
        return jnp.where(remaining[0] <= goal, passed, _cross_validated(candidates))


def _cross_validated(candidates: SmoothingCandidates) -> Float[Array, ""]:
    left = 1.0 - candidates.effective / candidates.points
    score = jnp.log(candidates.remaining) - 2.0 * jnp.log(jnp.maximum(left, 1e-3))
    k = jnp.clip(jnp.argmin(score), 1, score.shape[0] - 2)
    low, middle, high = score[k - 1], score[k], score[k + 1]
    bend = low - 2.0 * middle + high
    offset = jnp.where(bend > 0, 0.5 * (low - high) / jnp.where(bend > 0, bend, 1.0), 0.0)
    logarithm = jnp.log(candidates.smoothing)
    step = logarithm[1] - logarithm[0]
    return jnp.exp(logarithm[k] + jnp.clip(offset, -1.0, 1.0) * step)


def _least_of_few(candidates: SmoothingCandidates) -> Float[Array, ""]:
    """The lambda that leaves one effective parameter to FEW points, too few to follow their noise."""
    effective = lax.cummax(candidates.effective[::-1])
    return jnp.exp(jnp.interp(candidates.points / FEW, effective, jnp.log(candidates.smoothing[::-1])))


def _check_counts(rule: Any) -> None:
    check_number("candidates", rule.candidates, 3, whole=True)
    check_number("rounds", rule.rounds, 1, whole=True)


PROBES = 16


def evaluate_candidates(
    system: RegularisedSystem, held: Bool[Any, "nu nv"], net: Float[Array, "nu nv d"], count: int
) -> SmoothingCandidates:
    """All candidates for the correction of `net`; one factorisation for each."""
    data, plate = system.data_stencil(), system.plate.stencil()
    free = free_points(data.plus(plate), held)
    mask = jnp.asarray(free)[:, :, None]
    traces = [jnp.sum(jnp.where(free, x.diagonal, 0.0)) for x in (data, plate)]
    tiny = jnp.finfo(net.dtype).tiny
    decades = jnp.asarray(np.linspace(*DECADES, count), net.dtype)
    smoothing = 10.0**decades * traces[0] / jnp.maximum(traces[1], tiny)
    residual = system.data_residual(net)
    data_rhs = jnp.where(mask, -system.data_adjoint(residual), 0.0)
    plate_rhs = jnp.where(mask, -plate(net), 0.0)
    signs = np.random.default_rng(0).integers(0, 2, (*net.shape[:2], PROBES)) * 2.0 - 1.0
    probes = jnp.where(mask, jnp.asarray(signs, net.dtype), 0.0)
    d = net.shape[2]
    normal = _normals(system, net) if d == 3 else None

    def one(value: Array) -> tuple[Array, Array]:
        operator = NormalOperator(data.plus(plate.times(value)), free, d + PROBES)
        solver = BlockCholesky()
        right = jnp.concatenate([data_rhs + value * plate_rhs, probes], axis=2)
        solution, _, _ = solver.compute(solver.init(operator, {}), right, {})
        left = system.data_residual(net + solution[:, :, :d])
        across = left if normal is None else jnp.sum(normal * left, axis=0)
        return jnp.sum(across**2), jnp.sum(probes * data(solution[:, :, d:])) / PROBES

    remaining, effective = lax.map(one, smoothing)
    remaining = jnp.maximum(remaining, tiny)
    points = jnp.sum(system.root > 0).astype(net.dtype)
    return SmoothingCandidates(smoothing, remaining, effective, points)


def _normals(system: RegularisedSystem, net: Float[Array, "nu nv 3"]) -> Float[Array, "3 rows width"]:
    """Unit normals at the points' parameters; 0 where there is none."""
    pieces = pieces_on(net, system.axis_u, system.axis_v)
    jet = evaluate_jet(row_coefficients(pieces, system.rows), system.s, system.t)
    normal = jnp.cross(jet.s, jet.t, axis=0)
    square = jnp.sum(normal**2, axis=0)
    return normal * jnp.where(square > 0, lax.rsqrt(jnp.where(square > 0, square, 1.0)), 0.0)[None]


def select_smoothing(
    rule: Any, method: Any, problem: Problem, surface: WorkingSurface, projection: FootPoints
) -> Float[Array, ""]:
    """The lambda for a fit that starts from `surface` and its feet."""
    without = eqx.tree_at(lambda m: m.smoothing, method, 0.0)
    return _select(rule, without, problem, surface, projection)


@partial(compiled, kept=True, static_argnums=(0, 1))
def _select(
    rule: Any, method: Any, problem: Problem, surface: WorkingSurface, projection: FootPoints
) -> Float[Array, ""]:
    """Each round selects lambda, solves with it, and corrects the parameters."""
    held, diagonal, net = method.held(surface), problem.diagonal, surface.control_points
    start = eqx.tree_at(lambda p: p.exact, projection, jnp.asarray(True))

    def selected(first: Any) -> Float[Array, ""]:
        """The lambda after all rounds, and before them `first` rounds that keep to few parameters."""

        def one_round(index: Any, last: tuple[Array, FootPoints, Array]) -> tuple[Array, FootPoints, Array]:
            net, here, _ = last
            system = method.system(problem, surface.moved_to(net), here, jnp.zeros((), net.dtype))
            candidates = evaluate_candidates(system, held, net, rule.candidates)
            scaled = eqx.tree_at(lambda c: c.remaining, candidates, candidates.remaining / diagonal**2)
            smoothing, least = rule.best(scaled), _least_of_few(candidates)
            smoothing = jnp.where(index < first, jnp.maximum(smoothing, least), smoothing)
            system = eqx.tree_at(lambda s: s.smoothing, system, smoothing)
            net, _ = method.solver(least_squares_problem(system, held, net))
            return net, method.project(problem, surface.moved_to(net), here), smoothing

        rounds = first + rule.rounds if method.parameter_correction else 1
        return lax.fori_loop(0, rounds, one_round, (net, start, jnp.zeros((), net.dtype)))[2]

    if rule.rounds == 1 or not method.parameter_correction:
        return selected(0)
    given, smooth = lax.map(selected, jnp.arange(2))
    return jnp.where(smooth > FOLLOWS * given, smooth, given)
