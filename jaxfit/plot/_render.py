"""A shaded picture of a surface without a mesh: many points, the nearest one wins each pixel."""

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._base._host_splines import GridEvaluator
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface
from jaxfit.plot._part import ranges, shown, whole
from jaxfit.plot._view import View, choose_view

_PIXELS = 1400  # longer side of the raw picture, which is halved in the end
_COARSE = 129  # surface points per direction that choose view and density
_DENSITY = 1.2  # surface points per raw pixel, per direction
_MOST = 1700  # surface points per direction, whatever the density asks for
_KNOT_LINES = 14  # at most, per direction
_DEPTHS = 16  # steps of depth per raw pixel
_INDEX_BITS = 32

_PLAIN = np.array([0.84, 0.80, 0.72])
_HEIGHTS = np.array([[0.47, 0.57, 0.44], [0.80, 0.77, 0.60], [0.70, 0.57, 0.45], [0.96, 0.94, 0.91]])
_LINE = np.array([0.13, 0.25, 0.40], np.float32)
FOLD = np.array([0.86, 0.10, 0.16], np.float32)
_RIM = 3  # samples by which a loop is drawn inwards
_FOLD_RADIUS = 6  # in samples, so about five raw pixels
_LIGHT = np.array([-0.68, 0.42, 0.60])  # from the upper left, in front of the picture


def render(
    part: BSplineSurface | TrimmedSurface,
    aspect: float = 1.1,
    view: View | None = None,
    paint: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    folds: Float[np.ndarray, "folds 2"] | None = None,
) -> tuple[Float[np.ndarray, "height width 4"], View]:
    """The surface in RGBA with shading and some of its knot lines, and the view it is seen in.

    The picture is transparent round the surface, and `aspect` times as wide as high. A `paint`
    gives the colours (a, b, 3) at parameters (a,) and (b,); nothing is shaded or drawn on them but red spots
    at the parameters of `folds`, where they can be seen. Of a trimmed surface nothing outside its loops is
    drawn, and they are.
    """
    surface = whole(part)
    us, vs, coarse = coarse_points(part)
    view = choose_view(coarse) if view is None else view
    seen = view(coarse)
    kept = shown(part, us, vs)
    framed = seen[kept] if kept.any() else seen.reshape(-1, 3)
    size = np.ptp(framed[:, :2], axis=0).max()
    pixel = max(size, np.finfo(float).tiny) / (_PIXELS - 1)
    (us, step_u), (vs, step_v) = _refine(us, seen, pixel), _refine(vs, seen.swapaxes(0, 1), pixel)
    # The view is affine: applied to the control points, it applies to the surface.
    net = (view(_net(surface)) - framed.min(axis=0)) / pixel
    points = _evaluator(surface, us, vs)
    kept = shown(part, us, vs)
    x, y, z = (points.points(net[..., c])[kept] for c in range(3))
    keys = _nearest(x, y, z, np.flatnonzero(kept), int(np.ceil(max(step_u, step_v))))
    filled = keys >= 0
    index = keys[filled] & ((1 << _INDEX_BITS) - 1)
    image = np.zeros((*keys.shape, 4), np.float32)
    image[filled, 3] = 1.0
    if paint is not None:
        image[filled, :3] = paint(us, vs).reshape(-1, 3)[index]
    else:
        colour = _ground(_heights(surface, view, points, index), len(index))
        colour *= _shade(net, points).ravel()[index, None]
        for knots, at, number in zip(
            (surface.knots_u, surface.knots_v), (us, vs), np.divmod(index, len(vs)), strict=True
        ):
            near = _near_a_knot(np.asarray(knots, dtype=float), at)[number]
            colour[near] = 0.5 * colour[near] + 0.5 * _LINE
        image[filled, :3] = np.clip(colour, 0, 1)
    if isinstance(part, TrimmedSurface):
        image[filled, :3] = np.where(_rim(kept).ravel()[index, None], _LINE, image[filled, :3])
    if folds is not None and len(folds):
        image[filled, :3] = np.where(_near(folds, us, vs).ravel()[index, None], FOLD, image[filled, :3])
    return _pad(_halve(image), aspect), view


