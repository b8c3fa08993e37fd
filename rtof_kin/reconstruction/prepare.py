"""What a recording goes through before the fragment solver: guards, even times, lifter and SF2."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.observability import WHOLE, levels_by_points
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core import signals
from rtof_kin.core.choices import SPACES, Backend
from rtof_kin.core.errors import ShapeError, UnknownNameError, ViewError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.data.stream_faults import StreamFault
from rtof_kin.inertial.outlier_rejection import guarded_imus, without
from rtof_kin.reconstruction.sensors_alone import SensorsAloneSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import usual_space
from rtof_kin.solve.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.vision.outlier_rejection import guarded_keypoints

if TYPE_CHECKING:
    from lifting.predict import LiftedPoses

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, in all)."""
_SLOWEST_HZ, _FASTEST_HZ = 2.0, 2000.0
"""Frames a second that a video of a moving person may have."""
_LOWEST_ANKLE = 0.02
"""[m] over a floor, however low a recording seems to have it: then something else is wrong."""
_log = logging.getLogger(__name__)


class LifterLike(Protocol):
    """Anything that takes keypoints to 3D joints, e.g. `lifting.predict.Lifter`."""

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: Array | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
    ) -> LiftedPoses:
        """Poses in world for each frame, with orientations where the lifter has them."""


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings of all stages."""

    lift_with_sensors: bool = True
    """Whether the lifter is told the sensors' orientations too, in the modes that use sensors; a lifter
    that knows none ignores them."""
    inertial_ik: InertialGuidedIKSettings = field(default_factory=InertialGuidedIKSettings)
    fragment: JointSpaceSettings | CartesianSettings | None = None
    """Of the fragment solver, and by their type its space; the defaults of `space` where not given."""
    space: str | None = None
    """One of `SPACES`, where `fragment` does not tell; where not given, that of `FragmentSolver`."""
    backend: Backend | None = None
    """'realtime' or 'ipopt', where `fragment` does not tell; by default the usual one of the space."""
    frames: int = 50
    """N, frames in a fragment."""
    guard_streams: bool = True
    """Whether keypoints and sensors are looked through for what may be wrong with them, which is mended
    or left out (`Reconstruction.faults`)."""
    confidence: bool = True
    """Whether to tell how well the motion is known (`MotionSequence.confidence`), in modes rto and rtof
    in joint space."""
    sensor_joints: tuple[str, ...] = ()
    """Segments on which the compiled problem of joint space has a place for a sensor, beside those that a
    recording declares one on: recordings with any subset of the same places share one compilation."""
    sensors_alone: SensorsAloneSettings = field(default_factory=SensorsAloneSettings)
    """Of mode imu: its frames, contacts and path."""

    def __post_init__(self) -> None:
        if self.fragment is not None and not self.space == self.backend is None:
            raise ShapeError("settings: give space and backend, or the settings of a fragment, not both")
        if self.space is not None and self.space not in SPACES:
            raise UnknownNameError("space", [self.space], SPACES)

    def solver(
        self, skeleton: SkeletonModel, calibrated: bool = False
    ) -> JointSpaceSettings | CartesianSettings:
        """Settings of the fragment solver: those given, else the defaults.

        Args:
            skeleton: that is solved. calibrated: whether the recording was calibrated from itself.

        Raises:
            ShapeError: there is no such backend.
        """
        if self.fragment is not None:
            return self.fragment
        fragment: JointSpaceSettings | CartesianSettings = CartesianSettings()
        if (self.space or usual_space(skeleton)) == "joint":
            fragment = JointSpaceSettings.calibrated() if calibrated else JointSpaceSettings()
        return fragment if self.backend is None else replace(fragment, backend=self.backend)

    def with_fragment(self, fragment: JointSpaceSettings | CartesianSettings | None) -> Self:
        """The same with settings of the fragment solver."""
        return replace(self, fragment=fragment, space=None, backend=None)


@dataclass(frozen=True)
class Prepared:
    """A recording up to the fragment solver's start."""

    recording: Recording
    """Its streams looked through, the keypoints evenly spaced."""
    bone_imus: BoneImuSequence | None
    """The sensors at the keypoints' times, in the modes that use some."""
    stages: dict[str, PoseSequence]
    start: PoseSequence
    faults: tuple[StreamFault, ...]
    """What was found wrong with the streams, and what was left out besides."""


