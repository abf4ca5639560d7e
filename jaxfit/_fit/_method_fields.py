"""The fields of a method: which are traced, and checks of those that several methods have."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxfit._checks import check_kind, check_number, is_concrete
from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._precision import working_dtype


def dynamic_fields(method: AbstractIterativeMethod) -> tuple[Any, Any]:
    """The fields that are traced numbers, and the others (`equinox.partition`)."""
    return eqx.partition(method, lambda x: isinstance(x, float | np.ndarray | jax.Array))


def static_fields(method: AbstractIterativeMethod) -> Any:
    """The fields that are no traced numbers: a program's, hashable."""
    return dynamic_fields(method)[1]


def static_and_numbers(method: AbstractIterativeMethod) -> tuple[Any, Any]:
    """The static fields of a method, and its numbers as arrays where they are known: what programs take."""
    numbers, rest = dynamic_fields(method)
    return rest, jax.tree.map(lambda x: np.asarray(x, working_dtype()) if is_concrete(x) else x, numbers)


def check_common_fields(method: Any) -> None:
    """Raise unless the fields that the methods of this library, and only they, have in common are valid."""
    check_number("stall_window", method.stall_window, 1, whole=True)
    check_number("stall_gain", method.stall_gain, 0.0)
    check_number("foot_tolerance", method.foot_tolerance, 0.0)
    check_kind("foot_method", method.foot_method, AbstractFootMethod, "Newton()")
