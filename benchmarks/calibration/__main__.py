"""What calibrating a recording from itself gains: ``python -m benchmarks calibration --corpus DIR``.

Three rows for the benchmark's 4 s motions and for sessions of 20 s that join motions of one person
(`sessions`), each with 8 and 10 sensors and independent errors of 2D (`KeypointNoise`):

* given: reconstructed with the calibration as it is given, which is off by 2 degrees a sensor, with a
  detector's biases and a late video.
* calibrated: the same recordings, calibrated from themselves first.
* known: recordings in which nothing that could be calibrated is wrong: no bias, no lag, no misalignment.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.accuracy.__main__ import clips as benchmark_clips
from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser
from benchmarks.keypoint_noise import independent
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

FIGURES = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "flexion_deg": "flexion deg", "angle_deg": "angle deg"}
VALIDATION = ("131_01", "131_02", "131_03", "08_04", "08_11")
SUBJECTS = {"test": ("02", "09", "12", "14", "16"), "validation": ("131", "08")}
Row = dict[str, Any]


def motions(corpus: Path, subset: str, kind: str) -> list[MocapClip]:
    """The benchmark's motions, or sessions of so many seconds, one for each subject."""
    if kind == "clips":
        return benchmark_clips(corpus, subset)
    seconds = float(kind)
    rows = harness.split()
    names = rows["benchmark"]["motions"] if subset == "test" else list(VALIDATION)
    whole = harness.whole_clips(corpus, rows[subset], names)
    found = []
    for subject in SUBJECTS[subset]:
        own = [clip for clip in whole if clip.name.startswith(f"{subject}_")]
        session = joined(own, seconds, f"{subject}/{kind}s")
        if len(session.poses) >= 0.9 * seconds * session.poses.rate_hz:
            found.append(session)
    return found


def recorded(clip: MocapClip, camera: int, sensors: Sequence[str], known: bool) -> Recording:
    """Simulate the recording of a motion; without calibration errors where they are known."""
    settings = replace(independent(), sensors=tuple(sensors))
    if known:
        settings = replace(
            settings,
            keypoints=replace(settings.keypoints, bias_px=0.0),
            imu=replace(settings.imu, misalignment_deg=0.0),
            video_lag_frames=(0.0, 0.0),
        )
    return harness.filmed(clip, zlib.crc32(clip.name.encode()), camera, settings)


def rows(clip: MocapClip, camera: int, count: str, lifter: str | None) -> list[Row]:
    """The three rows of one recording."""
    sensors, out = harness.SENSOR_SETS[count], []
    for case in ("given", "calibrated", "known"):
        recording = recorded(clip, camera, sensors, case == "known")
        began = process_time()
        if case == "known":
            given = SelfCalibration(())  # nothing to put right
        result = reconstruct(
            recording, lifter=harness.lifter(lifter), calibrate=case == "calibrated", calibration=given
        )
        assert result.metrics is not None
        out.append(
            {
                "motion": clip.name,
                "camera": camera,
                "sensors": count,
                "case": case,
                "frames": len(recording.keypoints),
                "seconds": process_time() - began,
                **{name: result.metrics[name] for name in FIGURES},
            }
        )
    return out


def table(found: Sequence[Row]) -> str:
    """Means over frames, as Markdown."""
    lines = [
        "| motions | sensors | case | recordings | " + " | ".join(FIGURES.values()) + " |",
        "|---|---|---|---|" + "---|" * len(FIGURES),
    ]
    for kind in dict.fromkeys(r["kind"] for r in found):
        for count in dict.fromkeys(r["sensors"] for r in found):
            for case in ("given", "calibrated", "known"):
                own = [r for r in found if (r["kind"], r["sensors"], r["case"]) == (kind, count, case)]
                if not own:
                    continue
                weights = [r["frames"] for r in own]
                cells = [f"{np.average([r[n] for r in own], weights=weights):.2f}" for n in FIGURES]
                lines.append(f"| {kind} | {count} | {case} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("calibration", __doc__)
    parser.add_argument("--subset", default="test", choices=tuple(SUBJECTS))
    parser.add_argument("--kinds", default="clips,20", help="clips, or seconds of a session")
    parser.add_argument("--sensors", default="8,10")
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5))
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    options = parser.parse_args(arguments)
    found: list[Row] = []
    for kind in options.kinds.split(","):
        for clip in motions(options.corpus, options.subset, kind):
            for camera in range(options.cameras):
                for count in options.sensors.split(","):
                    own = rows(clip, camera, count, options.lifter)
                    found += [{"kind": kind if kind == "clips" else f"{kind} s", **r} for r in own]
                    write(options.out, options.subset, found)
    print(table(found))


def write(out: Path, subset: str, found: Sequence[Row]) -> None:
    """Write the JSON, a line a row, and the table beside it."""
    lines = ",\n".join("  " + json.dumps(row) for row in found)
    head = json.dumps({"subset": subset})[:-1]
    out.write_text(f'{head},\n "rows": [\n{lines}\n ]\n}}\n', encoding="utf-8")
    out.with_suffix(".md").write_text(table(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
