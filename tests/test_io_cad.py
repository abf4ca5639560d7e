"""CAD files and meshes hold the surface that was written, by what their own readers say."""

import os
import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, diagonal, random_surface, wavy_grid, wavy_net, wavy_surface
from scipy.interpolate import BSpline

import jaxfit as jf
from jaxfit import _cli
from jaxfit.io import InputError, check_output, write_surface

FAR = np.array([500_000.0, 5_200_000.0, 0.0])  # a place on earth, in metres


def need(*modules):
    for module in modules:
        pytest.importorskip(module, reason=f"{module} is not installed; pip install .[cad]")


def on_uniform_knots(net, order=(4, 4)):
    return jf.BSplineSurface(net, *(clamped_uniform(n, k) for n, k in zip(net.shape, order, strict=False)))


def tube(pole=False):
    """Closed along u: its first and last sides are one; with a pole, one more side is a point."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 12), np.linspace(0, 2, 6), indexing="ij")
    net = np.stack([np.cos(angle), np.sin(angle), height], axis=-1)
    net[-1] = net[0]
    if pole:
        net[:, 0] = [0.0, 0.0, -1.0]
    return on_uniform_knots(net)


def unclamped():
    return jf.BSplineSurface(wavy_net(7, 6), np.arange(11.0), np.arange(10.0))


def creased():
    """Knots as deep as the degree, along both directions. Its normal vanishes nowhere: where one does, Open
    CASCADE's quadrature of the area is too coarse to judge by."""
    net = wavy_net(10, 9) + 0.03 * np.random.default_rng(0).normal(size=(10, 9, 3))
    knots_u = [0, 0, 0, 0, 0.3, 0.3, 0.3, 0.6, 0.6, 0.8, 1, 1, 1, 1]
    knots_v = [0, 0, 0, 0.2, 0.4, 0.4, 0.7, 0.7, 0.8, 1, 1, 1]
    return jf.BSplineSurface(net, np.array(knots_u, float), np.array(knots_v, float))


def moved(surface, scale=1.0, offset=0.0):
    return jf.BSplineSurface(
        scale * np.asarray(surface.control_points) + offset, surface.knots_u, surface.knots_v
    )


SURFACES = {
    "wavy": wavy_surface,
    "creases": creased,
    "order 8": lambda: random_surface((8, 8), repeats=0, seed=4),
    "bilinear": lambda: on_uniform_knots(wavy_net(2, 2), (2, 2)),
    "tube": tube,
    "cone": lambda: tube(pole=True),
    "unclamped": unclamped,
    "small": lambda: moved(wavy_surface(), 1e-3),
    "large": lambda: moved(wavy_surface(), 1e5),
}


def samples(surface, count=15):
    return [np.linspace(float(low), float(high), count) for low, high in surface.domain]


def on_grid(surface, us, vs, du=0, dv=0):
    """Points or derivatives, by SciPy: nothing compiles."""
    net = np.asarray(surface.control_points, float)
    for knots, order, at, derivative in zip(
        (surface.knots_u, surface.knots_v), surface.order, (us, vs), (du, dv), strict=True
    ):
        net = np.swapaxes(BSpline(np.asarray(knots, float), net, order - 1)(at, derivative), 0, 1)
    return net


def area(surface, per_span=12):
    """By Gauss's quadrature on every rectangle of knots."""
    node, weight = np.polynomial.legendre.leggauss(per_span)
    at, weights = [], []
    for knots, (low, high) in zip((surface.knots_u, surface.knots_v), surface.domain, strict=True):
        breaks = np.unique(np.clip(np.asarray(knots), float(low), float(high)))
        half = 0.5 * np.diff(breaks)[:, None]
        at.append((breaks[:-1, None] + half * (1 + node)).reshape(-1))
        weights.append((half * weight).reshape(-1))
    normal = np.cross(on_grid(surface, *at, 1, 0), on_grid(surface, *at, 0, 1))
    return float(weights[0] @ np.linalg.norm(normal, axis=2) @ weights[1])


# -------------------------------------------------------------- STEP and IGES


def shape_in(path):
    """The shape in a STEP or IGES file, by Open CASCADE's reader."""
    from OCP.IGESControl import IGESControl_Reader
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader() if path.suffix in (".step", ".stp") else IGESControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    return reader.OneShape()


def only_face(shape):
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_FACE)
    face = TopoDS.Face_s(explorer.Current()) if hasattr(TopoDS, "Face_s") else TopoDS.Face(explorer.Current())
    explorer.Next()
    assert not explorer.More()
    return face


