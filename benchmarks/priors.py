"""The pose prior alone exchanged: each prior on every test motion, held-out rigs and people, with 8 and 10 sensors.

``python -m benchmarks priors --corpus DIR --exercises CORPUS.npz PRIOR.npz ...`` with the benchmark's motions and
cameras (one in turn for each motion), realistic 2D, no self-calibration. The priors are files of
`models/build_pose_prior.py`. Each is compared with the shipped one motion by motion: a default must not be worse in
nine of ten.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from benchmarks.command_line import in_parallel, study_parser
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.mocap_families import NAMES

SHIPPED = "shipped"
FIGURES = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "hips_deg": "hips deg", "trunk_deg": "trunk deg"}
NOT_WORSE = 0.1  # [mm]


def rows(priors: Sequence[Path], job: tuple[int, MocapClip]) -> list[dict[str, Any]]:
    """One row for each number of sensors and prior."""
    index, clip = job
    known = {SHIPPED: PosePrior.load(NAMES)} | {path.stem: PosePrior.load(NAMES, path) for path in priors}
    found = []
    for sensors in ("8", "10"):
        recording = harness.recorded(clip, index % 4, "realistic", harness.SENSOR_SETS[sensors], 0)
        for name, prior in known.items():
            result = reconstruct(replace(recording, model_prior=prior), mode="rtof", calibrate=False)
            about = {"sensors": sensors, "prior": name, "rig": clip.rig, "frames": len(recording.video)}
            found.append(about | scoring.figures(result, "rtof"))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("priors", __doc__, page="{}.md")
    parser.add_argument("--exercises", type=Path, metavar="CORPUS.npz", help="also exercises of held-out people")
    parser.add_argument("priors", type=Path, nargs="+", metavar="PRIOR.npz")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    clips = harness.test_clips(options.corpus)
    jobs = list(enumerate(clips + (harness.exercise_clips(options.exercises) if options.exercises else [])))
    found = [row for own in in_parallel(partial(rows, options.priors), jobs, options.workers) for row in own]
    heads = ["sensors", "prior", *FIGURES.values(), "not worse than shipped", "worst", "best", "by rig, rr mm"]
    lines = ["# The pose prior alone exchanged", "", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for sensors in ("8", "10"):
        base = [row["mpjpe_rr_mm"] for row in found if (row["sensors"], row["prior"]) == (sensors, SHIPPED)]
        for name in dict.fromkeys(row["prior"] for row in found):
            own = [row for row in found if (row["sensors"], row["prior"]) == (sensors, name)]
            pooled = harness.pooled([row | {"motion": i} for i, row in enumerate(own)], FIGURES)
            change = np.array([row["mpjpe_rr_mm"] for row in own]) - base
            rigs = {rig: [r["mpjpe_rr_mm"] for r in own if r["rig"] == rig] for rig in sorted({r["rig"] for r in own})}
            cells = [f"{pooled[figure]:.1f}" for figure in FIGURES]
            cells += [f"{np.mean(change < NOT_WORSE):.0%}", f"{change.max():+.1f}", f"{change.min():+.1f}"]
            by_rig = ", ".join(f"{rig} {np.mean(values):.1f}" for rig, values in rigs.items())
            lines.append("| " + " | ".join([sensors, name, *cells, by_rig]) + " |")
    text = "\n".join(lines) + "\n"
    options.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
