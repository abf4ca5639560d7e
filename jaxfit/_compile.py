"""`jax.jit` with the options that make XLA's CPU compiler quick on programs of many small kernels."""

from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from typing import Any

import jax
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._compile_ahead import compile_ahead, wait_for_program
from jaxfit._kept_programs import call_kept

# XLA's newer emitter of fused CPU kernels takes 1.5 to 1.8 times as long to compile a fit as the older one,
# whose kernels run no slower.
OLDER_EMITTER = {"xla_cpu_use_fusion_emitters": False}  # other devices ignore it
# Level 1 of 3 saves another 10 to 15 % of what compiling takes, for kernels that run 2 to 4 % longer.
LEVEL = {"xla_backend_optimization_level": 1}
NO_LEVEL = {"xla_backend_optimization_level": 0}
# Into so many parts, which threads share, a module is cut; 32, as by default, take more time in all.
PARTS = {"xla_cpu_parallel_codegen_split_count": 8}
# Where vectors are that wide, kernels take 4 to 8 % less time than with the 256 bits that LLVM prefers.
VECTORS = {"xla_cpu_prefer_vector_width": 512}
# Fewer arrays are copied in loops, which saves another 1 to 3 %.
COPIES = {"xla_cpu_copy_insertion_use_region_analysis": True}
FOR_CPUS = OLDER_EMITTER | LEVEL | PARTS | VECTORS | COPIES
UNKNOWN = "No such compile option"


@cache
def _options(optimised: bool) -> dict[str, Any]:
    """Those for CPUs only are for a session that has not told JAX to optimise nothing."""
    if jax.default_backend() == "cpu" and not jax.config.read("jax_disable_most_optimizations"):
        return FOR_CPUS if optimised else FOR_CPUS | NO_LEVEL
    return OLDER_EMITTER


def compiled(
    function: Callable[..., Any], kept: bool = False, optimised: bool = True, **jit_options: Any
) -> "Compiled":
    """`jax.jit(function, **jit_options)` with options quick to compile, where JAX and XLA allow them.

    JAX takes compiler options for outermost programs only, so a call with traced arguments is an ordinary
    `jit`; so is every call once XLA has said that it does not know the option. Without a traced argument
    the call is computed at once, whatever is traced around it.

    What takes long to trace is `kept`: if programs are kept on disk, it is loaded from there. It has no
    keyword arguments, and its static ones, in `static_argnums`, are the first. What takes little time to run
    need not be `optimised`.
    """
    return Compiled(function, kept, optimised, jit_options)


class Compiled:
    """What `compiled` returns."""

    def __init__(
        self, function: Callable[..., Any], kept: bool, optimised: bool, jit_options: dict[str, Any]
    ):
        update_wrapper(self, function)
        self._function = function
        self._plain = jax.jit(function, **jit_options)
        self._kept, self._optimised, self._jit_options = kept, optimised, jit_options
        self._static = np.size(jit_options.get("static_argnums", ()))
        self._options_known = True  # until XLA says that it does not know one

    @cached_property
    def _quick(self) -> Any:  # made by the first call, when JAX knows its devices
        options = _options(self._optimised)
        return jax.jit(self._function, **self._jit_options, compiler_options=options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not self._options_known or not is_concrete(args, kwargs):
            return self._plain(*args, **kwargs)
        try:
            with jax.core.eval_context():
                wait_for_program(self._quick, self._static, args)
                if self._kept:
                    return call_kept(self._quick, self._static, args)
                return self._quick(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if UNKNOWN not in str(error):
                raise
            self._options_known = False
        return self._plain(*args, **kwargs)

    def ahead(self, *args: Any) -> None:
        """Have a thread compile for a call with such arguments, which waits for what is left of that.

        For concrete arguments without keywords; their values do not matter.
        """
        if self._options_known:
            with jax.core.eval_context():
                compile_ahead(self._quick, self._static, args, self._kept)

    def like_result(self, *args: Any) -> Any:
        """Zeros in the place of what a call with such arguments returns."""
        with jax.core.eval_context():
            return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), self._quick.eval_shape(*args))
