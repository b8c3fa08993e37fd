"""The command batch: a chain of commands on many recordings."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rtof_kin.cli.options import Output, Overwrite, Threads, command
from rtof_kin.cli.terminal import STYLES, ended_by_signals, err, job_progress, out, remark, say
from rtof_kin.core.errors import InvalidInputError


@command
def batch(
    source: Path,
    /,
    *,
    output: Output,
    chain: str = "reconstruct,report",
    threads: Threads = None,
    memory_per_job: Annotated[float, Parameter(metavar="GB")] = 2.0,
    engine: Literal["processes", "ray"] = "processes",
    address: Annotated[str | None, Parameter(metavar="HOST:PORT")] = None,
    shard: Annotated[str, Parameter(metavar="I/N")] = "1/1",
    overwrite: Overwrite = False,
) -> int:
    """A chain of commands on many recordings, with one table and index.

    SOURCE is a folder, below which every recording is taken, or a CSV file that lists recordings. Each gets a folder in
    OUT; OUT/batch.csv has a line for each and OUT/index.html links the reports, the worst verdict first. The same
    command goes on after it was stopped or killed: what is done and made from the same is kept, what failed is tried
    again. docs/batch.md has more. Exit code 1: a recording failed.

    Args:
        source: folder, or manifest.csv
        chain: commands separated by commas, each with its options, as 'reconstruct --calibrate, report --weight 70'
        memory_per_job: as many run at once as fit into the memory available at the start; 0: not looked at
        engine: processes of this machine, or a Ray cluster (extra: cluster)
        address: of the Ray cluster; default: RAY_ADDRESS, else this machine
        shard: only this one of N parts, for arrays of jobs, as 3/10
    """
    import rtof_kin
    from rtof_kin.batch.recordings import Shard, find_recordings, read_chain
    from rtof_kin.batch.rows import ERROR, INDEX_PAGE, WORST_FIRST
    from rtof_kin.batch.run import TABLE, Batch, check_chain, run_batch
    from rtof_kin.batch.work import process  # noqa: F401  # what workers do is loaded before they start
    from rtof_kin.cli import OLD_COMMANDS, check, command_names, dispatch
    from rtof_kin.core.jobs import Engine, Processes, RayCluster

    if address is not None and engine != "ray":
        raise InvalidInputError("--address is of a Ray cluster; add --engine ray")
    for part in chain.split(","):
        if (name := (part.split() or [""])[0]) in OLD_COMMANDS:
            raise InvalidInputError(f"chain: {name} is now {OLD_COMMANDS[name]}")
    memory = memory_per_job * 1e9
    machines: Engine = RayCluster(address, threads, memory) if engine == "ray" else Processes(threads, memory)
    steps = read_chain(chain, command_names() - {"batch"})
    entries = find_recordings(source, output)
    work = Batch(source, entries, steps, output, rtof_kin.__version__, Shard.of(shard))
    check_chain(work, check)
    try:
        with ended_by_signals(), job_progress("recordings") as update:
            rows = run_batch(work, dispatch, machines, overwrite, update)
    except KeyboardInterrupt:
        err.print("stopped; what is done is kept, and the same command goes on from here", style="bold")
        raise
    counts = Counter(row.verdict for row in rows)
    for verdict in WORST_FIRST:
        if counts[verdict]:
            out.print(f"{counts[verdict]:6} {verdict}", style=STYLES.get(verdict, ""))
    say(f"wrote {output / TABLE} and {output / INDEX_PAGE}")
    if counts[ERROR]:
        remark(f"{counts[ERROR]} failed; the same command tries them again", style="bold red")
    return 1 if counts[ERROR] else 0
