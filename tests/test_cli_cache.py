"""The command keeps what it compiles: in the user's cache folder, within bounds, and never at any cost."""

import os
import sys

import numpy as np
import pytest
from helpers import wavy_grid
from test_cli_fit import command

from jaxfit import _cli, _cli_cache


@pytest.fixture
def grid(tmp_path, monkeypatch):
    np.savez(tmp_path / "grid.npz", grid=wavy_grid(8, 7))
    monkeypatch.chdir(tmp_path)
    return ("fit", "grid.npz", "-o", "s.npz", "--no-picture")


def test_a_second_run_compiles_nothing_anew(grid, tmp_path):
    home = {"XDG_CACHE_HOME": str(tmp_path / "c"), "HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path / "c")}
    kept = []
    for _ in range(2):
        done = command(*grid, **home)
        assert (done.returncode, done.stderr) == (0, "")
        kept.append({path.name for path in tmp_path.rglob("*-cache")})
    assert len(kept[0]) > 3
    assert kept[0] == kept[1]


@pytest.mark.parametrize(
    ("argv", "variable"), [(["--no-cache"], "c"), ([], "off"), ([], ""), (["--cache", "grid.npz"], "off")]
)
def test_without_it_nothing_is_kept(grid, tmp_path, monkeypatch, capsys, argv, variable):
    monkeypatch.setenv("JAXFIT_CACHE_DIR", variable)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    assert _cli.main(["fit", "none.npz", "-o", "s.npz", "--no-picture", *argv]) == 2
    said = capsys.readouterr().err.splitlines()
    assert os.listdir(tmp_path) == ["grid.npz"]
    assert len(said) == 1 + ("grid.npz" in argv)
    assert said[0].startswith("jaxfit: warning: compiled programs are not kept") == ("grid.npz" in argv)


def test_the_folder_is_that_of_option_variable_or_user(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv(_cli_cache.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _cli_cache.cache_folder() == tmp_path / "jaxfit"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative, which the standard says to ignore")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert _cli_cache.cache_folder() == tmp_path / "home" / ".cache" / "jaxfit"
    monkeypatch.setenv(_cli_cache.VARIABLE, str(tmp_path / "v"))
    assert _cli_cache.cache_folder() == tmp_path / "v"
    assert _cli_cache.cache_folder(str(tmp_path / "o")) == tmp_path / "o"
    assert not os.listdir(tmp_path / "o")
    monkeypatch.setenv(_cli_cache.VARIABLE, "OFF")
    assert _cli_cache.cache_folder() is None


def test_what_was_not_used_for_longest_goes(tmp_path, monkeypatch):
    monkeypatch.setattr(_cli_cache, "LARGEST", 250)
    for age, name in enumerate(("new", "middle", "old")):
        (tmp_path / f"{name}-cache").write_bytes(bytes(100))
        os.utime(tmp_path / f"{name}-cache", (1e9 - age, 1e9 - age))
    (tmp_path / "interrupted-cache").touch()
    (tmp_path / "of-somebody-else").write_bytes(bytes(1000))
    _cli_cache.cache_folder(str(tmp_path))
    assert sorted(os.listdir(tmp_path)) == ["middle-cache", "new-cache", "of-somebody-else"]
