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
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._closest._forms import Forms, either, product, total

# What a lifted eigenvalue of the Hessian, against the first form, is at least.
LEAST_EIGENVALUE = 1e-3
# Hu and Wallner's circle is followed up to this share of the way to the centre of curvature.
TRUSTED_SHARE = 0.5

Step = Float[Array, "2 1 slots"]
Active = Bool[Array, "2 1 slots"]


class AbstractFootMethod(eqx.Module):
    """How a foot point moves, given the inner products at it."""

    needs_christoffel: AbstractClassVar[bool]  # whether `step` uses `Forms.christoffel`
    converges_quadratically: AbstractClassVar[bool]  # whether steps shrink quadratically at a foot

    @abstractmethod
    def step(self, forms: Forms, active: Active, fall_back: Bool[Array, "1 1 slots"]) -> Step:
        """The step in local coordinates; a coordinate at an `active` bound does not move.

        Where `fall_back` holds, a method that converges linearly takes a Newton step.
        """


class Newton(AbstractFootMethod):
    """Newton's method on the squared distance, on a Hessian that is made positive where it is not.

    Converges quadratically. The safeguard around it halves every step that would increase the
    distance.

    Examples
    --------
    >>> jf.OrthogonalDistance().foot_method
    Newton()
    """

    needs_christoffel: ClassVar[bool] = False
    converges_quadratically: ClassVar[bool] = True

    def step(self, forms: Forms, active: Active, fall_back: Bool[Array, "1 1 slots"]) -> Step:
        """Solve the 2x2 system with the Hessian, made positive where it is not."""
        metric, (diagonal, mixed) = forms.metric, forms.hessian
        # Its eigenvalues against the first form are 1 - curvature * distance; lift a negative one.
        area = product(metric) - forms.metric_mixed * forms.metric_mixed
        trace = total(diagonal * lax.rev(metric, (0,))) - 2.0 * mixed * forms.metric_mixed
        root = jnp.sqrt(jnp.maximum(trace * trace - 4.0 * (product(diagonal) - mixed * mixed) * area, 0.0))
        lowest = _divide(trace - root, 2.0 * area)
        doubtful = lowest < _tiny_angle(lowest) ** 0.5
        lift = jnp.where(doubtful, jnp.abs(lowest) - lowest + LEAST_EIGENVALUE, 0.0)
        single = jnp.maximum(jnp.abs(diagonal), LEAST_EIGENVALUE * metric)
        diagonal = lax.select(lax.rev(active, (0,)), single, diagonal + lift * metric)
        return _solve(forms, diagonal, mixed + lift * forms.metric_mixed, active)


class HuWallner(AbstractFootMethod):
    """The second-order geometric iteration of Hu and Wallner (CAGD 22, 2005), the paper's choice.

    The foot on the tangent plane gives a direction; the normal section in that direction is replaced
    by its circle of curvature, the point is projected onto the circle, and the parameter step follows
    from the second-order expansion of the section. Written with inner products only, so for any
    dimension. Close to the centre of curvature and beyond it, where that foot jumps to the far side of the
    circle, it takes Newton's step.

    Examples
    --------
    >>> jf.GeometricApproximation.paper().foot_method
    HuWallner()
    """

    needs_christoffel: ClassVar[bool] = True
    converges_quadratically: ClassVar[bool] = False

    def step(self, forms: Forms, active: Active, fall_back: Bool[Array, "1 1 slots"]) -> Step:
        """Tangent-plane step, scaled to the foot on the circle of curvature."""
        plane = _solve(forms, forms.metric, forms.metric_mixed, active)
        factor, trusted = self._factor(forms, plane)
        circle = jnp.broadcast_to(trusted & ~fall_back, plane.shape)
        return lax.select(circle, factor * plane, Newton().step(forms, active, fall_back))

    def _factor(self, forms: Forms, step: Step) -> tuple[Array, Array]:
        """What the tangent-plane step is multiplied by, and where that can be trusted."""
        assert forms.christoffel is not None
        # Weights of the second derivative along the step: ss, tt, st.
        weight = jnp.concatenate([step * step, 2.0 * product(step)])
        length2 = total(weight * jnp.concatenate([forms.metric, forms.metric_mixed]))
        height2 = forms.f - 2.0 * total(step * forms.gradient) + length2
        along = step[:1] * total(weight * forms.christoffel[0]) + step[1:] * total(
            weight * forms.christoffel[1]
        )
        above = total(weight * forms.second_form) - along
        curvature_height = _divide(above, length2)  # 1 at the centre of curvature
        # tan(angle on the circle) = curvature * tangential distance / (1 - curvature * height)
        turn2 = _divide(_divide(above * above, length2), height2)
        remaining = 1.0 - curvature_height
        shrink = lax.rsqrt(jnp.maximum(remaining * remaining + turn2, jnp.finfo(step.dtype).tiny))
        # The section advances by x + (along / length2) x^2 / 2 in its tangent's direction.
        factor = shrink * (1.0 - 0.5 * _divide(along, length2) * shrink)
        # Near the centre of curvature the circle's foot jumps, and the direction is no longer right.
        return factor, curvature_height <= TRUSTED_SHARE


def _solve(forms: Forms, diagonal: Array, mixed: Array, active: Active) -> Step:
    """Solve the 2x2 systems for the step of the free coordinates; the others do not move.

    Where the tangents are parallel, along the axes. As few divisions as can be, for they take the time.
    """
    gradient = jnp.where(active, 0.0, forms.gradient)
    # The equation of a coordinate at an active bound becomes that of the identity.
    diagonal, alone = jnp.where(active, 1.0, diagonal), either(active)
    mixed = jnp.where(alone, 0.0, mixed)
    determinant = product(diagonal) - mixed * mixed
    least = jnp.where(alone, 0.0, _tiny_angle(mixed) * product(forms.metric))
    regular = determinant > least
    inverse = 1.0 / jnp.where(regular, determinant, 1.0)
    step = (lax.rev(diagonal, (0,)) * gradient - mixed * lax.rev(gradient, (0,))) * inverse
    return jnp.where(regular, step, 0.5 * _divide(gradient, forms.metric))


def _tiny_angle(x: Array) -> float:
    return 100.0 * float(jnp.finfo(x.dtype).eps)


def _divide(x: Array, y: Array) -> Array:
    """x / y, and 0 where y is 0."""
    safe = y > jnp.finfo(y.dtype).tiny
    return jnp.where(safe, x / jnp.where(safe, y, 1.0), 0.0)
