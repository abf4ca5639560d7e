"""A shaded picture of a surface without a mesh: many points, the nearest one wins each pixel."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from jaxfit._splines import BSplineSurface
from jaxfit.plot._view import View, choose_view

_PIXELS = 1400  # longer side of the raw picture, which is halved in the end
_COARSE = 129  # surface points per direction that choose view and density
_DENSITY = 1.2  # surface points per raw pixel, per direction
_MOST = 2000  # surface points per direction, whatever the density asks for
_KNOT_LINES = 14  # at most, per direction

_PLAIN = np.array([0.84, 0.80, 0.72])
_HEIGHTS = np.array([[0.47, 0.57, 0.44], [0.80, 0.77, 0.60], [0.70, 0.57, 0.45], [0.96, 0.94, 0.91]])
_LINE = np.array([0.13, 0.25, 0.40])
_LIGHT = np.array([-0.68, 0.42, 0.60])  # from the upper left, in front of the picture


def render(
    surface: BSplineSurface,
    aspect: float = 1.1,
    view: View | None = None,
    paint: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[Float[np.ndarray, "height width 4"], View]:
    """The surface in RGBA with shading and some of its knot lines, and the view it is seen in.

    The picture is transparent round the surface, and `aspect` times as wide as high. A `paint`
    gives the colours (a, b, 3) at parameters (a,) and (b,); nothing is shaded or drawn on them.
    """
    us, vs, coarse = coarse_points(surface)
    view = choose_view(coarse) if view is None else view
    seen = view(coarse)
    size = np.ptp(seen[..., :2].reshape(-1, 2), axis=0).max()
    pixel = max(size, np.finfo(float).tiny) / (_PIXELS - 1)
    us, vs = _refine(us, seen, pixel), _refine(vs, seen.swapaxes(0, 1), pixel)
    xyz = _points(surface, us, vs)
    seen = view(xyz)
    if paint is not None:
        colour = paint(us, vs)
    else:
        colour = _ground(xyz, view) * _shade(seen)[..., None]
        _draw_knot_lines(colour, surface, us, vs)
    image = _halve(_splat(seen.reshape(-1, 3), np.clip(colour, 0, 1).reshape(-1, 3), pixel))
    return _pad(image, aspect), view


def coarse_points(surface: BSplineSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evenly spaced parameters along u and along v, and the points there: enough to choose a view."""
    (u0, u1), (v0, v1) = surface.domain
    us, vs = np.linspace(u0, u1, _COARSE), np.linspace(v0, v1, _COARSE)
    return us, vs, _points(surface, us, vs)


def _draw_knot_lines(colour: np.ndarray, surface: BSplineSurface, us: np.ndarray, vs: np.ndarray) -> None:
    for axis, (knots, at) in enumerate(((surface.knots_u, us), (surface.knots_v, vs))):
        line = np.moveaxis(colour, axis, 0)  # a view: drawing on it draws on `colour`
        near = _near_a_knot(np.asarray(knots, dtype=float), at)
        line[near] = 0.5 * line[near] + 0.5 * _LINE


def _points(surface: BSplineSurface, us: np.ndarray, vs: np.ndarray) -> np.ndarray:
    """Surface points, cut or filled with zeros to three coordinates."""
    xyz = np.asarray(surface.grid(us, vs), dtype=float)
    return np.concatenate([xyz, np.zeros((*xyz.shape[:2], 3))], axis=-1)[..., :3]


def _refine(at: np.ndarray, seen: np.ndarray, pixel: float) -> np.ndarray:
    """Parameters spaced evenly in the picture, where the first axis of `seen` belongs to `at`."""
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=-1).max(axis=1) / pixel
    along = np.append(0.0, np.cumsum(np.maximum(steps, 1e-3)))
    count = int(np.clip(_DENSITY * along[-1], 200, _MOST))
    return np.interp(np.linspace(0, along[-1], count), along, at)


