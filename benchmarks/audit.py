"""Does the audit of a report warn where something is wrong, and only there?

``python -m benchmarks.audit --corpus DIR`` reconstructs motions of the validation subjects, realistic 2D,
eight sensors, unchanged and with one fault, and counts the verdicts of `report.audit` by section.
What usual recordings reach is where the limits of its reprojection errors come from, so that usual ones
pass says little; that others do not says more.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import harness
from rtof_kin.core import rotations as so3
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.report.audit import audit
from rtof_kin.report.audit_results import Grade, section_verdict
from rtof_kin.report.residuals import reprojection_errors
from rtof_kin.report.statistics import ReconstructionStatistics
from rtof_kin.simulation.mocap import MocapClip, read_corpus

RESULTS = harness.HERE / "results"
SUBJECTS = ["CMU008", "CMU131"]
SECTIONS = ("streams", "image", "sensors", "body", "solver")
SECONDS, CAMERAS, SEED = 6.0, (0, 2), 3


def late(recording: Recording) -> Recording:
    """The video's stamps are 150 ms late."""
    video = recording.video
    return replace(recording, keypoints=replace(video, times=video.times + 0.15))


def exchanged(recording: Recording) -> Recording:
    """The sensors of the two shanks were put on the wrong legs."""
    imus = recording.imus
    assert imus is not None
    other = {"L_LowLeg": "R_LowLeg", "R_LowLeg": "L_LowLeg"}
    order = [imus.names.index(other.get(name, name)) for name in imus.names]
    R, f = imus.R_inertial_sensor[:, order], imus.f_sensor[:, order]
    return replace(recording, imus=replace(imus, R_inertial_sensor=R, f_sensor=f))


def askew(recording: Recording) -> Recording:
    """One thigh's sensor is mounted 40 degrees off, across the bone."""
    given = recording.calibration
    assert given is not None
    R = given.R_sensor_bone.copy()
    thigh = given.sensors.index("L_UpLeg")
    R[thigh] = R[thigh] @ so3.about_axis("x", np.radians(40.0))
    return replace(recording, calibration=replace(given, R_sensor_bone=R))


def short_limbs(recording: Recording) -> Recording:
    """The skeleton's limbs are 20 % too short."""
    offsets = recording.joint_offsets.copy()
    names = ("LeftForeArm", "RightForeArm", "LeftHand", "RightHand",
             "LeftLeg", "RightLeg", "LeftFoot", "RightFoot")  # fmt: skip
    offsets[recording.skeleton.index(*names)] *= 0.8
    return replace(recording, joint_offsets=offsets)


CASES: dict[str, Callable[[Recording], Recording]] = {
    "as usual": lambda recording: recording,
    "video 150 ms late": late,
    "shank sensors exchanged": exchanged,
    "thigh sensor 40 deg off": askew,
    "limbs 20 % too short": short_limbs,
}


def row_of(result: Reconstruction, clip: MocapClip, camera: int, case: str) -> dict[str, Any]:
    """Verdicts and figures of one reconstruction."""
    findings = audit(result)
    errors = reprojection_errors(result)
    height = ReconstructionStatistics(result)["body height px"].median_of_all
    figures = ("orientation residual across", "orientation residual about", "acceleration")
    worst = {name: max(f.value for f in findings if f.name.startswith(name)) for name in figures}
    assert result.metrics is not None
    return {
        "motion": clip.name, "camera": camera, "case": case,
        "verdicts": {s: section_verdict(s, findings).grade.value for s in SECTIONS},
        "picture_share": float(np.nanmedian(errors)) / height,
        "landmark_share": float(np.nanmedian(errors, axis=0).max()) / height,
        "worst": worst, "mpjpe_rr_mm": result.metrics["mpjpe_rr_mm"],
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Verdicts by case, and the figures of usual recordings."""
    lines = [
        "| case | mean rr mm | " + " | ".join(SECTIONS) + " | any |",
        "|---|---|" + "---|" * (len(SECTIONS) + 1),
    ]
    for case in CASES:
        own = [row for row in rows if row["case"] == case]
        error = np.mean([row["mpjpe_rr_mm"] for row in own])
        cells = []
        for grades in ([[row["verdicts"][s]] for row in own] for s in SECTIONS):
            cells.append(_counts(grades))
        cells.append(_counts([list(row["verdicts"].values()) for row in own]))
        lines.append(f"| {case} | {error:.1f} | " + " | ".join(cells) + " |")
    usual = [row for row in rows if row["case"] == "as usual"]
    figures = {
        "median error of all landmarks, % of height": [100 * r["picture_share"] for r in usual],
        "largest median error of a landmark, % of height": [100 * r["landmark_share"] for r in usual],
        **{f"worst sensor, {name}": [r["worst"][name] for r in usual] for name in usual[0]["worst"]},
    }
    lines += ["", "| recordings as usual | median | 95 % | largest |", "|---|---|---|---|"]
    for name, values in figures.items():
        numbers = (np.median(values), np.quantile(values, 0.95), max(values))
        lines.append(f"| {name} | " + " | ".join(f"{v:.1f}" for v in numbers) + " |")
    return "\n".join(lines)


def _counts(grades: list[list[str]]) -> str:
    """Count recordings that warn and that fail."""
    failed = sum(Grade.FAIL.value in own for own in grades)
    warned = sum(Grade.WARN.value in own and Grade.FAIL.value not in own for own in grades)
    return f"{warned} warn, {failed} fail of {len(grades)}"


def main() -> None:
    """Run and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--motions", type=int, default=4)
    options = parser.parse_args()
    known = read_corpus(options.corpus, SUBJECTS, output_rate_hz=120.0)
    names = [clip.name for clip in known if "GLITCH" not in clip.quality][: options.motions]
    clips = harness.whole_clips(options.corpus, SUBJECTS, names)
    jobs = [(harness.middle(clip, SECONDS), camera) for clip in clips for camera in CAMERAS]
    rows = []
    for clip, camera in track(jobs, "recordings"):
        given = harness.recorded(clip, camera, "realistic", harness.SENSOR_SETS["8"], SEED)
        rows += [row_of(reconstruct(make(given)), clip, camera, case) for case, make in CASES.items()]
    head = (
        "Verdicts of the report's audit, `python -m benchmarks.audit`: validation subjects, realistic\n"
        f"2D, eight sensors, {len(jobs)} recordings of {SECONDS:g} s; real motion, simulated sensors.\n\n"
    )
    (RESULTS / "audit.json").write_text(json.dumps(rows, indent=1) + "\n")
    (RESULTS / "audit.md").write_text(head + table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
