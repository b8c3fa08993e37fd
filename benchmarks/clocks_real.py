"""Clocks and headings of real sensors, beside a video simulated from their own motion.

``python -m benchmarks clocks_real --data DIR`` with DIR the folder of the trials of
examples/sensor_trials.toml (see README.md here). No recording at hand has a video and sensors of one motion,
so the motion is that of the real sensors, calibrated by the N-pose at their start; segments without a sensor
follow their parents and the pelvis stays in place. A camera films `SECONDS` of it with realistic 2D. The
clock is planted, the headings are those of the calibration. Movement of sensors on the skin is part of the
motion here and costs nothing: the benchmark that counts is `clocks_headings`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clocks_headings import REACH, Session, clock_row, filmed, heading_rows
from benchmarks.command_line import study_parser, table_head
from benchmarks.harness import write_results
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.orientation import log_with_orientation
from rtof_kin.inertial.pose_calibration import calibrate_by_pose, calibrated

HERE = Path(__file__).parent
TRIALS = HERE.parent / "examples" / "sensor_trials.toml"
SECONDS, LONGEST = 12.0, 120.0
"""[s] Of a video, and of a trial."""


def sessions(folder: Path) -> Iterator[Session]:
    """The trials that are there."""
    skeleton = SkeletonModel.default()
    for trial, facts in tomllib.loads(TRIALS.read_text(encoding="utf-8")).items():
        log = _log(folder / trial, facts)
        if log is None:
            continue
        joints = {sensor: joint for sensor, joint in facts["joints"].items() if sensor in log.names}
        found = calibrate_by_pose(log, joints, facts["pose"], skeleton, headings=facts["headings"])
        imus = calibrated(log, found.calibration)
        poses = _poses(imus[: int(LONGEST * 60)], skeleton)
        first = poses.times[0]
        log = replace(log, streams=tuple(replace(s, times=s.times - first) for s in log.streams))
        poses = replace(poses, times=poses.times - first)
        yield Session(trial, poses, skeleton, (0, len(poses)), log, found.calibration)


def _log(folder: Path, facts: Mapping[str, Any]) -> SensorLog | None:
    """The first readable log in a folder, with orientations."""
    for place in [folder, *(p for p in sorted(folder.rglob("*")) if p.is_dir())]:
        try:
            log = read_sensor_log(place, **facts.get("declared", {}))
        except RtofError:
            continue
        log = log.select([name for name in facts["joints"] if name in log.names])
        if not log.streams:
            continue
        if facts.get("vqf"):
            log = replace(log, streams=tuple(replace(s, R_inertial_sensor=None) for s in log.streams))
        return log_with_orientation(log)
    return None


def _poses(imus: BoneImuSequence, skeleton: SkeletonModel) -> PoseSequence:
    """The motion of the sensors; what has none follows its parent."""
    R: list[Array] = []
    for j, name in enumerate(skeleton.names):
        if name in imus.joints:
            own = imus.R_world_bone[:, imus.joints.index(name)]
            own = signals.interpolate_rotations(imus.times, own[:, None], imus.times)[:, 0]
        else:
            own = R[skeleton.parents[j]] if j else np.tile(np.eye(3), (len(imus.times), 1, 1))
        R.append(own)
    turned = np.stack(R, axis=1)
    known = np.isfinite(turned).all(axis=(1, 2, 3))
    first, last = np.flatnonzero(known)[[0, -1]]
    turned = so3.nearest_rotation(signals.low_pass(turned[first : last + 1], 60.0, 10.0))
    root = np.tile([0.0, 0.0, 0.95], (len(turned), 1))
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, root, turned)
    return PoseSequence(imus.times[first : last + 1], p, turned, skeleton.names)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("clocks_real", __doc__, motion=False)
    parser.add_argument("--data", type=Path, required=True, help="folder of real sensors")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    clocks = f"trial | seconds | clock: error ms (stated), of up to {REACH:g} s | said"
    lines = table_head(f"{clocks} | headings: median deg, largest, in doubt")
    for i, own in enumerate(sessions(options.data)):
        count = min(round(SECONDS * 60), len(own.poses) - 1)
        video = filmed(own, (len(own.poses) - count) // 2, count, 30.0, i)
        row, log = clock_row(np.random.default_rng(i), own, video, known=True)
        clock = f"{row['error_ms']:.1f} ({row['sigma_ms']:.1f})" if log is not None else "-"
        headings: list[dict[str, Any]] = []
        if log is not None and abs(row["error_ms"]) < 50:
            headings = heading_rows(own, video, log, row)
        off = np.abs([h["error_deg"] for h in headings])
        doubtful = sum(bool(h["doubt"]) for h in headings)
        rows.append(row | {"headings": headings})
        said = row["doubt"].split(":")[0] or "sure"
        turned = f"{np.median(off):.1f}, {off.max():.1f}, {doubtful} of {len(off)}" if len(off) else "-"
        lines.append(f"| {own.name} | {count / 60:.0f} | {clock} | {said} | {turned} |")
        print(lines[-1], flush=True)
    write_results(options.out, rows, "\n".join(lines))


if __name__ == "__main__":
    main()