def _ground(xyz: np.ndarray, view: View) -> np.ndarray:
    """One colour, or colours by height for a relief."""
    if not view.relief:
        return np.broadcast_to(_PLAIN, xyz.shape)
    height = xyz[..., "xyz".index(view.relief)]
    height = (height - height.min()) / max(np.ptp(height), np.finfo(float).tiny)
    stops = np.linspace(0, 1, len(_HEIGHTS))
    return np.stack([np.interp(height, stops, channel) for channel in _HEIGHTS.T], axis=-1)


def _shade(seen: np.ndarray) -> np.ndarray:
    """Brightness by the angle to the light; both sides are lit."""
    normal = np.cross(np.gradient(seen, axis=0), np.gradient(seen, axis=1))
    length = np.linalg.norm(normal, axis=-1)
    cosine = normal @ (_LIGHT / np.linalg.norm(_LIGHT)) / np.where(length > 0, length, 1.0)
    cosine = np.where(normal[..., 2] < 0, -cosine, cosine)
    # The square keeps some shape in the shade, where Lambert's law has none.
    return 0.2 + 0.95 * (0.5 + 0.5 * cosine) ** 2


def _near_a_knot(knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Indices into `at` next to evenly chosen knots; the ends of the domain always count."""
    knots = np.unique(np.clip(knots, at[0], at[-1]))
    every = -(-(len(knots) - 1) // _KNOT_LINES)
    nearest = np.searchsorted(at, np.append(knots[:-1:every], knots[-1]))
    return np.unique(np.clip(nearest[:, None] + np.arange(-1, 2), 0, len(at) - 1))


def _splat(seen: np.ndarray, colour: np.ndarray, pixel: float) -> np.ndarray:
    low = seen[:, :2].min(axis=0)
    column, row = (np.rint((seen[:, :2] - low) / pixel).astype(np.int64) + 2).T
    width, height = column.max() + 3, row.max() + 3
    order = np.argsort(seen[:, 2])
    # Of several points in a pixel the last one stays, and that is the nearest.
    rank = np.full((height, width), -1)
    rank[height - 1 - row[order], column[order]] = np.arange(len(order))
    for _ in range(2):
        rank = _close_gaps(rank, seen[order, 2], 4 * pixel)
    image = np.zeros((height, width, 4))
    filled = rank >= 0
    image[filled, :3] = colour[order[rank[filled]]]
    image[filled, 3] = 1.0
    return image


def _close_gaps(
    rank: Int[np.ndarray, "height width"], depth: Float[np.ndarray, "samples"], step: float
) -> Int[np.ndarray, "height width"]:
    """Fill a pixel, or cover what shows through it from behind, with its nearest neighbour.

    Ranks order the samples from far to near, -1 is an empty pixel. Only pixels with neighbours on
    opposite sides count as gaps, so that outlines do not grow.
    """
    height, width = rank.shape
    padded = np.pad(rank, 1, constant_values=-1)
    best = np.full_like(rank, -1)
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = padded[1 + di : 1 + di + height, 1 + dj : 1 + dj + width]
        behind = padded[1 - di : 1 - di + height, 1 - dj : 1 - dj + width]
        best = np.maximum(best, np.minimum(ahead, behind))
    covered = (best >= 0) & ((rank < 0) | (depth[best] - depth[rank] > step))
    return np.where(covered, best, rank)


def _halve(image: np.ndarray) -> np.ndarray:
    """Mean of 2 x 2 pixels, which smooths edges; colours count by their opacity."""
    image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)))
    small = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, 4).mean(axis=(1, 3))
    small[..., :3] /= np.where(small[..., 3:] > 0, small[..., 3:], 1.0)
    return small


def _pad(image: np.ndarray, aspect: float) -> np.ndarray:
    height, width = image.shape[:2]
    rows, columns = max(0, round(width / aspect) - height), max(0, round(height * aspect) - width)
    sides = [(extra // 2, extra - extra // 2) for extra in (rows, columns)]
    return np.pad(image, (*sides, (0, 0)))
