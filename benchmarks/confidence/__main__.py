"""Whether the confidence is honest: ``python -m benchmarks confidence --corpus DIR --exercises CORPUS.npz``.

The benchmark's motions of held-out people and rigs x 4 cameras with realistic 2D and 0, 4, 8 and 10 sensors,
and with white and perfect 2D and 8; every fourth frame. ``--fit`` fits the inflation instead, on other people
(`motions.FITTED_ON` and `motions.EXERCISES`), and writes ``models/confidence.toml``: six minutes on one core.
``--curves`` then makes the factors of whole curves, on further people (`motions.curve_people`), and adds them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.progress import track

from benchmarks import harness
from benchmarks.command_line import rounded, study_parser
from benchmarks.confidence import motions
from benchmarks.confidence.cases import EVERY, KINDS, SENSORS, Case, reconstructed
from benchmarks.confidence.curves import Curve, coverage, curve_factors, curves, section, split_file
from benchmarks.confidence.curves import as_toml as curves_toml
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import as_toml, fitted
from benchmarks.confidence.motions import curve_recordings
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


MADE_OF = (
    "{count} recordings of {people} people with the simulated detector, {seconds} s each, half of them re-posed on "
    "another rig, by python -m benchmarks confidence --corpus DIR --exercises CORPUS.npz --curves{more}"
)
FILE = CHECKOUT / "confidence.toml"

Recorded = tuple[MocapClip, int, str, str]
"""A motion, its camera, the kind of 2D and the number of sensors."""


def collected(options: argparse.Namespace, recordings: Sequence[Recorded]) -> Iterator[Case]:
    """The recordings, reconstructed."""
    for one in track(recordings, "recordings"):
        yield reconstructed(*one, options.seed, options.calibrate, options.lifter)


def fit(options: argparse.Namespace) -> None:
    """Write the inflation."""
    clips = motions.clips(options.corpus, options.exercises)
    recordings = [(clip, camera, "realistic", count) for clip, camera, count in motions.recordings(clips, SENSORS)]
    cases = [case[::EVERY] for case in collected(options, recordings)]
    exercises = " --exercises CORPUS.npz" if options.exercises else ""
    more = " --calibrated" if options.calibrate else ""
    people = len({clip.subject for clip in clips})
    head = HEAD.format(exercises=exercises, more=more, count=len(cases), people=people)
    _, had_curves = split_file(FILE.read_text(encoding="utf-8"))
    FILE.write_text(head + as_toml(fitted(cases)), encoding="utf-8")
    print(f"wrote {FILE}")
    if had_curves:
        print("without the factors of whole curves, which were those of other bands: run --curves")


def fit_curves(options: argparse.Namespace) -> None:
    """Write the factors of whole curves behind the inflation."""
    found = curve_recordings(options.exercises, SENSORS)
    recordings = [(clip, camera, "realistic", count) for clip, camera, count in found]
    shipped = CovarianceInflation.shipped()
    cases = zip(collected(options, recordings), recordings, strict=True)
    scores = [curve for case, (clip, *_) in cases for curve in curves(case, clip.subject, shipped)]
    people = len({clip.subject for clip, *_ in recordings})
    seconds = "{:g} to {:g}".format(*motions.SECONDS)
    more = " --calibrated" if options.calibrate else ""
    made_of = MADE_OF.format(count=len(recordings), people=people, seconds=seconds, more=more)
    inflation, _ = split_file(FILE.read_text(encoding="utf-8"))
    FILE.write_text(inflation + "\n" + curves_toml(curve_factors(scores, made_of)), encoding="utf-8")
    print(f"added factors of whole curves to {FILE}")


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
    shipped, cases, found = CovarianceInflation.shipped(), list[Case](), list[Curve]()
    for case, (clip, _, kind, _) in zip(collected(options, recordings), recordings, strict=True):
        cases.append(case[::EVERY])
        if kind == "realistic" and clip.category != "exercise":
            found += curves(case, clip.subject, shipped)
    how = f"The benchmark's motions, {options.cameras} of 4 cameras each, `calibrate={options.calibrate}`."
    write(cases, found, options.out, how)


def write(cases: Sequence[Case], of_curves: Sequence[Curve], out: Path, how: str) -> None:
    """Numbers, tables and figure side by side.

    Args:
        how: of the report.
    """
    shipped = CovarianceInflation.shipped()
    found, rigs = rows(cases, shipped), sharpness(cases, shipped)
    text = report(found, how) + "\n" + by_rig(rigs)
    out.parent.mkdir(parents=True, exist_ok=True)
    tables = {"rows": rounded(found, 4), "rigs": rounded(rigs, 4)}
    if shipped.curves is not None and of_curves:
        covered = coverage(of_curves, shipped.curves)
        text += "\n" + section(covered, shipped.curves)
        tables["curves"] = rounded(covered, 4)
    lines = [
        f'"{name}": [\n' + ",\n".join(" " + json.dumps(row, default=float) for row in table) + "\n]"
        for name, table in tables.items()
    ]
    out.write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    reliability(found, out.with_suffix(".png"))
    print(text)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("confidence", __doc__)
    parser.add_argument("--exercises", type=Path, help="corpus of models/build_corpus.py with UI-PRMD's people")
    parser.add_argument("--fit", action="store_true", help="fit the inflation that ships")
    parser.add_argument("--curves", action="store_true", help="make the factors of whole curves that ship")
    parser.add_argument("--calibrated", dest="calibrate", action="store_true", help="calibrate recordings first")
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5))
    parser.add_argument("--keypoints", default="realistic,white,perfect", help="kinds of 2D")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    options = parser.parse_args(arguments)
    if options.curves and not options.exercises:
        parser.error("--curves needs the corpus of --exercises")
    (fit if options.fit else fit_curves if options.curves else study)(options)


if __name__ == "__main__":
    main()
