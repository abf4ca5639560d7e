"""Programs that a thread compiles while the host does what comes before their call.

XLA compiles without Python's lock: what a fit does on the host, or another program's compiling, costs no time
beside it where there is a second core.
"""

import os
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache, partial
from typing import Any

import jax

from jaxfit._kept_programs import compile_kept, is_kept, path_of

_asked: set[Any] = set()
_begun: set[Any] = set()
_coming: dict[Any, Future[Any]] = {}


def is_first(*about: Any) -> bool:
    """Whether this has not been asked before, which takes less time to find out than a program's arguments to
    make up.
    """
    first = about not in _asked
    _asked.add(about)
    return first


def compile_ahead(jitted: Any, static: int, args: tuple[Any, ...], kept: bool = True) -> None:
    """Begin to compile `jitted` for a call with such arguments, of which the first `static` are static: of
    the others only types, shapes and dtypes count. Each kind of call is begun once. What is not `kept` is
    never on disk.
    """
    kind = _kind(jitted, static, args)
    if kind in _begun or jax.config.values["jax_disable_jit"]:
        return
    _begun.add(kind)
    path = path_of(jitted, static, args) if kept else None
    if path is not None and is_kept(path):
        return
    lowered = jitted.lower(*args)  # here, where JAX's settings are those of the caller
    compile_now = lowered.compile if path is None else partial(compile_kept, path, lowered)
    _coming[kind] = _threads().submit(compile_now)


def wait_for_program(jitted: Any, static: int, args: tuple[Any, ...]) -> None:
    """Until what has been begun for this call is done; what went wrong there is for the call to raise."""
    if _coming and (future := _coming.get(kind := _kind(jitted, static, args))):
        wait([future])
        _coming.pop(kind, None)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, "jaxfit-compile")


def _forget() -> None:
    """In a forked process, which has none of the threads."""
    _coming.clear()
    _threads.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _kind(jitted: Any, static: int, args: tuple[Any, ...]) -> Any:
    leaves, tree = jax.tree.flatten(args[static:])
    return jitted, args[:static], tree, tuple(map(jax.typeof, leaves))
