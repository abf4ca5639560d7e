"""What would mislead a fit is refused in a sentence, before anything is computed or allocated."""

import dataclasses
import inspect
import io
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import zipfile

import jax
import numpy as np
import pytest
from helpers import CHECKOUT, wavy_cloud, wavy_grid, wavy_surface

import jaxfit as jf
from jaxfit import _cli, _interrupt
from jaxfit._approximation._sharded_fit import fit_sharded_cloud
from jaxfit._approximation._smoothing_term import check_smoothing
from jaxfit._checks import as_floating, check_number
from jaxfit._fit._border import check_border
from jaxfit.io import InputError, PointData, read_points, read_surface, write_surface

GRID = wavy_grid(8, 7)
POINTS, EDGES = wavy_cloud(60)
BOUNDARY = jf.Boundary(**EDGES)


def without_data(points):
    marked = points.copy()
    marked.reshape(-1, 3)[[7, 20], 2] = -9999.0
    return marked


def sentence(error):
    said = str(error.value)
    assert "\n" not in said
    assert said.endswith(".")
    return said


# ------------------------------------------------------------------ text files


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", "1,5,2,0,3,1\n1,0,2,5,3,2\n1,1,2,2,3,3\n1,2,2,3,3,4\n"),
        ("a.csv", "x,y,z\n1,5,2,0,3,1\n1,0,2,5,3,2\n1,1,2,2,3,3\n1,2,2,3,3,4\n"),
        ("a.csv", "1,5,2,3,1\n1,0,2,5,3,2\n1,1,2,2,3,3\n1,2,2,3,3,4\n"),
        ("a.csv", "1,5;2,0;3,1\n" * 4),
        ("a.csv", "1,5 2,0 3,1\n" * 4),
        ("a.xyz", "1,5 2,0 3,1\n" * 4),
        ("a.txt", "1,5;2,0;3,1\n" * 4),
        ("a.txt", "1,5\t-2,0\t3\n" * 4),
    ],
)
def test_decimal_commas_are_refused(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name} seems to hold decimal commas") as error:
        read_points(tmp_path / name)
    assert "write decimals with points" in sentence(error)


