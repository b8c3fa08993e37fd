"""Whether the confidence is honest: ``python -m benchmarks.confidence --corpus DIR``.

The benchmark's motions x 4 cameras with realistic 2D and 0, 4, 8 and 10 sensors, and with white and
perfect 2D and 8; every fourth frame. ``--fit`` fits the inflation instead, on other people
(`motions.FITTED_ON`), and writes ``models/confidence.toml``; what ships was made with ``--cameras 1``.
``--held-out`` asks the same of each of those people, with an inflation fitted on all the others.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.progress import track

from benchmarks import harness
from benchmarks.confidence import motions
from benchmarks.confidence.cases import FITTED, KINDS, Case, reconstructed
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import fitted
from benchmarks.confidence.study import Row, rows
from benchmarks.confidence.tables import report
from rtof_kin.core.resources import CHECKOUT
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.uncertainty.covariance_inflation import CovarianceInflation

HEAD = """\
# Inflation of the Hessian's covariances; see rtof_kin/solve/uncertainty/covariance_inflation.py.
# Made by: python -m benchmarks.confidence --corpus DIR --fit{more}
# from {count} recordings of {people} people, see benchmarks/confidence/motions.py.

"""


def collected(options: argparse.Namespace, clips: Sequence[MocapClip], kinds: Any) -> list[Case]:
    """Every motion seen by so many cameras, which take turns."""
    jobs = [
        (clip, (i + k) % 4, *kind)
        for i, clip in enumerate(clips) for k in range(options.cameras) for kind in kinds
    ]  # fmt: skip
    return [
        reconstructed(*job, options.seed, options.calibrate, options.lifter)
        for job in track(jobs, "recordings")
    ]


def fit(options: argparse.Namespace) -> None:
    """Write the inflation."""
    cases = collected(options, motions.clips(options.corpus), FITTED)
    more = f" --cameras {options.cameras}" + ("" if options.calibrate else " --as-given")
    head = HEAD.format(more=more, count=len(cases), people=len(motions.FITTED_ON))
    path = CHECKOUT / "confidence.toml"
    path.write_text(head + fitted(cases).text(), encoding="utf-8")
    print(f"wrote {path}")


def study(options: argparse.Namespace) -> None:
    """Write the tables, their numbers and the figure."""
    cases = collected(options, harness.test_clips(options.corpus), KINDS)
    found = rows(cases, CovarianceInflation.shipped())
    how = f"The benchmark's motions, {options.cameras} cameras each, `calibrate={options.calibrate}`."
    write(found, options.out, report(found, how))


def study_held_out(options: argparse.Namespace) -> None:
    """The same of the fit's people, each with what was fitted on the others."""
    cases = collected(options, motions.clips(options.corpus), FITTED)
    found = held_out(cases, motions.person)
    how = (
        f"{len(motions.FITTED_ON)} people, each with an inflation that was fitted on all others; "
        f"{options.cameras} cameras, `calibrate={options.calibrate}`."
    )
    write(found, options.out.with_name("confidence_held_out.json"), report(found, how, "people"))


def held_out(cases: Sequence[Case], person: Callable[[str], str]) -> list[Row]:
    """Rows of each subject's recordings, with an inflation fitted on the other subjects.

    Args:
        person: who moves in a motion.
    """
    own = {case.motion_name: person(case.motion_name) for case in cases}
    inflations = {
        who: fitted([case for case in cases if own[case.motion_name] != who])
        for who in track(dict.fromkeys(own.values()), "people held out")
    }
    return rows(cases, lambda case: inflations[own[case.motion_name]], lambda case: own[case.motion_name])


def write(found: list[Row], out: Path, text: str) -> None:
    """Numbers, tables and figure side by side."""
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(" " + json.dumps(row, default=float) for row in _rounded(found))
    out.write_text(f'{{"rows": [\n{lines}\n]}}\n', encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    reliability(found, out.with_suffix(".png"))
    print(text)


def _rounded(value: Any) -> Any:
    """Four significant digits are plenty in a file."""
    return json.loads(json.dumps(value), parse_float=lambda text: float(f"{float(text):.4g}"))


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.confidence", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--fit", action="store_true", help="fit the inflation that ships")
    what.add_argument("--held-out", action="store_true", help="each person of the fit against the others")
    parser.add_argument(
        "--as-given", dest="calibrate", action="store_false", help="do not calibrate recordings first"
    )
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--out", type=Path, default=harness.HERE / "results" / "confidence.json")
    options = parser.parse_args(arguments)
    (fit if options.fit else study_held_out if options.held_out else study)(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
