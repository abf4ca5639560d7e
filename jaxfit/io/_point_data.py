"""What a file of points holds, and the error that says what is wrong with it."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from jaxfit._base import Boundary

MOST_COLUMNS = 16  # without names: coordinates, colours and the ten fields of LAS; more are heights


class InputError(ValueError):
    """A file cannot be used; the message is one sentence that names it and says what to do.

    Examples
    --------
    >>> try:
    ...     jf.io.read_points("nowhere.npy")
    ... except jf.io.InputError as error:
    ...     print(error)
    nowhere.npy does not exist; check its name and folder.
    """


def one_line(error: Exception) -> str:
    """What a library has to say, for a sentence of ours."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


@dataclasses.dataclass(frozen=True)
class PointData:
    """Data points as read from a file: scattered `points`, or a `grid`, never both.

    Parameters
    ----------
    points : array (N, 3), optional
        Scattered points, float64, in file order; None for a grid.
    grid : array (n, m, 3), optional
        Points in rows and columns, float64: the first index runs along u, the second along v;
        None for scattered points.
    boundary : Boundary, optional
        The four border polylines: as stored beside scattered points, or the edges of a grid
        (None where the edges make no boundary, for instance because one of them is a single
        point). None when nothing is known about the border.
    name : str
        Short name for tables, titles and sentences: the file's name without its folder.
    left_out : dict of int
        Of a scanner's file or a mesh: how many of its points are not in `points`, by reason; empty if
        all are. The reasons are "withheld" and "classified as noise" (LAS), "invalid" (E57),
        "not finite", and of meshes "in no face" and "repeated".
    faces : array (faces, 3) of int, optional
        Of a mesh: the numbers of the `points` at the corners of each triangle; None otherwise.

    Examples
    --------
    >>> data = jf.io.PointData(points=np.zeros((6, 3)), grid=None, boundary=None, name="six")
    >>> data.as_grid(3, 2).grid.shape
    (3, 2, 3)
    """

    points: Float[np.ndarray, "points 3"] | None
    grid: Float[np.ndarray, "n m 3"] | None
    boundary: Boundary | None
    name: str
    left_out: Mapping[str, int] = dataclasses.field(default_factory=dict)
    faces: Int[np.ndarray, "faces 3"] | None = None

    @property
    def cloud(self) -> Float[np.ndarray, "points 3"]:
        """All points one after another, whether or not they make a grid (row by row)."""
        if self.points is not None:
            return self.points
        assert self.grid is not None
        return self.grid.reshape(-1, 3)

    def as_grid(self, n: int, m: int) -> "PointData":
        """The same points read as a grid of `n` by `m`, the second index running fastest.

        Raises
        ------
        InputError
            If there are not n * m points.
        """
        cloud = self.cloud
        if len(cloud) != n * m:
            raise InputError(
                f"{self.name} holds {len(cloud)} points, which do not make a {n} x {m} grid of "
                f"{n * m}; give the grid's true size."
            )
        return dataclasses.replace(grid_data(cloud.reshape(n, m, 3), self.name), left_out=self.left_out)


def grid_data(grid: Float[np.ndarray, "n m 3"], name: str, path: object = None) -> PointData:
    """A grid, its four edges as the boundary where they make one; errors name the `path`."""
    if min(grid.shape[:2]) < 2:
        raise InputError(
            f"{path or name} holds a grid of {grid.shape[0]} x {grid.shape[1]} points, which "
            "spans no surface; give at least two rows and two columns."
        )
    try:
        boundary = Boundary.from_grid(grid)
    except ValueError:
        boundary = None
    return PointData(None, grid, boundary, name)
