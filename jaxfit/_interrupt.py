"""Ctrl-C ends the command `jaxfit` without a traceback, also while it is still being imported."""

import os
import signal
import sys
import threading
from itertools import pairwise
from typing import Any

EXIT_CODE = 130
GRACE = 10.0  # seconds until an interrupted command ends, if need be without putting anything in order


def end_at_once(*_: Any) -> None:
    """A handler of signals: there is nothing yet to be put in order."""
    os._exit(EXIT_CODE)


def is_command() -> bool:
    """Whether this process is `jaxfit` or `python -m jaxfit`, and not a program that uses the package."""
    name = os.path.basename(getattr(sys, "argv", [""])[0])
    as_module = name == "-m" and ("-m", "jaxfit") in pairwise(sys.orig_argv)
    return as_module or os.path.splitext(name)[0] in ("jaxfit", "jaxfit-script")


def interrupt(*_: Any) -> None:
    """Raise KeyboardInterrupt, and see to it that the process ends.

    What is raised within a callback of Python's own is ignored there; one of those of the import system holds
    a lock, which nobody gives back then.
    """
    last = threading.Timer(GRACE, os._exit, [EXIT_CODE])
    last.daemon = True
    last.start()
    raise KeyboardInterrupt


def restore_ctrl_c() -> None:
    """Have Ctrl-C raise KeyboardInterrupt, once there is someone to catch it."""
    if signal.getsignal(signal.SIGINT) is end_at_once:
        signal.signal(signal.SIGINT, interrupt)


if (
    is_command()
    and threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    signal.signal(signal.SIGINT, end_at_once)
