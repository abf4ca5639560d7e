"""The cores that there are for the threads of this process, and work for them."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

VARIABLE = "NPROC"  # by which XLA, too, is told


def cores() -> int:
    """As many as this process may run on, and no more than the environment grants, as it does to a worker."""
    affinity = getattr(os, "sched_getaffinity", None)
    ours = len(affinity(0)) if affinity else os.cpu_count() or 1
    granted = os.environ.get(VARIABLE, "").strip()
    return min(ours, int(granted)) if granted.isdecimal() and int(granted) else ours


def on_all_cores(function: Callable[[Any], Any], parts: Sequence[Any]) -> list[Any]:
    """`function` of each part, in threads if there are several: for work outside Python, as in NumPy."""
    threads = min(len(parts), cores())
    if threads <= 1:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, parts))
