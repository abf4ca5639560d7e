"""Rooms import only lower rooms, and `import jaxfit` is quiet and light."""

import ast
import re
import subprocess
import sys

from helpers import CHECKOUT

PACKAGE = CHECKOUT / "jaxfit"

# Lowest first; a room may import its own modules and those of the lines above it.
ROOMS = [
    ("_interrupt", "_version", "_cores"),
    ("_checks", "_remembered"),
    ("_precision", "_progress_line"),
    ("_varying", "_differentiable_once", "_symmetric_solve"),
    ("_kept_programs",),
    ("_compile_ahead",),
    ("_unrolling", "_barrier", "_compile", "_program_folder"),
    ("_linear_call",),
    ("_splines",),
    ("_parameters",),
    ("_cells",),
    ("_closest",),
    ("_normal_equations",),
    ("_base",),
    ("_scan",),
    ("_quality",),
    ("_trimmed",),
    ("_fit",),
    ("_interpolation",),
    ("_approximation",),
    ("_streams",),
    ("_batch",),
    ("io",),
    ("plot",),
    ("_cli_methods",),
    ("_cli_arguments", "_cli_output"),
    ("_cli_session", "_cli_fit", "_cli_table", "_cli_workers"),
    ("_cli_batch_file", "_cli_report"),
    ("_cli_batch",),
    ("_cli",),
    ("__main__",),
]
HEIGHT = {room: height for height, rooms in enumerate(ROOMS) for room in rooms}
TOP = HEIGHT["plot"]  # only what is above files and pictures may import the whole package

MODULES = sorted(PACKAGE.rglob("*.py"))


def room_of(path):
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported_rooms(path):
    """Names of the rooms of jaxfit a file imports; "jaxfit" for the package as a whole."""
    package = ("jaxfit", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            base = ".".join(filter(None, (base, node.module)))
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            root, *rest = name.split(".")
            if root == "jaxfit":
                yield rest[0] if rest and rest[0] in HEIGHT else "jaxfit"


def complaint(path, room, other):
    """What is wrong with an import of `other` in a file of `room`, if anything."""
    if other == "jaxfit":
        return None if HEIGHT[room] > TOP else f"{path} imports the whole package"
    if {room, other} == {"_interpolation", "_approximation"}:
        return f"{path} imports {other}: neither group of methods needs the other"
    return None if other == room or HEIGHT[other] < HEIGHT[room] else f"{path} imports {other}"


def test_rooms_import_only_lower_rooms():
    wrong = []
    for path in MODULES:
        room = room_of(path)
        if room == "__init__":
            continue  # the table of contents
        assert room in HEIGHT, f"{path} is in no room; add it to ROOMS"
        wrong += filter(None, (complaint(path, room, other) for other in imported_rooms(path)))
    assert not wrong


def test_the_page_for_contributors_lists_all_rooms():
    page = (CHECKOUT / ".docs" / "pages" / "contributing.md").read_text()
    table = page.split("## Rooms")[1].split("## ")[0]
    listed = [name.removesuffix("/").removesuffix(".py") for name in re.findall(r"^\| `(\S+)`", table, re.M)]
    rooms = [room for rooms in ROOMS for room in rooms if not room.startswith("_cli_")]
    assert listed == [room.replace("_cli", "_cli*") for room in rooms]


def test_no_room_changes_the_global_configuration():
    changes = re.compile(r"config\.update|config\.\w+ = |enable_x64\(")
    changed = [
        str(path.relative_to(PACKAGE))
        for path in MODULES
        if changes.search(path.read_text()) and room_of(path) != "_cli_session"
    ]
    assert not changed


def test_what_to_install_is_quoted_alike():
    """In double quotes, which all shells know."""
    install = re.compile(r"""(?<!")jaxfit-surfaces\[|jaxfit-surfaces\[[^]]+\](?!")""")
    assert [path.name for path in MODULES if install.search(path.read_text())] == []


def test_cores_are_counted_in_one_place():
    counts = re.compile(r"cpu_count|getaffinity|workers=-1")
    assert [path.name for path in MODULES if counts.search(path.read_text())] == ["_cores.py"]


def test_importing_the_package_is_light_and_changes_no_configuration():
    program = """
import sys, jax
before = dict(jax.config.values)
import jaxfit, jaxfit.io
# The command line switches to double precision after this, so no array may exist yet.
assert not jax.live_arrays(), jax.live_arrays()
heavy = {"matplotlib", "jaxopt", "optimistix", "scipy.spatial", "scipy.interpolate", "rich"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
extra = {"OCP", "rhino3dm", "trimesh", "laspy", "lazrs", "pye57", "pypcd4", "shapely"}
assert not extra & set(sys.modules), extra & set(sys.modules)
assert dict(jax.config.values) == before
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
