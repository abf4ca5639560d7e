r"""`RegularSmoothing`: follows the errors, and is raised where a step would fold the surface."""

import dataclasses
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._approximation._folds import folds_by_cell, near_folds
from jaxfit._approximation._losses import DataTerm
from jaxfit._checks import Scalar, check_number, is_concrete
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import Roughness

# Below this share of the diagonal, distances are met with less smoothing yet, or else where a surface can
# be met exactly the last digits would come slowly.
FINE = 3e-5
LONGEST_HOLD = 3.0  # accepted steps for which control points stay, around folds that come again and again
# One of the first steps, if it would fold a surface that has had no folds, is taken again with factors so
# much greater everywhere: the more points there are to a control point, the stiffer a first step has to be.
EARLY_STEPS, STIFFER = 5, 4.0
# A base whose average error is less than NEAR spacings of the net begins with less smoothing and damping, as
# steps from there are seldom longer than control points may move; but with no less than LEAST_SHARE of them.
NEAR, LEAST_SHARE = 0.25, 0.01
# From a base farther away `first` grows in proportion to the number of points, from this one on, for each
# point pulls, but what it costs to bend the whole surface depends on the number neither of points nor of
# control points. With too little smoothing first steps crease what has yet to move, and parts are caught.
FEW_POINTS = 3000.0
FAR = 4.0  # times the average error, where folds have been kept out: out of reach
STUCK = 4.0  # times the least factor, around folds that a step has not removed
RAISED_FLOOR = 1.2  # a factor at which there was a fold, times this, is not gone below
FLOOR_FALL = 0.95  # at once: it falls by this with every accepted step
# After so many iterations, where folds had to be kept out, the surface is smoothed once more, from this share
# of the first factor: what was caught in a bad place is then free to settle in a better one. Not where the
# fit would end before that has faded again.
RENEWED_AT, RENEWED = 25, 0.5
LEAST_STEPS = RENEWED_AT + 15
SETTLED_AT = RENEWED_AT + 5  # errors that rise with the factors are none to compare later ones with


