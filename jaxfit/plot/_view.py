"""Where to look at a surface from, and how much to stretch a flat one."""

import dataclasses

import numpy as np
from jaxtyping import Float

_FLAT = 0.15  # height over extent, below which heights are exaggerated
_TILT = np.deg2rad(48.0)  # of the line of sight from the mean normal, for reliefs
_TILT_ROUND = np.deg2rad(22.0)  # the same for everything else
_TURN = np.deg2rad(20.0)


@dataclasses.dataclass(frozen=True)
class View:
    """An orthographic camera for points scaled by `stretch`.

    `relief` is the name of the coordinate that is a height, or empty; `factor` is the stretch
    along it.
    """

    right: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    toward: Float[np.ndarray, "3"]  # from the surface to the eye
    stretch: Float[np.ndarray, "3"]
    relief: str
    factor: int

    def __call__(self, xyz: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Coordinates right, up and toward the eye."""
        return (xyz * self.stretch) @ np.stack([self.right, self.up, self.toward], axis=1)


def choose_view(net: Float[np.ndarray, "a b 3"]) -> View:
    """A view of a grid of surface points that shows its upper or outer side.

    A surface whose extent along one coordinate axis is small against both others is a relief: it
    is seen from the positive side of that axis and stretched along it by a whole factor. Any
    other is seen from the side it bulges to.
    """
    extent = np.ptp(net.reshape(-1, 3), axis=0)
    axis = int(np.argmin(extent))
    normal = _mean_normal(net)
    steepness = extent[axis] / max(np.median(extent), np.finfo(float).tiny)
    stretch, factor, relief = np.ones(3), 1, ""
    if steepness < _FLAT and abs(normal[axis]) > 0.9:
        normal, relief = np.eye(3)[axis], "xyz"[axis]
        if steepness > 1e-6:  # less is rounding
            factor = int(_FLAT / steepness)
            stretch[axis] = factor
    elif _bulge(net, normal) < 0:
        normal = -normal
    return View(*_frame(normal, _TILT if relief else _TILT_ROUND), stretch, relief, factor)


def view_from(toward: Float[np.ndarray, "3"]) -> View:
    """The view from a far eye in the direction `toward`, unstretched; z points up, or y as on a map."""
    toward = _unit(toward)
    up = np.eye(3)[1 if abs(toward[2]) > 0.9 else 2]
    right = _unit(np.cross(up, toward))
    return View(right, np.cross(toward, right), toward, np.ones(3), "", 1)


def _mean_normal(net: np.ndarray) -> np.ndarray:
    """Unit vector of the surface's oriented area."""
    areas = np.cross(net[1:, 1:] - net[:-1, :-1], net[:-1, 1:] - net[1:, :-1])
    total = areas.sum(axis=(0, 1))
    if np.linalg.norm(total) > 0.02 * np.linalg.norm(areas, axis=-1).sum():
        return _unit(total)
    # A closed surface has none: look at it horizontally, where it is broad.
    return -np.eye(3)[np.argmin(np.ptp(net.reshape(-1, 3), axis=0)[:2])]


def _bulge(net: np.ndarray, normal: np.ndarray) -> float:
    border = np.concatenate([net[0], net[-1], net[:, 0], net[:, -1]])
    return float((net.mean(axis=(0, 1)) - border.mean(axis=0)) @ normal)


def _frame(normal: np.ndarray, tilt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and toward the eye, which stands off the normal by `tilt`, a little to the right.

    z points up in the picture, and the eye stands above the normal; but who looks down on z sees
    y point up, as on a map, and stands below.
    """
    on_a_map = abs(normal[2]) > 0.9
    up = np.eye(3)[1 if on_a_map else 2]
    right = _unit(np.cross(up, normal))
    climb = np.cross(normal, right) * (-1 if on_a_map else 1)
    toward = np.cos(tilt) * normal + np.sin(tilt) * (np.cos(_TURN) * climb + np.sin(_TURN) * right)
    right = _unit(np.cross(up, toward))
    return right, np.cross(toward, right), toward


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