def points_of(face, us, vs):
    from OCP.BRep import BRep_Tool

    surface = BRep_Tool.Surface_s(face)
    at = [[surface.Value(u, v) for v in vs.tolist()] for u in us.tolist()]
    return np.array([[(p.X(), p.Y(), p.Z()) for p in row] for row in at])


def area_of(shape):
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    properties = GProp_GProps()
    BRepGProp.SurfaceProperties_s(shape, properties, 1e-7)
    return properties.Mass()


@pytest.mark.parametrize("suffix", [".step", ".iges"])
@pytest.mark.parametrize("which", SURFACES)
def test_open_cascade_reads_the_surface_as_one_valid_face(tmp_path, which, suffix, capfd):
    need("OCP")
    from OCP.BRepCheck import BRepCheck_Analyzer

    surface = SURFACES[which]()
    offset = write_surface(tmp_path / f"s{suffix}", surface)
    assert capfd.readouterr() == ("", "")  # Open CASCADE's own chatter
    assert offset.tolist() == [0, 0, 0]
    shape = shape_in(tmp_path / f"s{suffix}")
    assert BRepCheck_Analyzer(shape).IsValid()
    ours = on_grid(surface, *samples(surface))
    theirs = points_of(only_face(shape), *samples(surface))
    assert np.abs(theirs - ours).max() <= 1e-9 * diagonal(ours)
    assert area_of(shape) == pytest.approx(area(surface), rel=1e-4)


@pytest.mark.parametrize("suffix", [".stp", ".igs"])
def test_large_coordinates_are_centred_and_the_offset_is_recorded(tmp_path, suffix):
    need("OCP")
    surface = moved(wavy_surface(), 120, FAR + 7.3 * np.eye(3)[0])
    offset = write_surface(tmp_path / f"s{suffix}", surface)
    assert offset.tolist() == [500_100.0, 5_200_100.0, 0.0]
    ours = on_grid(surface, *samples(surface))
    theirs = points_of(only_face(shape_in(tmp_path / f"s{suffix}")), *samples(surface))
    assert np.abs(theirs + offset - ours).max() <= 1e-9 * diagonal(ours)
    content = " ".join((tmp_path / f"s{suffix}").read_text().split())
    assert "add to coordinates: 500100.0 5200100.0 0.0" in content


def test_a_step_file_is_one_face_for_gmsh(tmp_path):
    need("OCP")
    try:
        import gmsh
    except (ImportError, OSError) as error:  # it needs libraries of the system
        pytest.skip(f"gmsh does not load: {error}")
    surface = wavy_surface()
    write_surface(tmp_path / "s.step", surface)
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.merge(str(tmp_path / "s.step"))
        ((dimension, tag),) = gmsh.model.getEntities(2)
        assert gmsh.model.occ.getMass(dimension, tag) == pytest.approx(area(surface), rel=1e-4)
    finally:
        gmsh.finalize()


def test_a_step_file_names_the_part(tmp_path):
    need("OCP")
    write_surface(tmp_path / "käfer 'hood'.step", wavy_surface())
    content = (tmp_path / "käfer 'hood'.step").read_text()
    assert "PRODUCT('k?fer ''hood''','k?fer ''hood''','written by jaxfit'" in content


def test_open_cascade_may_speak_again(tmp_path, capfd):
    need("OCP")
    from OCP.Message import Message

    for suffix in ("step", "iges"):
        write_surface(tmp_path / f"s.{suffix}", wavy_surface())
    Message.SendInfo_s("heard")
    sys.stdout.flush()
    assert capfd.readouterr().out.count("heard") == 1


def test_what_makes_no_valid_face_is_not_written(tmp_path, monkeypatch):
    need("OCP")
    with pytest.raises(ValueError, match=r"at least 0\.0001 across .* use a smaller unit\.$"):
        write_surface(tmp_path / "s.step", moved(wavy_surface(), 1e-5))

    class Never:
        def __init__(self, shape):
            pass

        def IsValid(self):
            return False

    monkeypatch.setattr("OCP.BRepCheck.BRepCheck_Analyzer", Never)
    for suffix in ("step", "iges"):
        with pytest.raises(ValueError, match=r"valid face.*write \.3dm or \.json\.$"):
            write_surface(tmp_path / f"s.{suffix}", wavy_surface())
    assert not os.listdir(tmp_path)


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
    assert "56 (grid 8 x 7; left out: 2 not finite)" in said
    assert re.search(r"offset +500000\.0 5200000\.0 0\.0", said)
    assert complaints == ""
    corner = points_of(only_face(shape_in(tmp_path / "part.step")), *[np.array([0.0])] * 2)[0, 0]
    np.testing.assert_allclose(corner + FAR, points[0], atol=1e-6)
