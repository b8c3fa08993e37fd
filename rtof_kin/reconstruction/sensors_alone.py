"""Mode ``imu``: a motion from inertial sensors alone, by the same energy and solver as the other modes.

Calibrated sensors -> poses frame by frame (`inertial.initial_poses`) -> foot contacts -> root path
(`inertial.root_path`) -> contact_points -> `FragmentSolver` without keypoints. Heading and position are those of
the calibration and the first frame; both drift.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import has_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance, valid_positions
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.root_path import Contacts, RootPath, contact_points, detect_contacts, root_path
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.settings import JointSpaceSettings

_LOW = 0.75  # Fraction of the standing root height below which a person sits, kneels or lies
_LONG = 1.0  # [s] of that, or without contact, that causes a warning


@dataclass(frozen=True)
class SensorsAloneSettings:
    """Settings of the frames."""

    rate_hz: float = 60.0
    """[Hz] Frame rate; the sensors' rate where that is lower."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz < np.inf:
            raise InvalidInputError("rate_hz must be positive and finite")


@dataclass(frozen=True)
class SensorsAlone:
    """A motion from sensors alone, with its contacts and root path."""

    start: PoseSequence  # Poses frame by frame, on the root path
    solution: FragmentSolution
    bone_imus: BoneImuSequence  # Sensors at the frames' times
    contacts: Contacts
    path: RootPath
    warnings: tuple[str, ...]  # Limitations of the root path, in sentences


def reconstruct_from_sensors(
    recording: Recording,
    skeleton: SkeletonModel,
    settings: SensorsAloneSettings | None = None,
    solver: JointSpaceSettings | None = None,
    frames: int = 50,
    sensor_joints: tuple[str, ...] = (),
    progress: Callable[[int, int], None] | None = None,
    times: Array | None = None,
) -> SensorsAlone:
    """Reconstruct a recording without its keypoints.

    Args:
        recording: with IMUs and their calibration; its floor height counts, 0 where it has none.
        sensor_joints: further segments for which the compiled problem has room for a sensor.
        progress: called with (fragments done, fragments in all).
        times: (T,) s of the frames; by default `frame_times`.

    Raises:
        InvalidInputError: there are no IMUs, none has samples, or the skeleton has no pose prior.
        CalibrationError: the IMUs are not calibrated.
    """
    settings, solver = settings or SensorsAloneSettings(), solver or JointSpaceSettings()
    if recording.imus is None:
        raise InvalidInputError("mode imu needs IMUs and the recording has none; use 'lift' or 'rto'")
    if not has_prior(skeleton.name):
        raise InvalidInputError(f"mode imu: no pose prior is shipped for the skeleton {skeleton.name!r}")
    times = frame_times(recording.imus, settings.rate_hz) if times is None else times
    bone_imus = recording.bone_imus(times=times)
    assert bone_imus is not None
    ankle_height = (recording.floor_height or 0.0) + solver.ankle_height
    start = poses_from_sensors(skeleton, bone_imus)
    contacts = detect_contacts(start, bone_imus, skeleton)
    path = root_path(start, bone_imus, contacts, skeleton, ankle_height)
    start = _on_path(start, path, contacts, skeleton)
    ankles = start.p_world_joint[:, skeleton.index(*contacts.joints)]
    stand = contact_points(contacts, ankles, ankle_height)
    solver = replace(solver, floor_height=None)  # the contact points contain it
    solution = FragmentSolver(skeleton, frames, solver, (*bone_imus.joints, *sensor_joints)).solve(
        start, None, bone_imus, progress, stand
    )
    warnings = _warnings(start, contacts, skeleton, ankle_height)
    return SensorsAlone(start, solution, bone_imus, contacts, path, warnings)


def frame_times(imus: ImuSequence, rate_hz: float, stop: float | None = None) -> Array:
    """Return even frame times (T,), s, at `rate_hz` or the sensors' lower one, to `stop`, s, or their last sample."""
    first, last = imus.times[[0, -1]]
    last = last if stop is None else stop
    own = 1 / float(np.median(np.diff(imus.times))) if len(imus) > 1 else rate_hz
    rate_hz = min(rate_hz, own)
    count = int(np.floor((last - first) * rate_hz + 1e-6)) + 1
    return np.asarray(np.minimum(first + np.arange(count) / rate_hz, last))


def _on_path(start: PoseSequence, path: RootPath, contacts: Contacts, skeleton: SkeletonModel) -> PoseSequence:
    """Poses with their root on a path, which sensors on the legs observed."""
    provenance = start.provenance.copy()
    provenance[:, 0] = Provenance.IMU if contacts.joints else Provenance.PRIOR
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, path.p_world, start.R_world_bone)
    valid = valid_positions(provenance, start.times, skeleton.parents)
    return replace(start, p_world_joint=p, provenance=provenance, valid=valid)


def _warnings(start: PoseSequence, contacts: Contacts, skeleton: SkeletonModel, ankle_height: float) -> tuple[str, ...]:
    if not contacts.joints:
        return ("no sensor on a foot or shank: the root stays at its first position, whatever the person does",)
    out, rate = [], start.rate_hz
    flights = signals.runs(~contacts.standing.any(axis=1))
    longest = max((stop - start_ for start_, stop in flights), default=0) / rate
    if longest > _LONG:
        out.append(
            f"no foot contact for {longest:.1f} s at a stretch: there the root follows accelerations and "
            "the lower foot, and drifts by decimetres per second"
        )
    upright, _ = skeleton.forward_kinematics(skeleton.t_pose()[None])
    standing = upright[0, 0, 2] - upright[0, skeleton.index(*contacts.joints), 2].min()
    low = start.p_world_joint[:, 0, 2] - ankle_height < _LOW * standing
    seconds = sum(stop - start_ for start_, stop in signals.runs(low)) / rate
    if seconds > _LONG:
        out.append(
            f"for {seconds:.1f} s the pelvis is low, as in sitting, kneeling or lying: contacts are "
            "detected for feet only, so where they do not carry the weight the root may be off"
        )
    return tuple(out)
