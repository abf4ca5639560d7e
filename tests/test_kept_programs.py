"""What is compiled is kept: in the user's cache folder, within bounds, whole, and never at any cost."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from helpers import CHECKOUT, wavy_grid
from test_cli_fit import command

import jaxfit as jf
from jaxfit import _cli, _kept_programs, _program_folder


@pytest.fixture
def grid(tmp_path, monkeypatch):
    np.savez(tmp_path / "grid.npz", grid=wavy_grid(8, 7))
    monkeypatch.chdir(tmp_path)
    return ("fit", "grid.npz", "-o", "s.npz", "--no-picture")


@pytest.mark.slow
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
    monkeypatch.delenv(_program_folder.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _program_folder.cache_folder() == tmp_path / "jaxfit"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative, which the standard says to ignore")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert _program_folder.cache_folder() == tmp_path / "home" / ".cache" / "jaxfit"
    monkeypatch.setenv(_program_folder.VARIABLE, str(tmp_path / "v"))
    assert _program_folder.cache_folder() == tmp_path / "v"
    assert _program_folder.cache_folder(str(tmp_path / "o")) == tmp_path / "o"
    assert not os.listdir(tmp_path / "o")
    monkeypatch.setenv(_program_folder.VARIABLE, "OFF")
    assert _program_folder.cache_folder() is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no such modes")
@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_a_folder_that_others_can_write_is_refused(grid, tmp_path, monkeypatch, capsys, mode):
    folder = tmp_path / "c" / "jaxfit"
    folder.mkdir(parents=True)
    folder.chmod(mode)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv(_program_folder.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    for asked in (None, folder):
        with pytest.raises(PermissionError, match="can be written by others; name another, or chmod go-w"):
            jf.keep_programs(asked)
    assert _cli.main(["fit", "none.npz", "-o", "s.npz", "--no-picture"]) == 2
    assert "programs are not kept (folder" in capsys.readouterr().err
    assert not os.listdir(folder)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no such users")
def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="belongs to another user; name another"):
        jf.keep_programs(tmp_path)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no such modes")
def test_folders_are_made_for_one_user(tmp_path, monkeypatch):
    monkeypatch.setattr(_kept_programs, "folder", None)
    before = os.umask(0)
    try:
        made = jf.keep_programs(tmp_path / "programs")
    finally:
        os.umask(before)
    assert [path.stat().st_mode & 0o777 for path in (made, made.parent)] == [0o700, 0o700]


def test_what_was_not_used_for_longest_goes(tmp_path, monkeypatch):
    monkeypatch.setattr(_program_folder, "LARGEST", 250)
    folders = [tmp_path / f"version-{name}" for name in "ab"]
    for folder in folders:
        folder.mkdir()
    for age, name in enumerate(("new", "middle", "old")):
        (folders[age // 2] / f"{name}-cache").write_bytes(bytes(100))
        os.utime(folders[age // 2] / f"{name}-cache", (1e9 - age, 1e9 - age))
    (folders[0] / "interrupted-cache").touch()
    (folders[0] / "of-somebody-else").write_bytes(bytes(1000))
    (tmp_path / "my-cache").write_bytes(bytes(1000))
    _program_folder.cache_folder(str(tmp_path))
    assert sorted(os.listdir(tmp_path)) == ["my-cache", "version-a"]
    assert sorted(os.listdir(folders[0])) == ["middle-cache", "new-cache", "of-somebody-else"]


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """The folder of this test's programs, and a list of what was compiled for it."""
    compiled, compile_now = [], _kept_programs._compiled

    def counted(path, *rest):
        compiled.append(path.name.split("-")[0])
        return compile_now(path, *rest)

    monkeypatch.setattr(_kept_programs, "folder", tmp_path)
    monkeypatch.setattr(_kept_programs, "_compiled", counted)
    monkeypatch.setattr(_kept_programs, "_loaded", {})
    return compiled


def nearest(count=60, method=None):
    surface = jf.interpolate(wavy_grid(8, 7), jf.StandardInterpolation()).surface
    points = np.random.default_rng(0).random((count, 3))
    return jf.closest_point(surface, points, **({} if method is None else {"method": method})).u


def test_a_kept_program_gives_the_same_numbers(kept, tmp_path):
    first = nearest()
    assert kept
    assert len(kept) == len(set(kept)) == len(os.listdir(tmp_path))
    _kept_programs._loaded.clear()
    compiled = list(kept)
    np.testing.assert_array_equal(nearest(), first)
    assert kept == compiled


@pytest.mark.parametrize("torn", [b"", b"x", None], ids=["empty", "other", "half"])
def test_a_file_that_is_not_whole_is_compiled_anew(kept, tmp_path, torn):
    first = nearest()
    for path in tmp_path.iterdir():
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2] if torn is None else torn)
    _kept_programs._loaded.clear()
    np.testing.assert_array_equal(nearest(), first)
    assert len(kept) == 2 * len(set(kept))
    assert all(path.stat().st_size > 1000 for path in tmp_path.iterdir())


