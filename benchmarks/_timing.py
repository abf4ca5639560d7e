"""Seconds of a call: the first, which compiles, and the median of later ones with their spread.

A first call finds nothing compiled, as in a new process; what importing takes is not in it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np


@dataclass
class Timed:
    """Seconds of the first call and of later ones, and what the first returned."""

    first: float
    later: list[float]
    result: Any

    @property
    def median(self):
        return float(np.median(self.later)) if self.later else self.first

    def cells(self):
        """Columns of a table."""
        later = self.later or [self.first]
        return {
            "first s": self.first,
            "median s": self.median,
            "lowest s": min(later),
            "highest s": max(later),
        }


def seconds(work: Callable[[], Any]):
    """Seconds of one call, until its arrays are there, and the result."""
    begun = time.perf_counter()
    result = jax.block_until_ready(work())
    return time.perf_counter() - begun, result


def timed(work: Callable[[], Any], runs: int):
    """`work` once, then `runs` times more."""
    return in_turns({"": work}, runs)[""]


def in_turns(works: dict[str, Callable[[], Any]], runs: int):
    """All of `works` once, then `runs` rounds in which they take turns, to meet the same machine."""
    done = {name: Timed(*_first(work)) for name, work in works.items()}
    for work in works.values() if len(works) > 1 else ():
        work()  # compiles again what the first calls of the others have dropped
    for _ in range(runs):
        for name, work in works.items():
            done[name].later.append(seconds(work)[0])
    return done


def _first(work):
    jax.clear_caches()
    spent, result = seconds(work)
    return spent, [], result