def prepare(    recording: Recording, skeleton: SkeletonModel, mode: str, lifter: LifterLike | None,
    settings: ReconstructionSettings, tell: Progress, left_out: tuple[StreamFault, ...] = (),
) -> Prepared:  # fmt: skip
    """Look the streams through, lift, and with sensors correct what was lifted.

    Args:
        left_out: faults of sensors that later stages found, by their segments.

    Raises:
        ShapeError: there are no keypoints, or their times or points are in another unit; the mode needs
            IMUs and there are none.
    """
    if recording.keypoints is None:
        raise ShapeError("the recording has no keypoints; without them use mode 'imu'")
    _check_video(recording.video)
    recording, faults = guarded(recording, settings)
    keypoints = evenly_spaced(recording.video)
    recording = replace(recording, keypoints=keypoints)
    inertial = mode in ("sf2", "rtof")
    bone_imus = recording.bone_imus() if inertial else None
    if inertial and bone_imus is None:
        raise ShapeError(f"mode {mode} needs IMUs and the recording has none; use 'lift' or 'rto'")
    if bone_imus is not None and left_out:
        bone_imus = without(bone_imus, left_out)
    tell("lift", 0, 1)
    told = bone_imus if settings.lift_with_sensors else None
    lifted, R_lifted = _lift(skeleton, keypoints, told, lifter, recording.floor_height)
    tell("lift", 1, 1)
    stages, start = {"lift": lifted}, lifted
    if inertial:
        ik = InertialGuidedIK(skeleton, settings.inertial_ik)
        start = stages["sf2"] = ik.refine(lifted, bone_imus, R_lifted)
    elif mode == "rto":
        start = InertialGuidedIK(skeleton).refine(lifted, None, R_lifted)
    return Prepared(recording, bone_imus, stages, start, (*faults, *left_out))


def _check_video(keypoints: KeypointSequence) -> None:
    """Raise where times or points are surely in another unit."""
    times, uv = keypoints.times, keypoints.uv_px
    seconds = float(times[-1] - times[0])
    if len(times) > 1 and not _SLOWEST_HZ <= (len(times) - 1) / seconds <= _FASTEST_HZ:
        raise ShapeError(
            f"keypoints: times make {(len(times) - 1) / seconds:.3g} frames a second; give them in "
            "seconds (are they milliseconds, or frame numbers?)"
        )
    if keypoints.seen.any() and np.nanmax(np.nanmax(uv, axis=(0, 1)) - np.nanmin(uv, axis=(0, 1))) < 3.0:
        raise ShapeError(
            "keypoints: all points of all frames lie within 3 px; where they are shares of the image, "
            "multiply x by its width and y by its height"
        )


def guarded(
    recording: Recording, settings: ReconstructionSettings, camera: bool = True
) -> tuple[Recording, tuple[StreamFault, ...]]:
    """A recording whose streams were looked through, and what was found.

    Args:
        camera: whether the keypoints are looked through too.
    """
    keypoints, imus, faults = recording.keypoints, recording.imus, tuple[StreamFault, ...]()
    if settings.guard_streams and camera and keypoints is not None:
        keypoints, faults = guarded_keypoints(keypoints)
    if settings.guard_streams and imus is not None:
        imus, of_sensors = guarded_imus(imus)
        faults += of_sensors
    return (replace(recording, keypoints=keypoints, imus=imus) if faults else recording), faults


def evenly_spaced(keypoints: KeypointSequence) -> KeypointSequence:
    """Keypoints at even steps of time, as differences over time need them.

    Times that jitter by less than 1 % of a frame are kept. Otherwise positions are interpolated to the
    mean rate (dropped frames counted) between neighbouring samples; where frames were dropped nothing
    is filled in: they are NaN with confidence 0.
    """
    times = keypoints.times
    if len(times) < 3:
        return keypoints
    steps = np.diff(times)
    usual = np.median(steps)
    if np.all(np.abs(steps - usual) < 0.01 * usual):
        return keypoints
    frames = max(int(np.round(steps / usual).sum()), 1)
    times_even, step = np.linspace(times[0], times[-1], frames + 1, retstep=True)
    even = _snapped(times_even, times, 0.01 * step)
    uv = signals.interpolate(times, keypoints.uv_px, even, max_gap=1.5 * step)
    confidence = signals.interpolate(times, keypoints.confidence, even, max_gap=1.5 * step)
    _log.warning(
        "keypoint times are uneven: %d samples brought to %d even frames of %.1f ms",
        len(times), len(even), 1000 * step,
    )  # fmt: skip
    confidence = np.clip(np.nan_to_num(confidence), 0, 1)
    return replace(keypoints, times=times_even, uv_px=uv, confidence=confidence)


