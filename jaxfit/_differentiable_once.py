"""Arguments of functions whose second derivative would be wrong.

Feet follow a surface to first order, and what their derivative depends on is held: a second one is refused.
"""

from typing import Any

import jax


def differentiable_once(tree: Any) -> Any:
    """The arrays of `tree`; what is made of them raises TypeError where it is differentiated twice."""
    return jax.tree.map(_once, tree)


def differentiated(tree: Any) -> Any:
    """The arrays of `tree`, in the rule of a derivative: to differentiate that raises TypeError."""
    return jax.tree.map(_never, tree)


@jax.custom_jvp
def _once(x: Any) -> Any:
    return x


@_once.defjvp
def _first(primals: Any, tangents: Any) -> tuple[Any, Any]:
    return _never(primals[0]), tangents[0]


@jax.custom_jvp
def _never(x: Any) -> Any:
    return x


@_never.defjvp
def _second(primals: Any, tangents: Any) -> Any:
    raise TypeError(
        "this fit is differentiable once only, since its feet move or its derivative is that of "
        "ImplicitAdjoint(); take differences of gradients. StandardInterpolation() has a second derivative, "
        "and so has StandardApproximation(parameter_correction=False) with UnrolledAdjoint()."
    )
