"""`worker_processes`: processes that fit side by side."""

import contextlib
import gc
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from pathlib import Path

import jax

from jaxfit import _kept_programs
from jaxfit._checks import check_number
from jaxfit._cores import VARIABLE, cores
from jaxfit._precision import working_dtype

_HANDED_ON = (
    "jax_enable_x64 jax_compilation_cache_dir jax_persistent_cache_min_compile_time_secs "
    "jax_persistent_cache_min_entry_size_bytes"
).split()


@contextlib.contextmanager
def worker_processes(workers: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """Processes that share the cores of this machine, as an executor for `map_fits`.

    Each starts Python and JAX anew, which takes seconds, and compiles for itself, or reads what is kept by
    `keep_programs` or in JAX's compilation cache. So they pay for hundreds of fits, and for further calls
    with the same executor. They have the precision and these folders of the session, and as many threads as
    there are cores for each.

    Parameters
    ----------
    workers : int, optional
        How many (default: one for each core).

    Raises
    ------
    ValueError
        For fewer than one.
    TypeError
        If `workers` is no whole number.
    RuntimeError
        If a process ends, for want of memory or because a script starts them where each starts its own.

    Notes
    -----
    As always with processes that are not forks, a script has to start its work below
    ``if __name__ == "__main__":``.

    Examples
    --------
    >>> with jf.worker_processes(2) as executor:  # doctest: +SKIP
    ...     fits = jf.map_fits(clouds, base, executor=executor)
    >>> callable(jf.worker_processes)
    True
    """
    if workers is not None:
        check_number("workers", workers, 1, whole=True)
    pool = started_processes(cores() if workers is None else workers)
    try:
        yield pool
    except BaseException as error:
        end_processes(pool, at_once=True)
        if isinstance(error, BrokenExecutor):
            raise RuntimeError(
                'a worker process has ended; in a script start them below if __name__ == "__main__":, else '
                "look whether they had enough memory."
            ) from error
        raise
    end_processes(pool)


def started_processes(workers: int) -> ProcessPoolExecutor:
    """Processes with the settings of the session."""
    settings = {name.upper(): getattr(jax.config, name, None) for name in _HANDED_ON}
    ours = {name: str(x) for name, x in settings.items() if x is not None}
    # JAX reads all of this as it starts.
    ours[VARIABLE] = str(max(1, cores() // workers))
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        # A fork would inherit the threads of JAX without what they hold.
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(
            workers, mp_context=spawn, initializer=_begin, initargs=(_kept_programs.folder,)
        )
        for _ in range(workers):
            pool.submit(working_dtype)  # each starts a process, for none is idle yet
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    return pool


def end_processes(pool: ProcessPoolExecutor, at_once: bool = False) -> None:
    """End them, `at_once` also in the middle of a fit."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=not at_once, cancel_futures=True)
    for process in processes:
        process.terminate()
        process.join()
    gc.collect()  # of the semaphores, of which the system otherwise warns


def _begin(programs: Path | None) -> None:
    _kept_programs.folder = programs
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first ends the others
