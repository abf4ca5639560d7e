"""Files of points are read exactly, and every bad one is named in one sentence."""

import gzip

import numpy as np
import pytest
from helpers import data, grid_edges, wavy_cloud, wavy_grid

import jaxfit as jf
from jaxfit import Boundary
from jaxfit.io import InputError, PointData, jacksboro, read_boundary, read_points

POINTS = np.arange(24.0).reshape(8, 3) ** 1.5


def boundary_arrays(edges):
    return {f"boundary_{side}": polyline for side, polyline in edges.items()}


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


def text(path, content):
    path.write_text(content)
    return path


def sentence(path):
    with pytest.raises(InputError) as caught:
        read_points(path)
    message = str(caught.value)
    assert path.name in message
    assert "\n" not in message
    assert message.endswith(".")
    return message


# ------------------------------------------------------------------ good files


def test_npz_with_points_and_boundary(tmp_path):
    points, edges = wavy_cloud(50)
    path = npz(tmp_path / "cloud.npz", points=points, extra=np.ones(3), **boundary_arrays(edges))
    read = read_points(path)
    assert read.name == "cloud.npz"
    assert read.grid is None
    np.testing.assert_array_equal(read.points, points)
    np.testing.assert_array_equal(read.cloud, points)
    for side, polyline in edges.items():
        np.testing.assert_allclose(getattr(read.boundary, side), polyline, atol=1e-12)
        np.testing.assert_allclose(getattr(read_boundary(path), side), polyline, atol=1e-12)


def test_npz_with_points_alone_has_no_boundary(tmp_path):
    read = read_points(npz(tmp_path / "a.npz", points=POINTS))
    assert read.boundary is None
    with pytest.raises(InputError, match="holds no boundary"):
        read_boundary(tmp_path / "a.npz")


def test_npz_with_a_grid_has_its_edges_as_boundary(tmp_path):
    grid = wavy_grid(5, 4)
    read = read_points(npz(tmp_path / "a.npz", grid=grid))
    assert read.points is None
    np.testing.assert_array_equal(read.grid, grid)
    np.testing.assert_array_equal(read.cloud, grid.reshape(-1, 3))
    for side, polyline in grid_edges(grid).items():
        np.testing.assert_allclose(getattr(read.boundary, side), polyline, atol=1e-12)


def test_what_was_read_is_fitted_as_it_is():
    grid = wavy_grid(8, 7)
    edges = Boundary.from_grid(grid)
    read = PointData(points=None, grid=grid, boundary=edges, name="waves")
    net = np.asarray(jf.interpolate(read, jf.StandardInterpolation()).surface.control_points)
    np.testing.assert_array_equal(
        net, jf.interpolate(grid, jf.StandardInterpolation()).surface.control_points
    )
    base = jf.base_surface(edges, net=(6, 6))
    fits = [
        jf.approximate(x, base, jf.GeometricApproximation(), max_steps=0) for x in (read, grid.reshape(-1, 3))
    ]
    np.testing.assert_array_equal(fits[0].errors, fits[1].errors)


def test_a_grid_whose_edge_is_one_point_has_no_boundary(tmp_path):
    grid = wavy_grid(5, 4)
    grid[0] = grid[0, 0]
    assert read_points(npz(tmp_path / "pole.npz", grid=grid)).boundary is None


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int32])
@pytest.mark.parametrize("columns", [3, 5])
def test_npy_holds_points_or_a_grid(tmp_path, dtype, columns):
    grid = np.arange(20 * columns).reshape(5, 4, columns).astype(dtype)
    np.save(tmp_path / "g.npy", grid)
    np.save(tmp_path / "p.npy", grid.reshape(20, columns))
    np.testing.assert_array_equal(read_points(tmp_path / "g.npy").grid, grid[..., :3])
    points = read_points(tmp_path / "p.npy").points
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, grid.reshape(20, columns)[:, :3])


