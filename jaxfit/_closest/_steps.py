"""One step of a closest-point iteration: Newton's and Hu and Wallner's, with borders as active bounds.

With e = Q - R(u, v), the squared distance f = |e|^2 has the gradient -2 (e.R_u, e.R_v) and the Hessian
2 [[R_u.R_u - e.R_uu, R_u.R_v - e.R_uv], [., R_v.R_v - e.R_vv]]. All derivatives here are in the local
coordinates of a cell; both steps are invariant under a linear change of parameters.
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array
from jaxtyping import Float

from jaxfit._barrier import materialise
from jaxfit._cells import Jet

# What a lifted eigenvalue of the Hessian, against the first form, is at least.
LEAST_EIGENVALUE = 1e-3
# Hu and Wallner's circle is followed up to this share of the way to the centre of curvature.
TRUSTED_SHARE = 0.5


def dot(a: Float[Array, "d ..."], b: Float[Array, "d ..."]) -> Float[Array, "..."]:
    """Inner product along the first axis; written out, for a reduction is not fused with what follows."""
    products = [x * y for x, y in zip(a, b, strict=True)]
    return sum(products[1:], products[0])


class Forms(eqx.Module):
    """Inner products at the current feet that every step is made of."""

    f: Array  # squared distance e . e
    gradient_s: Array  # e . R_s, half the fall of f along s
    gradient_t: Array
    E: Array  # first fundamental form
    F: Array
    G: Array
    e_ss: Array  # e . R_ss
    e_st: Array
    e_tt: Array
    drift: tuple[Array, ...] | None = None  # second times first derivatives, where a method asks


def measure(e: Float[Array, "d ..."], jet: Jet, drift: bool) -> Forms:
    """All inner products from the residual and the derivatives."""
    seconds = (jet.ss, jet.st, jet.tt)
    sideways = tuple(dot(x, y) for x in seconds for y in (jet.s, jet.t)) if drift else None
    return Forms(
        f=dot(e, e),
        gradient_s=dot(e, jet.s),
        gradient_t=dot(e, jet.t),
        E=dot(jet.s, jet.s),
        F=dot(jet.s, jet.t),
        G=dot(jet.t, jet.t),
        e_ss=dot(e, jet.ss),
        e_st=dot(e, jet.st),
        e_tt=dot(e, jet.tt),
        drift=sideways,
    )


class AbstractFootMethod(eqx.Module):
    """How a foot point moves, given the inner products at it."""

    drift: AbstractClassVar[bool]  # whether `step` needs Forms.drift
    quadratic: AbstractClassVar[bool]  # whether steps shrink quadratically at a foot

    @abstractmethod
    def step(
        self, first: Forms, pinned_s: Array, pinned_t: Array, late: Array, always: Array
    ) -> tuple[Array, Array]:
        """The step in local coordinates; a pinned coordinate does not move.

        Where it is `late`, a method that converges linearly takes a Newton step.
        """


class Newton(AbstractFootMethod):
    """Newton's method on the squared distance, on a Hessian that is made positive where it is not.

    Converges quadratically. The safeguard around it halves every step that would increase the
    distance.
    """

    drift: ClassVar[bool] = False
    quadratic: ClassVar[bool] = True

    def step(
        self, first: Forms, pinned_s: Array, pinned_t: Array, late: Array, always: Array
    ) -> tuple[Array, Array]:
        """Solve the 2x2 system with the Hessian, made positive where it is not."""
        return materialise(always, self._step, first, pinned_s, pinned_t)

    def _step(self, first: Forms, pinned_s: Array, pinned_t: Array) -> tuple[Array, Array]:
        E, F, G = first.E, first.F, first.G
        a, b, c = E - first.e_ss, F - first.e_st, G - first.e_tt
        # Its eigenvalues against the first form are 1 - curvature * distance; lift a negative one.
        metric = E * G - F * F
        trace = a * G + c * E - 2.0 * b * F
        root = jnp.sqrt(jnp.maximum(trace**2 - 4.0 * (a * c - b * b) * metric, 0.0))
        lowest = _divide(trace - root, 2.0 * metric)
        doubtful = lowest < _tiny_angle(E) ** 0.5
        lift = jnp.where(doubtful, jnp.abs(lowest) - lowest + LEAST_EIGENVALUE, 0.0)
        single_a = jnp.maximum(jnp.abs(a), LEAST_EIGENVALUE * E)
        single_c = jnp.maximum(jnp.abs(c), LEAST_EIGENVALUE * G)
        a = jnp.where(pinned_t, single_a, a + lift * E)
        c = jnp.where(pinned_s, single_c, c + lift * G)
        return _solve(first, a, b + lift * F, c, pinned_s, pinned_t)


class HuWallner(AbstractFootMethod):
    """The second-order geometric iteration of Hu and Wallner (CAGD 22, 2005), the paper's choice.

    The foot on the tangent plane gives a direction; the normal section in that direction is replaced
    by its circle of curvature, the point is projected onto the circle, and the parameter step follows
    from the second-order expansion of the section. Written with inner products only, so for any
    dimension. Close to the centre of curvature and beyond it, where that foot jumps to the far side of the
    circle, it takes Newton's step.
    """

    drift: ClassVar[bool] = True
    quadratic: ClassVar[bool] = False

    def step(
        self, first: Forms, pinned_s: Array, pinned_t: Array, late: Array, always: Array
    ) -> tuple[Array, Array]:
        """Tangent-plane step, scaled to the foot on the circle of curvature."""
        newton_s, newton_t = Newton().step(first, pinned_s, pinned_t, late, always)
        ds, dt = materialise(always, _tangent_plane, first, pinned_s, pinned_t)
        factor, trusted = materialise(always, self._factor, first, ds, dt)
        circle = trusted & ~late
        return jnp.where(circle, factor * ds, newton_s), jnp.where(circle, factor * dt, newton_t)

    def _factor(self, first: Forms, ds: Array, dt: Array) -> tuple[Array, Array]:
        """What the tangent-plane step is multiplied by, and where that can be trusted."""
        ss, st, tt = ds * ds, 2.0 * ds * dt, dt * dt  # second derivative along (ds, dt)
        length2 = ss * first.E + st * first.F + tt * first.G
        height2 = first.f - 2.0 * (ds * first.gradient_s + dt * first.gradient_t) + length2
        assert first.drift is not None
        ss_s, ss_t, st_s, st_t, tt_s, tt_t = first.drift
        along = ds * (ss * ss_s + st * st_s + tt * tt_s) + dt * (ss * ss_t + st * st_t + tt * tt_t)
        above = ss * first.e_ss + st * first.e_st + tt * first.e_tt - along
        bend = _divide(above, length2)  # curvature times height
        # tan(angle on the circle) = curvature * tangential distance / (1 - curvature * height)
        turn2 = _divide(_divide(above**2, length2), height2)
        remaining = 1.0 - bend
        shrink = 1.0 / jnp.sqrt(jnp.maximum(remaining**2 + turn2, jnp.finfo(ds.dtype).tiny))
        # The section advances by x + (along / length2) x^2 / 2 in its tangent's direction.
        factor = shrink * (1.0 - 0.5 * _divide(along, length2) * shrink)
        # Near the centre of curvature the circle's foot jumps, and the direction is no longer right.
        return factor, bend <= TRUSTED_SHARE


def _tangent_plane(first: Forms, pinned_s: Array, pinned_t: Array) -> tuple[Array, Array]:
    return _solve(first, first.E, first.F, first.G, pinned_s, pinned_t)


def _solve(
    first: Forms, a: Array, b: Array, c: Array, pinned_s: Array, pinned_t: Array
) -> tuple[Array, Array]:
    """Solve [[a, b], [b, c]] step = gradient for the free coordinates; the others do not move.

    Where the tangents are parallel, along the axes. As few divisions as can be, for they take the time.
    """
    gs = jnp.where(pinned_s, 0.0, first.gradient_s)
    gt = jnp.where(pinned_t, 0.0, first.gradient_t)
    # A pinned coordinate's own equation becomes that of the identity.
    a, c = jnp.where(pinned_s, 1.0, a), jnp.where(pinned_t, 1.0, c)
    alone = pinned_s | pinned_t
    b = jnp.where(alone, 0.0, b)
    determinant = a * c - b * b
    regular = determinant > jnp.where(alone, 0.0, _tiny_angle(a) * first.E * first.G)
    inverse = 1.0 / jnp.where(regular, determinant, 1.0)
    ds = jnp.where(regular, (c * gs - b * gt) * inverse, 0.5 * _divide(gs, first.E))
    dt = jnp.where(regular, (a * gt - b * gs) * inverse, 0.5 * _divide(gt, first.G))
    return ds, dt


def _tiny_angle(x: Array) -> float:
    return 100.0 * float(jnp.finfo(x.dtype).eps)


def _divide(x: Array, y: Array) -> Array:
    """x / y, and 0 where y is 0."""
    safe = y > jnp.finfo(y.dtype).tiny
    return jnp.where(safe, x / jnp.where(safe, y, 1.0), 0.0)
