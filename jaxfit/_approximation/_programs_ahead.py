"""The programs of a fit, compiled by threads while its base surface is made and its first feet are found."""

from typing import Any

import numpy as np

from jaxfit._approximation._errors import GlobalFeet
from jaxfit._approximation._room import Room
from jaxfit._closest import Newton, compile_search_ahead
from jaxfit._compile_ahead import is_first
from jaxfit._fit._adjoints import UnrolledAdjoint
from jaxfit._fit._loop import compile_ahead
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._method_fields import static_fields
from jaxfit._fit._problem import Problem, Tolerances, make_problem
from jaxfit._fit._scaling import unit_of
from jaxfit._fit._working_surface import WorkingSurface, plane
from jaxfit._precision import working_dtype


def programs_ahead(
    method: AbstractIterativeMethod,
    problem: Problem,
    begun: WorkingSurface,
    count: int,
    request: dict[str, Any],
    room: Room | None,
    differentiated: bool = False,
) -> None:
    """Begin to compile the search for closest points, if there will be any, and the iteration.

    All is concrete. Nothing is begun for unrolled fits, which have a program of their own.
    """
    steps = request["max_steps"] if room is None else room.steps
    if isinstance(request["adjoint"], UnrolledAdjoint):
        return
    if not is_first(
        static_fields(method), begun.control_points.shape, problem.target.shape, problem.target.dtype, steps
    ):
        return
    if request["start"] is None or isinstance(request["errors"], GlobalFeet | None):
        chunk = None if room is None else room.chunk
        compile_search_ahead(Newton(), begun.control_points, *begun.axes, count, chunk)
    compile_ahead(method, problem, begun, steps, differentiated)


def programs_of_cloud_ahead(
    method: AbstractIterativeMethod,
    points: Any,
    net: tuple[int, int],
    order: tuple[int, int],
    request: dict[str, Any],
    room: Room | None = None,
    differentiated: bool = False,
) -> None:
    """`programs_ahead` of a fit whose base surface is still to be made."""
    cloud, dtype = np.asarray(points), working_dtype()
    if not is_first(static_fields(method), net, order, cloud.shape, request["max_steps"], room, dtype):
        return
    limit = np.asarray(0.0, dtype)
    limits = Tolerances(limit, limit, np.asarray(request["max_steps"], np.int32))
    problem = make_problem(cloud, None, unit_of(cloud), limits)
    begun = plane((*net, cloud.shape[1]), order, dtype)
    if room is not None:
        begun = begun.padded(room.net[0] - net[0], room.net[1] - net[1])
    programs_ahead(method, problem, begun, len(cloud), request, room, differentiated)