def test_named_columns_of_whole_numbers_are_no_decimal_commas(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x,y,z,r,g,b\n1,5,2,0,3,1\n1,0,2,5,3,2\n1,1,2,2,3,3\n1,2,2,3,3,4\n")
    np.testing.assert_array_equal(read_points(path).points, [[1, 5, 2], [1, 0, 2], [1, 1, 2], [1, 2, 2]])
    path.write_text("1,5,2\n1,0,2\n1,1,2\n1,2,2\n")
    assert read_points(path).points.shape == (4, 3)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("name", ["a.csv", "a.xyz"])
def test_a_column_that_counts_the_points_is_refused(tmp_path, first, name):
    delimiter = "," if name == "a.csv" else " "
    numbered = np.column_stack([np.arange(first, first + 60), POINTS])
    np.savetxt(tmp_path / name, numbered, delimiter=delimiter, header="my scan", comments="")
    with pytest.raises(InputError, match=f"{name}: the first column only counts the points") as error:
        read_points(tmp_path / name)
    assert "remove it, or name the columns x, y and z in the first line" in sentence(error)
    header = delimiter.join("xyzw")
    np.savetxt(tmp_path / name, numbered, delimiter=delimiter, header=header, comments="")
    np.testing.assert_array_equal(read_points(tmp_path / name).points, numbered[:, :3])
    np.savetxt(tmp_path / name, numbered[:, [1, 2, 3, 0]], delimiter=delimiter)
    np.testing.assert_array_equal(read_points(tmp_path / name).points, POINTS)


@pytest.mark.parametrize(
    "numbers",
    [np.arange(1000, 1060), 10 * np.arange(60), np.delete(np.arange(1, 62), 7), np.arange(60)[::-1]],
    ids=["from 1000", "in tens", "with a gap", "backwards"],
)
def test_a_column_that_numbers_the_points_is_refused(tmp_path, numbers):
    path = tmp_path / "a.csv"
    np.savetxt(path, np.column_stack([numbers, POINTS]), delimiter=",")
    said = f"the first column only numbers the points, from {numbers.min()} to {numbers.max()}; remove it, or"
    with pytest.raises(InputError, match=said):
        read_points(path)
    repeated = np.column_stack([numbers - numbers % 20, POINTS])
    np.savetxt(path, repeated, delimiter=",")
    np.testing.assert_array_equal(read_points(path).points, repeated[:, :3])
    whole = np.column_stack([numbers, numbers % 7, POINTS])
    np.savetxt(path, whole, delimiter=",")
    np.testing.assert_array_equal(read_points(path).points, whole[:, :3])


@pytest.mark.parametrize(("name", "delimiter"), [("a.csv", ","), ("a.xyz", " ")])
@pytest.mark.parametrize("names", ["n x y z", "z y x w", 'w "Z" "X" "Y"'])
def test_columns_are_found_by_their_names(tmp_path, name, delimiter, names):
    where = [names.replace('"', "").lower().split().index(axis) for axis in "xyz"]
    table = np.full((60, 4), 7.5)
    table[:, where] = POINTS
    header = delimiter.join(names.split())
    np.savetxt(tmp_path / name, table, delimiter=delimiter, header=header, comments="")
    np.testing.assert_allclose(read_points(tmp_path / name).points, POINTS)


def test_a_short_line_of_whole_numbers_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n4,5,6\n1,2\n7,8,9\n")
    with pytest.raises(InputError, match="line 4 has 2 columns, but a point has three"):
        read_points(tmp_path / "a.csv")


# -------------------------------------------------------------------- archives


def member(shape, dtype="<f8", content=b""):
    """An array in NumPy's format that claims this shape and type."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def archive(path, name, content, claimed=None):
    """An .npz file with one member, which may claim to be larger than it is."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    if claimed is not None:
        whole = bytearray(path.read_bytes())
        whole[22:26] = struct.pack("<I", claimed)
        at = whole.index(b"PK\x01\x02")
        whole[at + 24 : at + 28] = struct.pack("<I", claimed)
        path.write_bytes(whole)
    return path


@pytest.mark.parametrize(
    ("suffix", "shape"), [(".npy", (10**12, 3)), (".npz", (10**12, 3)), (".npz", (10**8, 3))]
)
def test_nothing_is_allocated_for_what_a_file_only_claims(tmp_path, suffix, shape, monkeypatch, capsys):
    path, content = tmp_path / f"a{suffix}", member(shape, content=bytes(240))
    if suffix == ".npy":
        path.write_bytes(content)
    else:
        archive(path, "points.npy", content, 24 * 10**8 + 128 if shape[0] == 10**8 else None)
    monkeypatch.setattr(np, "fromfile", None)
    with pytest.raises(InputError, match="is damaged"):
        read_points(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    assert _cli.main(["fit", f"a{suffix}", "-o", "s.npz", "--no-picture"]) == 2
    assert f"a{suffix} is damaged" in capsys.readouterr().err


def test_a_surface_that_only_claims_its_size_is_refused(tmp_path):
    path = archive(tmp_path / "s.npz", "control_points.npy", member((10**12, 3)))
    with pytest.raises(InputError, match="is damaged"):
        read_surface(path)


def test_members_need_no_suffix_but_must_be_arrays(tmp_path):
    buffer = io.BytesIO()
    np.save(buffer, POINTS)
    path = archive(tmp_path / "a.npz", "points", buffer.getvalue())
    np.testing.assert_array_equal(read_points(path).points, POINTS)
    archive(path, "points", b"1 2 3\n" * 9)
    with pytest.raises(InputError, match="is damaged, or holds something else"):
        read_points(path)


@pytest.mark.parametrize("dtype", [">f8", ">f4", ">i4"])
def test_the_order_of_bytes_does_not_matter(tmp_path, dtype):
    points = (1000 * POINTS).astype(dtype)
    np.savez(tmp_path / "a.npz", points=points)
    read = read_points(tmp_path / "a.npz").points
    assert read.dtype.isnative
    np.testing.assert_array_equal(read, points)
    surface = wavy_surface()
    np.savez(
        tmp_path / "s.npz",
        control_points=np.asarray(surface.control_points, ">f8"),
        knots_u=np.asarray(surface.knots_u, ">f8"),
        knots_v=np.asarray(surface.knots_v, ">f8"),
    )
    np.testing.assert_array_equal(read_surface(tmp_path / "s.npz").control_points, surface.control_points)


@pytest.mark.parametrize("array", [np.zeros(8, "f8,f8,f8"), POINTS + 0j, POINTS.astype(object), POINTS > 0])
def test_arrays_of_no_real_numbers_are_refused(tmp_path, array):
    np.savez(tmp_path / "a.npz", points=array)
    with pytest.raises(InputError, match=r"a\.npz") as error:
        read_points(tmp_path / "a.npz")
    sentence(error)


# ------------------------------------------------------------------- arguments


def masked(x, count=3):
    mask = np.zeros(np.shape(x), bool)
    mask.flat[:count] = True
    return np.ma.array(x, mask=mask)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("points", lambda: jf.fit_points(masked(POINTS), BOUNDARY)),
        ("points", lambda: jf.fit_points(masked(POINTS))),
        ("points", lambda: jf.approximate(masked(POINTS), wavy_surface())),
        ("points", lambda: jf.closest_point(wavy_surface(), masked(POINTS))),
        ("weights", lambda: jf.fit_points(POINTS, BOUNDARY, weights=masked(np.ones(60)))),
        (
            "start u",
            lambda: jf.approximate(POINTS, wavy_surface(), start=(masked(POINTS[:, 0]), POINTS[:, 1])),
        ),
        ("grid", lambda: jf.interpolate(masked(GRID))),
        ("grid", lambda: jf.Boundary.from_grid(masked(GRID))),
        ("normals", lambda: jf.interpolate(GRID, normals=masked(GRID))),
        ("v1", lambda: jf.Boundary(**EDGES | {"v1": masked(EDGES["v1"])})),
    ],
)
def test_masked_entries_are_refused(name, call):
    with pytest.raises(ValueError, match=f"{name} must not be masked, but 3 of its") as error:
        call()
    sentence(error)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"weights": np.ones(59)}, "weights must hold one number for each of the 60 points"),
        ({"weights": -np.ones(60)}, "weights must not be negative"),
        ({"start": (np.ones(59), np.ones(59))}, "start must hold a u and a v for each of the 60 points"),
        ({"start": (np.ones(60), 2 * np.ones(60))}, r"start v must lie in the domain \[0, 1\]"),
        ({"start": 5}, "start must be a pair"),
    ],
)
def test_rows_of_a_divided_cloud_are_checked_before_they_are_sent(options, said, monkeypatch):
    points, _ = jf.shard_points(POINTS, jax.make_mesh((1,), ("points",)))
    parameters = inspect.signature(jf.approximate).parameters.values()
    request = {x.name: x.default for x in parameters if x.default is not x.empty}
    monkeypatch.setattr(jax, "device_put", None)
    with pytest.raises(ValueError, match=said) as error:
        fit_sharded_cloud(points, wavy_surface(), jf.GeometricApproximation(), request | options)
    sentence(error)