class RegularSmoothing(eqx.Module):
    r"""Smoothing relative to the tangents, as strong as the errors allow, stronger where a fold threatens.

    The smoothing term is

    $$\rho \sum_{ij} c_{ij} \Big(\frac{|D_{uu}|^2}{|D_u|^2}
      + |D_{uv}|^2 \Big(\frac1{|D_u|^2} + \frac1{|D_v|^2}\Big) + \frac{|D_{vv}|^2}{|D_v|^2}\Big),$$

    with differences D of the net at each control point, those in the denominators being of the net before the
    step. These are squared angles: how much the normal turns and the tangents change from one control point
    to the next. The thin plate is slack where the net is narrow, for there second derivatives are
    small; this term is not.

    $\rho$ is the mean square of the distances (weighted ones, over the number of points), and less where
    these are below 3e-5 of the diagonal on average. So the objective, divided by it, compares numbers without
    unit: a bend counts as much as some points at the usual distance. Smoothing fades where all points can be
    met, follows the noise where they cannot, and depends neither on the unit nor on the weights' scale. The
    more points there are to a control point, the less it bends the surface, as with any prior knowledge.

    The factors $c_{ij}$ fall from `first` to `least` from step to step. A step after which the surface would
    have more folds than before is rejected; the control points around the new ones stay where they are for
    the next one to three accepted steps, and their factors are raised and fall again more slowly. So a
    surface without folds remains so on the samples: 8 in each direction of a cell, whose normals may turn by
    60 degrees from one to the next. Points that ask for a fold remain far away. A part of the surface that
    folds were kept out of may be caught: too far from its points to follow them with the smoothing that their
    distances cause. So after 25 iterations, if folds were kept out anywhere and the fit may take 40, all
    factors rise once more, to half of `first`, and what has been raised around folds is forgotten.

    From a base surface without folds fewer steps are enough. Until a first fold has to be kept out, the
    factors fall by `fall` squared. If the distance of the points from the base is on average less than a
    quarter of the spacing of its free control points, the first factor is `first` times the square of the
    ratio of the two, or `least`, and the first damping is the square of the ratio. Where it is more, the
    first factor is `first` for up to 3,000 points and grows in proportion to their number: each of them pulls
    at the surface, while a bend of its whole shape costs the same for any number of points and any net. When
    a first fold has to be kept out, all factors rise to `first`; or, after 25 iterations and in fits that may
    not take 40, to what falling by `fall` from the beginning would have left. But if one of the first five
    iterations would fold while no factor has fallen below `first`, it is taken again with four times the
    factors everywhere: clouds with many points to a control point need that.

    Parameters
    ----------
    least : float
        The factor where nothing folds (default 3): a bend of 0.58 radian between two control points counts
        as one point at the usual distance.
    first : float
        The factor of the first step from a base surface far from the points, of which there are at most
        3,000 (default 100).
    fall : float
        The factor of the next step over that of an accepted one, between 0 and 1 (default 0.7).
    raised : float
        By how much factors are raised around a fold, more than 1 (default 2).
    most : float
        The factor up to which they are raised around folds (default 1000).

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    On scans of faces and terrain, with tolerances out of reach, average errors are less than those of a thin
    plate of weight 5e-6 against the sum over the points, and there are no folds. Where a surface is far
    smoother than its net, a coarser net or a greater `least` is better. `first` matters: the large shape has
    to settle before detail is followed, as it has in a base near the points. Smoothing once more took average
    errors of six fits of a head (nets of 30 x 30 to 50 x 50, some points left out) to 0.67 times what they
    are without.

    Source: this library's own. The thin plate that it departs from is equation (10) of Kineri, Wang, Lin and
    Maekawa (2012).

    Examples
    --------
    >>> jf.OrthogonalDistance(smoothing=jf.RegularSmoothing(least=1.0)).smoothing.least
    1.0
    """

    least: Scalar = 3.0
    first: Scalar = 100.0
    fall: Scalar = 0.7
    raised: Scalar = 2.0
    most: Scalar = 1000.0

    def __check_init__(self) -> None:
        for name in ("least", "first", "fall", "raised", "most"):
            check_number(name, getattr(self, name), 0.0)
        if not is_concrete((self.least, self.first, self.fall, self.raised, self.most)):
            return
        if not 0 < self.least <= self.first <= self.most:
            raise ValueError(
                "least, first and most must be positive and not decrease, but are "
                f"{self.least!r}, {self.first!r} and {self.most!r}; the defaults are 3, 100 and 1000."
            )
        if not 0 < self.fall < 1 < self.raised:
            raise ValueError(
                f"fall must lie between 0 and 1 and raised be greater than 1, but they are {self.fall!r} "
                f"and {self.raised!r}; the defaults are 0.7 and 2."
            )

    def begin(self, surface: WorkingSurface) -> tuple["FoldGuard", Roughness]:
        """Before the first step, and in place of a smoothing term nothing."""
        net = surface.control_points
        xp: Any = np if is_concrete(self.first, self.least) else jnp
        factor, floor, zero = (xp.full(net.shape[:2], x, net.dtype) for x in (self.first, self.least, 0.0))
        folds = np.zeros((surface.axis_u.cells, surface.axis_v.cells), net.dtype)
        nothing = _no_roughness(*(_kind(x) for x in (net, surface.knots_u, surface.knots_v, factor)))
        return FoldGuard(factor, floor, zero, zero, folds, xp.asarray(self.first, net.dtype)), nothing

    def penalty(
        self, guard: "FoldGuard", surface: WorkingSurface, diagonal: Array, term: DataTerm
    ) -> Roughness:
        """The smoothing term of a step from a surface at which the data term of the objective is `term`."""
        knots, net = (surface.knots_u, surface.knots_v), jnp.asarray(surface.control_points)
        least = jnp.finfo(net.dtype).tiny  # a root of 0 has no derivative
        distance = jnp.sqrt(jnp.maximum(term.cost / term.weight, least)) / diagonal
        rho = term.cost / term.points * jnp.minimum(distance / FINE, 1.0)
        return Roughness.of(net, *knots, rho * jnp.asarray(guard.factor))

    def after(
        self,
        old: "FoldGuard",
        new: "FoldGuard",
        better: Array,
        good: Array,
        order: Any,
        step: Any,
        max_steps: Any,
    ) -> "FoldGuard":
        """The factors after a step: `better` if its objective is lower, `good` if also accepted. Its number
        and the largest one say whether all factors may still rise and fade again.
        """
        in_time = (step <= RENEWED_AT) & (max_steps >= LEAST_STEPS)
        fresh = near_folds(jnp.maximum(new.folds - old.folds, 0.0), order) & better & ~good
        kept = near_folds(jnp.minimum(new.folds, old.folds), order) & good
        factor, floor, holds, held = jax.tree.map(jnp.asarray, (new.factor, new.floor, new.holds, new.held))
        no_fold_yet = jnp.sum(holds) + jnp.sum(old.folds) == 0
        first_fold = no_fold_yet & jnp.any(fresh)
        early = first_fold & (step <= EARLY_STEPS) & (jnp.min(factor) >= self.first)
        late = ~early
        fresh &= late
        factor = lax.select(early, STIFFER * factor, factor)
        again = in_time & (step == RENEWED_AT) & jnp.any(floor > self.least)
        raised_floor = jnp.maximum(jnp.minimum(RAISED_FLOOR * factor, self.most), floor)
        floor = lax.select(fresh, raised_floor, floor)
        floor = lax.select(good, jnp.maximum(FLOOR_FALL * floor, self.least), floor)
        factor = lax.select(good, jnp.maximum(self.fall ** (1 + no_fold_yet) * factor, floor), factor)
        usual = jnp.where(in_time, self.first, self.fall**step * new.first)
        usual = jnp.where(again, RENEWED * self.first, usual)
        risen = again | (first_fold & late)
        factor = lax.select(risen, jnp.maximum(factor, usual), factor)
        floor = jnp.where(again, self.least, floor)
        raised = jnp.maximum(jnp.minimum(self.raised * factor, self.most), factor)
        factor = lax.select(fresh, raised, factor)
        factor = lax.select(kept, jnp.maximum(factor, STUCK * self.least), factor)
        holds = lax.select(fresh, jnp.minimum(2.0 * holds + 1.0, LONGEST_HOLD), holds)
        # Also where no step is better, as none is while all are held.
        held = lax.select(fresh, holds, jnp.maximum(held - (good | ~better), 0.0))
        folds = lax.select(good, new.folds, jnp.asarray(old.folds))
        return FoldGuard(factor, floor, holds, held, folds, new.first)

    def beginning(self, guard: "FoldGuard", share: Array, far: Array, term: DataTerm) -> "FoldGuard":
        """With this share of the factors, or `least`; from a base `far` away with more for many points."""
        many = jnp.where(far, jnp.maximum(term.points / FEW_POINTS, 1.0), 1.0)
        factor = jnp.maximum(share * many * jnp.asarray(guard.factor), self.least)
        return dataclasses.replace(guard, factor=factor, first=many * guard.first)

    def renewed(self, guard: "FoldGuard", surface: WorkingSurface) -> "FoldGuard":
        """For a surface whose new knots have moved the control points in the net."""
        least = jnp.full_like(guard.factor, self.least)
        zero = jnp.zeros_like(least)
        return FoldGuard(least, least, zero, zero, guard.folds, guard.first).seeing(surface)

    def has_faded(self, guard: "FoldGuard") -> Bool[Array, ""]:
        """Whether the factor of some control point has fallen to `least`."""
        return jnp.min(jnp.asarray(guard.factor)) <= self.least

    def following_least(self, guard: "FoldGuard") -> "FoldGuard":
        """With factors that have fallen to `least` as functions of it, for derivatives."""
        factor = jnp.where(guard.factor <= lax.stop_gradient(self.least), self.least, guard.factor)
        return eqx.tree_at(lambda g: g.factor, guard, factor)

    def held_back(
        self, guard: "FoldGuard", surface: WorkingSurface, problem: Problem, here: FootPoints
    ) -> Bool[Array, " points"]:
        """Points far from the surface where it has been kept from folding."""
        i, j = (
            axis.locate(x) + axis.polynomials.shape[1] // 2
            for axis, x in zip(jax.tree.map(jnp.asarray, surface.axes), (here.u, here.v), strict=True)
        )
        assert here.summary is not None
        average = here.summary[0] * problem.diagonal
        stiff = jnp.asarray(guard.floor)[i, j] > self.least
        return problem.counted & stiff & (here.error > FAR * average)


