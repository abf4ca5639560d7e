"""Arguments that are given once or for each fit."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfit._checks import check_kind, is_concrete
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._splines import BSplineSurface


class Request(NamedTuple):
    """The arguments of one fit."""

    cloud: Any
    base: Any
    method: Any
    weights: Any


def requests_of(clouds: Any, base: Any, method: Any, weights: Any) -> list[Request]:
    """The arguments of each fit; raises if the lists differ in length, or if nothing is one."""
    if isinstance(clouds, (Mapping, Iterator)):
        kind = type(clouds).__name__
        raise TypeError(f"clouds must be a list of arrays, but is a {kind}; pass a list of its arrays.")
    given = {
        "clouds": _each(clouds, 2),
        "base": base,
        "method": method,
        "weights": _each(weights, 1),
    }
    lengths = {name: len(x) for name, x in given.items() if isinstance(x, (list, tuple))}
    if not lengths:
        raise ValueError(
            "clouds, base, method or weights must be a list with one entry for each fit, but none is; use "
            "approximate for a single fit."
        )
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"lists must have one entry for each fit, but have the lengths {lengths}; make them equal."
        )
    count = next(iter(lengths.values()))
    columns = [given[name] if name in lengths else [given[name]] * count for name in given]
    requests = [Request(getattr(row[0], "cloud", row[0]), *row[1:]) for row in zip(*columns, strict=True)]
    for i, request in enumerate(requests):
        check_kind(f"base[{i}]", request.base, BSplineSurface, "base_surface(boundary)")
        check_kind(f"method[{i}]", request.method, AbstractIterativeMethod | None, "GeometricApproximation()")
    return requests


def _each(x: Any, ndim: int) -> Any:
    """A list of arrays where an array has one dimension more than one fit takes, or lists hold arrays."""
    if isinstance(x, (list, tuple)) or x is None:
        return x
    return list(x) if np.ndim(x) == ndim + 1 else x


def one_by_one(function: Any, requests: list[Request]) -> list[Any]:
    """`jax.lax.map` of a function of a request; leaves that are the same for all stay as they are."""
    trees: list[Any] = [jax.tree.flatten(request) for request in requests]
    if any(structure != trees[0][1] for _, structure in trees):
        raise ValueError("bases and methods must be of one kind inside a transformation; give equal types.")
    columns = list(zip(*(leaves for leaves, _ in trees), strict=True))
    if any(len({np.shape(x) for x in column}) > 1 for column in columns):
        raise ValueError("clouds and bases must have one size inside a transformation; see pad_clouds.")
    varying = [i for i, column in enumerate(columns) if not _is_same(column)]

    def one(values: list[Any]) -> Any:
        leaves = [column[0] for column in columns]
        for i, value in zip(varying, values, strict=True):
            leaves[i] = value
        return function(jax.tree.unflatten(trees[0][1], leaves))

    values = [jnp.stack([jnp.asarray(x) for x in columns[i]]) for i in varying]
    found = jax.lax.map(one, values)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(requests))]


def _is_same(column: tuple[Any, ...]) -> bool:
    first = column[0]
    if all(x is first for x in column):
        return True
    return is_concrete(column) and all(np.array_equal(x, first) for x in column)