@pytest.mark.parametrize("change", [np.ma.array, lambda x: x.astype(">f8")])
def test_unset_masks_and_foreign_bytes_change_nothing(change):
    plain, changed = (jf.Boundary.from_grid(x) for x in (GRID, change(GRID)))
    np.testing.assert_array_equal(plain.v0, changed.v0)
    us, vs = (jf.grid_parameters(x) for x in (GRID, change(GRID)))
    np.testing.assert_array_equal(us[0], vs[0])


NUMBERS = {
    "tol_average": lambda x: jf.fit_points(POINTS, BOUNDARY, tol_average=x),
    "tolerance": lambda x: jf.interpolate(GRID, tolerance=x),
    "scale": jf.GemanMcClure,
    "foot_tolerance": lambda x: jf.GeometricApproximation(foot_tolerance=x),
    "smoothing": lambda x: jf.StandardApproximation(smoothing=x),
    "reach": lambda x: jf.OrthogonalDistance(reach=x),
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_numbers_are_finite(name, value):
    with pytest.raises(ValueError, match=f"{name} must be") as error:
        NUMBERS[name](value)
    sentence(error)


@pytest.mark.parametrize("value", [True, np.True_, np.ones(1), "1", None])
def test_switches_arrays_and_text_are_no_numbers(value):
    with pytest.raises(TypeError, match="x must be a number, but is"):
        check_number("x", value, 0.0)
    with pytest.raises(ValueError, match="smoothing must be a finite number"):
        check_smoothing(value, "a rule")


@pytest.mark.parametrize("value", [9.0, 2.5, np.nan, np.float64(9.0), np.array(9.0)])
def test_whole_numbers_are_no_floats(value):
    with pytest.raises(ValueError, match=r"x must be a whole number .*; pass a whole number\."):
        check_number("x", value, 1, whole=True)
    for whole in (9, np.int32(9), np.array(9)):
        check_number("x", whole, 1, whole=True)


def test_a_number_that_is_none_is_not_to_be_raised():
    with pytest.raises(ValueError, match="x must be a number of at least 0, but is nan; pass a number"):
        check_number("x", np.nan, 0.0)


@pytest.mark.parametrize(
    ("call", "advice"),
    [
        (lambda: jf.fit_points(GRID, BOUNDARY), r"pass points.reshape\(-1, 3\), or interpolate it"),
        (lambda: jf.fit_points(GRID), r"pass points.reshape\(-1, 3\), or interpolate it"),
        (lambda: jf.fit_points(POINTS.T, BOUNDARY), "pass points.T"),
        (lambda: jf.fit_points(POINTS.T), "pass points.T"),
        (lambda: jf.fit_points(POINTS[:, :2], BOUNDARY), "give one row per point"),
        (lambda: jf.interpolate(POINTS), "fit them by fit_points as a cloud"),
        (lambda: jf.Boundary.from_grid(POINTS), "fit them by fit_points as a cloud"),
        (lambda: jf.StandardApproximation(smoothing="gcv"), r"or GeneralizedCrossValidation\(\) or Disc"),
        (lambda: jf.OrthogonalDistance(smoothing="auto"), r"or RegularSmoothing\(\)"),
        (lambda: jf.fit_points(POINTS, BOUNDARY, net=(65, 64)), "at most 4,096 control points for 60 points"),
        (lambda: jf.fit_points(POINTS, net=(65, 64)), "at most 4,096 control points for 60 points"),
        (lambda: jf.interpolate(np.moveaxis(GRID, 2, 0)), r"pass np.moveaxis\(grid, 0, -1\)"),
        (lambda: jf.fit_points(np.moveaxis(GRID, 2, 0), BOUNDARY), r"pass points.reshape\(3, -1\).T"),
        (lambda: jf.interpolate(without_data(GRID)), r"2 have a coordinate .* \(.*-9999\); fit what is left"),
        (lambda: jf.fit_points(without_data(POINTS), BOUNDARY), "must hold measured points only, but 2"),
        (lambda: jf.interpolate(PointData(POINTS, None, None, "a")), "a holds 60 scattered points; fit"),
        (lambda: jf.fit_points(POINTS, BOUNDARY, tol_average=6), "must be at most 1, .* 6e-4 for 0.06 %"),
        (lambda: jf.fit_points((POINTS + 5e6).astype(np.float32), BOUNDARY), "before they are rounded"),
        (lambda: jf.fit_points((POINTS + 5e6).astype(np.float32)), "before they are rounded"),
        (lambda: jf.approximate(POINTS, wavy_surface(), tol_average=None), r"pass tol_average=0\.0 to go on"),
        (lambda: jf.fit_points(POINTS, BOUNDARY, tol_average=None), "must not both be None"),
        (lambda: jf.approximate(POINTS, wavy_surface(), tol_maximum=1.5), "such as 6e-4 for 0.06 %"),
    ],
)
def test_what_is_mixed_up_gets_the_advice_that_helps(call, advice, monkeypatch):
    monkeypatch.setattr(jax, "jit", None)
    with pytest.raises(ValueError, match=advice) as error:
        call()
    sentence(error)


@pytest.mark.parametrize(
    ("call", "advice"),
    [
        (
            lambda: inspect.unwrap(as_floating)("points", "a.csv", 2),
            "points must be an array, but is 'a.csv'",
        ),
        (lambda: inspect.unwrap(as_floating)("grid", CHECKOUT, 3), "read a file by jaxfit.io.read_points"),
        (
            lambda: inspect.unwrap(jf.fit_points)(POINTS, BOUNDARY, base="meshless"),
            r"such as Coons\(\) or Meshless\(\), but is the string 'meshless'; pass one of these",
        ),
        (
            lambda: inspect.unwrap(check_border)("free"),
            r"FixedCorners\(\), FixedSides.* FreeBorder.* 'free'; ",
        ),
        (
            lambda: inspect.unwrap(as_floating)("points", PointData(POINTS, None, None, "a"), 2),
            "points must be an array, but is a PointData; pass its .cloud or .grid",
        ),
        (
            lambda: inspect.unwrap(as_floating)("points", None, 2),
            r"points must be an array, but is None; .* pass data itself, or data\.grid\.reshape\(-1, 3\)\.",
        ),
        (
            lambda: inspect.unwrap(as_floating)("grid", None, 3),
            r"grid must be an array, but is None; .* pass data\.as_grid\(n, m\), or fit data by fit_points\.",
        ),
        *(
            (
                lambda call=call, args=args: inspect.unwrap(call)(*args),
                "points must be an array, but is a Boundary; pass",
            )
            for call, args in (
                (jf.fit_points, (BOUNDARY, POINTS)),
                (jf.fit_points, (BOUNDARY,)),
                (jf.base_surface, (POINTS, BOUNDARY)),
                (jf.meshless_parameters, (BOUNDARY, POINTS)),
            )
        ),
        (lambda: inspect.unwrap(jf.base_surface)(POINTS), r"or Boundary.from_grid\(grid\), but is a ndarray"),
        (
            lambda: inspect.unwrap(jf.interpolate)(GRID, progress=5),
            "progress must be callable, but is 5; pass a function of",
        ),
        (
            lambda: inspect.unwrap(jf.interpolate)(GRID, throw="no"),
            "throw must be True or False, but is 'no'",
        ),
        (lambda: jf.fit_points(POINTS, BOUNDARY, degree=3), "degree is not an option .* pass order"),
        (lambda: jf.fit_points(POINTS, BOUNDARY, nett=3), "pass any of boundary, net, order, method, base"),
        (
            lambda: jf.approximate(POINTS, wavy_surface(), jf.GeometricInterpolation()),
            r"GeometricInterpolation\(\) is one for grids; call interpolate",
        ),
        (
            lambda: jax.eval_shape(lambda x: jf.fit_points(x, BOUNDARY, net=(6, 5)), POINTS),
            "points must be concrete, but are traced; call fit_points outside jit and vmap",
        ),
    ],
)
def test_what_is_of_the_wrong_kind_gets_the_advice_that_helps(call, advice):
    with pytest.raises(TypeError, match=advice) as error:
        call()
    sentence(error)


@pytest.mark.parametrize(
    "call",
    [
        lambda: jf.fit_points(POINTS + 1e14, BOUNDARY),
        lambda: jf.approximate(POINTS + 1e14, wavy_surface()),
        lambda: jf.interpolate(GRID + 1e14),
        lambda: jf.interpolate(GRID + 1e14, jf.StandardInterpolation()),
    ],
)
def test_points_below_their_own_rounding_are_refused(call):
    with pytest.raises(
        ValueError, match="must differ by more than the rounding of their coordinates"
    ) as error:
        call()
    assert "subtract their centre" in sentence(error)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (POINTS + np.array([5.0, 0.0, 0.0]), "boundary lies 4"),
        (POINTS - np.array([0.0, 1e4, 0.0]), "boundary lies 1e+04 away"),
        (1000 * POINTS, "bounding box with the diagonal 1.4"),
        (1e-3 * POINTS, "bounding box with the diagonal 1.4"),
    ],
)
def test_a_boundary_elsewhere_is_refused(points, said):
    for call in (jf.fit_points, lambda p, b: jf.base_surface(b, p)):
        with pytest.raises(ValueError, match="same unit and frame") as error:
            call(points, BOUNDARY)
        assert said in sentence(error)


