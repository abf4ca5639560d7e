"""The folder in which compiled programs are kept, so that each is compiled once and not in every process."""

import contextlib
import os
import sys
from pathlib import Path

from jaxfit import _kept_programs

VARIABLE = "JAXFIT_CACHE_DIR"
VERSION = "version-"
LARGEST = 256 * 2**20  # bytes; a fit leaves about two MiB


def keep_programs(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs on disk: a later process that calls this loads them, and compiles nothing.

    Call it once, before the first fit. The programs of fits, of base surfaces and of closest points are kept
    whole, so that they are not even traced again. A program serves the arguments' shapes and dtypes, the
    settings of the method, this version of the code and of JAX, and this kind of processor; anything else is
    compiled anew. What was not used for longest is removed beyond 256 MiB. The command `jaxfit` does this by
    itself.

    Parameters
    ----------
    folder
        Where (default: the environment variable ``JAXFIT_CACHE_DIR``, else ``jaxfit`` in the user's cache
        folder, which is ``~/.cache/jaxfit`` on Linux). It is made if need be. Whoever can write it can run
        code here, so that must be nobody else. ``"off"`` or an empty name keep nothing.

    Returns
    -------
    Path or None
        The folder of this version's programs; None if nothing is kept.

    Raises
    ------
    OSError
        The folder can't be made or written, or belongs to another user or can be written by others (which is
        not looked at on Windows).
    RuntimeError
        There is no home folder, and none is named.

    Notes
    -----
    No setting of JAX is changed. Its own cache (`jax_compilation_cache_dir`) can be used beside this, for the
    many small programs around a fit, programs for several devices, fits with functions of your own, and fits
    inside `grad`, `vmap` or `jit`, none of which are kept here. What it holds already is not kept here again.

    Examples
    --------
    >>> import tempfile
    >>> import jaxfit as jf
    >>> folder = jf.keep_programs(tempfile.mkdtemp())  # doctest: +SKIP
    """
    found = cache_folder(None if folder is None else os.fspath(folder))
    if found is None:
        _kept_programs.folder = None
    else:
        found /= f"{VERSION}{_kept_programs.version_of_code()}"  # so JAX's cache holds nothing that we lack
        _make_private(found)
        _kept_programs.folder = found
    return found


def cache_folder(asked: str | None = None) -> Path | None:
    """The folder, made and cleared of what has long not been used; None if the variable says "off".

    It is the one that is `asked` for, else that of the environment variable, else one in the user's cache
    folder. Raises OSError if it cannot be written, or if others can.
    """
    named = os.environ.get(VARIABLE) if asked is None else asked
    if named is not None and named.strip().lower() in ("", "off"):
        return None
    folder = Path(named).expanduser() if named else _user_cache() / "jaxfit"
    _make_private(folder)
    trial = folder / f".{os.getpid()}"
    trial.touch()
    trial.unlink()
    _remove_oldest(folder)
    return folder.absolute()


def _make_private(folder: Path) -> None:
    """Make it, unless it is there, for this user alone; refuse one that others can write."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    # What lies there is run. On Windows neither number says who may write.
    if not hasattr(os, "getuid"):
        return
    advice = None
    if status.st_uid != os.getuid():
        advice = "belongs to another user; name another"
    elif status.st_mode & 0o022:
        advice = f"can be written by others; name another, or chmod go-w {folder}"
    if advice:
        raise PermissionError(f"folder must be private, for what it holds is run, but {folder} {advice}.")


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return named if named.is_absolute() else Path.home() / ".cache"


def _remove_oldest(folder: Path) -> None:
    """Remove the programs that were not used for longest, beyond `LARGEST`, and empty ones.

    JAX has a bound of its own, but it needs one more package and locks the folder at every look.
    """
    found = []
    for path in folder.glob(f"{VERSION}*/*{_kept_programs.SUFFIX}"):
        with contextlib.suppress(OSError):  # another process may have removed it
            status = path.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = 0
    for _, size, path in sorted(found, reverse=True):
        total += size
        if total > LARGEST or not size:  # what was interrupted while it was written is empty
            with contextlib.suppress(OSError):  # in use elsewhere, or gone; the folder holds others still
                path.unlink()
                path.parent.rmdir()
