"""Planted 3D poses of another model as a second lift: right ones, and ones with known faults, with 0 and 8 sensors.

``python -m benchmarks external_lift --corpus DIR``: every third of the benchmark's motions, one camera each, realistic
2D. The other model gives the points of MHR (SAM 3D Body) about the hips on the camera's axes, with errors of 35 mm that
last half a second; *faults* adds a lean of 8 degrees, the scale 0.9, 80 ms of delay and 60 mm that last five seconds;
*somebody else* is the motion of the next recording.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from rtof_kin.core import rotations as so3
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.noise import coloured_noise
from rtof_kin.vision.lift_points import LiftPoints, convention

CASES = ("none", "right", "faults", "somebody else")
SENSORS = ("0", "8")
COLUMNS = {name: harness.COLUMNS[name] for name in ("mpjpe_rr_mm", "mpjpe_mm", "hips_deg", "trunk_deg", "flexion_deg")}
ERROR, SLOW, LEAN, SCALE, DELAY = 0.035, 0.06, 8.0, 0.9, 0.08  # [m], [m], [deg], [1], [s]


def points(recording: Recording, seed: int, faults: bool) -> LiftPoints:
    """What the other model says of a recording with truth."""
    truth, rng, form = recording.truth, np.random.default_rng(seed), convention("mhr70")
    assert truth is not None
    segments, places = [truth.names.index(name) for name in form.segments], form.places
    p = truth.p_world_joint[:, segments] + np.einsum("tkij,kj->tki", truth.R_world_bone[:, segments], places)
    p = p - truth.p_world_joint[:, :1]
    for memory, size in ((0.5, ERROR), (5.0, SLOW if faults else 0.0)):
        p = p + size / np.sqrt(3) * coloured_noise(rng, truth.times, memory, places.shape)
    turn = recording.video.camera.R_camera_world
    turn = turn @ so3.about_axis("y", np.radians(LEAN)) if faults else turn
    times, scale = (truth.times + DELAY, SCALE) if faults else (truth.times, 1.0)
    return LiftPoints("points", MarkerSequence(times, form.layout.names, scale * p @ turn.T))


def rows(job: tuple[int, MocapClip, MocapClip]) -> list[dict[str, Any]]:
    """Figures of one motion."""
    number, clip, other = job
    found = list[dict[str, Any]]()
    for sensors in SENSORS:
        worn = harness.SENSOR_SETS.get(sensors, ())
        recording = harness.recorded(clip, number % 4, "realistic", worn, 0)
        foreign = harness.recorded(other, number % 4, "realistic", (), 0)
        mode = "rtof" if worn else "rto"
        for case in CASES:
            given = (
                None
                if case == "none"
                else points(foreign if case == "somebody else" else recording, number, case == "faults")
            )
            with without_warnings(RESULT_WARNINGS):
                result = reconstruct(replace(recording, lifts=() if given is None else (given,)), mode=mode)
            named = any(lift.warning in result.warnings for lift in result.lifts)
            about = {"motion": clip.name, "sensors": sensors, "lift": case, "named": named}
            found.append(about | {"frames": len(recording.video)} | scoring.figures(result, mode))
    return found


def table(found: list[dict[str, Any]]) -> str:
    """Rows pooled by sensors and lift, as Markdown."""
    heads = [
        "sensors",
        "other lift",
        *(heading for heading, _ in COLUMNS.values()),
        "not worse",
        "worst mm",
        "left out",
    ]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for sensors in SENSORS:
        without = [row["mpjpe_rr_mm"] for row in found if (row["sensors"], row["lift"]) == (sensors, "none")]
        for case in CASES:
            own = [row for row in found if (row["sensors"], row["lift"]) == (sensors, case)]
            change = np.array([row["mpjpe_rr_mm"] for row in own]) - without
            figures = harness.pooled(own, COLUMNS)
            cells = [f"{figures[name]:.{digits}f}" for name, (_, digits) in COLUMNS.items()]
            named = sum(row["named"] for row in own)
            cells += [f"{np.mean(change < 0.1):.0%}", f"{change.max():+.1f}", f"{named} of {len(own)}"]
            lines.append(f"| {sensors} | {case} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks external_lift", description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--out", type=Path, default=harness.HERE / "results" / "external_lift.md")
    options = parser.parse_args(arguments)
    clips = harness.test_clips(options.corpus)[::3]
    jobs = [(i, clip, clips[(i + 1) % len(clips)]) for i, clip in enumerate(clips)]
    with ProcessPoolExecutor(2) as pool:
        found = [row for own in pool.map(rows, jobs) for row in own]
    about = (__doc__ or "").partition("\n\n")[2]
    text = f"# The 3D poses of another model as a second lift\n\n{about}\n{table(found)}"
    options.out.write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
