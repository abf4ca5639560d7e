"""What the command asks of JAX: its precision, and that it keeps the programs it compiles."""

import argparse
import gc
import os
import sys

import jax

from jaxfit._program_folder import VARIABLE, keep_programs


def choose_precision(args: argparse.Namespace) -> None:
    """Double, unless told ``--float32``."""
    jax.config.update("jax_enable_x64", not args.float32)


def trace_quickly() -> None:
    """Less work around tracing: its many small objects are no rubbish, and no line of source is kept."""
    gc.freeze()  # what is imported stays
    gc.set_threshold(50_000, 20, 50)
    jax.config.update("jax_traceback_in_locations_limit", 0)


def set_compile_cache(args: argparse.Namespace) -> None:
    """Have JAX keep what it compiles, where the user has not told JAX itself where to."""
    kept_by_jax = getattr(jax.config, "jax_compilation_cache_dir", None)
    if args.no_cache or (kept_by_jax and args.cache is None and VARIABLE not in os.environ):
        return
    try:
        folder = keep_programs(args.cache)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home folder
        if not args.quiet:
            print(
                f"jaxfit: warning: compiled programs are not kept ({error}); give --cache DIR or --no-cache.",
                file=sys.stderr,
            )
        return
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # Small programs too: there are twenty of them, and each takes a tenth of a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
