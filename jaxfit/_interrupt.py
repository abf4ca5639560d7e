"""Ctrl-C ends the command `jaxfit` without a traceback, also while it is still being imported."""

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

EXIT_CODE = 130
GRACE = 10.0  # seconds until an interrupted command ends, if need be without putting anything in order

last_calls: list[Callable[[], Any]] = []  # of an interrupted command, the last one first


@contextlib.contextmanager
def at_last(call: Callable[[], Any]) -> Iterator[None]:
    """Make this call when the block ends, also where Ctrl-C ends the command within it."""
    last_calls.append(call)
    with contextlib.ExitStack() as stack:
        stack.callback(last_calls.remove, call)
        stack.callback(call)
        yield


def end(*_: Any) -> None:
    """A handler of signals that ends the process.

    It raises nothing, for that can be lost: within a callback of Python's own exceptions are ignored (one of
    those of the import system holds a lock, which nobody gives back then), and an extension that is being
    loaded makes another of them.
    """
    _thread.start_new_thread(_after_grace, (os._exit,))
    for call in reversed(last_calls):
        with contextlib.suppress(Exception):
            call()
    os._exit(EXIT_CODE)


def _after_grace(leave: Callable[[int], Any]) -> None:
    time.sleep(GRACE)
    leave(EXIT_CODE)


def is_command() -> bool:
    """Whether this process is `jaxfit` or `python -m jaxfit`, and not a program that uses the package."""
    name = os.path.basename(getattr(sys, "argv", [""])[0])
    as_module = name == "-m" and ("-m", "jaxfit") in pairwise(sys.orig_argv)
    return as_module or os.path.splitext(name)[0] in ("jaxfit", "jaxfit-script")


if (
    is_command()
    and threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    signal.signal(signal.SIGINT, end)
