"""Whether the confidence is honest: ``python -m benchmarks confidence --corpus DIR --exercises CORPUS.npz``.

The benchmark's motions of held-out people and rigs x 4 cameras with realistic 2D and 0, 4, 8 and 10 sensors,
and with white and perfect 2D and 8; every fourth frame. ``--fit`` fits the inflation instead, on other people
(`motions.FITTED_ON` and `motions.EXERCISES`), and writes ``models/confidence.toml``: six minutes on one core.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.progress import track

from benchmarks import harness
from benchmarks.confidence import motions
from benchmarks.confidence.cases import KINDS, SENSORS, Case, reconstructed
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import as_toml, fitted
from benchmarks.confidence.sharpness import by_rig, sharpness
from benchmarks.confidence.study import rows
from benchmarks.confidence.tables import report
from rtof_kin.core.resources import CHECKOUT
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.uncertainty import CovarianceInflation

HEAD = """\
# Inflation of the Hessian's covariances; see rtof_kin/solve/uncertainty.py.
# Made by: python -m benchmarks confidence --corpus DIR{exercises} --fit{more}
# from {count} recordings of {people} people with the simulated detector, half of them re-posed on another
# rig with their own neutral posture, see benchmarks/confidence/motions.py.

"""


Recorded = tuple[MocapClip, int, str, str]
"""A motion, its camera, the kind of 2D and the number of sensors."""


def collected(options: argparse.Namespace, recordings: Sequence[Recorded]) -> list[Case]:
    """The recordings, reconstructed."""
    return [
        reconstructed(*one, options.seed, options.calibrate, options.lifter) for one in track(recordings, "recordings")
    ]


def fit(options: argparse.Namespace) -> None:
    """Write the inflation."""
    clips = motions.clips(options.corpus, options.exercises)
    recordings = [(clip, camera, "realistic", count) for clip, camera, count in motions.recordings(clips, SENSORS)]
    cases = collected(options, recordings)
    exercises = " --exercises CORPUS.npz" if options.exercises else ""
    more = " --calibrated" if options.calibrate else ""
    people = len({clip.subject for clip in clips})
    head = HEAD.format(exercises=exercises, more=more, count=len(cases), people=people)
    path = CHECKOUT / "confidence.toml"
    path.write_text(head + as_toml(fitted(cases)), encoding="utf-8")
    print(f"wrote {path}")


def study(options: argparse.Namespace) -> None:
    """Write the tables, their numbers and the figure."""
    clips = harness.test_clips(options.corpus)
    if options.exercises:
        clips += harness.exercise_clips(options.exercises)
    recordings = [
        (clip, (i + k) % 4, *kind)  # the cameras take turns
        for i, clip in enumerate(clips)
        for k in range(options.cameras)
        for kind in KINDS
        if kind[0] in options.keypoints.split(",")
    ]
    cases = collected(options, recordings)
    how = f"The benchmark's motions, {options.cameras} of 4 cameras each, `calibrate={options.calibrate}`."
    write(cases, options.out, how)


def write(cases: Sequence[Case], out: Path, how: str) -> None:
    """Numbers, tables and figure side by side.

    Args:
        how: of the report.
    """
    shipped = CovarianceInflation.shipped()
    found, rigs = rows(cases, shipped), sharpness(cases, shipped)
    text = report(found, how) + "\n" + by_rig(rigs)
    out.parent.mkdir(parents=True, exist_ok=True)
    tables = {"rows": _rounded(found), "rigs": _rounded(rigs)}
    lines = [
        f'"{name}": [\n' + ",\n".join(" " + json.dumps(row, default=float) for row in table) + "\n]"
        for name, table in tables.items()
    ]
    out.write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    reliability(found, out.with_suffix(".png"))
    print(text)


def _rounded(value: Any) -> Any:
    """Four significant digits are plenty in a file."""
    return json.loads(json.dumps(value), parse_float=lambda text: float(f"{float(text):.4g}"))


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks confidence",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--exercises", type=Path, help="corpus of models/build_corpus.py with UI-PRMD's people")
    parser.add_argument("--fit", action="store_true", help="fit the inflation that ships")
    parser.add_argument("--calibrated", dest="calibrate", action="store_true", help="calibrate recordings first")
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5))
    parser.add_argument("--keypoints", default="realistic,white,perfect", help="kinds of 2D")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--out", type=Path, default=harness.HERE / "results" / "confidence.json")
    options = parser.parse_args(arguments)
    (fit if options.fit else study)(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