def test_a_cloud_far_out_of_its_boundary_is_no_mistake():
    bulge = POINTS * np.array([0.5, 0.5, 1.0]) + np.array([0.25, 0.25, 0.6])
    assert jf.base_surface(BOUNDARY, bulge).dimension == 3


# ------------------------------------------------------------ fits and surfaces


@pytest.fixture(scope="module")
def fit():
    return jf.interpolate(GRID)


def test_a_fit_is_written_like_its_surface(tmp_path, fit):
    write_surface(tmp_path / "s.npz", fit)
    np.testing.assert_array_equal(read_surface(tmp_path / "s.npz").control_points, fit.surface.control_points)


def test_a_printed_fit_tells_its_errors(fit):
    for said in (
        "8 x 7",
        "4 x 4",
        "GeometricInterpolation",
        " % of the diagonal",
        "all tolerances are met",
        "iterations",
    ):
        assert said in str(fit)
    assert "\n" not in repr(fit)
    assert "8 x 7 control points, average error" in repr(fit)


@pytest.mark.parametrize(
    ("left_out", "more"),
    [({}, False), ({"nodata": 1, "non_finite": 1}, False), ({"nodata": 2, "outliers": 1}, True)],
)
def test_errors_of_points_left_out_are_printed_where_there_are_any(fit, left_out, more):
    errors = fit.errors.at[0, :2].set(np.nan if left_out else 0.0)
    scan = dataclasses.replace(fit, errors=errors, stats=fit.stats | {"points_read": 56} | left_out)
    assert (" of the diagonal, of the points that count" in str(scan)) == bool(left_out)
    assert ("all points" in str(scan)) == more


