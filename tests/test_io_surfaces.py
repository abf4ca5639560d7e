"""Surfaces come back from files as they went in, for us and for geomdl; files appear whole."""

import json
import os
import stat

import numpy as np
import pytest
from helpers import wavy_surface

from jaxfit.io import InputError, check_output, read_surface, write_surface

ARRAYS = ("control_points", "knots_u", "knots_v")


@pytest.mark.float32_too
@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_surface_survives_the_file(tmp_path, suffix):
    surface = wavy_surface(6, 5, (4, 3))
    write_surface(tmp_path / f"s{suffix}", surface)
    read = read_surface(tmp_path / f"s{suffix}")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(surface, name))
        assert getattr(read, name).dtype == getattr(surface, name).dtype
    assert read.order == (4, 3)


def test_npz_says_what_it_holds(tmp_path):
    surface = wavy_surface(6, 5, (4, 3))
    write_surface(tmp_path / "s.npz", surface)
    with np.load(tmp_path / "s.npz") as file:
        assert sorted(file.files) == ["control_points", "knots_u", "knots_v", "order"]
        assert file["order"].tolist() == [4, 3]


def test_geomdl_sees_the_same_surface(tmp_path):
    exchange = pytest.importorskip("geomdl.exchange")
    surface = wavy_surface(6, 5, (4, 3))
    write_surface(tmp_path / "s.json", surface)
    (peer,) = exchange.import_json(str(tmp_path / "s.json"))
    for u, v in [(0.0, 0.0), (1.0, 0.0), (0.3, 0.8), (0.71, 0.07), (1.0, 1.0)]:
        np.testing.assert_allclose(peer.evaluate_single((u, v)), surface(u, v), atol=1e-13)


def test_geomdl_writes_what_we_read(tmp_path):
    exchange = pytest.importorskip("geomdl.exchange")
    from geomdl import BSpline

    surface = wavy_surface(6, 5, (4, 3))
    peer = BSpline.Surface()
    peer.degree_u, peer.degree_v = 3, 2
    peer.ctrlpts_size_u, peer.ctrlpts_size_v = 6, 5
    peer.ctrlpts = np.asarray(surface.control_points).reshape(-1, 3).tolist()
    peer.knotvector_u, peer.knotvector_v = (
        np.asarray(x).tolist() for x in (surface.knots_u, surface.knots_v)
    )
    exchange.export_json(peer, str(tmp_path / "s.json"))
    read = read_surface(tmp_path / "s.json")
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(read, name), getattr(surface, name), atol=1e-15)


def test_a_file_is_replaced_and_nothing_is_left_over(tmp_path):
    path = tmp_path / "s.json"
    path.write_text("old")
    write_surface(path, wavy_surface())
    json.loads(path.read_text())
    assert os.listdir(tmp_path) == ["s.json"]
    plain = tmp_path / "plain"
    plain.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_link_keeps_pointing(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "s.npz").symlink_to(tmp_path / "there" / "s.npz")
    write_surface(tmp_path / "s.npz", wavy_surface())
    assert (tmp_path / "s.npz").is_symlink()
    assert os.listdir(tmp_path / "there") == ["s.npz"]


@pytest.mark.parametrize("breaks", ["write_bytes", "replace"])
def test_a_failure_half_way_leaves_the_old_file(tmp_path, monkeypatch, breaks):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    path = tmp_path / "s.npz"
    path.write_text("old")
    owner = "pathlib.Path.write_bytes" if breaks == "write_bytes" else "os.replace"
    monkeypatch.setattr(owner, full)
    with pytest.raises(OSError, match="No space"):
        write_surface(path, wavy_surface())
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["s.npz"]


def test_surfaces_that_are_not_finite_are_not_written(tmp_path):
    surface = wavy_surface()
    broken = type(surface)(surface.control_points.at[0, 0, 0].set(0.0), surface.knots_u, surface.knots_v)
    object.__setattr__(broken, "control_points", surface.control_points * np.nan)
    with pytest.raises(ValueError, match="finite control points"):
        write_surface(tmp_path / "s.npz", broken)
    assert not os.listdir(tmp_path)


def test_outputs_are_refused_before_any_work(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"the suffix \.dwg"):
        check_output(tmp_path / "s.dwg")
    with pytest.raises(InputError, match="no suffix"):
        check_output(tmp_path / "s")
    with pytest.raises(InputError, match="does not exist"):
        check_output(tmp_path / "none" / "s.npz")
    (tmp_path / "d.npz").mkdir()
    for folder, options, file in (
        (tmp_path / "d.npz", (), "surface.step"),
        (tmp_path, (), "surface.step"),
        (tmp_path, ((".png", ".pdf"),), "surface.png"),
    ):
        with pytest.raises(InputError, match=f"{folder} is a folder; .* such as {folder}/{file}"):
            check_output(folder, *options)

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    with pytest.raises(InputError, match=r"no file can be written .* Permission denied"):
        check_output(tmp_path / "s.npz")


def test_checking_leaves_nothing_behind(tmp_path):
    check_output(tmp_path / "s.json")
    check_output(tmp_path / "s.png", (".png",))
    assert not os.listdir(tmp_path)


def geomdl_shape(**changes):
    surface = {
        "rational": False,
        "degree_u": 1,
        "degree_v": 1,
        "size_u": 2,
        "size_v": 2,
        "knotvector_u": [0, 0, 1, 1],
        "knotvector_v": [0, 0, 1, 1],
        "control_points": {"points": [[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 1]]},
    }
    return {"shape": {"type": "surface", "count": 1, "data": [surface | changes]}}


def test_a_rational_surface_needs_equal_weights(tmp_path):
    path = tmp_path / "s.json"
    points = geomdl_shape()["shape"]["data"][0]["control_points"]
    path.write_text(json.dumps(geomdl_shape(control_points=points | {"weights": [1, 1, 1, 1]})))
    assert read_surface(path).shape == (2, 2)
    path.write_text(json.dumps(geomdl_shape(control_points=points | {"weights": [1, 2, 1, 1]})))
    with pytest.raises(InputError, match="rational"):
        read_surface(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", "{"),
        ("a.json", "[]"),
        ("a.json", "{}"),
        ("a.json", json.dumps({"shape": {"type": "curve", "data": [{}]}})),
        ("a.json", json.dumps(geomdl_shape(knotvector_u=[0, 1]))),
        ("a.json", json.dumps(geomdl_shape(size_u=3))),
        ("a.npz", "PK no"),
        ("a.stl", "solid"),
    ],
)
def test_files_that_hold_no_surface(tmp_path, name, content):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_surface(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
