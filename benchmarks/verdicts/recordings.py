"""Recordings of the study: subjects and rigs outside every fit, ordinary and with a planted fault."""

from __future__ import annotations

import runpy
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks import harness
from benchmarks.accuracy import video_faults
from benchmarks.accuracy.faults import FAULTS, with_wrong_focal_length
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import low_passed
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections

Apply = Callable[[Recording, Generator], Recording]
ORDINARY = "ordinary"
SIMULATED, SAMPLED = "independent", "mediapipe"
"""2D with independent errors of the joints, and drawn from a model fitted to real detections of MediaPipe."""
SENSORS = ("0", "4", "8", "10")
RIGS = {
    "Meredith": ("pymo_8walk_meredith",),
    "CMU (martial, 135?)": ("martial_03", "martial_04", "martial_06"),
    "CMU060/061 (one of)": ("salsa_01", "salsa_05"),
    "CMU060/061 (the other)": ("salsa_16",),
}
"""Motions by subject, besides those of the benchmark, on skeletons other than those of the confidence's
fit. The lifter was trained on the salsa and the martial arts."""
_PARTS = {"pymo_8walk_meredith": 2}


def _longer_focal(recording: Recording, rng: Generator) -> Recording:
    """A focal length believed 8 % too long."""
    for _ in range(4):
        recording = with_wrong_focal_length(recording, rng)
    return recording


def _short_limbs(recording: Recording) -> Recording:
    """The skeleton's limbs are 20 % too short."""
    offsets = recording.joint_offsets.copy()
    names = [f"{side}{bone}" for side in ("Left", "Right") for bone in ("ForeArm", "Hand", "Leg", "Foot")]
    offsets[recording.skeleton.index(*names)] *= 0.8
    return replace(recording, joint_offsets=offsets)


def _exchanged_shanks(recording: Recording) -> Recording:
    """The sensors of the two shanks were put on the wrong legs."""
    imus = recording.imus
    assert imus is not None
    other = {"L_LowLeg": "R_LowLeg", "R_LowLeg": "L_LowLeg"}
    order = [imus.names.index(other.get(name, name)) for name in imus.names]
    R, f = imus.R_inertial_sensor[:, order], imus.f_sensor[:, order]
    return replace(recording, imus=replace(imus, R_inertial_sensor=R, f_sensor=f))


def _plain(change: Callable[[Recording], Recording]) -> Apply:
    return lambda recording, rng: change(recording)


CAMERA_FAULTS: dict[str, Apply] = {
    "limbs 20 % too short": _plain(_short_limbs),
    "left and right exchanged": FAULTS["left and right exchanged for 0.5 s"].apply,
    "focal length + 8 %": _longer_focal,
    "camera tilted by 1 deg": FAULTS["camera tilted by 1 deg"].apply,
    "person hidden": FAULTS["person out of the picture for 1 s"].apply,
    "legs exchanged": FAULTS["left and right leg exchanged for 0.5 s"].apply,
    "left side hidden": FAULTS["left arm and leg unseen for 1 s"].apply,
    "somebody else followed": FAULTS["somebody else followed for 0.5 s"].apply,
}
SENSOR_FAULTS: dict[str, Apply] = {
    "video 150 ms late": partial(video_faults.with_late_video, delay=0.15),
    "sensor slipped": FAULTS["left forearm's sensor slips by 30 deg halfway"].apply,
    "shank sensors exchanged": _plain(_exchanged_shanks),
    "heading off for 1 s": FAULTS["left forearm's heading off by 40 deg for 1 s"].apply,
    "headings off by 10 deg": FAULTS["headings off by 10 deg"].apply,
    "mounting off by 6 deg": FAULTS["mounting off by 6 deg per axis"].apply,
    "sensors stop halfway": FAULTS["all sensors stop halfway"].apply,
}
"""Besides those of the camera, where there are sensors."""


