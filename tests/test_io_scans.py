"""Scanners' files and meshes are read exactly; what they mark as no measurement is left out and counted."""

import struct
import sys

import numpy as np
import pytest

from jaxfit.io import InputError, read_points

FAR = np.array([500_000.0, 5_200_000.0, 250.0])  # a place on earth, in metres
POINTS = FAR + np.random.default_rng(0).random((6, 3))
FACES = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4]])  # the sixth point is in none


def rows(points):
    return "".join(" ".join(map(repr, point)) + "\n" for point in np.asarray(points).tolist())


def need(*modules):
    for module in modules:
        pytest.importorskip(module, reason=f"{module} is not installed; pip install .[scan]")


def ply(path, points, faces=(), binary=False):
    kind = "binary_little_endian" if binary else "ascii"
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{names}"
    if len(faces):
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    if binary:
        triangles = b"".join(b"\x03" + np.asarray(face, "<i4").tobytes() for face in faces)
        body = np.asarray(points, "<f8").tobytes() + triangles
    else:
        body = (rows(points) + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)).encode()
    path.write_bytes((head + "end_header\n").encode() + body)
    return path


def obj(path, points, faces=()):
    lines = [f"v {line}" for line in rows(points).splitlines()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def off(path, points, faces=()):
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)
    path.write_text(f"OFF\n{len(points)} {len(faces)} 0\n{rows(points)}{triangles}")
    return path


def stl(path, points, faces):
    """Single precision, binary."""
    triangles = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    triangles["corners"] = np.asarray(points)[np.asarray(faces)]
    path.write_bytes(b" " * 80 + np.uint32(len(faces)).tobytes() + triangles.tobytes())
    return path


def ascii_stl(path, points, faces):
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {line}\n" for line in rows(np.asarray(points)[list(face)]).splitlines())
        + "endloop\nendfacet\n"
        for face in faces
    )
    path.write_text(f"solid part\n{facets}endsolid part\n")
    return path


# ------------------------------------------------------------------------ meshes


@pytest.mark.parametrize("write", [ply, obj, off])
def test_points_without_faces_are_all_read(tmp_path, write):
    need("trimesh")
    points = np.concatenate([POINTS, POINTS[:1]])  # a cloud may hold a point twice
    read = read_points(write(tmp_path / f"a.{write.__name__}", points))
    np.testing.assert_array_equal(read.points, points)
    assert read.grid is None
    assert read.boundary is None
    assert read.left_out == {}


@pytest.mark.parametrize("binary", [False, True])
def test_a_ply_keeps_all_digits_in_text_and_in_binary(tmp_path, binary):
    need("trimesh")
    read = read_points(ply(tmp_path / "a.PLY", POINTS, FACES, binary))
    np.testing.assert_array_equal(read.points, POINTS[:5])
    assert read.points.dtype == np.float64
    assert read.left_out == {"in no face": 1}


@pytest.mark.parametrize("write", [obj, off])
def test_vertices_in_no_face_are_counted(tmp_path, write):
    need("trimesh")
    read = read_points(write(tmp_path / f"a.{write.__name__}", POINTS, FACES))
    np.testing.assert_array_equal(read.points, POINTS[:5])
    assert read.left_out == {"in no face": 1}


def test_corners_that_triangles_repeat_are_read_once(tmp_path):
    need("trimesh")
    local = (POINTS - FAR).astype(np.float32)
    for path, points in (
        (stl(tmp_path / "b.stl", local, FACES), local),
        (ascii_stl(tmp_path / "a.stl", POINTS, FACES), POINTS),
    ):
        read = read_points(path)
        np.testing.assert_array_equal(read.points, points[:5])  # in the order of their first use
        assert read.left_out == {"repeated": 4}
        assert read.faces.max() < len(read.points)


def test_an_obj_of_several_materials_is_one_cloud(tmp_path):
    need("trimesh")
    path = obj(tmp_path / "a.obj", POINTS)
    path.write_text(path.read_text() + "mtllib none.mtl\nusemtl a\nf 1 2 3 4\nusemtl b\nf 3 4 5\nf 5 6 1\n")
    read = read_points(path)
    assert {tuple(point) for point in read.points.tolist()} == {tuple(point) for point in POINTS.tolist()}
    assert len(read.points) == 6


def test_vertices_that_are_not_finite_are_left_out(tmp_path):
    need("trimesh")
    points = POINTS.copy()
    points[3, 2] = np.nan
    read = read_points(ply(tmp_path / "a.ply", points, binary=True))
    np.testing.assert_array_equal(read.points, np.delete(POINTS, 3, axis=0))
    assert read.left_out == {"not finite": 1}


# ----------------------------------------------------------------------- surveys


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [1, 6])
def test_las_applies_scale_and_offset_in_double_precision(tmp_path, suffix, point_format):
    need("laspy", "lazrs")
    import laspy

    header = laspy.LasHeader(point_format=point_format)
    header.scales, header.offsets = np.full(3, 1e-3), np.array([500_000.0, 5_200_000.0, 0.0])
    survey = laspy.LasData(header)
    steps = np.random.default_rng(1).integers(-(10**6), 10**6, (9, 3))
    survey.X, survey.Y, survey.Z = steps.T
    survey.withheld = np.arange(9) == 2
    survey.classification = np.where(np.arange(9) < 4, 7, 2)
    path = tmp_path / f"a.{suffix}"
    survey.write(path)
    read = read_points(path)
    np.testing.assert_array_equal(read.points, (steps * header.scales + header.offsets)[4:])
    assert read.left_out == {"withheld": 1, "classified as noise": 3}


