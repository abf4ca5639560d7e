"""Nets that grow until some of the points meet the tolerances, or finer nets follow only noise."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._beyond_border import points_beyond_border
from jaxfit._approximation._cloud_fit import fit_cloud
from jaxfit._approximation._errors import LocalFeet
from jaxfit._approximation._errors_of_neighbours import ErrorsOfNeighbours, errors_of_neighbours
from jaxfit._approximation._level_nets import FIRST_SIZE, AbstractNets
from jaxfit._approximation._programs_ahead import programs_of_cloud_ahead
from jaxfit._approximation._regular_smoothing import RegularSmoothing
from jaxfit._approximation._room import Room
from jaxfit._base import mean_distance_to
from jaxfit._closest import chunk_size
from jaxfit._fit._border import FixedBorder
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit
from jaxfit._splines import BSplineSurface

MOST_SIZE = 200  # control points along either direction
# From one net to the next the size grows by a factor or, far from the tolerance, by its square: sizes are
# those of one ladder, so that clouds that differ little get the same net.
GROWTH, MOST_FACTORS = 1.2, 2
# What the size has to grow by in the end is at least this power of how many times too large an error is.
SIZE_OF_EXCESS = 0.6
BETTER = 0.985  # what the held-out error has to fall to, as a multiple of that with a coarser net
# Much noise hides what a finer net gains: where the errors of neighbours with the coarser one correlate by
# NOISE_CORRELATION or more, which those of noise hardly do among thousands, so little is enough.
NOISE_CORRELATION, A_LITTLE_BETTER = 0.05, 0.997
# Where it falls less, but the errors of neighbours are so much alike that they are no noise, so many finer
# nets are tried all the same: waves that a net is too coarse for take several to be found.
ALIKE, PATIENCE = 0.5, 4
LEVEL_STEPS = 20  # iterations with each net but the last
# Without a tolerance for the maximum a net is too coarse, too, while a whole patch, a point and most of those
# with feet beside its own, is FAR times the average's tolerance away, if the next net brings it so much
# nearer.
NEARER = 0.8
LOST = 0.9  # of the mean distance of a surface that is not fitted, from which a fit is no better
LEAST_POINTS = 500  # of a cloud from which some can be held out
HELD_OUT = 10  # one in so many points
# A net is chosen by some of the points of a large cloud: by ENOUGH, or where that is more by
# POINTS_TO_CHOOSE for each control point.
ENOUGH, POINTS_TO_CHOOSE = 20_000, 24
# All nets up to one of these sizes are fitted to the same points by the same program, with room for the
# largest: compiling another takes longer than the surplus. Beyond, a net has no more than it needs.
STAGES = tuple(FIRST_SIZE * GROWTH**k for k in (7, 10, 14))
MULTIPLE = 4  # of control points that there is room for: clouds of similar shape share programs
# A cloud without outliers is fitted on while one of its points is farther from the surface than so many times
# the tolerance of the average: that may be met before the fit has come to the ends of a scroll.
FAR = 10.0
# No net helps where so many of the points lie so far beyond a border that is held, in diagonals.
MANY_BEYOND, FAR_BEYOND = 0.25, 0.01


class Level(NamedTuple):
    """A net, its fit to a part of the points, the errors of those held out and those of neighbours."""

    size: float
    fit: Fit
    held_out: float
    beside: ErrorsOfNeighbours


class NetGrowth:
    """The levels of one cloud, from coarse to fine."""

    def __init__(
        self,
        points: Float[np.ndarray, "points d"],
        nets: AbstractNets,
        method: Any,
        request: dict[str, Any],
        cleaned: bool = False,
    ):
        self.points, self.nets, self.method, self.request = points, nets, method, request
        self.cleaned = cleaned  # of outliers
        given = request["weights"]
        self.weights = np.ones(len(points)) if given is None else np.asarray(given, float)
        counted = np.flatnonzero(self.weights > 0)
        # Sorted, so that every n-th of them is an even choice, whatever order the points came in.
        self.sorted = counted[np.lexsort(points[counted].T)]
        average, maximum = request["tol_average"], request["tol_maximum"]
        self.far = np.inf if average is None or maximum is not None else far_from(average)
        self.most = float(np.sqrt(len(counted) / nets.points_a_control_point))
        self.chunk = chunk_size(min(len(counted), ENOUGH))
        self.steps = 0  # iterations so far, of all nets

    def net(self, size: float) -> tuple[int, int]:
        """Control points along u and v."""
        return self.nets.net(size, MOST_SIZE)

    def allows(self, size: float) -> bool:
        """Whether there are points enough for a net of this size."""
        return size <= self.most and math.prod(self.net(size)) <= self.most**2

    def _stage(self, size: float) -> float:
        """The largest size of a net that shares points and program with one of this size."""
        stage = next((most for most in STAGES if size <= 1.001 * most), size)
        return max(size, min(stage, self.most))

    def _room(self, size: float, shape: tuple[int, int]) -> Room:
        """What the program has room for that fits a net of this shape."""
        largest = zip(shape, self.net(self._stage(size)), strict=True)
        nu, nv = (max(n, -(-most // MULTIPLE) * MULTIPLE) for n, most in largest)
        return Room((nu, nv), self.request["max_steps"], len(self.points), self.chunk)

    def compile_ahead(self, size: float = FIRST_SIZE) -> None:
        """Begin to compile the fit of a net of this size."""
        net, (some, _) = self.net(size), self._chosen(size)
        request = self.request | {"max_steps": min(LEVEL_STEPS, self.request["max_steps"])}
        room = self._room(size, net)
        programs_of_cloud_ahead(self.method, self.points[some], net, self.nets.order, request, room)

    def _next_stage_ahead(self, level: Level) -> None:
        """Begin to compile what fits all nets of the next stage, if the errors say that one is needed."""
        most, beyond = self._stage(level.size), level.size * self._excess(level) ** SIZE_OF_EXCESS
        if most in STAGES[:-1] and beyond > most and self.allows(GROWTH * most):
            self.compile_ahead(GROWTH * most)

    def fit(self, points: Any, size: float, base: BSplineSurface, request: dict[str, Any]) -> Fit:
        """The fit of `points`, in a program for all nets of the stage and for any number of iterations."""
        room = self._room(size, base.shape)
        fit = fit_cloud(points, base, self.method, request, room)
        self.steps += int(fit.stats["num_steps"])
        return fit

    def grown(self) -> tuple[Level, Any]:
        """The level to end with, and why there is none beyond it."""
        best, met, before, size, waited = None, None, None, FIRST_SIZE, 0
        base = self.nets.base(self.net(size))
        while True:
            level = self._level(size, base, before, met is not None)
            if before is not None:
                level = self._found_again(level, met is not None)
            elif not self._is_met(level) and self._reaches_beyond(level):
                return level, RESULTS.stalled
            nearer = met is None or level.beside.farthest < NEARER * met.beside.farthest
            if met is not None and not (self._is_met(level) and nearer):
                return met, RESULTS.converged
            if self._is_met(level):
                met = level
                if level.beside.farthest <= self.far:
                    return met, RESULTS.converged
            if best is None or met is not None or self._is_better(level, best):
                best, waited = level, 0
            elif waited == PATIENCE or not level.beside.correlation >= ALIKE:
                return best, RESULTS.noise_reached
            else:
                waited += 1
            self._next_stage_ahead(level)
            coarser, size = size, size * self._growth(level)
            if not self.allows(size) or self.net(size) == self.net(coarser):
                return best, RESULTS.net_exhausted if met is None else RESULTS.converged
            base, before = self.nets.carried(level.fit.surface, self.net(size)), level

    def _is_better(self, level: Level, best: Level) -> bool:
        """Whether points that were held out are nearer to a finer net, by more than chance may bring them."""
        enough = A_LITTLE_BETTER if best.beside.correlation >= NOISE_CORRELATION else BETTER
        return level.held_out < enough * best.held_out

    def _is_met(self, level: Level) -> bool:
        """Whether the tolerances that were asked for are met: `far`, a maximum for some levels, is none."""
        if bool(level.fit.converged):
            return True
        return self.far < np.inf and float(level.fit.average_error) <= float(self.request["tol_average"])

    def _reaches_beyond(self, level: Level) -> bool:
        """Whether many points lie far beyond the border, which is held."""
        if not isinstance(getattr(self.method, "border", None), FixedBorder):
            return False
        some, _ = self._chosen(level.size)
        fit, counted = level.fit, self.weights[some] > 0
        errors = np.asarray(fit.errors)
        beyond = points_beyond_border(fit.surface, self.points[some], (fit.u, fit.v), errors, counted)
        return bool((beyond & (errors > FAR_BEYOND)).sum() > MANY_BEYOND * counted.sum())

    def _level(self, size: float, base: BSplineSurface, before: Level | None, farther: bool) -> Level:
        """The fit with a net of this size; with `farther` it goes on to a maximum of `far`, too."""
        some, held_out = self._chosen(size)
        start, feet = None, self.nets.feet(self.net(size))
        if feet is not None:
            start = feet[0][some], feet[1][some]
        elif before is not None and len(before.fit.u) == len(some):
            start = before.fit.u, before.fit.v
        request = self.request | {
            "weights": np.where(held_out, 0.0, self.weights[some]),
            "start": start,
            "max_steps": min(LEVEL_STEPS, self.request["max_steps"]),
            "throw": False,
            "errors": LocalFeet(),
        }
        if farther:
            request["tol_maximum"] = self.far
        fit = self.fit(self.points[some], size, base, request)
        beside = errors_of_neighbours(fit, self.points[some])
        return Level(size, fit, float(np.asarray(fit.errors)[held_out].mean()), beside)

    def _found_again(self, level: Level, farther: bool) -> Level:
        """The level, or if the fit has lost its way, one that begins with a surface made of the points alone.

        Where nets are too coarse for the waves of a sheet, feet come to rest on wrong ones, and finer nets
        keep them there. A fit is nearer than a smoothed surface at parameters that come from neighbours,
        unless that has happened. What was smooth at first would take the waves away again: where this helps,
        later fits do without.
        """
        beside = level.beside
        if (self._is_met(level) and beside.farthest <= self.far) or not beside.correlation >= ALIKE:
            return level
        some, _ = self._chosen(level.size)
        fresh = self.nets.fresh(self.points[some], self.net(level.size))
        if fresh is None:
            return level
        distance = mean_distance_to(fresh, self.points[some]) / float(level.fit.stats["diagonal"])
        if float(level.fit.average_error) < LOST * distance:
            return level
        method, self.method = self.method, without_first_smoothing(self.method)
        other = self._level(level.size, fresh, None, farther)
        if other.held_out < level.held_out:
            return other
        self.method = method
        return level

    def afresh(self, level: Level) -> Level:
        """The level, or one fitted to a base surface of the same net, if that does as well and bends less.

        What coarser nets could not follow they have evened out by bending their parameter lines, and these
        stay bent on finer nets.
        """
        if level.size == FIRST_SIZE or not self.nets.carries:
            return level
        other = self._level(level.size, self.nets.base(self.net(level.size)), None, False)
        as_near = self._is_met(other) or (
            not self._is_met(level) and other.held_out <= level.held_out / BETTER
        )
        if not as_near or other.beside.farthest > max(level.beside.farthest, self.far):
            return level
        return min(level, other, key=bending)

    def _chosen(self, size: float) -> tuple[Int[np.ndarray, " some"], Bool[np.ndarray, " some"]]:
        """The points that a net of this size is fitted to, and which of them are held out."""
        most = ENOUGH
        nu, nv = self.net(self._stage(size))
        while most < POINTS_TO_CHOOSE * nu * nv:
            most *= 2
        some = self.sorted[:: -(-len(self.sorted) // most)]
        return some, np.arange(len(some)) % HELD_OUT == HELD_OUT // 2

    def _excess(self, level: Level) -> float:
        """How many times too large the errors are, infinite where nothing is small enough."""
        far = self.far if self._is_met(level) else None
        goals = self.request["tol_average"], self.request["tol_maximum"], far
        errors = float(level.fit.average_error), float(level.fit.maximum_error), level.beside.farthest
        return max(
            error / goal if goal else np.inf
            for error, goal in zip(errors, goals, strict=True)
            if goal is not None
        )

    def _growth(self, level: Level) -> float:
        """How many times finer the next net is: errors fall about with the square of the size."""
        factors = np.round(np.log(np.sqrt(self._excess(level))) / np.log(GROWTH))
        return float(GROWTH ** np.clip(factors, 1, MOST_FACTORS))


def bending(level: Level) -> tuple[int, float]:
    """How often the surface of a level folds, and how much it bends."""
    found = level.fit.regularity
    return found.folds, found.thin_plate_energy if found.curvature_energy is None else found.curvature_energy


def without_first_smoothing(method: Any) -> Any:
    """The method with the smoothing that it would end with from the first step on, if it has such a one."""
    smoothing = getattr(method, "smoothing", None)
    if not isinstance(smoothing, RegularSmoothing):
        return method
    return dataclasses.replace(method, smoothing=dataclasses.replace(smoothing, first=smoothing.least))


def far_from(average: Any) -> float:
    """The maximum that goes with a tolerance for the average."""
    return min(FAR * float(average), 1.0)
