"""The four boundary polylines of a patch, checked and with common corners."""

from itertools import permutations, product
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import as_floating, as_points, check_kind, check_number, is_concrete

JOINABLE = 0.01  # of the diagonal: ends so close are meant to meet, as those of curves that were measured

# The two ends that meet in each corner: (v-polyline, its end, u-polyline, its end), end 0 or -1.
CORNERS = (("v0", 0, "u0", 0), ("v0", -1, "u1", 0), ("v1", 0, "u0", -1), ("v1", -1, "u1", -1))


class Boundary(eqx.Module):
    """Four polylines around a patch, sharing its corners c00, c10, c11, c01.

        c01 ---- v1 ---> c11
         ^                ^
         u0               u1
         |                |
        c00 ---- v0 ---> c10

    `v0` and `v1` are the sides v = 0 and v = 1, along which u grows; `u0` and `u1` are the sides
    u = 0 and u = 1, along which v grows. A polyline may be closed: opposite corners then coincide,
    as on a tube.

    Parameters
    ----------
    v0, v1, u0, u1 : arrays (n_i, d)
        At least two vertices each, in order, in any unit. Consecutive duplicates are dropped.
    tolerance : float
        How far ends that should meet may be apart, as a fraction of the bounding-box diagonal
        (default 1e-6, at least 0). The end of the u-polyline moves onto that of the v-polyline.

    Raises
    ------
    ValueError
        For too few vertices, numbers that are not finite, masked entries, different d, a polyline of
        length zero (patches with three sides are not supported), sides that all lie on one line, corners
        that do not meet, or a tolerance that is negative or not finite. Inside `jit` only shapes are
        checked, and the vertices are taken as they are.
    TypeError
        If the tolerance is no number, or the polylines are not real.

    Examples
    --------
    >>> boundary = jf.Boundary(
    ...     v0=np.array([[0.0, 0.0], [1.0, 0.0]]),
    ...     v1=np.array([[0.0, 2.0], [1.0, 2.0]]),
    ...     u0=np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]]),
    ...     u1=np.array([[1.0, 0.0], [1.0, 2.0]]),
    ... )
    >>> boundary.u0.shape
    (3, 2)
    """

    v0: Float[Array, "v0_points d"]
    v1: Float[Array, "v1_points d"]
    u0: Float[Array, "u0_points d"]
    u1: Float[Array, "u1_points d"]

    def __init__(
        self,
        v0: ArrayLike,
        v1: ArrayLike,
        u0: ArrayLike,
        u1: ArrayLike,
        tolerance: ArrayLike = 1e-6,
    ):
        check_number("tolerance", tolerance, 0.0)
        given = {"v0": v0, "v1": v1, "u0": u0, "u1": u1}
        lines = {name: as_points(name, x, least=2) for name, x in given.items()}
        for name, line in lines.items():
            if line.shape[1] != lines["v0"].shape[1]:
                raise ValueError(
                    f"{name} has {line.shape[1]} coordinates a vertex and v0 has "
                    f"{lines['v0'].shape[1]}; give all four polylines in one space."
                )
        dtype = jnp.result_type(*lines.values())
        if is_concrete(lines):
            # Into the final dtype first: rounding may create duplicates and part the corners.
            arrays = {name: np.array(x, dtype=dtype) for name, x in lines.items()}
            lines = _cleaned(arrays, tolerance)
        self.v0, self.v1, self.u0, self.u1 = (jnp.asarray(x, dtype) for x in lines.values())

    @classmethod
    def from_grid(cls, grid: ArrayLike) -> "Boundary":
        """The four edges of grid data (n, m, d), u along the first index, v along the second."""
        data = as_floating("grid", grid, 3)
        if data.shape[0] < 2 or data.shape[1] < 2:
            raise ValueError(
                f"grid must hold at least 2 x 2 points, but has shape {data.shape}; give an array (n, m, d)."
            )
        return cls(v0=data[:, 0], v1=data[:, -1], u0=data[0], u1=data[-1])


def checked_boundary(boundary: Any, points: Any) -> Boundary:
    """`boundary`, if it is one; raises otherwise, and says so where the points took its place."""
    if isinstance(points, Boundary):
        raise TypeError("points must be an array, but is a Boundary; pass it as boundary=.")
    check_kind("boundary", boundary, Boundary, "Boundary(v0, v1, u0, u1) or Boundary.from_grid(grid)")
    return boundary


def check_concrete(boundary: Boundary) -> None:
    """Raise where values of a boundary are not known yet."""
    if not is_concrete(boundary):
        raise TypeError(
            "boundary must be concrete, but is traced; call base_surface outside jit, or blend its curves by "
            "coons_surface, which may be traced and differentiated."
        )


def diagonal(*sets: np.ndarray) -> float:
    """Bounding-box diagonal of all the points together."""
    return float(np.linalg.norm(np.ptp(np.concatenate(sets).astype(float), axis=0)))


