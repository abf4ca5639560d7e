"""Fits of clouds in a file, read in blocks: seconds a pass and memory, against the number of points.

    python benchmarks/streams.py [--points 10000 100000 1000000 10000000] [--net 62 57] [--block 262144]
        [--method standard|geometric] [--steps 2] [--folder FOLDER]

Each size is fitted in a process of its own, so that its greatest resident memory is its own. Printed are that
memory when the libraries are loaded and at the end; the first pass over the blocks, which compiles and
searches the first feet on the whole surface; the quickest of the others; the last one, which measures the
errors; and nanoseconds a point of the quickest. The files (24 bytes a point) are removed.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]
jax.config.update("jax_enable_x64", True)

import jaxfit as jf

AT_ONCE = 1 << 18
METHODS = {"standard": jf.StandardApproximation, "geometric": jf.GeometricApproximation}


def write_sheet(path, count):
    """A wavy sheet with noise, at random places."""
    rng = np.random.default_rng(0)
    with open(path, "wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (count, 3)}
        np.lib.format.write_array_header_1_0(file, header)
        for start in range(0, count, AT_ONCE):
            u, v = rng.random((2, min(AT_ONCE, count - start)))
            z = 0.2 * np.sin(9 * u) * np.cos(7 * v) + 0.02 * np.sin(60 * u * v)
            z += 2e-4 * rng.normal(size=u.size)
            np.stack([u + 0.05 * np.sin(5 * v), v, z], axis=-1).astype("<f8").tofile(file)


def smooth_base(shape):
    """The sheet without its finest waves."""
    knots = [np.asarray(jf.clamped_uniform_knots(n, 4)) for n in shape]
    u, v = np.meshgrid(*(np.convolve(k[1:-1], np.ones(3) / 3, "valid") for k in knots), indexing="ij")
    net = np.stack([u + 0.05 * np.sin(5 * v), v, 0.2 * np.sin(9 * u) * np.cos(7 * v)], axis=-1)
    return jf.BSplineSurface(net, *knots)


def memory():
    """The greatest resident memory of this process, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fit_one(path, options):
    """One fit, in this process; prints its row."""
    before, count = memory(), len(np.load(path, mmap_mode="r"))
    ticks = [time.perf_counter()]
    method = METHODS[options.method](border=jf.FreeBorder())
    fit = jf.approximate_stream(
        path,
        smooth_base(options.net),
        method,
        tol_average=1e-9,
        max_steps=options.steps,
        progress=lambda *_: ticks.append(time.perf_counter()),
        block_size=options.block,
    )
    first, *others, last = np.diff([*ticks, time.perf_counter()])
    row = f"{count:>12,}{before:>8.0f}{memory():>8.0f} MiB{first:>9.1f}{min(others):>9.2f}{last:>9.1f} s"
    each = 1e9 * min(others) / count
    print(f"{row}{each:>9.0f} ns   average error {100 * float(fit.average_error):.4f} %", flush=True)


def main():
    """A row for every size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="*", default=[10**k for k in range(4, 8)])
    parser.add_argument("--net", type=int, nargs=2, default=[62, 57])
    parser.add_argument("--block", type=int, default=1 << 18)
    parser.add_argument("--method", choices=list(METHODS), default="standard")
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--folder", default=None, help="for the files (default: the system's)")
    parser.add_argument("--file", default=None, help="fit this .npy file, in this process")
    options = parser.parse_args()
    if options.file:
        fit_one(options.file, options)
        return
    print(f"jax {jax.__version__}, {jax.default_backend()}, net {options.net}, {options.method}")
    print(
        f"{'points':>12}{'loaded':>8}{'most':>12}{'first':>9}{'pass':>9}{'last':>11}{'a point':>12}",
        flush=True,
    )
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        for count in options.points:
            path = Path(folder) / f"sheet_{count}.npy"
            write_sheet(path, count)
            subprocess.run([sys.executable, *sys.argv, "--file", str(path)], check=True)
            path.unlink()


if __name__ == "__main__":
    main()
