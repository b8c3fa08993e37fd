"""The command batch: a chain of commands on many recordings."""

from __future__ import annotations

import argparse
import contextlib
import io
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import STYLES, command, ended_by_signals, err, job_progress, out

if TYPE_CHECKING:
    from rtof_kin.batch.rows import Row
    from rtof_kin.core.jobs import Engine

_GB = 1e9


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "batch",
        _batch,
        "a chain of commands on many recordings, with one table and index",
        "SOURCE is a folder, below which every recording is taken, or a CSV file that lists recordings. Each "
        "gets a folder in OUT; OUT/batch.csv has a line for each and OUT/index.html links the reports, the "
        "worst verdict first. The same command goes on after it was stopped or killed: what is done and made "
        "from the same is kept, what failed is tried again. docs/batch.md has more.",
    )
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder, or manifest.csv")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="do everything again")
    parser.add_argument(
        "--chain",
        default="reconstruct,analyse,report",
        metavar="COMMANDS",
        help="separated by commas, each with its options, as 'reconstruct --calibrate, analyse --weight 70'",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="at a time; default: one per core")
    parser.add_argument(
        "--memory-per-job",
        type=float,
        default=2.0,
        metavar="GB",
        help="none is started while less is available; 0: not looked at",
    )
    parser.add_argument(
        "--engine",
        choices=["processes", "ray"],
        default="processes",
        help="processes of this machine, or a Ray cluster (extra: cluster)",
    )
    parser.add_argument(
        "--address", metavar="HOST:PORT", help="of the Ray cluster; default: RAY_ADDRESS, else this machine"
    )
    parser.add_argument(
        "--shard", default="1/1", metavar="I/N", help="only this one of N parts, for arrays of jobs, as 3/10"
    )


def _batch(options: argparse.Namespace) -> int:
    import rtof_kin
    from rtof_kin.batch.recordings import Shard, find_recordings, read_chain
    from rtof_kin.batch.run import Batch, check_chain, run_batch
    from rtof_kin.batch.work import process  # noqa: F401  # what workers do is loaded before they start
    from rtof_kin.cli import command_names, dispatch

    engine = _engine(options)
    chain = read_chain(options.chain, command_names() - {"batch"})
    entries = find_recordings(options.source, options.output)
    batch = Batch(options.source, entries, chain, options.output, rtof_kin.__version__, Shard.of(options.shard))
    check_chain(batch, _check)
    try:
        with ended_by_signals(), job_progress("recordings") as update:
            rows = run_batch(batch, dispatch, engine, options.overwrite, update)
    except KeyboardInterrupt:
        err.print("stopped; what is done is kept, and the same command goes on from here", style="bold")
        raise
    return _print_rows(rows, batch.out)


def _engine(options: argparse.Namespace) -> Engine:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.core.jobs import Processes, RayCluster

    memory = options.memory_per_job * _GB
    if options.engine == "ray":
        return RayCluster(options.address, options.workers, memory)
    if options.address is not None:
        raise InvalidInputError("--address is of a Ray cluster; add --engine ray")
    return Processes(options.workers, memory)


def _check(line: list[str]) -> None:
    """Check a command line; what argparse says becomes an error of the package."""
    from rtof_kin.cli import parse
    from rtof_kin.core.errors import InvalidInputError

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            parse(line)
    except SystemExit as error:
        text = said.getvalue().strip().splitlines() or ["asks for help only"]
        raise InvalidInputError(text[-1].partition("error: ")[2] or text[-1]) from error


def _print_rows(rows: list[Row], folder: Path) -> int:
    """Print the verdicts and where they are; return the exit code."""
    from rtof_kin.batch.rows import ERROR, INDEX_PAGE, WORST_FIRST
    from rtof_kin.batch.run import TABLE

    counts = Counter(row.verdict for row in rows)
    for verdict in WORST_FIRST:
        if counts[verdict]:
            out.print(f"{counts[verdict]:6} {verdict}", style=STYLES.get(verdict, ""))
    out.print(f"wrote {folder / TABLE} and {folder / INDEX_PAGE}", soft_wrap=True)
    if counts[ERROR]:
        err.print(f"{counts[ERROR]} failed; the same command tries them again", style="bold red", soft_wrap=True)
    return 1 if counts[ERROR] else 0