def lines(delimiter, extra=""):
    return "".join(delimiter.join(map(repr, row)) + extra + "\n" for row in POINTS.tolist())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", lines(" ")),
        ("a.txt", "# made by hand\n\n" + lines("\t", "  # yes")),
        ("a.csv", lines(",")),
        ("a.csv", "x,y,z\n" + lines(", ")),
        ("a.CSV", "\ufeffeast, north, height\n" + lines(",")),
        ("a.csv", "X,Y,Z,x_m,y_m,z_m\n" + lines(",", ",7,8,9")),
        ("a.csv", "x\ty\tz\n" + lines("\t")),
        ("a.xyz", "x y z\n" + lines("   ", " 0.5 0.5")),
    ],
)
def test_text_is_read_exactly(tmp_path, name, content):
    np.testing.assert_array_equal(read_points(text(tmp_path / name, content)).points, POINTS)


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("a.csv", "nr, X (mm), Y (mm), Z (mm)"),
        ("a.csv", "nr;x_mm;y_mm;z_mm"),
        ("a.csv", '"nr","X [m]","Y [m]","Z [m]"'),
        ("a.csv", "nr\tx/mm\ty/mm\tz/mm"),
        ("a.txt", "nr X (mm) Y (mm) Z (mm)"),
        ("a.txt", "Point ID\tX\tY\tZ"),
        ("a.txt", "nr, x mm, y mm, z mm"),
    ],
)
def test_names_may_have_units(tmp_path, name, header):
    between = next((x for x in ";\t," if x in header and name == "a.csv"), " ")
    rows = "\n".join(between.join(map(repr, [7.0, *row])) for row in POINTS.tolist())
    np.testing.assert_array_equal(read_points(text(tmp_path / name, f"{header}\n{rows}\n")).points, POINTS)


@pytest.mark.parametrize("rows", ["p 1\t{}\t5", "\t{}\t5"])  # a blank is no tab, nor is an empty cell nothing
def test_tabs_separate_columns_of_a_csv(tmp_path, rows):
    content = "".join(rows.format("\t".join(map(repr, row))) + "\n" for row in POINTS.tolist())
    found = read_points(text(tmp_path / "a.csv", "label\tx\ty\tz\tI\n" + content))
    np.testing.assert_array_equal(found.points, POINTS)


@pytest.mark.parametrize(
    ("name", "header", "said"),
    [
        ("a.csv", "Nr;Rechtswert;Hochwert;Hoehe", "its columns Nr, Rechtswert, Hochwert, Hoehe; name three"),
        ("a.csv", ",lon,lat,height", "its columns '', lon, lat, height; name three of them x, y and z"),
        ("a.csv", "x (m),y (m),x (px),y (px)", "its columns x (m), y (m), x (px), y (px); name"),
        ("a.csv", "nr,x_normal,y_normal,z_normal", "nr, x_normal, y_normal, z_normal; name"),
        ("a.xyz", "Point ID x y z", "its columns Point, ID, x, y, z, but has 4; name three"),
        ("a.txt", "ID mm z mm y mm x mm", "z, mm, y, mm, x, mm, but has 4; name three of them x, y and z"),
    ],
)
def test_names_that_do_not_tell_the_axes_are_refused(tmp_path, name, header, said):
    between = next((x for x in ";," if x in header), " ")
    rows = "".join(between.join(map(repr, [7.0, *row])) + "\n" for row in POINTS.tolist())
    assert said in sentence(text(tmp_path / name, f"{header}\n{rows}"))


@pytest.mark.parametrize("name", ["a.csv", "a.txt"])
def test_semicolons_separate_columns(tmp_path, name):
    rows = "\n".join(";".join(map(repr, row.tolist())) for row in POINTS[:, [2, 0, 1]])
    path = text(tmp_path / name, f"z; x; y\n{rows}\n")
    np.testing.assert_array_equal(read_points(path).points, POINTS)
    assert "line 2 has 2 columns" in sentence(text(tmp_path / "b.csv", "1;2;3\n4;5\n6;7;8\n9;1;2\n"))
    assert "by semicolons" in sentence(text(tmp_path / "b.csv", "1;2;3\n4;5\n6;7;8\n9;1;2\n"))


def test_scattered_points_can_be_read_as_a_grid(tmp_path):
    read = read_points(text(tmp_path / "a.xyz", lines(" ")))
    np.testing.assert_array_equal(read.as_grid(4, 2).grid, POINTS.reshape(4, 2, 3))
    with pytest.raises(InputError, match="8 points, which do not make a 3 x 3 grid"):
        read.as_grid(3, 3)
    with pytest.raises(InputError, match="two rows"):
        read.as_grid(8, 1)


# ------------------------------------------------------------------- bad files


def test_files_that_are_not_there(tmp_path):
    assert "does not exist" in sentence(tmp_path / "none.npz")
    assert "is a folder" in sentence(tmp_path)
    assert "suffix .dwg" in sentence(text(tmp_path / "a.dwg", "AC10"))
    assert "no suffix" in sentence(text(tmp_path / "points", "0 0 0"))


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".csv", ".xyz"])
def test_empty_and_damaged_files(tmp_path, suffix):
    path = text(tmp_path / f"a{suffix}", "")
    assert "is empty" in sentence(path)
    path.write_bytes(b"\xff\xfe\x00\x80 not what it says")
    assert "plain" in sentence(path)


