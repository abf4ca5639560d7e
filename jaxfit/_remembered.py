"""`remembered`: what a function of arrays on the host returned is there when it is asked the same again.

The clouds of a batch share a base surface, and queries one after the other a surface: its knots are prepared
and its samples laid into trees once.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


class _Contents(NamedTuple):
    """An array by its contents, so that the caller's own is not kept and may change."""

    dtype: str
    shape: tuple[int, ...]
    bytes: bytes

    @staticmethod
    def of(array: Any) -> "_Contents":
        array = np.asarray(array)
        return _Contents(array.dtype.str, array.shape, array.tobytes())

    def array(self) -> np.ndarray:
        """The array, which can't be written to."""
        return np.frombuffer(self.bytes, self.dtype).reshape(self.shape)


def remembered(most: int) -> Callable[[Function], Function]:
    """Keep the last `most` results of a function of concrete pytrees, whose arrays it is given as NumPy's.

    All who ask share a result, so nobody may change it.
    """

    def decorated(function: Function) -> Function:
        @lru_cache(most)
        def of_contents(tree: Any, *contents: Any) -> Any:
            leaves = [x.array() if isinstance(x, _Contents) else x for x in contents]
            return function(*jax.tree.unflatten(tree, leaves))

        @wraps(function)
        def asked(*args: Any) -> Any:
            leaves, tree = jax.tree.flatten(args)
            return of_contents(tree, *(_Contents.of(x) if hasattr(x, "shape") else x for x in leaves))

        return asked  # type: ignore[return-value]

    return decorated