@pytest.mark.parametrize("found_by_jax", [False, True])
def test_what_jax_found_in_its_own_cache_is_not_written(tmp_path, found_by_jax):
    lowered = jax.jit(lambda x: x + 1).lower(1.0)

    class Found:
        def compile(self):
            if found_by_jax:
                jax.monitoring.record_event("/jax/compilation_cache/cache_hits")
            return lowered.compile()

    program = _kept_programs._compiled(tmp_path / "program", Found())
    assert program(1.0) == 2.0
    assert (tmp_path / "program").exists() != found_by_jax


def test_other_settings_and_sizes_are_other_programs(kept):
    def runs():
        return kept.count("_run")

    nearest()
    assert runs() == 1
    nearest(method=jf.HuWallner())
    assert runs() == 2
    nearest(5000)
    assert runs() == 3
    with jax.default_matmul_precision("highest"):
        nearest()
    assert runs() == 4
    nearest()
    assert runs() == 4


class OfTheUser(jf.Newton):
    """May change from one process to the next, unseen."""


def test_what_holds_code_of_the_user_is_not_kept(kept):
    np.testing.assert_array_equal(nearest(method=OfTheUser()), nearest())
    assert kept.count("_run") == 1


@pytest.mark.parametrize("value", [OfTheUser(), lambda x: x, object(), {"a": [OfTheUser]}])
def test_a_value_without_a_lasting_name_has_no_key(value):
    with pytest.raises(_kept_programs.NoStableName):
        _kept_programs._spelled(value)


@pytest.mark.slow
def test_gradients_are_those_without_kept_programs(kept):
    grid = wavy_grid(8, 7)

    def energy(grid):
        return (jf.interpolate(grid, jf.GeometricInterpolation()).surface.control_points ** 2).sum()

    with_programs = jax.grad(energy)(grid)
    _kept_programs.folder = None
    np.testing.assert_allclose(with_programs, jax.grad(energy)(grid), rtol=1e-9)


def test_without_jit_and_with_a_mesh_nothing_is_kept(kept):
    double = jax.jit(lambda x: 2 * x)
    double.__qualname__ = "double"
    with jax.disable_jit():
        assert _kept_programs.call_kept(double, 0, (1.0,)) == 2.0
    assert not kept
    grid = wavy_grid(8, 7)
    plain = jf.interpolate(grid, jf.StandardInterpolation()).surface.control_points
    mesh = jax.make_mesh((1,), ("x",))
    held = jax.device_put(grid, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("x")))
    found = jf.interpolate(held, jf.StandardInterpolation()).surface.control_points
    assert kept == ["_compiled"]
    np.testing.assert_allclose(plain, found, atol=1e-12)


def test_off_is_off_and_another_folder_gets_its_own(kept, tmp_path, monkeypatch):
    folders = [jf.keep_programs(tmp_path / name) for name in "ab" if nearest() is not None]
    nearest()
    assert [len(os.listdir(folder)) for folder in folders] == [len(set(kept))] * 2
    for off in ("off", ""):
        assert jf.keep_programs(off) is None
        assert _kept_programs.folder is None
    monkeypatch.setenv("HOME", str(tmp_path))
    assert jf.keep_programs("~/c").parent == tmp_path / "c"


def test_a_file_that_another_process_has_removed_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "version-a").mkdir()
    (tmp_path / "version-a" / "gone-cache").symlink_to(tmp_path / "nothing")
    assert _program_folder.cache_folder(str(tmp_path)) == tmp_path


def folder_of_programs():
    return _kept_programs.folder


def test_worker_processes_keep_programs_in_the_same_folder(kept, tmp_path):
    with jf.worker_processes(1) as executor:
        assert executor.submit(folder_of_programs).result() == tmp_path


FITS = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxfit as jf
from jaxfit import _kept_programs
jf.keep_programs(sys.argv[1])
if sys.argv[2] == "again":
    _kept_programs._compiled = None
surface = jf.interpolate(np.load("grid.npy")).surface
points = surface(*np.random.default_rng(0).random((2, 300)))
fit = jf.approximate(np.asarray(points), surface, max_steps=2)
print(repr(float(np.sum(fit.surface.control_points))))
"""


@pytest.mark.slow
def test_a_second_process_compiles_no_fit(tmp_path):
    np.save(tmp_path / "grid.npy", wavy_grid(8, 7))
    printed = [
        subprocess.run(
            [sys.executable, "-c", FITS, "programs", when],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for when in ("first", "again")
    ]
    assert printed[0] == printed[1] != ""
