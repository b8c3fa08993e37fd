"""The recordings that the estimator is measured on, and what the whole recording's solver makes of them."""

from __future__ import annotations

import hashlib
import os
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import rtof_kin
from benchmarks import harness
from benchmarks.accuracy.__main__ import clips
from benchmarks.calibration.sessions import joined
from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras

KEYPOINTS = "realistic"
PEOPLE = {"02": ("02_04", "02_05", "02_06", "02_09"), "14": ("14_08", "14_14"), "16": ("16_15", "16_16")}
"""Test people with several motions, of which long ones are made."""


@dataclass(frozen=True)
class Job:
    """One motion seen by one camera, with so many sensors, as in the harness."""

    clip: MocapClip
    camera: int
    sensors: str
    seed: int
    work: str
    """Folder of what is computed once."""

    @property
    def key(self) -> str:
        """Name of its files."""
        return f"{self.clip.name}_{self.camera}_{self.sensors}_{self.seed}"

    @property
    def about(self) -> dict[str, Any]:
        """What its rows have in common."""
        held_out = self.clip.rig in harness.split()["benchmark"]["rigs"]
        return {
            "motion": self.clip.name,
            "rig": self.clip.rig,
            "subject": self.clip.subject,
            "held out": "rigs" if held_out else "people",
            "category": self.clip.category,
            "camera": self.camera,
            "sensors": self.sensors,
        }

    def recorded(self) -> Recording:
        """The harness's recording."""
        own = harness.SENSOR_SETS[self.sensors]
        return harness.recorded(self.clip, self.camera, KEYPOINTS, own, self.seed)


def jobs(options: Namespace) -> list[Job]:
    """Motions x cameras x sensors, as told."""
    motions = clips(options.corpus, options.subset)
    if options.motions:
        wanted = options.motions.split(",")
        by_count = options.motions.isdecimal()
        motions = motions[: int(wanted[0])] if by_count else [c for c in motions if c.name in wanted]
    if options.seconds:
        motions = [harness.middle(clip, options.seconds) for clip in motions]
    return [
        Job(clip, (camera + i) % 4, sensors, options.seed, str(options.work))
        for i, clip in enumerate(motions)
        for sensors in options.sensors
        for camera in range(options.cameras)
    ]


def batch(job: Job, recording: Recording) -> Motion:
    """Reconstruct a whole recording as given (mode rtof), or take what was kept of it."""
    path = Path(job.work) / _version() / f"{job.key}_{len(recording.video)}.h5"
    if path.is_file():
        return Motion.load(path)
    motion = reconstruct(recording).motion
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.{os.getpid()}.h5")
    write_motion(part, motion, first_frame=recording.first_frame, mode="rtof")
    part.replace(path)
    return motion


@cache
def _version() -> str:
    """Digest of what a batch reconstruction depends on."""
    package = Path(rtof_kin.__file__).parent
    sources = [path for path in package.rglob("*.py") if path.parts[-2] not in ("live", "cli", "report")]
    sources += [*(harness.HERE.parent / "lifting").rglob("*.py"), harness.HERE / "harness.py"]
    sources += [harness.HERE / "split.toml", *model_path("skeleton.toml").parent.glob("*.*")]
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def long_motion(corpus: Path, person: str, seconds: float) -> MocapClip:
    """Motions of one person, one after the other, again and again; between them the person glides."""
    own = harness.whole_clips(corpus, harness.split()["test"], list(PEOPLE[person]))
    once = sum(len(clip.poses) for clip in own) / own[0].poses.rate_hz
    return joined(own * (1 + int(seconds / once)), seconds, f"{person}/{seconds:g}s")


def long_recording(
    clip: MocapClip, sensors: Sequence[str], imu_rate_hz: float, seed: int = 0, camera: int = 0
) -> Recording:
    """Simulate a long motion with realistic 2D."""
    settings = replace(SimulationSettings.realistic(), sensors=tuple(sensors), imu_rate_hz=imu_rate_hz)
    cameras = standard_cameras(clip.poses, seed)
    return simulate(
        clip.poses, clip.joint_offsets, camera=cameras[camera], settings=settings, seed=seed, name=clip.name
    )


def truth_of(recording: Recording) -> PoseSequence:
    """The true poses."""
    assert recording.truth is not None
    return recording.truth
