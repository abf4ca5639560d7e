"""Files appear whole or not at all."""

import os
from functools import partial
from pathlib import Path

from jaxfit._interrupt import at_last
from jaxfit.io._extras import import_extra
from jaxfit.io._point_data import InputError

LIBRARIES = {  # of the extra `cad`
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), "OCP"),
    ".3dm": "rhino3dm",
    **dict.fromkeys((".ply", ".stl", ".obj"), "trimesh"),
}
PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".eps", ".ps")
_SURFACES = (".npz", ".json", *LIBRARIES)


def check_output(path: str | os.PathLike, suffixes: tuple[str, ...] = _SURFACES) -> None:
    """Raise now if `path` cannot be written later, before a long fit is spent on it.

    Parameters
    ----------
    path
        The file to be written. An existing file is left alone here and replaced later.
    suffixes
        The formats that can be written; by default those of surfaces.

    Raises
    ------
    InputError
        For an unknown suffix, a library that is not installed, a missing folder, a folder in place of a
        file, and a folder in which no file can be made.

    Examples
    --------
    >>> try:
    ...     jf.io.check_output("surface.xyz", suffixes=(".npz", ".json"))
    ... except jf.io.InputError as error:
    ...     print(error)
    surface.xyz has the suffix .xyz, so its format is not known; use one of .npz, .json.
    """
    path = Path(path)
    if path.is_dir():
        file = path / f"surface{'.step' if '.step' in suffixes else suffixes[0]}"
        raise InputError(f"{path} is a folder; name a file in it, such as {file}.")
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"{path} has {'no suffix' if not path.suffix else f'the suffix {path.suffix}'}, so "
            f"its format is not known; use one of {', '.join(suffixes)}."
        )
    part = _part(path)
    if not part.parent.is_dir():
        raise InputError(f"the folder {part.parent} does not exist; make it first.")
    try:
        # Permission bits say too little (an administrator ignores them), so try.
        with at_last(partial(part.unlink, missing_ok=True)):
            part.touch()
    except OSError as error:
        raise InputError(
            f"no file can be written in the folder {part.parent}: {error.strerror or error}."
        ) from error
    if (suffix := path.suffix.lower()) in LIBRARIES:
        import_extra(LIBRARIES[suffix], suffix, "cad")


def write_atomically(path: str | os.PathLike, content: bytes) -> None:
    """Write `content` to a neighbour of `path`, then put it in its place in one step.

    Raises
    ------
    OSError
        If that fails; an existing file is then left as it was, and no part stays behind.
    """
    part = _part(Path(path))
    try:
        with at_last(partial(part.unlink, missing_ok=True)):
            part.write_bytes(content)
            os.replace(part, os.path.realpath(path))
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"{path} cannot be written ({reason}); make room, or name another file.") from error


def _part(path: Path) -> Path:
    # Beside the target of a link, not beside the link: only there replacing is one step.
    target = Path(os.path.realpath(path))
    return target.with_name(f".{target.name}.{os.getpid()}.part")
