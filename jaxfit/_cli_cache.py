"""Where the command keeps compiled programs, so that each is compiled once and not in every run."""

import os
import sys
from pathlib import Path

VARIABLE = "JAXFIT_CACHE_DIR"
LARGEST = 256 * 2**20  # bytes; a fit leaves about one MiB


def cache_folder(asked: str | None = None) -> Path | None:
    """The folder, made and cleared of what has long not been used; None if the variable says "off".

    It is the one that is `asked` for, else that of the environment variable, else one in the user's cache
    folder. Raises OSError if it cannot be written.
    """
    named = asked or os.environ.get(VARIABLE)
    if named is not None and named.strip().lower() in ("", "off"):
        return None
    folder = Path(named) if named else _user_cache() / "jaxfit"
    # JAX runs what it finds there, so nobody else may write it.
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    trial = folder / f".{os.getpid()}"
    trial.touch()
    trial.unlink()
    _remove_oldest(folder)
    return folder.absolute()


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
    for path in folder.glob("*-cache"):
        status = path.stat()
        found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = 0
    for _, size, path in sorted(found, reverse=True):
        total += size
        if total > LARGEST or not size:  # what was interrupted while it was written is empty
            path.unlink(missing_ok=True)