def centre_and_size(sides: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Centre of gravity of the polylines, and twice the greatest distance from it: the size.

    For a rectangle the size is the diagonal. Unlike the bounding box, both turn with the boundary.
    """
    steps = [np.linalg.norm(np.diff(x.astype(float), axis=0), axis=1) for x in sides]
    halves = [(x[1:].astype(float) - sides[0][0] + x[:-1] - sides[0][0]) / 2 for x in sides]
    length = np.concatenate(steps)
    centre = sides[0][0] + length @ np.concatenate(halves) / length.sum()
    return centre, 2 * farthest(centre, *sides)


def farthest(centre: np.ndarray, *sets: np.ndarray) -> float:
    """Greatest distance of any of the points from the centre."""
    return max(float(np.linalg.norm(x - centre, axis=1).max()) for x in sets)


def _cleaned(lines: dict[str, np.ndarray], tolerance: Any) -> dict[str, np.ndarray]:
    magnitude = max(float(np.abs(x).max()) for x in lines.values())
    eps = float(jnp.finfo(lines["v0"].dtype).eps)
    rounding, size = 4 * eps * magnitude, diagonal(*lines.values())
    _check_lengths(lines, rounding)
    _check_corners(lines, max(tolerance * size, rounding), size)
    for v, v_end, u, u_end in CORNERS:
        lines[u][u_end] = lines[v][v_end]
    _check_lengths(lines, rounding)  # a side within the tolerance may have shrunk to a point
    _check_area(lines, rounding)
    return {name: _without_repeats(line, 4 * eps * size) for name, line in lines.items()}


def _check_lengths(lines: dict[str, np.ndarray], rounding: float) -> None:
    for name, line in lines.items():
        if diagonal(line) <= rounding:
            raise ValueError(
                f"{name} has length zero in {line.dtype}; patches with three sides are not supported, so cut "
                "the tip off or give a polyline of distinct points, and subtract what is common to large "
                "coordinates or switch on jax_enable_x64."
            )


def _check_area(lines: dict[str, np.ndarray], rounding: float) -> None:
    """That the sides do not all lie on one line, in a space where they need not."""
    vertices = np.concatenate(list(lines.values())).astype(float)
    away = vertices - vertices[0]
    far = away[np.argmax(np.linalg.norm(away, axis=1))]
    along = far / np.linalg.norm(far)
    beside = np.linalg.norm(away - (away @ along)[:, None] * along, axis=1).max()
    if vertices.shape[1] > 1 and beside <= 2 * rounding:
        raise ValueError(
            f"v0, v1, u0 and u1 all lie on one line in {lines['v0'].dtype}; give the four sides of a patch, "
            "and subtract what is common to large coordinates or switch on jax_enable_x64."
        )


def _without_repeats(line: np.ndarray, least: float) -> np.ndarray:
    steps = np.linalg.norm(np.diff(line.astype(float), axis=0), axis=1)
    kept = line[np.concatenate([[True], steps > least])]
    if len(kept) < 2:
        return line[[0, -1]]
    kept[-1] = line[-1]  # the corner stays, whichever of its copies went
    return kept


def corner_gaps(lines: dict[str, np.ndarray]) -> list[float]:
    """How far apart the ends are that are to meet, in the order of CORNERS."""
    ends = [lines[v][v_end].astype(float) - lines[u][u_end].astype(float) for v, v_end, u, u_end in CORNERS]
    return [float(np.linalg.norm(x)) for x in ends]


def _check_corners(lines: dict[str, np.ndarray], allowed: float, size: float) -> None:
    gaps = corner_gaps(lines)
    worst = int(np.argmax(gaps))
    if gaps[worst] <= allowed:
        return
    v, v_end, u, u_end = CORNERS[worst]
    raise ValueError(
        f"boundary corners do not meet: the {'start' if v_end == 0 else 'end'} of {v} and the "
        f"{'start' if u_end == 0 else 'end'} of {u} are {gaps[worst]:.3g} apart "
        f"({100 * gaps[worst] / size:.3g} % of the diagonal); {_remedy(lines, gaps[worst], size)}."
    )


def _remedy(lines: dict[str, np.ndarray], gap: float, size: float) -> str:
    allowed = JOINABLE * size
    if gap <= allowed:
        return f"pass tolerance={1.1 * gap / size:.2g} to Boundary to join them, or share the corner points"
    if turned := _to_reverse(lines, allowed):
        return f"reverse {' and '.join(turned)}"
    for others in permutations(lines.values()):
        if _to_reverse(dict(zip(lines, others, strict=True)), allowed) is not None:
            return "v0 and v1 are opposite sides, and so are u0 and u1: give them as Boundary(v0, v1, u0, u1)"
    return "make the polylines share their corner points"


def _to_reverse(lines: dict[str, np.ndarray], allowed: float) -> list[str] | None:
    """Which sides have to be reversed for the corners to meet, the fewest; None if that does not help."""
    for flips in sorted(product((1, -1), repeat=4), reverse=True):
        turned = {name: x[::flip] for (name, x), flip in zip(lines.items(), flips, strict=True)}
        if max(corner_gaps(turned)) <= allowed:
            return [name for name, flip in zip(lines, flips, strict=True) if flip < 0]
    return None
