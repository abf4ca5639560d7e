"""`as_varying`: values that differ from device to device inside `jax.shard_map`.

JAX distinguishes what each device of a mesh has for itself from what is the same on all of them. A loop that
begins with constants and ends with a device's own sums must begin with values of the second kind.
"""

from typing import Any

import jax
from jax import lax


def as_varying(tree: Any, *like: Any) -> Any:
    """The tree, its leaves varying over all axes of a mesh over which some leaf of `like` does.

    Elsewhere than inside `jax.shard_map` it is the tree itself.
    """
    axes = frozenset[str]().union(*(varying_axes(x) for x in jax.tree.leaves(like)))

    def one(x: Any) -> Any:
        missing = axes - varying_axes(x)
        return lax.pcast(x, tuple(sorted(missing)), to="varying") if missing else x

    return jax.tree.map(one, tree) if axes else tree


def as_varying_as(tree: Any, model: Any) -> Any:
    """The tree, each leaf varying over all axes over which the same leaf of `model` does."""
    return jax.tree.map(as_varying, tree, model)


def varying_axes(x: Any) -> frozenset[str]:
    """The axes of a mesh over which a value, or a value of the type `x`, varies."""
    kind = (x if hasattr(x, "manual_axis_type") else jax.typeof(x)).manual_axis_type
    return frozenset() if kind is None else frozenset(kind.varying)
