"""A long fit says what it is doing, where someone looks on and nowhere else."""

import contextlib
import io
import sys
import threading
import time

import jax
import numpy as np
import pytest
import rich.live  # noqa: F401 - importing it takes longer than a short fit
from helpers import wavy_cloud

import jaxfit as jf
from jaxfit import _cli, _progress_line
from jaxfit._approximation import _cloud_fit
from jaxfit._approximation._room import Room


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    """What a call shows on a terminal, where the line comes at once."""
    monkeypatch.setattr(_progress_line, "DELAY", 0.0)
    monkeypatch.setattr(_progress_line, "INTERVAL", 0.001)
    monkeypatch.delenv(_progress_line.SETTING, raising=False)
    monkeypatch.setenv("TERM", "xterm")

    def text_of(call, *args, stream=Terminal, **options):
        with contextlib.redirect_stderr(stream()) as terminal:
            call(*args, **options)
        return terminal.getvalue()

    return text_of


GRID = np.stack([*np.meshgrid(np.arange(7.0), np.arange(5.0), indexing="ij"), np.ones((7, 5))], axis=2)
CLOUD, SIDES = wavy_cloud(300)


@_progress_line.shows_progress("waiting")
def wait(*_, progress=None):
    """Two phases; where a line comes at once, each lasts until it is drawn."""
    for phase in ("jaxfit: waiting", "jaxfit: still waiting"):
        _progress_line.doing(phase.removeprefix("jaxfit: "))
        patience = time.monotonic() + (20.0 if _progress_line._lines and not _progress_line.DELAY else 0.0)
        while time.monotonic() < patience and phase not in sys.stderr.getvalue():
            time.sleep(0.001)


def test_the_line_follows_the_work_and_goes(shown):
    text = shown(wait)
    assert text.index("jaxfit: waiting, 0 s") < text.index("jaxfit: still waiting, 0 s")
    assert text.endswith("\x1b[2K")  # the line is erased
    assert "jaxfit: waiting, 0 s" in shown(wait, (x for x in [GRID]))
    assert not _progress_line._lines


def test_fits_say_what_they_do(shown):
    text = shown(jf.fit_points, CLOUD, jf.Boundary(**SIDES), net=(6, 6), max_steps=2)
    assert "jaxfit: making a base surface" in text
    assert "jaxfit: fitting 6 x 6 control points to 300 points" in text
    assert "jaxfit: interpolating a grid" in shown(jf.interpolate, GRID)


def test_the_command_says_the_same(shown, monkeypatch, tmp_path):
    monkeypatch.setenv(_progress_line.SETTING, "")  # which the command may set
    sides = {f"boundary_{side}": polyline for side, polyline in SIDES.items()}
    np.savez(tmp_path / "cloud.npz", points=CLOUD, **sides)
    argv = f"fit {tmp_path}/cloud.npz -o {tmp_path}/s.npz --no-picture --no-cache".split()
    argv += "--net 6x6 --max-steps 2".split()
    assert "jaxfit: fitting 6 x 6 control points to 300 points" in shown(_cli.main, argv)
    assert shown(_cli.main, [*argv, "--quiet"]) == ""


def test_the_command_writes_a_line_now_and_then_into_a_log(shown, monkeypatch, tmp_path):
    monkeypatch.setattr(_progress_line, "LOG_INTERVAL", 0.001)
    monkeypatch.setenv(_progress_line.SETTING, "")
    sides = {f"boundary_{side}": polyline for side, polyline in SIDES.items()}
    np.savez(tmp_path / "cloud.npz", points=CLOUD, **sides)
    argv = f"fit {tmp_path}/cloud.npz -o {tmp_path}/s.npz --no-picture --no-cache".split()
    argv += "--net 6x6 --max-steps 2".split()
    lines = shown(_cli.main, argv, stream=io.StringIO).splitlines()
    assert len(lines) > 1
    assert any("fitting 6 x 6 control points to 300 points" in line for line in lines)
    assert not any("\x1b" in line for line in lines)
    assert shown(_cli.main, [*argv, "--quiet"], stream=io.StringIO) == ""


def test_a_short_fit_leaves_no_line_in_a_log(shown, monkeypatch):
    monkeypatch.setenv(_progress_line.SETTING, "log")
    assert shown(wait, stream=io.StringIO) == ""
    assert "still waiting" in shown(wait)  # where a terminal looks on all is as before


def test_a_net_chosen_by_some_of_the_points_says_of_how_many(monkeypatch):
    said = []
    monkeypatch.setattr(_cloud_fit, "doing", said.append)
    request = {"tol_average": 1e-3, "tol_maximum": None, "max_steps": 0, "weights": None, "start": None}
    request |= {"progress": None, "throw": False, "errors": None, "adjoint": None}
    base = jf.base_surface(jf.Boundary(**SIDES), net=(6, 6))
    for room in (None, Room((6, 6), 0, len(CLOUD), 64), Room((6, 6), 0, 400, 64)):
        _cloud_fit.fit_cloud(CLOUD, base, jf.OrthogonalDistance(), request, room)
    counts = ["300", "300", "300 of 400"]
    assert said == [f"fitting 6 x 6 control points to {count} points" for count in counts]


def test_fits_side_by_side_share_one_line(shown):
    base = jf.base_surface(jf.Boundary(**SIDES), net=(6, 6))
    text = shown(jf.map_fits, [CLOUD, CLOUD, CLOUD], base, max_steps=1)
    assert "jaxfit: fitting clouds, 0 of 2" in text
    assert text.count("\x1b[?25l") == 1  # the cursor is hidden once a line


def refuse(*_, **__):
    raise AssertionError("no thread is to be started")


def traced():
    jax.jit(wait)(GRID)
    jax.vmap(wait)(GRID)
    jax.grad(lambda x: (wait(x), x)[1])(1.0)


def test_nothing_is_started_where_nothing_is_to_be_shown(shown, monkeypatch):
    monkeypatch.setattr(threading, "Thread", refuse)
    assert shown(wait, stream=io.StringIO) == ""
    assert shown(wait, progress=print) == ""
    assert shown(traced) == ""
    monkeypatch.setenv(_progress_line.SETTING, "off")
    assert shown(wait) == ""


def test_short_work_shows_nothing(shown, monkeypatch):
    monkeypatch.setattr(_progress_line, "DELAY", 3.0)
    assert shown(wait) == ""


def test_the_line_goes_when_the_fit_fails(shown):
    with pytest.raises(ValueError, match="order"):
        shown(jf.interpolate, GRID, order=(99, 99))
    assert not _progress_line._lines
    assert "still waiting" in shown(wait)


def test_compiling_is_told_from_computing():
    seen = []

    def backend_compile_and_load():
        seen.append(_progress_line._is_compiling(threading.get_ident()))

    backend_compile_and_load()
    assert seen == [True]
    assert not _progress_line._is_compiling(threading.get_ident())


def test_the_name_of_the_compiler_is_jax_s():
    from jax._src import compiler

    assert any(name.startswith(_progress_line.COMPILER) for name in vars(compiler))
