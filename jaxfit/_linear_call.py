"""Linear functions whose transposes are programs of their own.

In the rule of a derivative tangents are traced, even where all else is concrete. What a `jit` does to them is
transposed by JAX when a gradient is asked for, and then compiled, with XLA's options rather than ours, while
everything waits.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxfit._checks import is_concrete
from jaxfit._compile import compiled


@dataclasses.dataclass(frozen=True)
class _Linear:
    """The linear function x -> function(known, x) on the leaves of x, or its transpose."""

    function: Callable[[Any, Any], Any]
    known: Any  # structures of the arguments
    x: Any
    like_x: tuple[ShapedArray, ...]
    like_y: tuple[ShapedArray, ...]
    transposed: bool = False

    @property
    def transpose(self) -> "_Linear":
        return dataclasses.replace(self, transposed=not self.transposed)

    def __call__(self, known: Any, given: Any) -> list[Any]:
        known = jax.tree.unflatten(self.known, known)

        def forward(*x: Any) -> list[Any]:
            return jax.tree.leaves(self.function(known, jax.tree.unflatten(self.x, x)))

        if not self.transposed:
            return forward(*given)
        return list(jax.linear_transpose(forward, *self.like_x)(list(given)))


def linear_call(function: Callable[[Any, Any], Any], known: Any, x: Any, like: Any) -> Any:
    """`function(known, x)`, linear in x and with shapes as in `like`.

    Where `known` is concrete, forward and transposed it is the program of `compiled`, also within `jax.grad`.
    """
    if not is_concrete(known):
        return jax.jit(function)(known, x)
    linear = _linear(function, known, x, like)
    found = _primitive.bind(*jax.tree.leaves((known, x)), linear=linear)
    return jax.tree.unflatten(jax.tree.structure(like), found)


def transpose_ahead(function: Callable[[Any, Any], Any], known: Any, x: Any, like: Any) -> None:
    """Begin to compile the transpose of `linear_call` for such arguments."""
    linear = _linear(function, known, x, like).transpose
    y = list(map(_zeros, linear.like_y))
    with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):  # as where JAX transposes
        _program.ahead(linear, jax.tree.leaves(known), y)


def _zeros(like: ShapedArray) -> np.ndarray:
    return np.zeros(like.shape, like.dtype)  # NumPy's compile nothing


def _linear(function: Callable[[Any, Any], Any], known: Any, x: Any, like: Any) -> _Linear:
    like_x, like_y = (
        tuple(ShapedArray(np.shape(a), a.dtype) for a in jax.tree.leaves(tree)) for tree in (x, like)
    )
    return _Linear(function, jax.tree.structure(known), jax.tree.structure(x), like_x, like_y)


@partial(compiled, static_argnums=0)
def _program(linear: _Linear, known: list[Any], given: list[Any]) -> list[Any]:
    return linear(known, given)


def _called(*args: Any, linear: _Linear) -> list[Any]:
    count = linear.known.num_leaves
    return _program(linear, list(args[:count]), list(args[count:]))


def _shapes(*args: Any, linear: _Linear) -> tuple[ShapedArray, ...]:
    return linear.like_x if linear.transposed else linear.like_y


def _differentiated(primals: Any, tangents: Any, *, linear: _Linear) -> Any:
    count = linear.known.num_leaves
    assert all(type(t) is ad.Zero for t in tangents[:count])
    along = map(ad.instantiate_zeros, tangents[count:])
    return tuple(_primitive.bind(*primals[:count], *x, linear=linear) for x in (primals[count:], along))


def _transposed(cotangents: Any, *args: Any, linear: _Linear) -> list[Any]:
    count = linear.known.num_leaves
    likes = zip(cotangents, _shapes(linear=linear), strict=True)
    given = (_zeros(like) if type(c) is ad.Zero else c for c, like in likes)
    found = _primitive.bind(*args[:count], *given, linear=linear.transpose)
    wanted = map(ad.is_undefined_primal, args[count:])
    return [None] * count + [x if wants else None for x, wants in zip(found, wanted, strict=True)]


def _batched(args: Any, axes: Any, *, linear: _Linear) -> Any:
    found = jax.vmap(partial(_called, linear=linear), in_axes=tuple(axes))(*args)
    return found, [0] * len(found)


_primitive = Primitive("jaxfit_linear_program")
_primitive.multiple_results = True
_primitive.def_impl(_called)
_primitive.def_abstract_eval(_shapes)
ad.primitive_jvps[_primitive] = _differentiated
ad.primitive_transposes[_primitive] = _transposed
batching.primitive_batchers[_primitive] = _batched
mlir.register_lowering(_primitive, mlir.lower_fun(_called, multiple_results=True))