@pytest.mark.parametrize("suffix", [".npz", ".npy"])
def test_truncated_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    np.save(path, POINTS) if suffix == ".npy" else np.savez(path, points=POINTS)
    path.write_bytes(path.read_bytes()[:-100])
    assert "is damaged" in sentence(path)


def test_a_damaged_member_is_noticed(tmp_path):
    path = npz(tmp_path / "a.npz", points=POINTS)
    content = bytearray(path.read_bytes())
    content[200] ^= 0xFF
    path.write_bytes(content)
    assert "is damaged" in sentence(path)


def test_python_objects_are_never_loaded(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=np.array([{"x": 1}, None], dtype=object))
    assert "plain NumPy arrays" in sentence(path)
    np.savez(path, points=POINTS, notes=np.array([{"x": 1}], dtype=object))
    np.testing.assert_array_equal(read_points(path).points, POINTS)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({}, "neither a grid nor points, but nothing"),
        ({"xyz": POINTS}, "neither a grid nor points, but xyz"),
        ({"points": POINTS[:, :2]}, r"points has shape (8, 2); it must be (N, 3)"),
        ({"points": POINTS.ravel()}, "points has shape (24,)"),
        ({"grid": POINTS}, r"grid has shape (8, 3); it must be (n, m, 3)"),
        ({"grid": POINTS[None]}, "grid of 1 x 8 points"),
        ({"points": POINTS + 1j}, "real numbers"),
        ({"points": POINTS.astype(str)}, "real numbers"),
        ({"grid": np.ones((3, 20, 30))}, "must be (n, m, 3): store np.moveaxis(grid, 0, -1)"),
        ({"grid": np.ones((20, 3, 30))}, "must be (n, m, 3): store np.moveaxis(grid, 1, -1)"),
        ({"grid": np.ones((20, 30, 40))}, "grid has shape (20, 30, 40); it must be (n, m, 3)"),
        ({"points": np.ones((30, 20))}, "(30, 20); it must be (N, 3), or a grid (n, m, 3) if these are"),
        ({"points": POINTS[:3]}, "3 points, but a surface needs at least 4"),
        ({"points": POINTS[:1]}, "1 point, but"),
        ({"points": POINTS[:0]}, "0 points, but"),
        ({"points": POINTS, "boundary_v0": POINTS}, "without boundary_v1, boundary_u0"),
    ],
)
def test_arrays_that_are_no_points(tmp_path, arrays, said):
    assert said in sentence(npz(tmp_path / "a.npz", **arrays))


def test_coordinates_that_are_no_numbers(tmp_path):
    points = POINTS.copy()
    points[[2, 5], 1] = np.nan, np.inf
    assert "2 of 8 points in array 'points'" in sentence(npz(tmp_path / "a.npz", points=points))
    assert "first at index 2;" in sentence(npz(tmp_path / "a.npz", points=points))
    grid = points.reshape(2, 4, 3)
    assert "first at index 0, 2;" in sentence(npz(tmp_path / "a.npz", grid=grid))


def test_a_bad_boundary_is_refused(tmp_path):
    points, edges = wavy_cloud(50)
    arrays = boundary_arrays(edges)
    arrays["boundary_v0"] = arrays["boundary_v0"][::-1]
    assert "corner" in sentence(npz(tmp_path / "a.npz", points=points, **arrays))
    arrays["boundary_v0"] = np.full((4, 3), np.nan)
    said = sentence(npz(tmp_path / "a.npz", points=points, **arrays))
    assert "4 of 4 points in array 'boundary_v0'" in said


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", "0 0 0\n1 1 1\n\n1 0\n0 1 1\n", "line 4 has 2 columns"),
        ("a.csv", "x,y,z\n0,0,0\n1,one,1\n", "line 3 has 'one' in place of a number"),
        ("a.csv", "0,0,0\n1,,1\n", "line 2 has '' in place of a number"),
        ("a.csv", "0\n1\n", "line 1 has 1 column, but a point has three"),
        ("a.xyz", "0,0\n1,1\n", "separate x, y and z by blanks"),
        ("a.xyz", "0 0 0\n1 nan 1\n0 1 inf\n1 1 1\n", "2 of 4 points have NaN"),
        ("a.xyz", "# c\n0 0 0\n1 nan 1\n0 1 0\n1 1 1\n", "the first in line 3"),
        ("a.xyz", "0 0 0\n1 0 1\n0 1 0\n", "3 points, but a surface needs at least 4"),
        ("a.csv", ",".join(["0.5"] * 20) + "\n", "has 20 columns without names; give one point x,y,z a line"),
        ("a.csv", "x,y,z\n[m],[m],[m]\n0,0,0\n", "line 2 is no point, and only one line of names may come"),
        ("a.csv", "Scan 7\n\nx,y,z\n0,0,0\n", "line 1 is no point, and only one line of names may come"),
        ("a.csv", "x,y,z\n0,one,0\n1,1,1\n", "line 2 has 'one' in place of a number"),
        ("a.csv", "0,0,0\none,two,three\n", "line 2 has 'one' in place of a number"),
        ("a.xyz", "# nothing\n\n", "holds no points"),
        ("a.csv", "x,y,z\n", "holds no points"),
        ("a.csv", "0,0,0\n1,0.5,1\n1,0,,1\n0,1,1\n", "line 3 has '' in place of a number"),
        ("a.csv", "0,0,0\n1,0.5,1\n1,0.5,1,1\n0,1,1\n", "line 3 has 4 columns, but the first point has 3"),
    ],
)
def test_text_that_is_no_table(tmp_path, name, content, said):
    assert said in sentence(text(tmp_path / name, content))