def _snapped(at: Array, times: Array, tolerance: float) -> Array:
    """Instants, those that lie next to one of the times exactly there: rounding is no gap."""
    right = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    left = right - 1
    nearest = np.where(at - times[left] < times[right] - at, times[left], times[right])
    return np.where(np.abs(nearest - at) < tolerance, nearest, at)


def sensor_places(
    recording: Recording, skeleton: SkeletonModel, settings: ReconstructionSettings
) -> tuple[str, ...]:
    """Segments that usually carry a sensor and of which the recording or the settings name one, whether
    the mode uses it, and whether it says anything, or not: one compiled problem fits all these cases.
    """
    places, calibration, imus = {*settings.sensor_joints}, recording.calibration, recording.imus
    if calibration is not None and imus is not None:
        told = zip(calibration.sensors, calibration.joints, strict=True)
        places |= {joint for sensor, joint in told if sensor in imus.names}
    return tuple(joint for joint, _ in skeleton.sensors.values() if joint in places)


def on_floor(
    settings: JointSpaceSettings | CartesianSettings,
    floor_height: float | None,
    calibration: SelfCalibration | None,
) -> JointSpaceSettings | CartesianSettings:
    """The fragment solver's settings with the recording's floor, where they know floors and have none.

    Args:
        calibration: what the recording said of itself: of ankles on the floor.
    """
    if isinstance(settings, JointSpaceSettings) and settings.floor_height is None:
        higher = 0.0 if calibration is None else calibration.ankle_height
        ankles = max(settings.ankle_height + higher, _LOWEST_ANKLE)
        return replace(settings, floor_height=floor_height, ankle_height=ankles)
    return settings


def _lift(
    skeleton: SkeletonModel,
    keypoints: KeypointSequence,
    bone_imus: BoneImuSequence | None,
    lifter: LifterLike | None,
    floor_height: float | None,
) -> tuple[PoseSequence, Array]:
    """The lifter's poses, orientations from positions where it gives none, and who saw what; and the
    orientations (T, J, 3, 3) that it gives, NaN where not.
    """
    if lifter is None:
        lifter = shipped_lifter()
    result = lifter.predict(keypoints, skeleton.joint_offsets, bone_imus=bone_imus, floor_height=floor_height)
    p = np.asarray(result.p_world_joint)
    depth = keypoints.camera.to_camera(p)[..., 2]
    if np.any(depth <= 0):
        frame = int(np.argwhere(depth <= 0)[0][0])
        raise ViewError(f"lifted pose of frame {frame} is behind the camera; check its extrinsics")
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    R = np.where(np.isfinite(result.R_world_bone), result.R_world_bone, R)
    joints = keypoints.select(skeleton.names)  # all that a lifter looks at
    seen = joints.seen
    provenance = np.where(seen, Provenance.CAMERA, Provenance.PRIOR)
    bridged = ~np.asarray(result.seen)
    provenance[bridged] = Provenance.BRIDGED
    valid = np.broadcast_to(~bridged[:, None], seen.shape)
    poses = PoseSequence(
        times=keypoints.times,
        p_world_joint=p,
        R_world_bone=R,
        names=skeleton.names,
        provenance=provenance.astype(np.uint8),
        valid=valid,
        orientation_observed=valid & (levels_by_points(skeleton, joints) == WHOLE),
        sigma_rad=result.sigma_rad,
    )
    return poses, result.R_world_bone


@cache
def shipped_lifter() -> LifterLike:
    """The lifter that ships, read once."""
    from lifting.predict import Lifter

    return Lifter.load()
