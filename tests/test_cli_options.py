"""What the command line hands to the fit, shows, and returns; the fit itself is faked here."""

import ast
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import CHECKOUT, wavy_cloud, wavy_grid, wavy_surface

import jaxfit
from jaxfit import _cli, _cli_output, plot
from jaxfit.io import read_surface


@pytest.fixture
def fits(monkeypatch):
    """Fakes of the two ways to fit; every call is noted, with what it is to return."""
    calls = SimpleNamespace(
        made=[], average=1e-5, maximum=1e-4, converged=True, fails=None, trimmed=None, stats={}
    )
    calls.surface, calls.message = wavy_surface(), "The errors are within their tolerances."

    def fake(name):
        def fit(data, *args, **options):
            calls.made.append((name, data, args, options))
            if calls.fails:
                raise calls.fails
            count = np.asarray(data).reshape(-1, 3).shape[0]
            u, v = np.random.default_rng(0).uniform(size=(2, count))
            return SimpleNamespace(
                surface=calls.surface,
                regularity=jaxfit.regularity(calls.surface),
                u=u,
                v=v,
                errors=np.full(count, calls.average),
                average_error=calls.average,
                maximum_error=calls.maximum,
                converged=calls.converged,
                message=calls.message,
                stats={"num_steps": 3, "diagonal": 1.0, **calls.stats},
                trimmed=calls.trimmed,
                inside=np.full(count, True),
                history=SimpleNamespace(average=np.full(4, 1e-5), maximum=np.full(4, 1e-4)),
            )

        return fit

    for name in ("interpolate", "fit_points"):
        monkeypatch.setattr(jaxfit, name, fake(name), raising=False)
    return calls


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with one file of each kind, as the current one."""
    points, edges = wavy_cloud(60)
    sides = {f"boundary_{side}": polyline for side, polyline in edges.items()}
    np.savez(tmp_path / "cloud.npz", points=points, **sides)
    np.savez(tmp_path / "border.npz", **sides)
    np.savez(tmp_path / "grid.npz", grid=wavy_grid(8, 7))
    np.savetxt(tmp_path / "bare.xyz", points)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    return tmp_path


def run(*argv):
    return _cli.main(["fit", *argv, "-o", "s.npz", "--no-picture"])


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ------------------------------------------------------------------ choices


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["grid.npz"], "interpolate"),
        (["grid.npz", "--net", "5x5"], "fit_points"),
        (["grid.npz", "--method", "approximate"], "fit_points"),
        (["cloud.npz"], "fit_points"),
        (["bare.xyz", "--grid", "10x6"], "interpolate"),
        (["bare.xyz", "--boundary", "border.npz"], "fit_points"),
        (["bare.xyz"], "fit_points"),
        (["grid.npz", "--loss", "huber"], "fit_points"),
        (["grid.npz", "--boundary", "border.npz"], "fit_points"),
        (["grid.npz", "--method", "interpolate-standard"], "interpolate"),
    ],
)
def test_the_method_follows_from_the_data(fits, folder, argv, expected):
    assert run(*argv) == 0
    assert [made[0] for made in fits.made] == [expected]


def test_large_grids_are_approximated(fits, folder):
    np.savez("large.npz", grid=wavy_grid(201, 200))
    assert run("large.npz") == 0
    name, points, (boundary,), options = fits.made[0]
    assert (name, points.shape, options["net"]) == ("fit_points", (40200, 3), None)
    np.testing.assert_allclose(boundary.v1, wavy_grid(201, 200)[:, -1], atol=1e-12)


@pytest.mark.parametrize(("argv", "name"), [((), "fit_points"), (("--method", "interpolate"), "interpolate")])
def test_what_is_left_of_a_grid_with_gaps_is_a_scan(fits, folder, argv, name):
    grid = wavy_grid(20, 20)
    grid[3:6, 4:8, 2] = -9999.0
    np.save("gaps.npy", grid)
    assert run("gaps.npy", *argv) == 0
    made = fits.made[0]
    assert made[0] == name  # which refuses the grid in a sentence, if it is to be interpolated
    assert made[1].shape == ((400, 3) if name == "fit_points" else (20, 20, 3))
    assert made[2] == ((None,) if name == "fit_points" else ())


def test_the_terrain_has_its_own_net(fits, folder, monkeypatch):
    assert run("jacksboro") == 0
    name, points, _, options = fits.made[0]
    assert (name, points.shape, options["net"]) == ("fit_points", (138632, 3), (62, 57))
    assert run("jacksboro", "--net", "20x30") == 0
    assert fits.made[1][3]["net"] == (20, 30)
    settings = []
    monkeypatch.setattr(plot, "report", lambda *_, tables, **options: settings.append(tables["Settings"]))
    assert run("jacksboro", "--order", "3x3", "--report", "r.html") == 0
    assert list(settings[0]) == ["tolerances", "--order"]  # nothing that the user has not asked for


def test_options_arrive_as_fractions(fits, folder):
    argv = "--net 8x9 --order 3x5 --tol-average 0.02 --tol-maximum 0.5% --max-steps 7".split()
    assert run("cloud.npz", *argv) == 0
    assert fits.made[0][3] == {
        "net": (8, 9),
        "order": (3, 5),
        "tol_average": pytest.approx(2e-4),
        "tol_maximum": pytest.approx(5e-3),
        "max_steps": 7,
    }
    assert run("grid.npz", "--tol-average", "0.1", "--tol-maximum", "0.01") in (0, 1)
    assert fits.made[1][3] == {
        "order": (4, 4),
        "tolerance": pytest.approx(1e-4),
    }
    assert run("cloud.npz", "--order", "3") == 0
    assert fits.made[2][3]["order"] == (3, 3)


def test_points_without_boundary_are_fitted_without(fits, folder):
    assert run("bare.xyz", "--hole-length", "0.25") == 0
    _, points, arguments, options = fits.made[0]
    assert (points.shape, arguments) == ((60, 3), (None,))
    assert set(options) == {"order", "net", "faces", "hole_length"}
    assert (options["faces"], options["hole_length"]) == (None, 0.25)


def test_a_hole_length_is_for_points_without_boundary(fits, folder, capsys):
    assert run("cloud.npz", "--hole-length", "0.25") == 2
    assert "--hole-length is for points without a boundary" in capsys.readouterr().err
    assert run("bare.xyz", "--hole-length", "0") == 2


def test_a_base_is_for_points_with_a_boundary(fits, folder, capsys):
    assert run("bare.xyz", "--base", "meshless") == 2
    assert "--base is for points with a boundary, but bare.xyz has none" in capsys.readouterr().err
    assert not fits.made


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        ("cloud.npz", None),
        ("cloud.npz --method approximate", None),
        ("cloud.npz --method orthogonal", jaxfit.OrthogonalDistance()),
        ("cloud.npz --method geometric", jaxfit.GeometricApproximation()),
        ("cloud.npz --method standard", jaxfit.StandardApproximation()),
        ("cloud.npz --smoothing 1e-9", jaxfit.OrthogonalDistance(smoothing=1e-9)),
        ("cloud.npz --smoothing regular", jaxfit.OrthogonalDistance(smoothing=jaxfit.RegularSmoothing())),
        (
            "cloud.npz --method standard --smoothing gcv",
            jaxfit.StandardApproximation(smoothing=jaxfit.GeneralizedCrossValidation()),
        ),
        ("cloud.npz --loss huber", jaxfit.OrthogonalDistance(loss=jaxfit.Huber())),
        ("cloud.npz --loss tukey", jaxfit.OrthogonalDistance(loss=jaxfit.Tukey())),
        (
            "cloud.npz --method geometric --loss geman-mcclure --insertion",
            jaxfit.GeometricApproximation(loss=jaxfit.GemanMcClure(), insertion=jaxfit.KnotInsertion()),
        ),
        ("cloud.npz --border corners", jaxfit.OrthogonalDistance(border=jaxfit.FixedCorners())),
        ("cloud.npz --border free", jaxfit.OrthogonalDistance(border=jaxfit.FreeBorder())),
        ("grid.npz", None),
        ("grid.npz --method interpolate-standard", jaxfit.StandardInterpolation()),
        ("grid.npz --symmetry rows", jaxfit.GeometricInterpolation(symmetry=jaxfit.Reflection(axis=0))),
        ("grid.npz --symmetry columns", jaxfit.GeometricInterpolation(symmetry=jaxfit.Reflection(axis=1))),
    ],
)
def test_options_are_fields_of_the_method(fits, folder, argv, expected):
    assert run(*argv.split()) in (0, 1)
    assert repr(fits.made[0][3].get("method")) == repr(expected)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("coons", jaxfit.Coons), ("meshless", jaxfit.Meshless), ("dynamic", jaxfit.DynamicBaseSurface)],
)
def test_the_base_is_chosen(fits, folder, name, expected):
    assert run("cloud.npz", "--base", name) == 0
    assert isinstance(fits.made[0][3]["base"], expected)
    assert fits.made[0][3].get("method") is None


def test_normals_are_read(fits, folder):
    normals = np.random.default_rng(0).normal(size=(8, 7, 3))
    np.savez("normals.npz", normals=normals)
    np.save("normals.npy", normals)
    for i, name in enumerate(("normals.npz", "normals.npy")):
        assert run("grid.npz", "--normals", name) in (0, 1)
        np.testing.assert_array_equal(fits.made[i][3]["normals"], normals)


def test_a_trimmed_fit_is_written_with_its_loops_and_its_counts_are_shown(fits, folder, capsys):
    loop = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]])
    fits.trimmed = jaxfit.TrimmedSurface(wavy_surface(), (loop,))
    fits.stats = {"points_read": 70, "duplicates": 4, "outliers": 6, "non_finite": 0, "off_the_sheet": 0}
    assert run("bare.xyz") == 0
    assert isinstance(read_surface("s.npz"), jaxfit.TrimmedSurface)
    said = " ".join(capsys.readouterr().out.split())
    assert "70; left out: 4 duplicates, 6 outliers" in said
    assert "the outer one with 3 vertices, no hole" in said


def test_the_surface_is_written(fits, folder):
    assert run("cloud.npz") == 0
    np.testing.assert_array_equal(read_surface("s.npz").control_points, wavy_surface().control_points)


# --------------------------------------------------------------- exit codes


@pytest.mark.parametrize(
    ("argv", "code"),
    [
        (["cloud.npz"], 0),
        (["cloud.npz", "--tol-average", "0.001"], 0),
        (["cloud.npz", "--tol-average", "0.0009"], 1),
        (["cloud.npz", "--tol-maximum", "0.005"], 1),
        (["grid.npz"], 1),
        (["grid.npz", "--tol-maximum", "0.02"], 0),
    ],
)
def test_a_tolerance_that_was_missed_is_told(fits, folder, argv, code):
    fits.average, fits.maximum, fits.converged = 1e-5, 1e-4, False
    assert run(*argv) == code
    assert (folder / "s.npz").is_file()


def test_the_table_is_shown_although_the_picture_cannot_be_written(fits, folder, monkeypatch, capsys):
    def fails(*_, **__):
        raise OSError("s.png cannot be written: no space left on device.")

    monkeypatch.setattr(plot, "surface_and_errors", fails)
    assert _cli.main(["fit", "cloud.npz", "-o", "s.npz", "--report", "r.html"]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("jaxfit: error: s.png cannot be written")
    assert "average error" in captured.out
    assert captured.out.splitlines()[-1].split() == ["written", "s.npz"]
    assert (folder / "s.npz").is_file()


def test_lines_of_the_table_are_whole_where_they_go_into_a_file(fits, folder, capsys):
    fits.message = "The errors are within their tolerances, " + "and this goes on " * 20 + "to here."
    assert run("cloud.npz") == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("stopped"))
    assert line == line.rstrip()
    assert line.endswith("to here.")


def test_a_missing_extra_is_a_sentence(fits, folder, capsys):
    fits.fails = ImportError('points without a boundary need shapely; pip install "jaxfit-surfaces[scan]".')
    assert _cli.main(["fit", "cloud.npz", "-o", "out.npz"]) == 2
    assert capsys.readouterr().err == f"jaxfit: error: {fits.fails}\n"
    assert not (folder / "out.npz").exists()


@pytest.mark.parametrize("how", ["nan", "raise"])
def test_a_numerical_failure_writes_nothing(fits, folder, capsys, how):
    before = names(folder)
    if how == "nan":
        fits.average = float("nan")
    else:
        fits.fails = RuntimeError("Out of memory\nwhile allocating.")
    assert run("cloud.npz") == 3
    assert names(folder) == before
    captured = capsys.readouterr()
    assert captured.err.startswith("jaxfit: error: the fit failed: ")
    assert captured.err.count("\n") == 1


def test_a_defect_is_told_from_a_missed_tolerance(fits, folder, capsys):
    fits.fails = KeyError("knots")
    assert run("cloud.npz") == 3
    *traceback, said = capsys.readouterr().err.splitlines()
    assert traceback[0].startswith("Traceback")
    assert said.startswith("jaxfit: error: the fit failed; please report this defect")
    assert said.endswith("KeyError: 'knots'")


def test_interruption_writes_nothing(fits, folder, capsys):
    before = names(folder)
    fits.fails = KeyboardInterrupt()
    assert run("cloud.npz") == 130
    assert names(folder) == before
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "see jaxfit --help"),
        (["fit", "cloud.npz"], "-o/--output; see jaxfit fit --help"),
        (["fit", "-o", "s.npz"], "INPUT"),
        (["draw", "cloud.npz"], "'draw'"),
        (["fit", "cloud.npz", "-o", "s.npz", "--nets", "5x5"], "--nets 5x5; see jaxfit fit --help"),
        (["batch", "cloud.npz", "-o", "new", "--no-picture"], "--no-picture; see jaxfit batch --help"),
        (["fit", "none.npz", "-o", "s.npz"], "none.npz does not exist"),
        (["fit", "bare.xyz", "-o", "s.npz", "--method", "interpolate"], "cannot be interpolated"),
        (["fit", "bare.xyz", "-o", "s.npz", "--grid", "7x7"], "bare.xyz holds 60 points, which do not"),
        (["fit", "bare.xyz", "-o", "s.npz", "--boundary", "grid.npz"], "holds no boundary"),
        (["fit", "grid.npz", "-o", "s.npz", "--method", "interpolate", "--net", "5x5"], "--net"),
        (["fit", "cloud.npz", "-o", "s.dwg"], "suffix .dwg"),
        (["fit", "cloud.npz", "-o", "none/s.npz"], "does not exist; make it first"),
        (["fit", "cloud.npz", "-o", "cloud.npz"], "is the file that is read"),
        (["fit", "cloud.npz", "-o", "./border.npz", "--boundary", "border.npz"], "is read"),
        (["fit", "grid.npz", "-o", "./border.npz", "--normals", "border.npz"], "is read"),
        (["fit", "cloud.npz", "-o", "s.npz", "--picture", "s.dwg"], "suffix .dwg"),
        (["fit", "cloud.npz", "-o", "s.npz", "--net", "5"], "'5' is no pair of counts"),
        (["fit", "cloud.npz", "-o", "s.npz", "--tol-average", "-1"], "'-1' is no percentage"),
        (["fit", "cloud.npz", "-o", "s.npz", "--tol-maximum", "nan"], "'nan' is no percentage"),
        (["fit", "cloud.npz", "-o", "s.npz", "--tol-average", "101"], "'101' is more than 100 %"),
        (["fit", "cloud.npz", "-o", "s.npz", "--order", "9"], "'9' is no order; pass 2 to 8 along u and v"),
        (["fit", "cloud.npz", "-o", "s.npz", "--order", "4x1"], "'4x1' is no order"),
        (["fit", "grid.npz", "-o", "s.npz", "--boundary", "none.npz"], "none.npz does not exist"),
        (
            ["fit", "grid.npz", "-o", "s.npz", "--boundary", "border.npz", "--method", "interpolate"],
            "--boundary is no option of --method interpolate; leave it out, or use --method approximate",
        ),
        (["fit", "grid.npz", "-o", "s.npz", "--hole-length", "1"], "a boundary, but grid.npz is a grid"),
        (["fit", "cloud.npz", "-o", "s.npz", "--max-steps", "0"], "'0' is no number of steps"),
        (["fit", "cloud.npz", "-o", "s.npz", "--method", "guess"], "'guess'"),
        (["fit", "cloud.npz", "-o", "s.npz", "--smoothing", "-1"], "'-1' is neither a number"),
        (["fit", "cloud.npz", "-o", "s.npz", "--smoothing", "gcv"], "is one of --method standard"),
        (
            ["fit", "cloud.npz", "-o", "s.npz", "--smoothing", "1", "--method", "geometric"],
            "--smoothing is no option of --method geometric",
        ),
        (["fit", "cloud.npz", "-o", "s.npz", "--symmetry", "rows"], "--symmetry is no option of"),
        (
            ["fit", "grid.npz", "-o", "s.npz", "--loss", "huber", "--method", "interpolate"],
            "--loss is no option of --method interpolate; leave it out, or use --method approximate",
        ),
        (["fit", "grid.npz", "-o", "s.npz", "--normals", "grid.npz"], "holds no normals"),
        (
            ["fit", "grid.npz", "-o", "s.npz", "--normals", "n.npy", "--symmetry", "rows"],
            "--normals has a method of its own",
        ),
    ],
)
def test_bad_usage_is_one_sentence(fits, folder, capsys, argv, said):
    before = names(folder)
    assert _cli.main(argv) == 2
    assert names(folder) == before
    assert not fits.made
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("jaxfit: error: ")
    assert captured.err.count("\n") == 1
    assert said in captured.err


def test_a_grid_without_a_boundary_says_why(fits, folder, capsys):
    grid = wavy_grid(8, 7)
    grid[0] = grid[0, 0]
    np.savez("pole.npz", grid=grid)
    assert run("pole.npz") == 0  # interpolation needs none
    assert run("pole.npz", "--net", "5x5") == 2
    assert capsys.readouterr().err.startswith("jaxfit: error: ")


# ------------------------------------------------------------------- output


@pytest.mark.parametrize("rich", [True, False])
def test_the_table_says_all(fits, folder, capsys, monkeypatch, rich):
    if not rich:
        monkeypatch.setattr(_cli_output.importlib.util, "find_spec", lambda name: None)
    assert run("grid.npz") == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    for said in (
        "grid.npz",
        "56 (grid 8 x 7)",
        "7 x 6",
        "4 x 4",
        "interpolate, double precision",
        "0.001 % of the diagonal",
        "0.01 % of the diagonal",
        "within their tolerances",
        "s.npz",
    ):
        assert said in captured.out


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("cloud.npz", "average 0.06 % (default), maximum without limit"),
        ("cloud.npz --tol-maximum 2", "average 0.06 % (default), maximum 2 %"),
        ("cloud.npz --tol-average 0.01", "average 0.01 %, maximum without limit"),
        ("grid.npz", "maximum at rounding (default)"),
        ("grid.npz --tol-average 0.01 --tol-maximum 0.1", "maximum 0.01 %"),
    ],
)
def test_the_table_says_the_tolerances_in_force(fits, folder, capsys, argv, said):
    run(*argv.split())
    row = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("tolerances"))
    assert row.removeprefix("tolerances").strip() == said


@pytest.mark.parametrize(
    ("argv", "folds", "asked"),
    [
        ("bare.xyz --grid 6x10", True, ", or is the grid 10x6?"),
        ("bare.xyz --grid 6x10", False, "."),
        ("grid.npz", True, "."),
    ],
)
def test_where_a_grid_folds_its_sides_are_asked_for(fits, folder, capsys, argv, folds, asked):
    if folds:
        net = fits.surface.control_points
        fits.surface = jaxfit.BSplineSurface(
            net[:, ::-1].at[:3].set(net[:3]), fits.surface.knots_u, fits.surface.knots_v
        )
    fits.message = "it folds: look whether its points are in order (fit.regularity.fold_parameters)."
    assert run(*argv.split(), "--tol-average", "1") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"it folds: look whether its points are in order{asked} tolerances" in said


def test_what_is_reworded_for_the_command_line_is_said_somewhere():
    sources = [path.read_text() for path in (CHECKOUT / "jaxfit").rglob("*.py") if path.stem != "_cli_output"]
    nodes = [node for source in sources for node in ast.walk(ast.parse(source))]
    texts = [str(node.value) for node in nodes if isinstance(node, ast.Constant)]
    for python in _cli_output.REWORDED:
        assert any(python in text for text in texts), python


def test_sentences_name_options_as_on_the_command_line(fits, folder, capsys):
    fits.fails = ValueError("raise hole_length, or\n tol_average; see hole_length.csv and ./max_steps.")
    assert run("bare.xyz") == 2
    said = "raise --hole-length, or --tol-average; see hole_length.csv and ./max_steps."
    assert capsys.readouterr().err == f"jaxfit: error: {said}\n"


def test_quiet_is_silent(fits, folder, capsys):
    assert run("cloud.npz", "--quiet") == 0
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_the_picture_lies_beside_the_surface(fits, folder):
    assert _cli.main(["fit", "cloud.npz", "-o", "s.json", "--quiet"]) == 0
    assert (folder / "s.png").read_bytes().startswith(b"\x89PNG")
    assert _cli.main(["fit", "cloud.npz", "-o", "t.json", "--quiet", "--picture", "p.svg"]) == 0
    assert (folder / "p.svg").is_file()
    assert not (folder / "t.png").exists()


def test_without_matplotlib_there_is_no_picture(fits, folder, capsys, monkeypatch):
    monkeypatch.setattr(_cli.importlib.util, "find_spec", lambda name: None)
    assert _cli.main(["fit", "cloud.npz", "-o", "s.json", "--quiet"]) == 0
    assert not (folder / "s.png").exists()
    argv = ["fit", "cloud.npz", "-o", "s.json", "--picture", "p.png"]
    assert _cli.main(argv) == 2
    assert "jaxfit-surfaces[plot]" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["fit", "batch"])
def test_the_help_has_all_exit_codes(capsys, command):
    with pytest.raises(SystemExit):
        _cli.main([command, "--help"])
    codes = capsys.readouterr().out.split("exit codes:\n")[1].split("\n\n")[0]
    assert [line.split()[0] for line in codes.splitlines()] == ["0", "1", "2", "3", "130"]


def test_the_help_trims_no_3dm(capsys):
    with pytest.raises(SystemExit):
        _cli.main(["fit", "--help"])
    lines = [line for line in capsys.readouterr().out.splitlines() if ".3dm" in line]
    assert len(lines) == 1
    assert "the whole surface" in lines[0]
    assert "trimmed" not in lines[0]


@pytest.mark.parametrize("argv", [["--help"], ["fit", "--help"], ["--version"]])
def test_help_and_version(capsys, argv):
    with pytest.raises(SystemExit) as caught:
        _cli.main(argv)
    assert caught.value.code == 0
    said = capsys.readouterr().out
    assert ("exit codes" in said) == ("fit" in argv)
    assert (jaxfit.__version__ in said) == ("--version" in argv)