def test_a_fit_without_values_prints_its_shapes(fit):
    shapes = []
    jax.eval_shape(lambda grid: shapes.append(str(jf.interpolate(grid))), GRID)
    batch = jax.tree.map(lambda x: np.stack([x, x]), fit)
    for said in (*shapes, str(batch), repr(jax.tree.map(lambda x: None, fit))):
        assert said.startswith("Fit(")


# ------------------------------------------------------------- the command line


@pytest.fixture
def folder(tmp_path, monkeypatch):
    np.savez(tmp_path / "grid.npz", grid=GRID)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    monkeypatch.setattr(jf, "interpolate", lambda *_, **__: pytest.fail("the fit has begun"))
    return tmp_path


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["-o", "s.npz"], "s.png is a folder"),
        (["-o", "t.npz", "--picture", "s.png"], "s.png is a folder"),
        (["-o", "d.npz"], "d.npz is a folder"),
        (["-o", "t.npz", "--picture", "none/p.png"], "does not exist; make it first"),
        (["-o", "t.npz", "--max-steps", "2147483646"], "at most 1,000,000"),
        (["-o", "t.npz", "--max-steps", "9" * 5000], "at most 1,000,000"),
        (["-o", "t.npz", "--order", "9x4"], "'9x4' is no order"),
        (["-o", "t.npz", "--cache", "c", "--no-cache"], "not allowed with"),
    ],
)
def test_bad_usage_is_noticed_before_the_fit(folder, monkeypatch, capsys, argv, said):
    (folder / "s.png").mkdir()
    (folder / "d.npz").mkdir()
    if "order" in said:
        monkeypatch.undo()
        monkeypatch.chdir(folder)
        monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    assert _cli.main(["fit", "grid.npz", *argv]) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1


