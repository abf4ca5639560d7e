"""`jaxfit batch`: many files, one table."""

import argparse
import sys
from pathlib import Path

from jaxfit import io
from jaxfit._base._default_net import checked_net_shape
from jaxfit._cli_batch_file import Job, failed, fit_file, job_of, size_of
from jaxfit._cli_fit import read_and_written
from jaxfit._cli_table import FAILED, FITTED, MISSED, Row, Table
from jaxfit._cli_workers import Schedule, chosen_pool
from jaxfit._interrupt import at_last

_CODES = {FITTED: 0, MISSED: 1, FAILED: 3}


def batch_command(args: argparse.Namespace) -> int:
    """Fit the files that are not yet in the table; return the exit code."""
    if args.net is not None:
        checked_net_shape(args.net, args.order)
    folder = Path(args.output)
    table = Table(folder)
    jobs = _jobs(args, folder, table)
    left = [job for job in jobs if not table.is_done(job.row, args.retry_failed)]
    if left:
        _fit_all(args, left, table)
        table.sort(job.row["input"] for job in jobs)
        table.write()
    again = {job.row["input"] for job in left}
    rows = [table.rows[job.row["input"]] for job in jobs]
    for row in rows:
        if row["status"] == FAILED and row["input"] not in again:
            print(f"jaxfit: error: {_with_name(row)} (In an earlier run.)", file=sys.stderr)
    if not args.quiet:
        _summarise(rows, len(jobs) - len(left), table)
    return max(_CODES[row["status"]] for row in rows)


def _jobs(args: argparse.Namespace, folder: Path, table: Table) -> list[Job]:
    """A job for each file; refuses two that would write the same surface, before anything is done, be it one
    of an earlier run.
    """
    for name in args.inputs:
        _check_name(name)
    jobs = {job.row["input"]: job for job in (job_of(args, name) for name in args.inputs)}
    taken = table.owners()
    for name, job in jobs.items():
        other = taken.setdefault(job.row["surface"], name)
        if other != name:
            raise io.InputError(
                f"{other} and {name} would both write {job.row['surface']} in {folder}; rename one, or give "
                "them folders of their own."
            )
    arguments = [job.arguments for job in jobs.values()]
    name = read_and_written(arguments, (x["output"] for x in arguments))
    if name:
        raise io.InputError(f"{folder} holds the file {Path(name).name} that is read; name another folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise io.InputError(f"the folder {folder} cannot be made: {error.strerror or error}.") from error
    io.check_output(folder / "table.npz")  # whether anything can be written there
    return list(jobs.values())


def _check_name(name: str) -> None:
    """Refuse what names no file: those that are missing or damaged get a row each."""
    if Path(name).is_dir():
        raise io.InputError(f"{name} is a folder; name the files in it, as in {Path(name) / '*'}.")
    if set(name) & set("*?[") and not Path(name).exists():
        raise io.InputError(f"{name} matches no file; check the folder and the pattern.")


def _fit_all(args: argparse.Namespace, jobs: list[Job], table: Table) -> None:
    with chosen_pool(args.workers, args.scheduler) as pool, at_last(table.write):
        done = Schedule(pool, jobs, size_of).run(fit_file, _died, table.write_if_rested)
        for count, row in enumerate(done, 1):
            table.put(row)
            _report(row, f"{count}/{len(jobs)}", args.quiet)


def _died(job: Job) -> Row:
    return failed(
        job, "the process that fitted it was ended, perhaps for want of memory; give it more, or a net."
    )


def _report(row: Row, count: str, quiet: bool) -> None:
    if row["status"] == FAILED:
        print(f"jaxfit: error: {_with_name(row)}", file=sys.stderr, flush=True)
    elif not quiet:
        errors = (f"{which} {row[f'{which}_error_percent']:.4g} %" for which in ("average", "maximum"))
        missed = f"  ({MISSED})" if row["status"] == MISSED else ""
        print(f"{count}  {row['input']}  {', '.join(errors)}{missed}", flush=True)


def _with_name(row: Row) -> str:
    return row["error"] if row["input"] in row["error"] else f"{row['input']}: {row['error']}"


def _summarise(rows: list[Row], before: int, table: Table) -> None:
    counts = [(name, sum(row["status"] == name for row in rows)) for name in _CODES]
    said = ", ".join(f"{count} {name}" for name, count in counts if count)
    retry = before and any(row["status"] == FAILED for row in rows)
    advice = "; --retry-failed fits the failed ones again" if retry else ""
    print(
        f"{len(rows)} file{'s' * (len(rows) != 1)} ({before} done before): {said}; see {table.sheet}{advice}"
    )