def test_e57_reads_all_scans_in_the_frame_of_the_file(tmp_path):
    need("pye57")
    import pye57

    local = np.random.default_rng(2).random((5, 3)).astype(np.float32).astype(float)
    quarter_turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # round z
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        fields = {f"cartesian{axis}": np.ascontiguousarray(x) for axis, x in zip("XYZ", local.T, strict=True)}
        invalid = (np.arange(5) == 1).astype(np.int8)
        file.write_scan_raw({**fields, "cartesianInvalidState": invalid}, translation=FAR)
        file.write_scan_raw(fields, rotation=quarter_turn)
    read = read_points(tmp_path / "a.e57")
    turned = local[:, [1, 0, 2]] * [-1, 1, 1]
    np.testing.assert_array_equal(read.points[:4], np.delete(local + FAR, 1, axis=0))
    np.testing.assert_allclose(read.points[4:], turned, atol=1e-15)
    assert read.left_out == {"invalid": 1}


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_is_read_in_every_encoding(tmp_path, encoding):
    need("pypcd4")
    import pypcd4

    points = np.round(POINTS, 6)  # as many digits as its text has
    points[[1, 4], 0] = np.nan  # how an organised cloud says that nothing came back
    columns = [np.arange(6.0), *points.T]
    cloud = pypcd4.PointCloud.from_points(columns, ("intensity", "x", "y", "z"), (np.float64,) * 4)
    cloud.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding(encoding))
    read = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(read.points, np.delete(points, [1, 4], axis=0))
    assert read.left_out == {"not finite": 2}


def test_a_pcd_without_heights_is_refused(tmp_path):
    need("pypcd4")
    import pypcd4

    cloud = pypcd4.PointCloud.from_points(POINTS[:, :2], ("x", "y"), (np.float64,) * 2)
    cloud.save(tmp_path / "a.pcd")
    with pytest.raises(InputError, match=r"a\.pcd holds no z"):
        read_points(tmp_path / "a.pcd")


# --------------------------------------------------------------------- bad files


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "off", "las", "laz", "e57", "pcd"])
@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00\x80 not what it says", b"ply\n", b"LASF\x00", b"OFF\n9 9"]
)
def test_damaged_files_are_one_sentence(tmp_path, suffix, content, capfd):
    need("trimesh", "laspy", "lazrs", "pye57", "pypcd4")
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_points(path)
    said = str(caught.value)
    assert "a." + suffix in said
    assert "\n" not in said
    assert said.endswith(".")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("order", "<>")
def test_faces_may_have_different_numbers_of_corners(tmp_path, order):
    need("trimesh", "plyfile")
    corners = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
    kind = "binary_little_endian" if order == "<" else "binary_big_endian"
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {kind} 1.0\nelement vertex 6\n{names}element face 3\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    faces = [(0, 1, 4, 3), (1, 2, 4), (2, 5, 4)]
    body = b"".join(struct.pack(f"{order}3f", *corner) for corner in corners)
    body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    read = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.points, corners)
    assert sorted(map(tuple, read.faces.tolist())) == [(0, 1, 4), (0, 4, 3), (1, 2, 4), (2, 5, 4)]
    (tmp_path / "a.ply").write_bytes(head.encode() + body[:-5])
    with pytest.raises(InputError, match="was cut short"):
        read_points(tmp_path / "a.ply")


def test_files_that_were_cut_are_noticed(tmp_path):
    need("trimesh", "pypcd4")
    path = ply(tmp_path / "a.ply", POINTS, FACES, binary=True)
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(InputError, match=r"a\.ply"):
        read_points(path)
    import pypcd4

    cloud = pypcd4.PointCloud.from_points(POINTS, ("x", "y", "z"), (np.float64,) * 3)
    cloud.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding.BINARY)
    whole = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(whole[:-24])
    with pytest.raises(InputError, match="claims 6 points, but holds 5"):
        read_points(tmp_path / "a.pcd")
    path = stl(tmp_path / "a.stl", POINTS, FACES)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"a\.stl holds no points, or was cut short; write it again"):
        read_points(path)


def without_last_lines(path, count):
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-count]))
    return path


@pytest.mark.parametrize(
    ("write", "faces", "cut", "said"),
    [
        (ply, (), 2, "claims 6 points, but holds 4"),
        (ply, FACES, len(FACES) + 1, "claims 6 points, but holds 5"),
        (ply, FACES, 1, f"claims {len(FACES)} faces, but holds {len(FACES) - 1}"),
        (off, FACES, 1, f"claims {len(FACES)} faces, but holds {len(FACES) - 1}"),
    ],
)
def test_text_that_was_cut_at_the_end_of_a_line_is_noticed(tmp_path, write, faces, cut, said):
    need("trimesh")
    path = tmp_path / f"a.{write.__name__}"
    write(path, POINTS, faces)
    read_points(path)
    with pytest.raises(InputError, match=said):
        read_points(without_last_lines(path, cut))


def test_too_few_points_are_refused(tmp_path):
    need("trimesh")
    with pytest.raises(InputError, match="3 points, but a surface needs"):
        read_points(stl(tmp_path / "a.stl", POINTS[:3], [[0, 1, 2], [2, 1, 0]]))


# ------------------------------------------------------------------------ extras


@pytest.mark.parametrize(
    ("suffix", "module"),
    [("ply", "trimesh"), ("las", "laspy"), ("laz", "lazrs"), ("e57", "pye57"), ("pcd", "pypcd4")],
)
def test_a_missing_library_is_one_sentence(tmp_path, monkeypatch, suffix, module):
    if module == "lazrs":
        need("laspy")
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    (tmp_path / f"a.{suffix}").write_text("anything")
    said = f'.{suffix} files need {module}, which is not installed; pip install "jaxfit-surfaces[scan]".'
    with pytest.raises(InputError) as caught:
        read_points(tmp_path / f"a.{suffix}")
    assert str(caught.value) == said