LOST = """
import os, signal, sys, weakref
sys.argv = ["jaxfit", *"fit grid.npz -o s.npz --no-cache --no-picture".split()]
import jaxfit
from jaxfit import _cli

class Loading: pass

def fit(*_, **__):
    loading = Loading()
    watch = weakref.ref(loading, lambda _: os.kill(os.getpid(), signal.SIGINT))
    del loading
    raise ImportError("initialization failed")

jaxfit.interpolate = fit
_cli.main()
"""


@pytest.mark.skipif(signal.getsignal(signal.SIGINT) == signal.SIG_IGN, reason="no SIGINT here")
def test_an_interrupt_where_exceptions_are_lost_ends_the_command(tmp_path):
    """As Python loses those within a callback of a weak reference, and extensions while they are loaded."""
    np.savez(tmp_path / "grid.npz", grid=GRID)
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, "-c", LOST]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=50)
    said = "jaxfit: error: interrupted, nothing more is written.\n"
    assert (done.returncode, done.stdout, done.stderr) == (130, "", said)


def test_an_interrupt_takes_away_what_is_written_in_part(folder, monkeypatch):
    left = []
    monkeypatch.setattr(os, "_exit", lambda code: left.append((code, os.listdir())))
    monkeypatch.setattr(os, "replace", lambda part, path: (os.stat(part), _interrupt.end()))
    write_surface("s.npz", wavy_surface())
    assert left == [(130, ["grid.npz"])]


