"""How accurate the joint-space solver is: by sensors, under faults, and without its ingredients.

``python -m benchmarks accuracy --corpus DIR`` with the harness' motions, cameras and noise. Tables:

* sensors: 0, 4, 8 and 10 IMUs x kinds of 2D, four cameras a motion; and on which motions the solver is
  worse than its own start, SF2.
* robustness: 8 IMUs, white 5 px, one thing wrong at a time, one camera a motion; through the whole
  pipeline, which may find what is wrong and leave it out.
* ablation: 8 IMUs, white and realistic 2D, one ingredient left out at a time, one camera a motion.

Rows are written as they come: an interrupted run resumes where it stopped. ``--subset validation`` takes
motions of the validation subjects instead, to tune on.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks import harness
from benchmarks.accuracy.row_file import RowFile, version_of, write_rows
from benchmarks.accuracy.rows import Job, Row, run
from benchmarks.accuracy.tables import TABLES, failures
from benchmarks.command_line import rounded, study_parser
from benchmarks.harness import HERE
from rtof_kin.protocols.tables import Table
from rtof_kin.simulation.mocap import MocapClip

VALIDATION = {"131_03": 3, "131_01": 1, "131_02": 1, "08_04": 1, "08_05": 1, "08_11": 1, "pymo_8walk_meredith": 1}
"""Motions to tune on, and into how many parts each is cut: only the first one of what the validation
subjects do is neither walking nor running."""


def clips(corpus: Path, subset: str) -> list[MocapClip]:
    """The motions of a subset: at most as many seconds each as the benchmark's."""
    if subset == "test":
        return harness.test_clips(corpus)
    whole = harness.whole_clips(corpus, harness.mocap_people("validation"), list(VALIDATION))
    return [part for clip in whole for part in harness.parts_of(clip, VALIDATION[clip.name])]


def jobs(table: str, motions: Sequence[MocapClip], options: argparse.Namespace) -> list[Job]:
    """Jobs of a table: all cameras of every motion for the first one, else one camera in turn."""
    return [
        Job(table, clip, camera, options.seed, options.lifter)
        for i, clip in enumerate(motions)
        if not options.motions or clip.name in options.motions
        for camera in (range(options.cameras) if table == "sensors" else [i % 4])
    ]


def _run(job: Job) -> list[Row]:
    rows: list[Row] = rounded(run(job))
    return rows


def write(out: Path, tables: Sequence[Table], facts: Row, rows: Sequence[Row]) -> str:
    """Write the JSON, a line a row, and the Markdown beside it; the Markdown."""
    text = "\n".join([*(table.markdown() for table in tables), *failures(rows)])
    return write_rows(out, text, facts | {"tables": rounded({t.name: t.as_dict() for t in tables})}, rows)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options = _parser().parse_args(arguments)
    motions = clips(options.corpus, options.subset)
    names = [clip.name for clip in motions]
    if unknown := sorted(set(options.motions) - set(names)):
        sys.exit(f"error: no motion {', '.join(unknown)}; there are {', '.join(names)}")
    for table in options.tables:
        if table not in TABLES:
            sys.exit(f"error: no table {table}; there are {', '.join(TABLES)}")
        name = f"accuracy_{table}" + (f"_{options.subset}" if options.subset != "test" else "")
        out = options.out / (name + ("_some" if options.motions or options.cameras != 4 else ""))
        work = jobs(table, motions, options)
        version = version_of(table, [job.key for job in work], options.seed, options.lifter)
        kept = RowFile(out.with_suffix(".jsonl"), version, options.restart)
        rows = kept.collect({job.key: partial(_run, job) for job in work}, options.workers)
        facts = {
            "command": _command(sys.argv[1:] if arguments is None else arguments, options),
            "version": version,
            "seed": options.seed,
            "subset": options.subset,
        }
        print(write(out, TABLES[table](rows), facts, rows))
        kept.path.unlink()


def _command(arguments: Sequence[str], options: argparse.Namespace) -> str:
    """The command without the places of one machine."""
    places = {str(options.corpus): "DIR", str(options.out): "FOLDER", options.lifter: "FILE"}
    parts = [option.partition("=") for option in arguments]
    words = [places.get(a, a) + equals + places.get(b, b) for a, equals, b in parts]
    return " ".join(["python -m benchmarks accuracy", *words])


def _names(text: str) -> list[str]:
    return text.split(",") if text else []


def _parser() -> argparse.ArgumentParser:
    parser = study_parser("accuracy", __doc__, page="")
    parser.add_argument("--tables", default=list(TABLES), type=_names, help="separated by commas")
    parser.add_argument("--subset", default="test", choices=("test", "validation"))
    parser.add_argument("--motions", default=[], type=_names, help="only these, separated by commas")
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5), help="a motion, in the table of sensors")
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the results")
    return parser


if __name__ == "__main__":
    main()
