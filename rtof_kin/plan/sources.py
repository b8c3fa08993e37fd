"""What a plan is made from: a protocol's file, the name of a movement, a recording or a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.motion_file import motion_path
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.measurements_file import measurements_path, read_measurements
from rtof_kin.plan.movements import MOVEMENTS, movement
from rtof_kin.plan.protocol import Protocol, place_of
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Progress
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording

_LONGEST: Final = 30.0
"""[s] of a movement that are planned with."""


@dataclass(frozen=True)
class Moved:
    """A movement that was recorded."""

    poses: PoseSequence
    skeleton: SkeletonModel
    camera: Camera | None
    """That filmed it."""
    sensors: tuple[str, ...]
    """Worn, by the usual names of their segments."""
    floor_height: float | None
    """[m] z of a flat floor, where it is declared."""


def planned(
    what: str | Path, lifter: LifterLike | None = None, progress: Progress | None = None
) -> tuple[Protocol, Setup]:
    """Return the protocol and the setup of what a plan is asked for.

    Args:
        what: a protocol's TOML file; the name of a movement of the library, recorded by a usual camera;
            the folder of a recording, or the output of `reconstruct`, planned as it was recorded.
        lifter, progress: as for `reconstruct`, for a recording.

    Raises:
        InvalidInputError: no camera filmed the recording, or it has no complete frame.
        UnknownNameError: there is no such movement. FileFormatError: a file cannot be read.
    """
    path = Path(what)
    if path.is_file() and path.suffix == ".toml" and path.name != INDEX:
        protocol = Protocol.read(path)
        return protocol, setup_of(protocol, lifter, progress)
    folder = path.parent if path.name == INDEX else path
    if not folder.is_dir():
        if str(what) not in MOVEMENTS:
            raise UnknownNameError("file, folder or movement", [str(what)], tuple(MOVEMENTS))
        protocol = Protocol(str(what), any_camera=True)
        return protocol, setup_of(protocol, lifter)
    moved = _moved(folder, lifter, progress)
    if moved.camera is None:
        raise InvalidInputError(f"plan: no camera filmed {folder}; name it as movement in a protocol's file")
    place = place_of(moved.camera, moved.poses, moved.poses.rate_hz)
    protocol = Protocol(str(folder), camera=place, sensors=moved.sensors)
    return protocol, Setup(moved.poses, moved.skeleton, moved.camera, moved.sensors, floor_height=moved.floor_height)


def setup_of(protocol: Protocol, lifter: LifterLike | None = None, progress: Progress | None = None) -> Setup:
    """Return the setup of a protocol.

    Args:
        protocol: with the name of a movement, or the folder of a motion or recording.
        lifter, progress: as for `reconstruct`, for a recording.
    """
    if protocol.movement in MOVEMENTS:
        skeleton = SkeletonModel.default()
        skeleton = skeleton if protocol.height_m is None else skeleton.with_height(protocol.height_m)
        poses = movement(protocol.movement, skeleton, protocol.repetitions, protocol.camera.rate_hz)
    elif Path(protocol.movement).is_dir():
        moved = _moved(Path(protocol.movement), lifter, progress)
        poses, skeleton = moved.poses, moved.skeleton
    else:
        raise UnknownNameError("movement", [protocol.movement], tuple(MOVEMENTS))
    return Setup(
        poses, skeleton, protocol.camera.camera(poses), protocol.sensors, protocol.detector, protocol.error_factor
    )


def _moved(folder: Path, lifter: LifterLike | None, progress: Progress | None) -> Moved:
    """The movement of a recording, which is reconstructed, or of a motion."""
    camera, joints, floor = None, tuple[str, ...](), None
    if (folder / INDEX).exists():
        recording = Recording.load(folder)
        motion = reconstruct(recording, lifter=lifter, progress=progress).motion
        camera = None if recording.keypoints is None else recording.keypoints.camera
        joints = () if recording.calibration is None else recording.calibration.joints
        floor = recording.floor_height
    else:
        path = motion_path(folder)
        motion = Motion.load(path)
        if (beside := measurements_path(path.parent)).exists():
            measured = read_measurements(beside)
            camera = measured.views[0].camera if measured.views else None
            joints, floor = measured.segments, measured.floor_height
    known = np.isfinite(motion.poses.p_world_joint).all(axis=(1, 2))
    known &= np.isfinite(motion.poses.R_world_bone).all(axis=(1, 2, 3))
    stretches = signals.runs(known)
    if not stretches:
        raise InvalidInputError(f"plan: the motion of {folder} has no complete frame")
    start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    poses = liveliest(motion.poses[start:stop], _LONGEST)
    return Moved(poses, motion.skeleton, camera, _worn(motion.skeleton, joints), floor)


def _worn(skeleton: SkeletonModel, joints: Sequence[str]) -> tuple[str, ...]:
    """Usual names of the sensors on some segments."""
    return tuple(name for name, (joint, _) in skeleton.sensors.items() if joint in joints)


def liveliest(poses: PoseSequence, seconds: float) -> PoseSequence:
    """Return the part of a movement with the fastest turns, from time 0.

    Args:
        seconds: its length, s; all of a shorter movement.
    """
    count = min(round(seconds * poses.rate_hz), len(poses))
    speed = np.linalg.norm(np.diff(poses.R_world_bone, axis=0), axis=(2, 3)).sum(axis=1)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    first = int(np.argmax(total[count - 1 :] - total[: len(total) - count + 1]))
    return replace(poses[first : first + count], times=poses.times[:count] - poses.times[0])