def test_an_interrupted_command_waits_for_nothing_that_hangs(monkeypatch):
    monkeypatch.setattr(_interrupt, "GRACE", 0.0)
    ended = threading.Event()
    monkeypatch.setattr(os, "_exit", lambda code: ended.set())
    with _interrupt.at_last(lambda: ended.wait(50) or pytest.fail("it hangs")):
        _interrupt.end()


@pytest.mark.skipif(signal.getsignal(signal.SIGINT) == signal.SIG_IGN, reason="no SIGINT here")
@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.1])
def test_an_interrupted_command_is_quiet(tmp_path, seconds):
    np.savez(tmp_path / "grid.npz", grid=GRID)
    imports = tmp_path.with_suffix(".imports")
    with imports.open("w") as file:
        running = subprocess.Popen(
            f"{sys.executable} -X importtime -m jaxfit fit grid.npz -o s.npz --no-cache".split(),
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
        )
    while "jaxfit._interrupt" not in imports.read_text():  # before it Python itself starts
        assert running.poll() is None, imports.read_text()
        time.sleep(0.02)
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    output, _ = running.communicate(timeout=60)
    # Threads import as well, so the note of an import may stand within the sentence.
    error = re.sub(r"import time:.*\n", "", imports.read_text())
    assert (running.returncode, output) == (130, "")
    assert error in ("", "jaxfit: error: interrupted, nothing more is written.\n")
    assert os.listdir(tmp_path) == ["grid.npz"]


# ------------------------------------------------------------------ under grad, where values are known

SURFACE = wavy_surface(7, 6)
UNDER_GRAD = {
    "points of a fit": (lambda x: jf.approximate(x, SURFACE, max_steps=1).surface(0.3, 0.7)[2], POINTS),
    "points to project": (lambda x: jf.closest_point(SURFACE, x).distance.sum(), POINTS),
    "a grid": (lambda x: jf.interpolate(x).surface(0.3, 0.7)[2], GRID),
}


@pytest.mark.parametrize(("function", "given"), UNDER_GRAD.values(), ids=UNDER_GRAD)
def test_what_is_not_finite_is_refused_under_grad_as_it_is_without(function, given):
    broken = np.array(given)
    broken.reshape(-1, 3)[3, 1] = np.nan
    with pytest.raises(ValueError, match="must be finite") as raised:
        jax.grad(function)(broken)
    with pytest.raises(ValueError, match="must be finite") as plain:
        function(broken)
    assert sentence(raised) == sentence(plain)


def test_a_grid_whose_squares_overflow_is_refused():
    with pytest.raises(ValueError, match="grid must be at most 1e"):
        jf.interpolate(1e155 * GRID)