@dataclass(frozen=True)
class Job:
    """One recording."""

    clip: MocapClip
    group: str
    """'people' of the benchmark, or other 'rigs'."""
    keypoints: str
    """`SIMULATED` or `SAMPLED`."""
    sensors: str
    fault: str
    """`ORDINARY`, or a key of the faults."""
    camera: int
    seed: int
    detector: Path | None
    """The sampler of `SAMPLED` 2D."""

    @property
    def key(self) -> str:
        """Name of the job in the file of results."""
        return f"{self.clip.name} {self.camera} {self.keypoints} {self.sensors} {self.fault}"

    def recording(self) -> Recording:
        """Simulate camera and sensors, with the job's fault."""
        own = harness.SENSOR_SETS.get(self.sensors, ())
        if self.keypoints == SIMULATED:
            given = harness.recorded(self.clip, self.camera, SIMULATED, own, self.seed)
        else:
            assert self.detector is not None
            exact = harness.recorded(self.clip, self.camera, "perfect", own, self.seed)
            given = sampled(exact, self.detector, zlib.crc32(f"{self.seed} {self.key}".encode()))
        if self.fault == ORDINARY:
            return given
        rng = np.random.default_rng(zlib.crc32(f"{self.seed} {self.key}".encode()))
        return (CAMERA_FAULTS | SENSOR_FAULTS)[self.fault](given, rng)


def jobs(
    clips: Sequence[tuple[str, MocapClip]], kinds: Sequence[str], seed: int, detector: Path | None, cameras: int = 1
) -> list[Job]:
    """Every motion with every kind of 2D and number of sensors, as it is and with a fault; cameras and
    faults take turns.

    Args:
        clips: motions with their group.
    """
    found, turn = [], {sensors: 2 * s for s, sensors in enumerate(SENSORS)}
    for i, (group, clip) in enumerate(clips):
        for keypoints in kinds:
            for sensors in SENSORS:
                for k in range(cameras):
                    faults = [*CAMERA_FAULTS, *(SENSOR_FAULTS if sensors != "0" else ())]
                    turn[sensors] += 7  # prime to the numbers of faults
                    found += [
                        Job(clip, group, keypoints, sensors, fault, (i + k) % 4, seed, detector)
                        for fault in (ORDINARY, faults[turn[sensors] % len(faults)])
                    ]
    return found


def held_out_clips(corpus: Path) -> list[tuple[str, MocapClip]]:
    """The benchmark's motions, and those of `RIGS`, with their group."""
    clips = [*harness.test_clips(corpus), *_rig_clips(corpus)]
    return [("people" if clip.rig.startswith("cmu") else "rigs", clip) for clip in clips]


def _rig_clips(corpus: Path) -> list[MocapClip]:
    """The middle of the longest piece of every file, or of its parts."""
    longest = dict[str, MocapClip]()
    for clip in read_corpus(corpus, list(RIGS), output_rate_hz=120.0):
        name = clip.name.partition("[")[0]
        if name in RIGS[clip.subject] and len(clip.poses) > len(getattr(longest.get(name), "poses", ())):
            longest[name] = clip
    found = []
    for name, clip in longest.items():
        whole = resample_clip(low_passed(clip, 10.0), 60.0)
        found += harness.parts_of(replace(whole, name=name), _PARTS.get(name, 1))
    return found


def sampled(recording: Recording, detector: Path, seed: int) -> Recording:
    """A recording whose keypoints are drawn from a fitted model of a real detector's errors.

    Args:
        recording: with exact keypoints. detector: Python file with the sampler, see its own README.
    """
    video, truth = recording.video, recording.truth
    assert truth is not None
    camera = video.camera
    uv, visibility = _sampler(detector)(
        truth.p_world_joint,
        truth.R_world_bone,
        camera.K,
        camera.R_camera_world,
        camera.t_camera_world,
        seed,
        rate=truth.rate_hz,
        size=(camera.width_px, camera.height_px),
        camera_error=False,
    )
    found = keypoints_from_detections(Detections(uv[:, None], visibility[:, None]), truth.times, camera, "mediapipe33")
    return replace(recording, keypoints=found.keypoints)


@cache
def _sampler(path: Path) -> Any:
    return runpy.run_path(str(path))["sample"]
