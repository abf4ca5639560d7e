"""STEP and IGES files hold the surface that was written, by what Open CASCADE and gmsh read."""

import os
import sys

import numpy as np
import pytest
from helpers import diagonal, wavy_surface
from surface_files import (
    FAR,
    SURFACES,
    area,
    area_of,
    moved,
    need,
    on_grid,
    only_face,
    points_of,
    samples,
    shape_in,
)

from jaxfit.io import write_surface


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
    with pytest.raises(ValueError, match=r"at most 4e\+08 across .* use a larger unit\.$"):
        write_surface(tmp_path / "s.step", moved(wavy_surface(), 1e9))

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
