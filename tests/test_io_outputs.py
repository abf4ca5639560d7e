"""3dm files and triangles hold the surface that was written; every format fails whole, in one sentence."""

import os
import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, diagonal, wavy_grid, wavy_net, wavy_surface
from surface_files import (
    FAR,
    SURFACES,
    area,
    moved,
    need,
    on_grid,
    on_uniform_knots,
    only_face,
    points_of,
    samples,
    shape_in,
    tube,
)

import jaxfit as jf
from jaxfit import _cli
from jaxfit.io import InputError, check_output, write_surface

# ----------------------------------------------------------------------- Rhino


@pytest.mark.parametrize("which", [*SURFACES, "far away"])
def test_rhino_reads_the_surface_to_the_last_bit(tmp_path, which):
    need("rhino3dm")
    import rhino3dm

    surface = moved(wavy_surface(), 120, FAR) if which == "far away" else SURFACES[which]()
    assert write_surface(tmp_path / "s.3dm", surface).tolist() == [0, 0, 0]
    model = rhino3dm.File3dm.Read(str(tmp_path / "s.3dm"))
    (item,) = model.Objects
    assert item.Attributes.Name == "s"
    read, (nu, nv) = item.Geometry, surface.shape
    assert not read.IsRational
    assert (read.OrderU, read.OrderV) == surface.order
    if which == "unclamped":
        at = samples(surface)
        points = [[read.PointAt(u, v) for v in at[1]] for u in at[0]]
        points = [[(p.X, p.Y, p.Z) for p in row] for row in points]
        np.testing.assert_allclose(points, on_grid(surface, *at), atol=1e-15)
        return
    points = [[read.Points.GetPoint(i, j) for j in range(nv)] for i in range(nu)]
    net = [[(p.X, p.Y, p.Z) for p in row] for row in points]
    np.testing.assert_array_equal(net, surface.control_points)
    np.testing.assert_array_equal(read.KnotsU.ToList(), surface.knots_u[1:-1])
    np.testing.assert_array_equal(read.KnotsV.ToList(), surface.knots_v[1:-1])


# ------------------------------------------------------------------- triangles


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_triangles_lie_on_the_surface(tmp_path, suffix, scale):
    need("trimesh")
    import trimesh

    write_surface(tmp_path / f"s.{suffix}", moved(wavy_surface(), scale))
    read = trimesh.load_mesh(tmp_path / f"s.{suffix}", process=False)
    mesh = trimesh.Trimesh(read.vertices / scale, read.faces, process=False)  # its tolerances are absolute
    surface, u = wavy_surface(), np.linspace(0.1, 0.9, 5)
    assert mesh.area == pytest.approx(area(surface), rel=2e-4)
    points, along_u, along_v = (on_grid(surface, u, u, *of).reshape(-1, 3) for of in ((0, 0), (1, 0), (0, 1)))
    normals = np.cross(along_u, along_v)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    _, distances, triangles = trimesh.proximity.closest_point_naive(mesh, points)
    assert distances.max() <= 1.01e-4 * diagonal(surface.control_points)
    assert (np.einsum("ij,ij->i", mesh.face_normals[triangles], normals) > 0.99).all()


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
def test_triangles_far_away_are_centred(tmp_path, suffix):
    need("trimesh")
    import trimesh

    surface = moved(wavy_surface(), 120, FAR)
    offset = write_surface(tmp_path / f"s.{suffix}", surface)
    mesh = trimesh.load_mesh(tmp_path / f"s.{suffix}")
    corners = np.asarray(mesh.bounds) + offset
    np.testing.assert_allclose(corners[:, :2], [FAR[:2], FAR[:2] + 120], atol=1e-5)
    assert b"add to coordinates: 500100.0 5200100.0 0.0" in (tmp_path / f"s.{suffix}").read_bytes()[:300]


def test_a_span_that_is_an_s_is_cut_into_pieces():
    from jaxfit.io._nets import clamped_net
    from jaxfit.io._tessellation import tessellate

    net = wavy_net(4, 2, height=0.0)
    net[:, :, 2] = np.array([0.0, 1.0, -1.0, 0.0])[:, None]  # its middle is on the chord
    surface = on_uniform_knots(net, (4, 2))
    vertices, triangles = tessellate(clamped_net(surface))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(
        area(surface), rel=1e-3
    )


