"""Accuracy of inertial sensors alone: mode ``imu`` on the benchmark's motions, with 8, 10, 13 sensors.

``python -m benchmarks inertial_only --corpus DIR`` with the harness' motions; ``--subset validation``
takes those to tune on. *exact* sensors have no errors; *realistic* ones are as the harness has them:
misaligned by 2 degrees per axis, slipping and wobbling with the soft tissue, noisy. Motions are
reconstructed whole: a walk of four seconds drifts little. Drift is the error of the root's horizontal
path since the first frame: at the end, by what was walked and by time.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.__main__ import VALIDATION
from benchmarks.command_line import in_parallel, study_parser
from benchmarks.harness import SENSOR_SETS, bootstrap, split, whole_clips, write_results
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.noise import ImuNoise
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras

SETS = {n: SENSOR_SETS[n] for n in ("8", "10")}
SETS["13"] = (*SETS["10"], "Head", "L_Foot", "R_Foot")
NOISE = {"exact": ImuNoise.perfect(), "realistic": ImuNoise()}
FIGURES = {
    "orientation_deg": ("sensed segments deg", 1),
    "angle_deg": ("joint angle deg", 1),
    "flexion_deg": ("flexion deg", 1),
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjae": ("MPJAE m/s2", 2),
}
_LONGEST = 30.0
"""[s] of a motion."""
_WALKED = 2.0
"""Least path for drift per distance, m."""


@dataclass(frozen=True)
class Job:
    """One motion with one set of sensors."""

    clip: MocapClip
    sensors: str
    noise: str
    seed: int


def recorded(job: Job) -> Recording:
    """Simulate the sensors' recording of a motion, without a camera."""
    clip, settings = job.clip, SimulationSettings.perfect()
    settings = replace(settings, sensors=SETS[job.sensors], imu=NOISE[job.noise])
    camera = standard_cameras(clip.poses, job.seed)[0]
    seen = simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=job.seed, name=clip.name)
    return replace(seen, keypoints=None)


def run(job: Job) -> dict[str, Any]:
    """Simulate, reconstruct and score."""
    result = reconstruct(recorded(job), mode="imu")
    about = {"motion": job.clip.name, "category": job.clip.category}
    return {**about, "sensors": job.sensors, "noise": job.noise, **scored(result)}


def scored(result: Reconstruction) -> dict[str, float]:
    """Errors of orientation and position, and of the root's path."""
    truth, poses, metrics = result.recording.truth, result.motion.poses, result.metrics
    assert truth is not None
    assert metrics is not None
    assert result.bone_imus is not None
    assert result.root_sigma is not None
    root = signals.interpolate(truth.times, truth.p_world_joint[:, 0], poses.times)
    known = np.flatnonzero(np.isfinite(root).all(axis=1))
    path, own = root[known], poses.p_world_joint[known, 0]
    error = (own - own[0]) - (path - path[0])
    sensed = result.motion.skeleton.index(*result.bone_imus.joints)
    R = signals.interpolate_rotations(truth.times, truth.R_world_bone[:, sensed], poses.times[known])
    angle = so3.angle_between(poses.R_world_bone[known][:, sensed], R)
    walked = float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())
    return {
        **{name: metrics[name] for name in FIGURES if name in metrics},
        "orientation_deg": float(np.degrees(angle).mean()),
        "frames": len(known),
        "seconds": float(poses.times[known[-1]] - poses.times[known[0]]),
        "walked_m": walked,
        "drift_m": float(np.linalg.norm(error[-1, :2])),
        "vertical_m": float(np.abs(error[:, 2]).mean()),
        "sigma_m": float(np.nan_to_num(result.root_sigma[-1])),
    }


def cells(rows: Sequence[dict[str, Any]]) -> list[Any]:
    """A row of the table from those of all motions."""
    frames = np.array([row["frames"] for row in rows], dtype=float)
    means = [float(np.average([row[name] for row in rows], weights=frames)) for name in FIGURES]
    far = [row for row in rows if row["walked_m"] > _WALKED]
    drift, walked, sigma = (np.array([row[n] for row in far]) for n in ("drift_m", "walked_m", "sigma_m"))
    walking = np.array([row["category"] == "walking" for row in far])
    low, high = np.sqrt(bootstrap([r["motion"] for r in far], (drift / walked) ** 2, walked**2))
    by_time = 60 * np.array([row["drift_m"] / row["seconds"] for row in rows])
    vertical = 1000 * float(np.average([row["vertical_m"] for row in rows], weights=frames))
    within = 100 * float(np.mean(drift < 2 * np.sqrt(2) * sigma))
    interval = f"{100 * low:.1f}-{100 * high:.1f}"
    shares = _share(drift, walked), interval, 100 * float(np.median(drift / walked))
    on_foot = _share(drift[walking], walked[walking])
    return [*means, *shares, on_foot, float(np.median(by_time)), vertical, within]


def _share(drift: Array, walked: Array) -> float:
    """Root of summed squares of the one by that of the other, per cent."""
    return 100 * float(np.sqrt(np.sum(drift**2) / np.sum(walked**2)))


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Table by noise and sensors."""
    columns = ("sensors", "IMUs", *(heading for heading, _ in FIGURES.values()))
    columns += ("drift % of walked", "95 %", "median", "walking alone")
    columns += ("drift m/min, median", "vertical mm", "within 2 sigma %")
    lines = []
    for noise in NOISE:
        for count in SETS:
            own = [row for row in rows if (row["noise"], row["sensors"]) == (noise, count)]
            lines.append((noise, count, *cells(own)))
    digits = (0, 0, *(d for _, d in FIGURES.values()), 1, 0, 1, 1, 1, 0, 0)
    far = len({row["motion"] for row in rows if row["walked_m"] > _WALKED})
    motions = len({row["motion"] for row in rows})
    notes = (
        f"{motions} motions; drift by what was walked is of the {far} that go further than "
        f"{_WALKED:g} m: root of summed squares at the end over that of what was walked; intervals are "
        "95 % bootstraps.",
        "within 2 sigma: share of these whose drift at the end is less than twice the standard deviation "
        "that the result states.",
        "sensed segments: mean angle between estimated and true orientation of segments with sensors.",
    )
    return Table("inertial_only", "Sensors alone", columns, digits, tuple(lines), notes)


def motions(corpus: Path, subset: str) -> list[MocapClip]:
    """Whole motions of a subset, at most half a minute each."""
    rows = split()
    names = list(VALIDATION) if subset == "validation" else rows["benchmark"]["motions"]
    clips = whole_clips(corpus, rows[subset], names)
    return [replace(clip, poses=clip.poses[: round(_LONGEST * clip.poses.rate_hz)]) for clip in clips]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("inertial_only", __doc__)
    parser.add_argument("--subset", choices=("test", "validation"), default="test")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args(arguments)
    jobs = [
        Job(clip, count, noise, zlib.crc32(clip.name.encode()))
        for noise in NOISE
        for count in SETS
        for clip in motions(options.corpus, options.subset)
    ]
    rows = in_parallel(run, jobs, options.workers)
    found = table(rows)
    content = {"subset": options.subset, "table": found.as_dict(), "rows": rows}
    write_results(options.out, content, found.markdown().removesuffix("\n"))
    print(found.markdown())


if __name__ == "__main__":
    main()
