"""How accurate a lifter is: by placement, action, joint; torso; calibration; learning curves.

``python -m benchmarks lifter --corpus DIR [--lifter FILE ...]`` with the harness' motions, seen from four
placements that no lifter was trained with, in perfect and realistic 2D, and with sensors where the lifter
takes any. Further lifters (a causal one, the baseline) become further rows. Curves are those beside the
lifters, and those named, such as of other seeds. Rows are written as they come: an interrupted run goes
on where it stopped. ``--subset validation`` takes motions of the validation subjects, to tune on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.progress import Progress

from benchmarks.accuracy.__main__ import clips
from benchmarks.accuracy.row_file import RowFile, version_of, write_rows
from benchmarks.command_line import study_parser
from benchmarks.harness import HERE
from benchmarks.lifter.figure import write_figure
from benchmarks.lifter.placements import PLACEMENTS
from benchmarks.lifter.rows import Job, Row, load, names_of, run
from benchmarks.lifter.tables import TABLES, failures, first_seeds, measured, seeds
from rtof_kin.core.errors import RtofError
from rtof_kin.protocols.tables import Table


def measure(work: Sequence[Job], kept: RowFile, workers: int) -> list[Row]:
    """Rows of all jobs in their order; those done earlier are taken from the file."""
    left = [job for job in work if job.key not in kept.rows]
    with Progress() as progress:
        task = progress.add_task("lifter", total=len(work), completed=len(work) - len(left))
        for job, rows in _done(left, workers):
            kept.add(job.key, _rounded(rows))
            progress.advance(task)
    return [row for job in work for row in kept.rows[job.key]]


def _done(work: Sequence[Job], workers: int) -> Iterator[tuple[Job, list[Row]]]:
    """Jobs as they are done, by new processes where there are several: torch should not be forked."""
    if workers == 1:
        yield from ((job, run(job)) for job in work)
        return
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        futures = {pool.submit(run, job): job for job in work}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def write(out: Path, tables: Sequence[Table], facts: Row, rows: Sequence[Row]) -> str:
    """Write the JSON, a line a row, and the Markdown beside it; the Markdown."""
    text = "\n".join([*(table.markdown() for table in tables), *failures(rows)])
    return write_rows(out, text, facts | {"tables": _rounded({t.name: t.as_dict() for t in tables})}, rows)


def _rounded(value: Any) -> Any:
    """The same as JSON has it: six significant digits are plenty, and what is not finite is nothing."""
    return json.loads(
        json.dumps(value), parse_float=lambda text: float(f"{float(text):.6g}"), parse_constant=lambda text: None
    )


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options = _parser().parse_args(arguments)
    lifters = tuple(options.lifter or [""])
    names = names_of(lifters)
    motions = clips(options.corpus, options.subset)
    known = [clip.name for clip in motions]
    if unknown := sorted(set(options.motions) - set(known)):
        raise RtofError(f"no motion {', '.join(unknown)}; there are {', '.join(known)}")
    work = [
        Job(clip, placement, options.seed, lifters)
        for clip in motions
        if not options.motions or clip.name in options.motions
        for placement in PLACEMENTS
    ]
    out = options.out / ("lifter" + _suffix(options))
    digests = {name: load(path).sha256 for name, path in zip(names, lifters, strict=True)}
    version = version_of(_sources(), [job.key for job in work], options.seed, digests)
    kept = RowFile(out.with_suffix(".jsonl"), version, options.restart)
    rows = measure(work, kept, options.workers)
    first = first_seeds(measured(rows))
    tables = [*(table(first) for table in TABLES), seeds(measured(rows))]
    curves = [path for path in (Path(f"{file}.curves.json") for file in lifters) if path.is_file()]
    write_figure(out.with_suffix(".png"), first, [*curves, *options.curves])
    facts = {
        "command": _command(options, names),
        "version": version,
        "seed": options.seed,
        "subset": options.subset,
        "lifters": digests,
    }
    print(write(out, tables, facts, rows))
    kept.path.unlink()


def _command(options: argparse.Namespace, names: Sequence[str]) -> str:
    """The command without the places of one machine."""
    words = ["python -m benchmarks lifter --corpus DIR"]
    words += ["--lifter", *(f"'{name}'" for name in names)] if options.lifter else []
    words += ["--curves FILE ..."] if options.curves else []
    words += [f"--subset {options.subset}"] if options.subset != "test" else []
    words += [f"--motions {','.join(options.motions)}"] if options.motions else []
    words += [f"--seed {options.seed}"] if options.seed else []
    return " ".join(words)


def _suffix(options: argparse.Namespace) -> str:
    """Suffix of files that are not those of the whole benchmark."""
    subset = "" if options.subset == "test" else f"_{options.subset}"
    return subset + ("_some" if options.motions else "")


def _sources() -> str:
    """Digest of the modules of this benchmark."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _parser() -> argparse.ArgumentParser:
    parser = study_parser("lifter", __doc__, page="")
    parser.add_argument("--lifter", nargs="+", metavar="FILE", help="checkpoints; the shipped one where not given")
    parser.add_argument("--curves", nargs="+", type=Path, default=[], metavar="FILE", help="further .curves.json files")
    parser.add_argument("--subset", default="test", choices=("test", "validation"))
    parser.add_argument("--motions", default=[], type=lambda text: text.split(","), help="only these, by commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), choices=(1, 2))
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the results")
    return parser


if __name__ == "__main__":
    main()
