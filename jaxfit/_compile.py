"""`jax.jit` with the options that make XLA's CPU compiler quick on programs of many small kernels."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any

import jax
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._kept_programs import call_kept

# XLA's newer emitter of fused CPU kernels takes 1.5 to 1.8 times as long to compile a fit as the older one,
# whose kernels run no slower.
OLDER_EMITTER = {"xla_cpu_use_fusion_emitters": False}  # other devices ignore it
# Level 1 of 3 saves another 10 to 15 % of what compiling takes, for kernels that run 2 to 4 % longer.
LEVEL = {"xla_backend_optimization_level": 1}
UNKNOWN = "No such compile option"


@cache
def _options() -> dict[str, Any]:
    """The level is for CPUs only, and for a session that has not told JAX to optimise nothing."""
    if jax.default_backend() == "cpu" and not jax.config.read("jax_disable_most_optimizations"):
        return OLDER_EMITTER | LEVEL
    return OLDER_EMITTER


def compiled(function: Callable[..., Any], kept: bool = False, **jit_options: Any) -> Callable[..., Any]:
    """`jax.jit(function, **jit_options)` with options quick to compile, where JAX and XLA allow them.

    JAX takes compiler options for outermost programs only, so a call with traced arguments is an ordinary
    `jit`; so is every call once XLA has said that it does not know the option. Without a traced argument
    the call is computed at once, whatever is traced around it.

    What takes long to trace is `kept`: if programs are kept on disk, it is loaded from there. It has no
    keyword arguments, and its static ones, in `static_argnums`, are the first.
    """
    plain = jax.jit(function, **jit_options)
    known = [True]  # until XLA says that it does not know an option
    static = np.size(jit_options.get("static_argnums", ()))

    @cache
    def quick() -> Any:  # made by the first call, when JAX knows its devices
        return jax.jit(function, **jit_options, compiler_options=_options())

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not known or not is_concrete(args, kwargs):
            return plain(*args, **kwargs)
        try:
            with jax.core.eval_context():
                if kept:
                    return call_kept(quick(), static, args)
                return quick()(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if UNKNOWN not in str(error):
                raise
            known.clear()
        return plain(*args, **kwargs)

    return call
