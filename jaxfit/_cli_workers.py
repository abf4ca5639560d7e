"""Where the files of `jaxfit batch` are fitted: here, in processes of this machine, or on a Dask cluster.

All three take jobs as executors of `concurrent.futures` do; what differs is how many they take at once.
"""

import contextlib
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from functools import partial
from typing import Any, TypeVar

from jaxfit._batch._worker_processes import end_processes, started_processes
from jaxfit._interrupt import at_last
from jaxfit.io import InputError

Done = TypeVar("Done")
_WAIT = 0.5  # seconds between two looks at what else is to be done
_CONNECT = 10  # seconds


class Here:
    """This very process, one job after the other."""

    width = 1

    def submit(self, function: Callable[..., Any], *args: Any) -> Future:
        """Do it at once."""
        future: Future = Future()
        try:
            future.set_result(function(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    def restart(self) -> None:
        """There is nothing that could have ended."""

    def shutdown(self, at_once: bool = False) -> None:
        """Nor is there anything to end."""


class Processes:
    """Processes of this machine, which share its cores. One that ends takes all jobs of the pool along."""

    def __init__(self, workers: int):
        self.width = workers
        self._pool = started_processes(workers)

    def submit(self, function: Callable[..., Any], *args: Any) -> Future:
        """Hand it to a free process."""
        return self._pool.submit(function, *args)

    def restart(self) -> None:
        """New processes in place of those that ended."""
        self.shutdown(at_once=True)
        self._pool = started_processes(self.width)

    def shutdown(self, at_once: bool = False) -> None:
        """End the processes, `at_once` also those that are in the middle of a fit."""
        end_processes(self._pool, at_once)


class Cluster:
    """The workers of a Dask scheduler, which does again what a lost worker had in hand."""

    def __init__(self, address: str):
        try:
            from distributed import Client
        except ImportError as error:
            raise InputError(
                "--scheduler needs Dask's distributed, which is not installed; pip install "
                '"jaxfit-surfaces[cluster]".'
            ) from error
        try:
            self._client = Client(address, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}; start one by 'dask scheduler' and give its address."
            ) from error
        self._pool = self._client.get_executor(pure=False)

    @property
    def width(self) -> int:
        """Two jobs for every thread, so that none waits for the next; workers may come and go."""
        return max(2, 2 * sum(self._client.nthreads().values()))

    def submit(self, function: Callable[..., Any], *args: Any) -> Future:
        """Hand it to the scheduler."""
        return self._pool.submit(function, *args)

    def restart(self) -> None:
        """The scheduler does that."""

    def shutdown(self, at_once: bool = False) -> None:
        """Leave the cluster to others."""
        self._client.close()


@contextlib.contextmanager
def chosen_pool(workers: int, scheduler: str | None) -> Iterator[Any]:
    """The executor that the arguments ask for."""
    pool: Any = Cluster(scheduler) if scheduler else Processes(workers) if workers > 1 else Here()
    with at_last(partial(pool.shutdown, at_once=True)):
        yield pool
        pool.shutdown()


class Schedule:
    """Runs jobs on a pool; the first job of each size goes ahead alone and compiles for the others.

    Where a process ended, all jobs that were running are suspects, and each is tried alone.
    """

    def __init__(self, pool: Any, jobs: list[Any], size_of: Callable[[Any], Hashable]):
        self.pool = pool
        self.waiting = [(job, size_of(job)) for job in jobs]
        self.suspects: list[tuple[Any, Hashable]] = []
        self.on_trial = False
        self.running: dict[Future, tuple[Any, Hashable]] = {}
        self.compiled: set[Hashable] = {None}

    def run(
        self, function: Callable[[Any], Done], died: Callable[[Any], Done], idle: Callable[[], None]
    ) -> Iterator[Done]:
        """Results as they come; `died(job)` is that of a job that ended its process."""
        while self.waiting or self.suspects or self.running:
            self._submit(function)
            together = dict(self.running)
            done, _ = wait(together, timeout=_WAIT, return_when=FIRST_COMPLETED)
            broken = False
            for future in done:
                job, size = self.running.pop(future)
                try:
                    result = _result(future, job, died)
                except BrokenExecutor:
                    self.running[future] = job, size
                    broken = True
                    continue
                self.compiled.add(size)
                yield result
            if broken or not together:  # nothing runs where the pool had ended before it took a job
                suspects = list(self.running.values())
                self.running.clear()
                self.pool.restart()
                if len(together) == 1:
                    yield died(suspects.pop()[0])
                self.suspects += suspects
            idle()

    def _submit(self, function: Callable[[Any], Any]) -> None:
        trial = self.suspects or (self.running and self.on_trial)
        width = 1 if trial else self.pool.width
        while len(self.running) < width:
            job, size = self._next()
            if job is None:
                return
            try:
                future = self.pool.submit(function, job)
            except BrokenExecutor:  # a process has ended since the last look
                self.suspects.append((job, size))
                return
            self.running[future] = job, size

    def _next(self) -> tuple[Any, Hashable]:
        self.on_trial = bool(self.suspects)
        if self.suspects:
            return self.suspects.pop()
        compiling = {size for _, size in self.running.values()} - self.compiled
        for i, (_, size) in enumerate(self.waiting):
            if size not in compiling:
                return self.waiting.pop(i)
        return None, None


def _result(future: Future, job: Any, died: Callable[[Any], Done]) -> Done:
    try:
        return future.result()
    except BrokenExecutor:
        raise
    except CancelledError as error:
        raise OSError(
            "the connection to the Dask scheduler was lost; run the command again, finished files are kept."
        ) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of Dask, after several workers
            return died(job)
        raise OSError(
            f"a worker could not run the fit ({error}); it needs the same jaxfit as here."
        ) from error