def test_numbers_may_stand_in_quotes_and_commas_before_blanks(tmp_path):
    rows = [(0.5, 0, 0), (1, 1.5, 0), (0, 1, -2e3), (1, 0, 4)]
    quoted = "".join(",".join(f'"{x}"' for x in row) + "\n" for row in rows)
    np.testing.assert_array_equal(read_points(text(tmp_path / "a.csv", quoted)).points, rows)
    labelled = "".join(f'{x},{y},{z},"{"a, b" if x else "c"}"\n' for x, y, z in rows)
    np.testing.assert_array_equal(read_points(text(tmp_path / "b.csv", labelled)).points, rows)
    spaced = "".join(", ".join(map(str, row)) + "\n" for row in rows)
    for name in ("c.xyz", "c.txt", "c.csv"):
        np.testing.assert_array_equal(read_points(text(tmp_path / name, spaced)).points, rows)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", "0.5,0,0\n1,1.5,0\n0,1,-2e3\n1,0,4\n"),
        ("a.xyz", "0.5,0,0,\n1,1.5,0,\n0,1,-2e3,\n1,0,4,\n"),
        ("a.csv", "x y z\n0.5 0 0\n1 1.5 0\n0 1 -2e3\n1 0 4\n"),
        ("a.csv", "4\n0.5,0,0\n1,1.5,0\n0,1,-2e3\n1,0,4\n"),
        ("a.xyz", "4\n0.5 0 0\n1 1.5 0\n0 1 -2e3\n1 0 4\n"),
    ],
)
def test_columns_may_be_separated_otherwise_and_their_number_may_come_first(tmp_path, name, content):
    expected = [(0.5, 0, 0), (1, 1.5, 0), (0, 1, -2e3), (1, 0, 4)]
    np.testing.assert_array_equal(read_points(text(tmp_path / name, content)).points, expected)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_text_may_be_in_the_usual_encodings(tmp_path, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes("# Gerät 7\nx,y,z,Höhe\n0.5,0,0,1\n1,1.5,0,1\n0,1,-2e3,1\n1,0,4,1\n".encode(encoding))
    np.testing.assert_array_equal(read_points(path).points[2], [0, 1, -2e3])
    path.write_bytes(b"0,0,0\n\x00\xff\n")
    assert "a.csv holds no plain text; save it as text in UTF-8" in sentence(path)


def test_packed_text_is_to_be_unpacked(tmp_path):
    (tmp_path / "a.csv").write_bytes(gzip.compress(b"0,0,0\n1,0,0\n0,1,0\n1,1,1\n"))
    assert "a.csv is packed; unpack it" in sentence(tmp_path / "a.csv")


# ----------------------------------------------------------------- the terrain


def test_the_terrain_inside_matplotlib_is_in_metres():
    terrain = jacksboro()
    assert terrain.grid.shape == (403, 344, 3)
    assert terrain.boundary is not None
    np.testing.assert_allclose(terrain.grid.mean(axis=(0, 1))[:2], 0, atol=1e-6)
    assert (np.diff(terrain.grid[..., 0], axis=0) > 0).all()  # first index east
    assert (np.diff(terrain.grid[..., 1], axis=1) < 0).all()  # second index south
    assert np.linalg.norm(np.ptp(terrain.cloud, axis=0)) == pytest.approx(43651.3, abs=0.1)


def test_the_terrain_equals_the_data_set():
    np.testing.assert_allclose(jacksboro().grid, data("jacksboro_dem")["grid"], rtol=1e-15)
