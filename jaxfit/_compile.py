"""`jax.jit` with the option that makes XLA's CPU compiler quick on programs of many small kernels."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._kept_programs import call_kept

# XLA's newer emitter of fused CPU kernels takes 1.5 to 1.8 times as long to compile a fit as the older one,
# whose kernels run no slower. Other devices ignore the option.
OPTIONS = {"xla_cpu_use_fusion_emitters": False}
UNKNOWN = "No such compile option"


def compiled(function: Callable[..., Any], kept: bool = False, **jit_options: Any) -> Callable[..., Any]:
    """`jax.jit(function, **jit_options)`, compiled with OPTIONS where JAX and XLA allow that.

    JAX takes compiler options for outermost programs only, so a call with traced arguments is an ordinary
    `jit`; so is every call once XLA has said that it does not know the option. Without a traced argument
    the call is computed at once, whatever is traced around it.

    What takes long to trace is `kept`: if programs are kept on disk, it is loaded from there. It has no
    keyword arguments, and its static ones, in `static_argnums`, are the first.
    """
    plain = jax.jit(function, **jit_options)
    calls = [jax.jit(function, **jit_options, compiler_options=OPTIONS)]
    static = np.size(jit_options.get("static_argnums", ()))

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not calls or not is_concrete(args, kwargs):
            return plain(*args, **kwargs)
        try:
            with jax.core.eval_context():
                if kept:
                    return call_kept(calls[0], static, args)
                return calls[0](*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if UNKNOWN not in str(error):
                raise
            calls.clear()
        return plain(*args, **kwargs)

    return call
