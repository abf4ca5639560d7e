"""Inputs in the roles of the paper's five models: real data where they are, else stand-ins made here.

The paper's own models are not public. Real data are `<name>.npz` in the folder JAXFIT_DATA, or in
`shared/data` beside the checkout. The terrain comes with Matplotlib and is always there.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import jaxfit as jf

CHECKOUT = Path(__file__).resolve().parents[1]
BESIDE = [folder / "shared" / "data" for folder in (CHECKOUT.parent, CHECKOUT)]
FOLDER = Path(os.environ.get("JAXFIT_DATA") or next(filter(Path.is_dir, BESIDE), BESIDE[0]))


@dataclass
class Grid:
    """A grid in the role of a model of the paper."""

    role: str
    source: str
    points: np.ndarray  # (n, m, 3)


@dataclass
class Cloud:
    """Scattered points in the role of a model of the paper, and what a fit of them is asked for."""

    role: str
    source: str
    points: np.ndarray  # (N, 3)
    boundary: jf.Boundary
    net: tuple[int, int]
    target: float
    smoothing: float
    base: object


def diagonal(points):
    """Of the bounding box of points (..., 3)."""
    return float(np.linalg.norm(np.ptp(np.asarray(points).reshape(-1, 3), axis=0)))


def arrays_of(name):
    """Arrays of a data set, or None where it is missing."""
    path = FOLDER / f"{name}.npz"
    if not path.is_file():
        return None
    with np.load(path) as arrays:
        return dict(arrays)


def grids(stand_ins=False):
    """The hood and the two fuselages of Tables 1 to 3."""
    roles = {
        "hood": ("hood_beetle_10x10", made_hood),
        "fuselage 10,000": ("fuselage_d150_50x200", lambda: made_fuselage(50, 200)),
        "fuselage 40,000": ("fuselage_d150_100x400", lambda: made_fuselage(100, 400)),
    }
    for role, (name, make) in roles.items():
        found = None if stand_ins else arrays_of(name)
        yield Grid(role, name, found["grid"]) if found else Grid(role, "stand-in", make())


def clouds(stand_ins=False):
    """The controller, the mannequin and the crown molding of Tables 4 and 5."""
    yield _cloud("controller", "blade_wrap_3000", stand_ins, made_controller, (24, 40), jf.Coons(), 1e-4)
    yield _cloud("mannequin", "mannequin_head", stand_ins, made_head, (42, 42), jf.DynamicBaseSurface(), 2e-5)
    grid = jf.io.jacksboro().grid
    terrain = grid.reshape(-1, 3), jf.Boundary.from_grid(grid)
    yield Cloud("crown molding", "jacksboro", *terrain, (62, 57), 6e-4, 2e-5, jf.Coons())


def _cloud(role, name, stand_ins, make, net, base, smoothing):
    found = None if stand_ins else arrays_of(name)
    if found:
        sides = jf.Boundary(*(found[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
        target = {"controller": 6e-4, "mannequin": 8e-4}[role]
        return Cloud(role, name, found["points"], sides, net, target, smoothing, base)
    shape, count = make
    rng = np.random.default_rng(0)
    line, zero, one = np.linspace(0, 1, 200), np.zeros(200), np.ones(200)
    sides = jf.Boundary(shape(line, zero), shape(line, one), shape(zero, line), shape(one, line))
    points = shape(*rng.uniform(size=(2, count)))
    net = (14, 18) if role == "controller" else net
    return Cloud(role, "stand-in", points, sides, net, 6e-4, smoothing, base)


def made_hood(n=10, m=10):
    """A car's bonnet in mm, symmetric in x."""
    s, t = np.linspace(-1, 1, n)[:, None], np.linspace(0, 1, m)[None, :]
    x = s * (720 - 90 * t**2)
    z = 180 * (1 - 0.7 * s**2) * np.sin(0.4 + 1.1 * t) + 20 * np.exp(-((np.abs(s) - 0.5) ** 2) / 0.03) * t
    return np.stack(np.broadcast_arrays(x, 1000 * t + 60 * s**2 * (t - 1), z), axis=-1)


def made_fuselage(n, m):
    """The starboard half of a fuselage in m, closed towards nose and tail but for a small ring."""
    angle, at = np.linspace(0, np.pi, n)[:, None], np.linspace(0, 1, m)[None, :]
    radius = 2 * (0.05 + np.sin(np.pi * (0.03 + 0.94 * at**0.8))) ** 0.6
    bulge = 1 + 0.15 * np.exp(-(((at - 0.12) / 0.04) ** 2) - (angle / 0.6) ** 2)
    y, z = radius * bulge * np.sin(angle), radius * bulge * np.cos(angle) + 1.5 * at**3
    return np.stack(np.broadcast_arrays(35 * at, y, z), axis=-1)


def _controller(s, t):
    """A shell with two grips and four buttons, its sides in a tight turn."""
    c = 2 * s - 1
    grip = 0.35 * np.exp(-(np.sqrt((t - 0.35) ** 2 + 2e-3) - 0.04) / 0.12) * np.abs(c) ** 3
    z = 0.25 * (16 * s * (1 - s) * t * (1 - t)) ** 1.5
    for a, b, high in ((0.3, 0.6, 0.05), (0.7, 0.6, 0.05), (0.4, 0.3, 0.04), (0.6, 0.3, 0.04)):
        z = z + high * np.exp(-((s - a) ** 2 + (t - b) ** 2) / 0.01)
    return np.stack([c * (1 + grip), t - 0.1 * grip, z], axis=-1)


def _head(s, t):
    """Half an ellipsoid with a nose, a brow, two eyes and a chin."""
    across, up = 2.4 * (s - 0.5), 2.2 * (t - 0.5)
    bumps = ((0.5, 0.5, 0.04, 0.08, 0.12), (0.35, 0.6, 0.05, 0.04, -0.05), (0.65, 0.6, 0.05, 0.04, -0.05))
    bumps += ((0.5, 0.36, 0.06, 0.015, -0.03), (0.5, 0.22, 0.08, 0.06, 0.06), (0.5, 0.7, 0.2, 0.05, 0.04))
    radius = 1 + sum(
        high * np.exp(-0.5 * (((s - a) / p) ** 2 + ((t - b) / q) ** 2)) for a, b, p, q, high in bumps
    )
    return np.stack(
        [
            0.8 * radius * np.sin(across) * np.cos(0.6 * up),
            1.1 * radius * np.sin(up),
            radius * np.cos(across) * np.cos(up),
        ],
        axis=-1,
    )


made_controller = _controller, 3_000
made_head = _head, 11_469
