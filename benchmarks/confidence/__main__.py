"""Whether the confidence is honest: ``python -m benchmarks.confidence --corpus DIR``.

The benchmark's motions x 4 cameras with realistic 2D and 0, 4, 8 and 10 sensors, and with white and
perfect 2D and 8; every fourth frame; what ships was made with ``--cameras 2``. ``--fit`` fits the
inflation instead, on other people (`motions.FITTED_ON`), and writes ``models/confidence.toml``.
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
from benchmarks.confidence.cases import FITTED, KINDS, Case, reconstructed
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import fitted
from benchmarks.confidence.study import Row, rows
from benchmarks.confidence.tables import report
from rtof_kin.inflation import Inflation
from rtof_kin.mocap import MocapClip
from rtof_kin.resources import CHECKOUT

HEAD = """\
# What errors that last add to the Hessian's covariances; see rtof_kin/inflation.py.
# Made by: python -m benchmarks.confidence --corpus DIR --fit{more}
# from {count} recordings of {people} people, see benchmarks/confidence/motions.py.

"""


def collected(options: argparse.Namespace, clips: Sequence[MocapClip], kinds: Any) -> list[Case]:
    """Every motion seen by every camera."""
    jobs = [
        (clip, camera, *kind) for clip in clips for camera in range(options.cameras) for kind in kinds
    ]
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
    found = rows(cases, Inflation.shipped())
    write(found, options.out, options.calibrate, options.cameras)


def write(found: list[Row], out: Path, calibrate: bool, cameras: int = 4) -> None:
    """The same for rows that are there."""
    how = f"The benchmark's motions, {cameras} cameras each, `calibrate={calibrate}`."
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(" " + json.dumps(row, default=float) for row in _rounded(found))
    out.write_text(f'{{"calibrate": {json.dumps(calibrate)}, "rows": [\n{lines}\n]}}\n', encoding="utf-8")
    text = report(found, how)
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
    parser.add_argument("--fit", action="store_true", help="fit the inflation that ships")
    parser.add_argument(
        "--as-given", dest="calibrate", action="store_false", help="do not calibrate recordings first"
    )
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--out", type=Path, default=harness.HERE / "results" / "confidence.json")
    options = parser.parse_args(arguments)
    (fit if options.fit else study)(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
