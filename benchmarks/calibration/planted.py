"""Planted errors and what a calibration from the recording recovers of them.

``python -m benchmarks calibration.planted --corpus DIR [--subset validation]``: in recordings of 20 s
with independent errors of 2D (`KeypointNoise`) and 8 sensors every error of `planting.ERRORS` alone, besides
what is usually wrong, and all of them together, at the sizes of docs/calibration.md and at three times those,
with a floor that is
known and unknown; recordings of 4 to 40 s of walking, standing work and varied motion; and recordings in
which next to nothing is wrong, by all four cameras, as differences are small there. An interrupted run
resumes where it stopped.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.calibration import planted_figure, planted_tables
from benchmarks.calibration.planted_rows import (
    ALL,
    BUT,
    GOOD,
    KNOWN,
    LENGTHS,
    PLAIN,
    SEEN,
    SESSIONS,
    Job,
    Row,
    row,
    session,
)
from benchmarks.calibration.planting import ERRORS
from benchmarks.command_line import study_parser


def jobs(subset: str, studies: list[str], seconds: float, cameras: int) -> Iterator[Job]:
    """Every recording that is made; some stand there twice."""
    unknown = [name for name in studies if name not in STUDIES]
    if unknown:
        sys.exit(f"error: no study {', '.join(unknown)}; there are {', '.join(STUDIES)}")
    for study in studies:
        for one in STUDIES[study](seconds):
            for name in SESSIONS[subset]:
                for camera in range(4 if study == "harm" else cameras):
                    yield replace(one, session=name, camera=camera)


def _planted(seconds: float) -> Iterator[Job]:
    one = Job("planted", "", KNOWN, seconds=seconds)
    for floor in (False, True):
        for case in (KNOWN, PLAIN, ALL):
            yield replace(one, case=case, floor=floor)
    for name in ERRORS:
        yield replace(one, case=name)
    yield replace(one, case="size", floor=True)  # observable only with a floor
    for case in (KNOWN, PLAIN, ALL):
        yield replace(one, case=case, sensors="10")


def _large(seconds: float) -> Iterator[Job]:
    for floor in (False, True):
        yield Job("planted", "", ALL, 3.0, seconds, floor)
    for name in ERRORS:
        yield Job("planted", "", name, 3.0, seconds)


def _lengths(seconds: float) -> Iterator[Job]:
    for length in LENGTHS:
        for case in (KNOWN, ALL):
            yield Job("length", "", case, seconds=length, floor=True)


def _harm(seconds: float) -> Iterator[Job]:
    for keypoints in ("perfect", "white", "independent"):  # whose biases can be taken away
        for length in (4.0, seconds):
            yield Job("harm", "", GOOD, keypoints=keypoints, seconds=length)
    for length in (4.0, seconds):
        yield Job("harm", "", SEEN, seconds=length)


def _measured(seconds: float) -> Iterator[Job]:
    alone = [name for name in ERRORS if name != "delay"]
    for names in (*alone, "size, proportions"):
        yield Job("measured", "", BUT + names, seconds=seconds)


STUDIES = {"planted": _planted, "harm": _harm, "length": _lengths, "large": _large, "measured": _measured}
"""Errors at their usual size; next to none; recordings of several lengths; thrice the usual size; all
errors but one that is measured."""


def measured(options: argparse.Namespace) -> list[Row]:
    """Rows of all jobs, from the file or made now."""
    own = [Path(__file__).with_name(f"{n}.py").read_bytes() for n in ("planting", "planted_rows")]
    version = version_of(options.subset, options.lifter, *own)
    file = RowFile(options.out.with_suffix(".jsonl"), version, options.restart)
    wanted = {}
    for job in jobs(options.subset, options.studies.split(","), options.seconds, options.cameras):
        wanted.setdefault(job.key, job)
    for i, (key, job) in enumerate(wanted.items()):
        if key not in file.rows:
            print(f"{i + 1}/{len(wanted)} {key}", file=sys.stderr, flush=True)
            clip = session(options.corpus, options.subset, job.session, job.seconds)
            enough = len(clip.poses) >= 0.9 * job.seconds * clip.poses.rate_hz
            file.add(key, [row(clip, job, options.lifter)] if enough else [])
    return [one for key in wanted for one in file.rows[key]]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("calibration.planted", __doc__)
    parser.add_argument("--subset", default="test", choices=tuple(SESSIONS))
    parser.add_argument("--studies", default=",".join(STUDIES), help="some, separated by commas")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--cameras", type=int, default=1, choices=range(1, 5))
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    options = parser.parse_args(arguments)
    rows = measured(options)
    text = planted_tables.report(rows)
    lines = ",\n".join("  " + json.dumps(one, separators=(",", ":")) for one in rows)
    head = json.dumps({"subset": options.subset})[:-1]
    options.out.write_text(f'{head},\n "rows": [\n{lines}\n ]\n}}\n', encoding="utf-8")
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")
    planted_figure.write_figure(options.out.with_suffix(".png"), rows)
    options.out.with_suffix(".jsonl").unlink()
    print(text)


if __name__ == "__main__":
    main()
