"""Files of trimmed surfaces hold the surface and its loops, by what their readers say."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import diagonal, wavy_surface
from scipy.interpolate import BSpline
from surface_files import (
    FAR,
    area,
    area_of,
    creased,
    moved,
    need,
    on_grid,
    only_face,
    points_of,
    samples,
    shape_in,
    tube,
    unclamped,
)
from test_trimmed_surface import LOOPS, SQUARE, circle, polygon_area

import jaxfit as jf
from jaxfit._trimmed._checked_loops import edges_of
from jaxfit._trimmed._quadrature import cut_at_lines
from jaxfit.io import InputError, read_surface, write_surface
from jaxfit.io._trim_curves import trim_curves


def stretched(loops, surface):
    """Loops of the unit square, in the domain of the surface."""
    low, high = np.array(surface.domain).T
    return [low + (high - low) * loop for loop in loops]


CASES = {
    which: (lambda loops=loops: jf.TrimmedSurface(wavy_surface(9, 8), loops))
    for which, loops in LOOPS.items()
}
CASES["creases"] = lambda: jf.TrimmedSurface(creased(), LOOPS["an L with two holes"])
CASES["order 3 x 5"] = lambda: jf.TrimmedSurface(wavy_surface(9, 8, (3, 5)), LOOPS["frayed"])
CASES["tube"] = lambda: jf.TrimmedSurface(tube(), LOOPS["frayed"])
CASES["unclamped"] = lambda: jf.TrimmedSurface(unclamped(), stretched(LOOPS["frayed"], unclamped()))
CASES["small"] = lambda: jf.TrimmedSurface(moved(wavy_surface(9, 8), 1e-2), LOOPS["frayed"])
CASES["large"] = lambda: jf.TrimmedSurface(moved(wavy_surface(9, 8), 1e5), LOOPS["an L with two holes"])


def number_of(shape, kind):
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer

    explorer, count = TopExp_Explorer(shape, getattr(TopAbs_ShapeEnum, f"TopAbs_{kind}")), 0
    while explorer.More():
        count += 1
        explorer.Next()
    return count


@pytest.mark.parametrize("suffix", [".step", ".iges"])
@pytest.mark.parametrize("which", CASES)
def test_open_cascade_reads_one_valid_face_with_all_loops(tmp_path, which, suffix, capfd):
    need("OCP")
    from OCP.BRepCheck import BRepCheck_Analyzer

    trimmed = CASES[which]()
    offset = write_surface(tmp_path / f"s{suffix}", trimmed)
    assert capfd.readouterr() == ("", "")
    assert offset.tolist() == [0, 0, 0]
    shape = shape_in(tmp_path / f"s{suffix}")
    assert BRepCheck_Analyzer(shape).IsValid()
    face = only_face(shape)
    assert number_of(face, "WIRE") == len(trimmed.loops)
    ours = on_grid(trimmed.surface, *samples(trimmed.surface))
    theirs = points_of(face, *samples(trimmed.surface))
    assert np.abs(theirs - ours).max() <= 1e-9 * diagonal(ours)
    assert area_of(shape) == pytest.approx(float(trimmed.area()), rel=1e-4)


@pytest.mark.parametrize("pole", [False, True])
def test_loops_that_would_coincide_in_space_are_refused(tmp_path, pole):
    need("OCP")
    closed = tube(pole)
    write_surface(tmp_path / "whole.step", jf.TrimmedSurface(closed, (SQUARE,)))
    assert area_of(shape_in(tmp_path / "whole.step")) == pytest.approx(area(closed), rel=1e-4)
    with pytest.raises(ValueError, match=r"along both sides of a seam .* along u; .*\.$"):
        write_surface(tmp_path / "s.step", jf.TrimmedSurface(closed, (SQUARE * [1, 0.5],)))
    half = jf.TrimmedSurface(closed, (SQUARE * [0.5, 1],))
    if pole:
        with pytest.raises(ValueError, match=r"along a side that is a point in space .* along v; .*\.$"):
            write_surface(tmp_path / "s.step", half)
    else:
        write_surface(tmp_path / "s.step", half)
        assert area_of(shape_in(tmp_path / "s.step")) == pytest.approx(float(half.area()), rel=1e-4)


def test_a_loop_below_the_tolerance_of_the_kernel_is_refused(tmp_path):
    need("OCP")
    trimmed = jf.TrimmedSurface(wavy_surface(), (SQUARE * 0.8 + 0.1, circle(0.5, 0.5, 1e-8)))
    with pytest.raises(ValueError, match=r"loops must be larger than 1e-07 .*\.$"):
        write_surface(tmp_path / "s.step", trimmed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".stp", ".igs"])
def test_large_coordinates_are_centred(tmp_path, suffix):
    need("OCP")
    trimmed = jf.TrimmedSurface(moved(wavy_surface(), 120, FAR), LOOPS["an L with two holes"])
    offset = write_surface(tmp_path / f"s{suffix}", trimmed)
    assert offset.tolist() == [500_100.0, 5_200_100.0, 0.0]
    shape = shape_in(tmp_path / f"s{suffix}")
    ours = on_grid(trimmed.surface, *samples(trimmed.surface))
    theirs = points_of(only_face(shape), *samples(trimmed.surface))
    assert np.abs(theirs + offset - ours).max() <= 1e-9 * diagonal(ours)
    assert area_of(shape) == pytest.approx(float(trimmed.area()), rel=1e-4)
    content = " ".join((tmp_path / f"s{suffix}").read_text().split())
    assert "add to coordinates: 500100.0 5200100.0 0.0" in content


def test_gmsh_reads_one_face_with_its_holes(tmp_path):
    need("OCP")
    try:
        import gmsh
    except (ImportError, OSError) as error:  # it needs libraries of the system
        pytest.skip(f"gmsh does not load: {error}")
    trimmed = CASES["an L with two holes"]()
    write_surface(tmp_path / "s.step", trimmed)
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.merge(str(tmp_path / "s.step"))
        ((dimension, tag),) = gmsh.model.getEntities(2)
        assert gmsh.model.occ.getMass(dimension, tag) == pytest.approx(float(trimmed.area()), rel=1e-4)
        assert len(gmsh.model.getBoundary([(2, tag)])) == sum(map(len, trimmed.loops))
    finally:
        gmsh.finalize()


@pytest.mark.parametrize("which", ["an L with two holes", "order 3 x 5", "creases"])
def test_rhino_reads_the_surface_and_its_loops_as_curves(tmp_path, which):
    need("rhino3dm")
    import rhino3dm

    trimmed = CASES[which]()
    write_surface(tmp_path / "s.3dm", trimmed)
    surface, *curves = rhino3dm.File3dm.Read(str(tmp_path / "s.3dm")).Objects
    names = ["s: outer loop", "s: hole 1", "s: hole 2"][: len(trimmed.loops)]
    assert [item.Attributes.Name for item in (surface, *curves)] == ["s", *names]
    nu, nv = trimmed.surface.shape
    net = [[surface.Geometry.Points.GetPoint(i, j) for j in range(nv)] for i in range(nu)]
    np.testing.assert_array_equal(
        [[(p.X, p.Y, p.Z) for p in row] for row in net], trimmed.surface.control_points
    )
    for item, loop in zip(curves, map(np.asarray, trimmed.loops), strict=True):
        curve = item.Geometry
        assert curve.IsValid
        assert curve.IsClosed
        lines = (np.unique(knots) for knots in (trimmed.surface.knots_u, trimmed.surface.knots_v))
        start, end = cut_at_lines(edges_of([loop]), *lines)
        assert len(start) == curve.Domain.T1
        for share in (0.0, 0.3, 0.8):
            points = [curve.PointAt(i + share) for i in range(len(start))]
            expected = trimmed.surface(*(start + share * (end - start)).T)
            np.testing.assert_allclose([(p.X, p.Y, p.Z) for p in points], expected, atol=1e-12)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
@pytest.mark.float32_too
def test_loops_come_back_to_the_last_bit(tmp_path, suffix):
    trimmed = jf.TrimmedSurface(wavy_surface(), LOOPS["an L with two holes"])
    write_surface(tmp_path / f"s{suffix}", trimmed)
    read = read_surface(tmp_path / f"s{suffix}")
    assert isinstance(read, jf.TrimmedSurface)
    np.testing.assert_array_equal(read.surface.control_points, trimmed.surface.control_points)
    for ours, theirs in zip(trimmed.loops, read.loops, strict=True):
        assert theirs.dtype == jnp.result_type(float)
        np.testing.assert_array_equal(ours, theirs)


def test_geomdl_keeps_what_is_inside_the_loops(tmp_path):
    pytest.importorskip("geomdl")
    from geomdl import exchange, tessellate

    trimmed = jf.TrimmedSurface(wavy_surface(), (SQUARE * 0.8 + 0.1, circle(0.5, 0.5, 0.2)))
    write_surface(tmp_path / "s.json", trimmed)
    (read,) = exchange.import_json(str(tmp_path / "s.json"))
    read.sample_size = 40
    read.tessellator = tessellate.TrimTessellate()
    read.tessellate()
    corners = np.array([[vertex.uv for vertex in face.vertices] for face in read.faces])
    assert np.asarray(trimmed.contains(*corners.mean(axis=1).T)).mean() > 0.95
    sides = corners[:, 1:] - corners[:, :1]
    assert 0.5 * abs(np.linalg.det(sides)).sum() == pytest.approx(0.64 - 0.04 * np.pi, rel=0.05)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_damaged_loops_are_one_sentence(tmp_path, suffix):
    path = tmp_path / f"s{suffix}"
    trimmed = jf.TrimmedSurface(wavy_surface(), LOOPS["an L with two holes"])
    write_surface(path, trimmed)
    if suffix == ".npz":
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **(arrays | {"loop_counts": arrays["loop_counts"] + 1}))
    else:
        document = json.loads(path.read_text())
        document["shape"]["data"][0]["trims"]["data"][1]["points"][3] = [7.0, 0.0]
        path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"holds no B-spline surface that can be read.*\.$"):
        read_surface(path)


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
def test_triangles_end_at_the_loops(tmp_path, suffix):
    need("trimesh")
    import trimesh

    trimmed = jf.TrimmedSurface(moved(wavy_surface(), 120, FAR), LOOPS["an L with two holes"])
    offset = write_surface(tmp_path / f"s.{suffix}", trimmed)
    assert offset.tolist() == [500_100.0, 5_200_100.0, 0.0]
    mesh = trimesh.load_mesh(tmp_path / f"s.{suffix}")
    assert mesh.area == pytest.approx(float(trimmed.area()), rel=1e-3)
    assert mesh.euler_number == 1 - trimmed.holes


# ----------------------------------------------------- curves in place of lines

UNIT = np.array([[0.0, 1.0], [0.0, 1.0]])


def capsule(count=300):
    angle = np.linspace(-np.pi / 2, np.pi / 2, count)
    half = 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    right = half + np.array([0.2, 0.0])
    return 0.5 + np.concatenate([right, -right])


def sampled(curves):
    points = []
    for curve in curves:
        spline = BSpline(curve.knots, curve.control_points, curve.degree)
        points.append(spline(np.linspace(curve.knots[0], curve.knots[-1], 2000)[:-1]))
    return np.concatenate(points)


@pytest.mark.parametrize(
    ("loop", "edges"),
    [
        (circle(0.5, 0.5, 0.4, 1000), 2),
        (capsule(), 4),
        (circle(0.5, 0.5, 0.4, 60), 60),  # whose splines would bulge
        (LOOPS["frayed"][0], 300),
        (SQUARE, 4),
    ],
)
def test_runs_without_corners_become_splines_where_these_follow_them(loop, edges):
    (curves,) = trim_curves([loop], UNIT)
    assert len(curves) == edges
    for curve, following in zip(curves, [*curves[1:], curves[0]], strict=True):
        np.testing.assert_allclose(curve.control_points[-1], following.control_points[0], atol=1e-15)
    points = sampled(curves)
    assert (points >= 0).all()
    assert (points <= 1).all()
    area = abs(polygon_area([loop]))
    assert abs(polygon_area([points])) == pytest.approx(area, rel=2.5e-5)


def test_loops_whose_splines_would_touch_stay_polylines():
    inner = circle(0.5, 0.5, 0.4, 1000)
    loops = [circle(0.5, 0.5, 0.4, 1000), 0.5 + (inner[::-1] - 0.5) * (1 - 4e-6)]
    assert [len(curves) for curves in trim_curves([loops[0], loops[1][::2]], UNIT)] == [1000, 500]


@pytest.mark.parametrize("suffix", [".step", ".iges"])
def test_open_cascade_reads_splines_as_few_edges(tmp_path, suffix):
    need("OCP")
    from OCP.BRepCheck import BRepCheck_Analyzer

    trimmed = jf.TrimmedSurface(creased(), (circle(0.5, 0.5, 0.45, 1000), capsule() * 0.5 + 0.25))
    write_surface(tmp_path / f"s{suffix}", trimmed)
    shape = shape_in(tmp_path / f"s{suffix}")
    assert BRepCheck_Analyzer(shape).IsValid()
    assert number_of(shape, "EDGE") == 6
    assert area_of(shape) == pytest.approx(float(trimmed.area()), rel=1e-4)
