"""Accuracy of calibrating sensors by a pose and by the movement after it.

``python -m benchmarks calibration_by_pose --corpus DIR`` with DIR the folder of free motion (README.md).
A motion of each validation subject of split.toml, up to 12 s, after two seconds of a pose that is held as
it should be, or with joints turned so that segments are off by 5, 10 or 15 degrees in the mean.
Eight sensors with soft tissue and accelerometer noise. The numbers are angles between segments by their
sensors and in truth over the movement, degrees, turned to one heading: the mean, and the 90th percentile
over segments. *right calibration* is what soft tissue alone makes of them. *given*: the facing is known.
*told*: derived from movement, of sensors with one reference. *own*: a heading for each sensor, derived
from rtof_kin.core.array_types import Array
from movement.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.command_line import study_parser
from benchmarks.harness import write_results
from benchmarks.held import HELD, MOVING, held_then_moving, held_wrongly
from benchmarks.mounting import pieces
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.pose_calibration import POSES, calibrate_by_pose, facing_of, pose_rotations
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import LIMB_SENSORS

SEED = 1
POSE_ERRORS_DEG = (0.0, 5.0, 10.0, 15.0)
KINDS = ("right calibration", "given", "told", "own")


@dataclass(frozen=True)
class Take:
    """Movement with sensors, and the calibration that is right."""

    skeleton: SkeletonModel
    poses: PoseSequence
    imus: ImuSequence
    truth: ImuCalibration

    @classmethod
    def of(cls, poses: PoseSequence, skeleton: SkeletonModel, name: str) -> Take:
        """Simulated; the same name gives the same errors."""
        rng = np.random.default_rng([SEED, zlib.crc32(name.encode())])
        noise = replace(ImuNoise(), misalignment_deg=0.0)
        imus, truth = simulate_imus(rng, poses, skeleton, LIMB_SENSORS, poses.times, noise)
        return cls(skeleton, poses, imus, truth)

    @property
    def joints(self) -> dict[str, str]:
        """Sensor -> segment."""
        return dict(zip(self.truth.sensors, self.truth.joints, strict=True))

    def aligned(self) -> ImuSequence:
        """Orientations measured by sensors with the world as reference frame."""
        R = self.truth.R_world_inertial @ self.imus.R_inertial_sensor
        return replace(self.imus, R_inertial_sensor=R)

    def errors_deg(self, imus: ImuSequence, calibration: ImuCalibration, since: float) -> list[float]:
        """Mean angle to the truth of every segment from a time on."""
        moving = self.poses.times >= since
        R = calibration.apply(imus).R_world_bone[moving]
        R_true = self.poses.R_world_bone[moving][:, self.skeleton.index(*self.truth.joints)]
        turn = so3.about_axis("z", so3.heading((R_true @ np.swapaxes(R, -1, -2)).mean(axis=(0, 1))))
        angles = np.degrees(so3.angle_between(turn @ R, R_true)).mean(axis=0)
        return [round(float(angle), 2) for angle in angles]


def by_pose(clip: MocapClip, pose: str, error_deg: float) -> list[dict[str, Any]]:
    """Rows of one piece of motion after one pose."""
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    rng = np.random.default_rng([SEED, zlib.crc32(clip.name.encode())])
    R_pose = pose_rotations(pose, skeleton)
    R_held = held_wrongly(rng, R_pose, skeleton, error_deg) if error_deg else R_pose
    take = Take.of(held_then_moving(clip.poses, R_held, skeleton), skeleton, clip.name)
    facing, one = facing_of(take.poses.R_world_bone[0]), take.aligned()
    ways: dict[str, tuple[ImuSequence, dict[str, Any]]] = {
        "given": (one, {"facing": facing}),
        "told": (one, {}),
        "own": (take.imus, {"headings": "own"}),
    }
    since = HELD + MOVING
    rows: list[dict[str, Any]] = [
        {"kind": "right calibration", "errors": take.errors_deg(take.imus, take.truth, since)}
    ]
    for kind, (imus, options) in ways.items():
        found = calibrate_by_pose(imus, take.joints, pose, skeleton, **options)
        rows.append(
            {
                "kind": kind,
                "errors": take.errors_deg(imus, found.calibration, since),
                "margin": found.heading_margin,
                "sigmas_deg": [round(r.heading_sigma_deg, 1) for r in found.sensors],
            }
        )
    about = {"motion": clip.name, "pose": pose, "pose_error_deg": error_deg}
    return [{**about, **row} for row in rows]


def table(rows: list[dict[str, Any]]) -> str:
    """Mean and 90th percentile over segments and pieces, as Markdown."""
    head = " | ".join(f"{error:.0f} deg off" for error in POSE_ERRORS_DEG)
    lines = [f"| kind | pose | {head} |", "|---" * (2 + len(POSE_ERRORS_DEG)) + "|"]
    for kind in KINDS:
        for pose in POSES:
            cells = []
            for error in POSE_ERRORS_DEG:
                own = [
                    e
                    for row in rows
                    for e in row["errors"]
                    if (row["kind"], row["pose"], row["pose_error_deg"]) == (kind, pose, error)
                ]
                cells.append(f"{np.mean(own):.1f} ({np.percentile(own, 90):.0f})" if own else "")
            if any(cells):
                lines.append(f"| {kind} | {pose} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("calibration_by_pose", __doc__)
    options = parser.parse_args(arguments)
    clips = list({clip.subject: clip for clip in pieces(options.corpus, "validation")}.values())
    jobs = [(clip, pose, error) for clip in clips for pose in POSES for error in POSE_ERRORS_DEG]
    rows = [row for job in track(jobs, "poses") for row in by_pose(*job)]
    command = "python -m benchmarks calibration_by_pose --corpus DIR"
    result = {"command": command, "seed": SEED, "rows": rows}
    print(write_results(options.out, result, table(rows)))


if __name__ == "__main__":
    main()
