"""Rows: every kind of 2D, set of sensors and lifter for one motion and placement."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.harness import KEYPOINTS, SENSOR_SETS
from benchmarks.lifter.measures import calibration_figures, position_figures, torso_figures
from benchmarks.lifter.placements import Placement
from rtof_kin.body import kinematics
from rtof_kin.body.metrics import motionless
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import simulate

if TYPE_CHECKING:
    from lifting.predict import LiftedPoses, Lifter

Row = dict[str, Any]
KINDS = ("perfect", "realistic")
SENSORS = ("0", "8", "10")
STILL = "zero motion"
SEED = 500_000
"""Offset of the seed of camera errors and sensors, so that other tables have other ones."""


@dataclass(frozen=True)
class Job:
    """One motion from one placement, for every lifter."""

    clip: MocapClip
    placement: Placement
    seed: int
    lifters: tuple[str, ...]
    """Files; empty for the one that ships."""

    @property
    def key(self) -> str:
        """Name of the job in the file of rows."""
        return f"{self.clip.name} {self.placement.name}"


@cache
def load(path: str) -> Lifter:
    """A lifter from a file, or the one that ships with the package."""
    from lifting.predict import Lifter

    return Lifter.load(path or None)


def names_of(lifters: Sequence[str]) -> list[str]:
    """Return the lifters' names in the tables.

    Raises:
        RtofError: two are called the same. Errors of reading them pass through.
    """
    names = []
    for path in lifters:
        network = load(path).description.network
        name = Path(path).stem if path else "shipped"
        names.append(name + (", causal" if network.causal else ""))
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise RtofError(f"lifters called {', '.join(sorted(twice))} twice; rename a file")
    return names


def recorded(job: Job, kind: str) -> Recording:
    """Simulate the camera and all sensors; depends on the motion's name, not on its index."""
    clip = job.clip
    own = SEED + job.seed * 1_000_003 + zlib.crc32(job.key.encode())
    return simulate(
        clip.poses,
        clip.joint_offsets,
        camera=job.placement.camera(clip.poses),
        settings=replace(KEYPOINTS[kind](), sensors=SENSOR_SETS["10"]),
        seed=own,
        name=clip.name,
    )


def run(job: Job) -> list[Row]:
    """Every row of a job."""
    rows: list[Row] = []
    for kind in KINDS:
        recording = recorded(job, kind)
        about = {
            "motion": job.clip.name,
            "source": job.clip.name.partition("/")[0],
            "category": job.clip.category,
            "placement": job.placement.name,
            "keypoints": kind,
            "all_frames": len(recording.keypoints),
        }
        rows.append(about | {"sensors": "0", "lifter": STILL} | _still(recording))
        for path, name in zip(job.lifters, names_of(job.lifters), strict=True):
            for count, worn in _sensors(recording, bool(load(path).description.body.sensors)):
                own = about | {"sensors": count, "lifter": name}
                try:
                    lifted = load(path).predict(recording.keypoints, recording.joint_offsets, bone_imus=worn)
                    rows.append(own | scored(lifted, recording))
                except RtofError as error:  # reported in the tables, instead of losing the others
                    rows.append(own | {"error": str(error)})
    return rows


def _sensors(recording: Recording, takes: bool) -> Iterator[tuple[str, BoneImuSequence | None]]:
    """The sets of sensors and what they say; a lifter that takes none has the image alone."""
    assert recording.imus is not None
    yield "0", None
    for count in SENSORS[1:] if takes else ():
        imus = recording.imus.select(SENSOR_SETS[count])
        yield count, replace(recording, imus=imus).bone_imus()


def scored(lifted: LiftedPoses, recording: Recording) -> Row:
    """All figures of a lifted motion, over the frames in which the camera saw enough."""
    truth, skeleton = recording.truth, recording.skeleton
    assert truth is not None
    p, known = np.asarray(lifted.p_world_joint), np.asarray(lifted.seen)
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    row: Row = {"frames": int(known.sum()), "coverage": float(known.mean())}
    row |= position_figures(p, truth, known)
    R = np.where(np.isfinite(lifted.R_world_bone), lifted.R_world_bone, R)
    row |= torso_figures(R, truth, known)
    return row | calibration_figures(
        p, lifted.R_world_bone, lifted.sigma_m, lifted.sigma_rad, truth, recording.keypoints.camera.center_world
    )


def _still(recording: Recording) -> Row:
    """Zero motion at the mean of the truth."""
    truth = recording.truth
    assert truth is not None
    everywhere = np.ones(len(truth), dtype=bool)
    return {"frames": len(truth), "coverage": 1.0} | position_figures(
        motionless(truth).p_world_joint, truth, everywhere
    )
