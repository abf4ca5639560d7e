"""A report is one page that needs nothing else: tables, pictures, versions."""

import base64
import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers import wavy_cloud, wavy_grid
from test_trimmed_surface import LOOPS

import jaxfit as jf
from jaxfit import _cli
from jaxfit.plot import report

pytest.importorskip("matplotlib")

EMPTY = {"meta", "img", "br", "link", "hr", "input"}


class Page(HTMLParser):
    """Headings, cells and pictures; checks that tags are closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.headings, self.images, self.metas, self.cells = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        if tag not in EMPTY:
            self.open.append(tag)
        if tag == "img":
            self.images.append(dict(attributes))
        if tag == "meta":
            self.metas.append(dict(attributes))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)
        if self.open and self.open[-1] in ("th", "td"):
            self.cells.append(data)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr("jaxfit.plot._render._PIXELS", 200)
    monkeypatch.setattr("jaxfit.plot._report._DPI", 40)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")


def fitted():
    points, edges = wavy_cloud(200)
    return points, jf.fit_points(points, jf.Boundary(**edges), net=(6, 6), max_steps=3)


@pytest.mark.slow
def test_a_trimmed_fit_has_a_page_with_all_pictures(tmp_path):
    points, fit = fitted()
    fit = dataclasses.replace(fit, trimmed=jf.TrimmedSurface(fit.surface, LOOPS["an L with two holes"]))
    path = tmp_path / "r.html"
    report(fit, path, points, title="a <b> & c", tables={"Input": {"file": "x<y"}})
    assert [item.name for item in tmp_path.iterdir()] == ["r.html"]
    text = path.read_text()
    page = Page(text)
    pictures = ["Errors and folds", "Zebra stripes", "Loops", "History"]
    assert page.headings == ["a <b> & c", "Input", "Result", *pictures, "Versions"]
    for said in (
        "x<y",
        "the outer one with 6 vertices, 2 holes",
        "OrthogonalDistance",
        jf.__version__,
        np.__version__,
    ):
        assert said in page.cells
    assert len(page.images) == 5  # surface and errors are two
    for image in page.images:
        kind, data = image["src"].split(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data).startswith(b"\x89PNG")
        assert image["alt"]


def test_a_page_asks_for_nothing_and_fits_a_telephone(tmp_path):
    fit = jf.interpolate(wavy_grid(8, 7))
    report(fit, tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    without = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.search(r"https?:|//|url\(|@import|<script|<link", without)
    page = Page(text)
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.metas
    assert re.search(r"img \{[^}]*max-width: 100%", text)
    assert "Loops" not in page.headings


def test_the_command_writes_a_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    points, edges = wavy_cloud(200)
    np.savez("cloud.npz", points=points, **{f"boundary_{side}": line for side, line in edges.items()})
    argv = "fit cloud.npz -o s.npz --net 6x6 --max-steps 3 --tol-average 5 --loss huber --no-picture".split()
    assert _cli.main([*argv, *"--method geometric --report r.html".split()]) == 0
    page = Page((tmp_path / "r.html").read_text())
    assert page.headings[:4] == ["cloud.npz", "Input", "Settings", "Output"]
    pairs = dict(zip(page.cells[::2], page.cells[1::2], strict=True))
    assert pairs["--loss"] == "huber"
    given = {name for name in pairs if name.startswith("--")}
    assert given == {"--net", "--max-steps", "--tol-average", "--loss", "--method"}
    assert (pairs["--net"], pairs["--tol-average"], pairs["points"]) == ("6x6", "5 %", "200")
    assert "s.npz, r.html" in " ".join(capsys.readouterr().out.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.npz", "r.html", "s.npz"]


@pytest.mark.parametrize("where", ["r.pdf", "none/r.html"])
def test_a_report_that_cannot_be_written_is_refused_before_the_fit(tmp_path, monkeypatch, capsys, where):
    monkeypatch.chdir(tmp_path)
    np.savez("grid.npz", grid=wavy_grid(8, 7))
    assert _cli.main(["fit", "grid.npz", "-o", "s.npz", "--report", where]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["grid.npz"]
