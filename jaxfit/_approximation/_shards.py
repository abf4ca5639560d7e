"""`shard_points`: a cloud divided among devices; and the rows of such arrays that this process holds."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Float, Shaped

from jaxfit._approximation._checked_arguments import checked_weights
from jaxfit._checks import as_points, check_kind, is_concrete


def shard_points(
    points: ArrayLike, mesh: Mesh, weights: ArrayLike | None = None
) -> tuple[Float[jax.Array, "padded d"], Float[jax.Array, " padded"]]:
    """A cloud divided evenly among the devices of a mesh, with its weights, for `approximate`.

    Parameters
    ----------
    points : array (points, d)
        With several processes (`jax.distributed`) each passes points of its own, which stay on its devices.
    mesh : jax.sharding.Mesh
        Points are divided along its first axis, and are the same along others.
    weights : array (points,), optional
        Of these points (default 1).

    Returns
    -------
    points, weights : arrays (padded, d) and (padded,)
        All devices get equally many points: those of a process are followed by copies of its last one, of
        weight 0, which have no influence.

    Raises
    ------
    ValueError
        If points or weights have the wrong shape or are not finite.

    Examples
    --------
    >>> mesh = jax.make_mesh((1,), ("points",))
    >>> points, weights = jf.shard_points(np.random.default_rng(0).random((50, 3)), mesh)
    >>> points.shape, weights.shape, tuple(points.sharding.spec)
    ((50, 3), (50,), ('points',))
    """
    check_kind("mesh", mesh, Mesh, 'jax.make_mesh((jax.device_count(),), ("points",))')
    cloud = np.asarray(as_points("points", points))
    weight = np.ones(len(cloud)) if weights is None else np.asarray(checked_weights(weights, len(cloud)))
    sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
    first = mesh.devices.reshape(mesh.devices.shape[0], -1)[:, 0]
    own = sum(device.process_index == jax.process_index() for device in first)
    rows = _most(-(-len(cloud) // max(own, 1)))
    spare = rows * own - len(cloud)
    cloud = np.concatenate([cloud, np.repeat(cloud[-1:], spare, axis=0)])
    weight = np.concatenate([weight, np.zeros(spare)])
    shape = (rows * len(first),)
    make = jax.make_array_from_process_local_data
    return make(sharding, cloud, (*shape, cloud.shape[1])), make(sharding, weight, shape)


def _most(count: int) -> int:
    """The largest of the numbers of all processes."""
    if jax.process_count() == 1:
        return count
    from jax.experimental.multihost_utils import process_allgather

    return int(np.max(process_allgather(np.asarray(count))))


def divided_over(points: Any) -> tuple[Mesh, Any] | None:
    """The mesh and the axis over which the rows of a concrete array are divided, or None."""
    sharding = getattr(points, "sharding", None) if is_concrete(points) else None
    if not isinstance(sharding, NamedSharding) or sharding.is_fully_replicated:
        return None
    axis = sharding.spec[0]
    return None if axis is None else (sharding.mesh, axis)  # type: ignore[return-value]


def local_rows(x: jax.Array) -> Shaped[np.ndarray, "..."]:
    """The rows of an array that lie on the devices of this process."""
    parts = {shard.index[0].start or 0: shard.data for shard in x.addressable_shards}
    return np.concatenate([np.asarray(parts[start]) for start in sorted(parts)])


def with_local_rows(rows: Shaped[np.ndarray, "..."], like: jax.Array) -> jax.Array:
    """An array divided as `like` is, from the rows of each process."""
    size = like.sharding.shard_shape(like.shape)[0]
    starts = sorted({shard.index[0].start or 0 for shard in like.addressable_shards})
    place = {start: number * size for number, start in enumerate(starts)}

    def part(index: Any) -> np.ndarray:
        begin = place[index[0].start or 0]
        return rows[begin : begin + size]

    spec = PartitionSpec(like.sharding.spec[0])  # type: ignore[attr-defined]
    sharding = NamedSharding(like.sharding.mesh, spec)  # type: ignore[attr-defined]
    return jax.make_array_from_callback((like.shape[0], *rows.shape[1:]), sharding, part)
