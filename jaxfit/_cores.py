"""How many cores there are for the threads of this process."""

import os

VARIABLE = "NPROC"  # by which XLA, too, is told


def cores() -> int:
    """As many as this process may run on, and no more than the environment grants, as it does to a worker."""
    affinity = getattr(os, "sched_getaffinity", None)
    ours = len(affinity(0)) if affinity else os.cpu_count() or 1
    granted = os.environ.get(VARIABLE, "").strip()
    return min(ours, int(granted)) if granted.isdecimal() and int(granted) else ours
