"""A line that says what a fit is doing, shown where someone looks on and only once it takes long.

A log, as the command writes it, gets a line each minute. A thread of its own draws them of what the fitting
thread notes down; no traced program knows of it.
"""

import contextlib
import importlib.util
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from jaxfit._checks import is_concrete
from jaxfit._interrupt import at_last

SETTING = "JAXFIT_PROGRESS"  # in the environment
OFF, LOG = "off", "log"  # nothing anywhere; lines for a log where nobody looks on
DELAY = 3.0  # seconds before the line appears
INTERVAL = 0.25  # between two updates
LOG_INTERVAL = 60.0  # before every line of a log
COMPILER = "backend_compile"  # begins or is within the name of JAX's function that waits for XLA


class _Line:
    """What the thread that made it is doing, and since when."""

    def __init__(self, phase: str):
        self.phase, self.begun = phase, time.monotonic()
        self.owner, self.ended = threading.get_ident(), threading.Event()

    def __str__(self) -> str:
        compiling = " (compiling)" if _is_compiling(self.owner) else ""
        return f"jaxfit: {self.phase}{compiling}, {time.monotonic() - self.begun:.0f} s"

    def watch(self) -> None:
        """Draw the line from DELAY seconds on until the end, or write one into a log now and then."""
        seen = _looks_on()
        delay, interval = (DELAY, INTERVAL) if seen else (LOG_INTERVAL, LOG_INTERVAL)
        if self.ended.wait(delay):
            return
        with _log() if not seen else _notebook() if _in_notebook() else _terminal() as draw:
            draw(str(self))
            while not self.ended.wait(interval):
                draw(str(self))


_lines: list[_Line] = []  # one at most: fits within a fit, or in other threads, share the first one's
_one_line = threading.Lock()


def doing(phase: str) -> None:
    """Note what is done now, if a line is prepared and it is about this thread."""
    for line in _lines:
        if line.owner == threading.get_ident():
            line.phase = phase


def shows_progress(phase: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Have a function show the line, outside transformations and unless it is given its own `progress`."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def shown(*args: Any, **options: Any) -> Any:
            if options.get("progress") is not None or not _is_watched():
                return function(*args, **options)
            # What can be read only once is no tree, and its function says so.
            if not is_concrete(*(x for x in (*args, *options.values()) if not isinstance(x, Iterator))):
                return function(*args, **options)
            with _line_of(phase):
                return function(*args, **options)

        return shown

    return decorate


@contextlib.contextmanager
def _line_of(phase: str) -> Iterator[None]:
    if not _one_line.acquire(blocking=False):
        doing(phase)
        yield
        return
    line = _Line(phase)
    thread = threading.Thread(target=line.watch, daemon=True)

    def end() -> None:
        _lines.clear()
        line.ended.set()
        thread.join()  # the line is gone before anything else is printed

    try:
        with at_last(end):
            _lines.append(line)
            thread.start()
            yield
    finally:
        _one_line.release()


def write_log() -> None:
    """Have fits write lines for a log where nobody looks on, unless the environment says otherwise."""
    os.environ[SETTING] = os.environ.get(SETTING) or LOG


def show_nothing() -> None:
    """Have fits say nothing of what they are doing."""
    os.environ[SETTING] = OFF


def _is_watched() -> bool:
    setting = os.environ.get(SETTING, "").lower()
    return setting != OFF and not multiprocessing.parent_process() and (setting == LOG or _looks_on())


def _looks_on() -> bool:
    return _in_notebook() or bool(getattr(sys.stderr, "isatty", bool)())


def _in_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    return hasattr(ipython.get_ipython() if ipython else None, "kernel")


def _is_compiling(thread: int) -> bool:
    """Whether a thread waits for XLA's compiler, as far as its stack says."""
    frame = sys._current_frames().get(thread)
    while frame is not None and COMPILER not in frame.f_code.co_name:
        frame = frame.f_back
    return frame is not None


@contextlib.contextmanager
def _log() -> Iterator[Callable[[str], None]]:
    def write(text: str) -> None:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()

    yield write


@contextlib.contextmanager
def _terminal() -> Iterator[Callable[[str], None]]:
    if importlib.util.find_spec("rich") is None:
        yield lambda text: None
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    screen = Live(
        console=Console(stderr=True),
        auto_refresh=False,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
    )
    with screen:
        yield lambda text: screen.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)


@contextlib.contextmanager
def _notebook() -> Iterator[Callable[[str], None]]:
    from IPython.display import display

    handle = display({"text/plain": ""}, raw=True, display_id=True)
    yield lambda text: handle.update({"text/plain": text}, raw=True)
    handle.update({"text/plain": ""}, raw=True)