def _evaluator(
    surface: BSplineSurface, us: np.ndarray, vs: np.ndarray, dtype: Any = np.float32
) -> GridEvaluator:
    """Of the surface's knots; in single precision, which a picture needs no more than."""
    knots = np.asarray(surface.knots_u, float), np.asarray(surface.knots_v, float)
    return GridEvaluator(knots, surface.order, us, vs, dtype)


def coarse_points(part: BSplineSurface | TrimmedSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evenly spaced parameters along u and along v, and the points there: enough to choose a view."""
    surface = whole(part)
    us, vs = (np.linspace(low, high, _COARSE) for low, high in ranges(part))
    points = _evaluator(surface, us, vs, float).points(_net(surface))
    return us, vs, points


def _net(surface: BSplineSurface) -> Float[np.ndarray, "nu nv 3"]:
    """Control points, cut or filled with zeros to three coordinates."""
    net = np.asarray(surface.control_points, dtype=float)
    return np.concatenate([net, np.zeros((*net.shape[:2], 3))], axis=-1)[..., :3]


def _refine(at: np.ndarray, seen: np.ndarray, pixel: float) -> tuple[np.ndarray, float]:
    """Parameters spaced evenly in the picture, where the first axis of `seen` belongs to `at`, and the
    distance of their points in raw pixels, at most.
    """
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=-1).max(axis=1) / pixel
    along = np.append(0.0, np.cumsum(np.maximum(steps, 1e-3)))
    count = int(np.clip(_DENSITY * along[-1], 200, _MOST))
    return np.interp(np.linspace(0, along[-1], count), along, at), along[-1] / (count - 1)


def _heights(
    surface: BSplineSurface, view: View, points: GridEvaluator, index: np.ndarray
) -> np.ndarray | None:
    """Heights from 0 to 1 of a relief at the samples `index`; None for any other surface."""
    if not view.relief:
        return None
    net = _net(surface)[..., "xyz".index(view.relief)]
    height = points.points(net - net.min())
    height = (height - height.min()) / max(np.ptp(height), np.finfo(np.float32).tiny)
    return height.ravel()[index]


def _ground(heights: np.ndarray | None, count: int) -> Float[np.ndarray, "count 3"]:
    """One colour, or colours by height for a relief."""
    if heights is None:
        return np.tile(_PLAIN.astype(np.float32), (count, 1))
    stops = np.linspace(0, 1, len(_HEIGHTS))
    channels = [np.interp(heights, stops, channel) for channel in _HEIGHTS.T]
    return np.stack(channels, axis=-1).astype(np.float32)


def _shade(net: Float[np.ndarray, "nu nv 3"], points: GridEvaluator) -> Float[np.ndarray, "a b"]:
    """Brightness by the angle to the light; both sides are lit."""
    along_u, along_v = ([points.points(net[..., c], *which) for c in range(3)] for which in ((1, 0), (0, 1)))
    normal = [along_u[b] * along_v[c] - along_u[c] * along_v[b] for b, c in ((1, 2), (2, 0), (0, 1))]
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    light = _LIGHT / np.linalg.norm(_LIGHT)
    cosine = sum(float(a) * x for a, x in zip(light, normal, strict=True))
    cosine = np.copysign(1.0, normal[2]) * cosine / np.where(length > 0, length, 1.0)
    # The square keeps some shape in the shade, where Lambert's law has none.
    return 0.2 + 0.95 * (0.5 + 0.5 * cosine) ** 2


def _near_a_knot(knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Which of `at` are next to evenly chosen knots; the ends of the domain always count."""
    knots = np.unique(np.clip(knots, at[0], at[-1]))
    every = -(-(len(knots) - 1) // _KNOT_LINES)
    nearest = np.searchsorted(at, np.append(knots[:-1:every], knots[-1]))
    near = np.zeros(len(at), bool)
    near[np.clip(nearest[:, None] + np.arange(-1, 2), 0, len(at) - 1)] = True
    return near


def _near(places: np.ndarray, us: np.ndarray, vs: np.ndarray) -> Bool[np.ndarray, "a b"]:
    """Which samples lie in a square round one of the parameters `places`."""
    near = np.zeros((len(us), len(vs)), bool)
    i, j = (np.searchsorted(at, places[:, k]) for k, at in enumerate((us, vs)))
    reach = np.arange(-_FOLD_RADIUS, _FOLD_RADIUS + 1)
    rows, columns = (
        np.clip(x[:, None] + reach, 0, len(at) - 1) for x, at in zip((i, j), (us, vs), strict=True)
    )
    near[rows[:, :, None], columns[:, None, :]] = True
    return near


def _rim(kept: Bool[np.ndarray, "a b"]) -> Bool[np.ndarray, "a b"]:
    """Samples within a few of one that is not kept."""
    from scipy.ndimage import binary_erosion

    return kept & ~binary_erosion(kept, np.ones((3, 3), bool), iterations=_RIM)


def _nearest(
    x: Float[np.ndarray, " k"],
    y: Float[np.ndarray, " k"],
    z: Float[np.ndarray, " k"],
    index: Int[np.ndarray, " k"],
    gap: int,
) -> Int[np.ndarray, "height width"]:
    """For every raw pixel a key of the sample in front: its depth in the upper bits, its number in `index` in
    the lower ones. -1 is an empty pixel. Samples of a sheet may be `gap` pixels apart.
    """
    column = np.rint(x + (2 - x.min())).astype(np.int32)
    row = np.rint((y.max() + 2) - y).astype(np.int32)
    width, height = int(column.max()) + 3, int(row.max()) + 3
    depth = ((z - z.min()) * _DEPTHS).astype(np.int64)
    keys = np.full((height, width), -1)
    np.maximum.at(keys.ravel(), row * width + column, (depth << _INDEX_BITS) + index)
    for reach in [gap] * gap + [1]:
        keys = _close_gaps(keys, reach)
    return keys


def _close_gaps(keys: Int[np.ndarray, "height width"], reach: int) -> Int[np.ndarray, "height width"]:
    """Fill a pixel, or cover what shows through it from behind, with the nearest one within `reach`.

    Only pixels with some on opposite sides count as gaps, so that outlines do not grow.
    """
    height, width = keys.shape
    padded = np.pad(keys, reach, constant_values=-1)

    def shifted(i: int, j: int) -> np.ndarray:
        return padded[reach + i : reach + i + height, reach + j : reach + j + width]

    best = np.full_like(keys, -1)
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = reduce(np.maximum, [shifted(k * i, k * j) for k in range(1, reach + 1)])
        behind = reduce(np.maximum, [shifted(-k * i, -k * j) for k in range(1, reach + 1)])
        best = np.maximum(best, np.minimum(ahead, behind))
    step = (4 * _DEPTHS) << _INDEX_BITS
    return np.where((best >= 0) & ((keys < 0) | (best - keys > step)), best, keys)


def _halve(image: np.ndarray) -> np.ndarray:
    """Mean of 2 x 2 pixels, which smooths edges; colours count by their opacity."""
    image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)))
    small = 0.25 * (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2])
    small[..., :3] /= np.where(small[..., 3:] > 0, small[..., 3:], 1.0)
    return small


def _pad(image: np.ndarray, aspect: float) -> np.ndarray:
    height, width = image.shape[:2]
    rows, columns = max(0, round(width / aspect) - height), max(0, round(height * aspect) - width)
    sides = [(extra // 2, extra - extra // 2) for extra in (rows, columns)]
    return np.pad(image, (*sides, (0, 0)))