class FoldGuard(eqx.Module):
    """Of each control point: the factor, what it does not fall below, for how many accepted steps the next
    fold will hold it, and for how many it is held still. The folds of the surface by cell, and the factor
    that the fit began with.
    """

    factor: Float[Any, "nu nv"]
    floor: Float[Any, "nu nv"]
    holds: Float[Any, "nu nv"]
    held: Float[Any, "nu nv"]
    folds: Float[Any, "cells_u cells_v"]
    first: Float[Any, ""]

    def at_base(self, step: Any, error: Array, spacing: Array) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """The share of the usual smoothing and damping that a step takes: for the first one from a base that
        is NEAR and has no folds the square of the average error over the average `spacing` of the net,
        otherwise 1. And whether it is the first one from a base that is not near.
        """
        close, smooth = error < NEAR * spacing, ~jnp.any(jnp.asarray(self.folds) > 0)
        near = (step == 0) & close & smooth
        ratio = error / jnp.where(near, spacing, 1.0)
        return jnp.where(near, jnp.maximum(ratio**2, LEAST_SHARE), 1.0), (step == 0) & ~close

    def seeing(self, surface: WorkingSurface) -> "FoldGuard":
        """With the folds of this surface."""
        return dataclasses.replace(self, folds=folds_by_cell(surface.pieces))


def _kind(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, jax.dtypes.canonicalize_dtype(x.dtype))


@cache
def _no_roughness(*kinds: jax.ShapeDtypeStruct) -> Roughness:
    """Zeros in the place of what `Roughness.of` returns, which takes longer to find out than a small fit."""
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(Roughness.of, *kinds))