def test_each_span_has_as_many_pieces_as_it_needs():
    from jaxfit.io._nets import clamped_net
    from jaxfit.io._tessellation import tessellate

    x, y = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 25), indexing="ij")
    bump = np.exp(-(((x - 0.2) / 0.05) ** 2))  # along u only, and at one place
    surface = jf.interpolate(np.stack([x, y, 0.1 * bump], axis=-1), jf.StandardInterpolation()).surface
    vertices, triangles = tessellate(clamped_net(surface))
    spans_u, spans_v = 27, 22
    assert len(np.unique(vertices[:, 1].round(9))) == 2 * spans_v + 1  # the fewest pieces along v
    assert len(vertices) < 6 * spans_u * (2 * spans_v + 1)
    assert len(triangles) == 2 * (len(vertices) // (2 * spans_v + 1) - 1) * 2 * spans_v


def test_a_pole_makes_no_triangle_without_area():
    from jaxfit.io._nets import clamped_net
    from jaxfit.io._tessellation import tessellate

    vertices, triangles = tessellate(clamped_net(tube(pole=True)))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0).all()
    few, _ = tessellate(clamped_net(tube()), most=400)
    assert len(few) <= 400


# ------------------------------------------------------------------- all formats

TRIANGLES = ("ply", "stl", "obj")
LIBRARIES = {"step": "OCP", "igs": "OCP", "3dm": "rhino3dm", **dict.fromkeys(TRIANGLES, "trimesh")}


@pytest.mark.parametrize("suffix", LIBRARIES)
def test_a_missing_library_is_said_before_the_fit(tmp_path, monkeypatch, suffix):
    module = LIBRARIES[suffix]
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    said = f'.{suffix} files need {module}, which is not installed; pip install "jaxfit-surfaces[cad]".'
    with pytest.raises(InputError) as caught:
        check_output(tmp_path / f"s.{suffix}")
    assert str(caught.value) == said
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("suffix", LIBRARIES)
def test_a_failure_half_way_leaves_the_old_file(tmp_path, monkeypatch, suffix):
    need(LIBRARIES[suffix])
    path = tmp_path / f"s.{suffix}"
    path.write_text("old")

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space"):
        write_surface(path, wavy_surface())
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", LIBRARIES)
def test_surfaces_that_a_format_cannot_hold_are_refused(tmp_path, suffix):
    need(LIBRARIES[suffix])
    plane = jf.BSplineSurface(wavy_net(4, 4)[..., :2], *[clamped_uniform(4, 4)] * 2)
    torn = jf.BSplineSurface(wavy_net(4, 4), np.array([0, 0, 0.5, 0.5, 1, 1]), clamped_uniform(4, 4))
    with pytest.raises(ValueError, match=r"three dimensions.*but has 2; write \.npz"):
        write_surface(tmp_path / f"s.{suffix}", plane)
    with pytest.raises(ValueError, match=r"must not jump, but knots_u repeats 0\.5"):
        write_surface(tmp_path / f"s.{suffix}", torn)
    assert not os.listdir(tmp_path)


@pytest.mark.float32_too
@pytest.mark.parametrize("suffix", LIBRARIES)
def test_single_precision_is_written_as_it_is(tmp_path, suffix):
    need(LIBRARIES[suffix], "OCP")
    surface = wavy_surface(dtype=jnp.float32)
    write_surface(tmp_path / f"s.{suffix}", surface)
    assert (tmp_path / f"s.{suffix}").stat().st_size > 1000
    if suffix == "step":
        corner = points_of(only_face(shape_in(tmp_path / "s.step")), *[np.array([0.0])] * 2)[0, 0]
        np.testing.assert_allclose(corner, np.asarray(surface.control_points, float)[0, 0], rtol=1e-12)


def test_the_command_reads_a_scan_and_writes_a_step_file(tmp_path, monkeypatch, capfd):
    need("OCP", "trimesh")
    points = 90 * wavy_grid(8, 7).reshape(-1, 3) + FAR
    np.savetxt(tmp_path / "rows.txt", np.concatenate([points, np.full((2, 3), np.nan)]), fmt="%.17g")
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points) + 2}\n{names}end_header\n"
    (tmp_path / "grid.ply").write_text(head + (tmp_path / "rows.txt").read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    assert _cli.main("fit grid.ply -o part.step --grid 8x7 --no-picture".split()) == 0
    said, complaints = capfd.readouterr()
    assert "56 (grid 8 x 7; without 2 not finite)" in said
    assert re.search(r"offset +500000\.0 5200000\.0 0\.0", said)
    assert complaints == ""
    corner = points_of(only_face(shape_in(tmp_path / "part.step")), *[np.array([0.0])] * 2)[0, 0]
    np.testing.assert_allclose(corner + FAR, points[0], atol=1e-6)
