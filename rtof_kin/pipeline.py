"""`reconstruct`: a recording in, a motion out: the paper's three stages, or inertial sensors alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics, signals
from rtof_kin.calibration_priors import CalibrationPriors
from rtof_kin.errors import ShapeError, UnknownNameError
from rtof_kin.fragment import FragmentSolution, FragmentSolver
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
from rtof_kin.joint_space.prior import has_prior
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.keypoint_guards import guarded_keypoints
from rtof_kin.metrics import Metrics, evaluate
from rtof_kin.motion_files import DEFAULT
from rtof_kin.recording import Recording
from rtof_kin.self_calibrate import calibrate as calibrate_from
from rtof_kin.self_calibration import SelfCalibration
from rtof_kin.sensor_guards import disagreeing, guarded_imus, without
from rtof_kin.sensors_alone import SensorsAloneSettings, reconstruct_from_sensors
from rtof_kin.skeleton import MotionSequence, SkeletonModel
from rtof_kin.stream_faults import StreamFault
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence, Provenance

if TYPE_CHECKING:
    from lifting.predict import LiftedPoses

Array = NDArray[np.float64]
CAMERA_MODES = ("lift", "sf2", "rto", "rtof")
"""lift: the network alone. sf2: corrected by IMUs frame by frame. rto: optimised, vision alone.
rtof: sf2, then optimised with everything."""
MODES = (*CAMERA_MODES, "imu")
"""imu: no camera at all (`sensors_alone`)."""
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, in all)."""
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
    fragment: JointSpaceSettings | FragmentSettings | None = None
    """Of the fragment solver, and by their type its space; its defaults where not given."""
    frames: int = 50
    """N, frames in a fragment."""
    guard_streams: bool = True
    """Whether keypoints and sensors are looked through for what may be wrong with them, which is mended
    or left out (`Reconstruction.faults`)."""
    sensors_alone: SensorsAloneSettings = field(default_factory=SensorsAloneSettings)
    """Of mode imu: its frames, contacts and path."""


@dataclass(frozen=True)
class Reconstruction:
    """The result of `reconstruct`."""

    recording: Recording
    """As it was reconstructed: with its own calibration where it has one."""
    mode: str
    motion: MotionSequence
    """The motion of the subject's skeleton: configurations, poses, flags."""
    stages: dict[str, PoseSequence]
    """Poses after each stage that ran, by mode name, imu's first one being 'start'; the last is what
    `motion` was made from."""
    keypoints: KeypointSequence | None
    """The keypoints as used, evenly spaced in time; None in mode imu, which looks at none."""
    bone_imus: BoneImuSequence | None
    """The calibrated sensors at the motion's times; None in the modes that use none."""
    solution: FragmentSolution | None
    """What the fragment solver reports, in the modes that use it."""
    metrics: Metrics | None
    """Against the recording's truth; None without one."""
    stage_metrics: dict[str, Metrics]
    """The same of every stage; empty without truth."""
    root_sigma: Array | None = None
    """(T,) m, standard deviation of each horizontal coordinate of the root since the first frame, in mode
    imu, where it drifts; NaN where nothing tells of the root."""
    faults: tuple[StreamFault, ...] = ()
    """What was found wrong with keypoints and sensors, and what was done about it."""
    warnings: tuple[str, ...] = ()
    """What a user must know before relying on the motion, in sentences."""
    calibration: SelfCalibration | None = None
    """What was estimated of the recording and applied; None where it was told not to."""

    def export(
        self, folder: str | Path, overwrite: bool = False, formats: Sequence[str] = DEFAULT
    ) -> Path:
        """Write the motion, its URDF, files of the formats named and figures; see `rtof_kin.export`.

        Args:
            formats: any of `rtof_kin.motion_files.FORMATS`, e.g. ("osim", "mot", "trc").

        Raises:
            OutputExistsError: something stands there and overwriting was not asked for.
            UnknownNameError: no such format. ShapeError: a format cannot hold the motion.
        """
        from rtof_kin.export import export

        return export(self, folder, overwrite, formats=formats)


def reconstruct(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    mode: str = "rtof",
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool | CalibrationPriors | SelfCalibration = False,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct the motion of a recording.

    Args:
        recording: keypoints of one camera and, for sf2 and rtof, IMUs with their calibration; for imu
            these alone.
        skeleton: the subject's; from the recording where not given.
        mode: one of `MODES`.
        lifter: takes keypoints to 3D; the shipped one where not given, loaded only now.
        settings: of SF2, the fragment solver and mode imu.
        calibrate: whether the recording is calibrated from itself first (`calibrate_recording`), in the
            modes that use sensors; or the priors to do that with, or what to apply of an earlier one.
        progress: told how far each stage is.

    Raises:
        UnknownNameError: no such mode. ShapeError: the mode needs keypoints or IMUs and there are none;
            the person is behind the camera. Errors of the stages pass through.
    """
    if mode not in MODES:
        raise UnknownNameError("mode", [mode], MODES)
    settings = settings or ReconstructionSettings()
    tell = progress or (lambda stage, done, total: None)
    if mode == "imu":
        return _without_camera(recording, skeleton or recording.skeleton, settings, tell)
    if recording.keypoints is None:
        raise ShapeError(f"mode {mode} needs keypoints and the recording has none; use 'imu'")
    cleaned, faults = _guarded(recording, settings, camera=True)
    found = None
    if calibrate is not False and mode in ("sf2", "rtof"):
        found = calibrate if isinstance(calibrate, SelfCalibration) else _calibration(
            cleaned, skeleton, None if calibrate is True else calibrate, lifter, settings, tell
        )  # fmt: skip
        cleaned = found.apply(cleaned)
        skeleton = None if found.of_kind("bones") else skeleton
    stages = _Stages(cleaned, skeleton or cleaned.skeleton, mode, lifter, settings, tell, found)
    bone_imus = stages.bone_imus()
    poses, solution = stages.run(bone_imus)
    if mode == "rtof" and settings.guard_streams and bone_imus is not None:
        wrong = disagreeing(poses[mode], bone_imus, stages.skeleton)
        if wrong:
            faults, bone_imus = (*faults, *wrong), without(bone_imus, wrong)
            poses, solution = stages.run(bone_imus)
    for fault in faults:
        _log.warning("%s: %s", recording.name, fault)
    motion = stages.skeleton.motion(poses[mode])
    poses[mode] = motion.poses if mode != "lift" else poses[mode]
    scores = _scores(cleaned, poses, stages.skeleton)
    return Reconstruction(
        cleaned, mode, motion, poses, stages.seen(poses), bone_imus, solution, scores.get(mode), scores,
        faults=faults, calibration=found,
    )  # fmt: skip


def calibrate_recording(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    priors: CalibrationPriors | None = None,
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    progress: Progress | None = None,
) -> SelfCalibration:
    """Estimate what is not known well about a recording from itself; see `rtof_kin.self_calibrate`.

    Args:
        recording: with IMUs and their calibration, however rough.
        skeleton: the subject's; from the recording where not given.
        priors: what is open, and how well it is known before; `CalibrationPriors.of` the recording where
            not given.
        lifter, settings, progress: as for `reconstruct`.

    Raises:
        CalibrationError: there is nothing to calibrate by. Errors of the stages pass through.
    """
    settings = settings or ReconstructionSettings()
    tell = progress or (lambda stage, done, total: None)
    cleaned, faults = _guarded(recording, settings, camera=True)
    for fault in faults:
        _log.warning("%s: %s", recording.name, fault)
    return _calibration(cleaned, skeleton, priors, lifter, settings, tell)


def _calibration(
    recording: Recording, skeleton: SkeletonModel | None, priors: CalibrationPriors | None,
    lifter: LifterLike | None, settings: ReconstructionSettings, tell: Progress,
) -> SelfCalibration:  # fmt: skip
    """The same of a recording whose streams were looked through."""
    if skeleton is not None:
        recording = replace(
            recording, joint_offsets=skeleton.joint_offsets, height=None, bone_lengths=None
        )
    stages = _Stages(recording, recording.skeleton, "sf2", lifter, settings, tell)
    poses, _ = stages.run(stages.bone_imus())
    fragment = _on_floor(settings.fragment, recording.skeleton, recording.floor_height)
    return calibrate_from(
        replace(recording, keypoints=stages.keypoints),
        poses["sf2"],
        priors or CalibrationPriors.of(recording),
        fragment if isinstance(fragment, JointSpaceSettings) else None,
        settings.frames,
        lambda done, total: tell("calibrate", done, total),
    )


def _guarded(
    recording: Recording, settings: ReconstructionSettings, camera: bool
) -> tuple[Recording, tuple[StreamFault, ...]]:
    """A recording whose streams, the camera's too or not, were looked through; and what was found."""
    keypoints, imus, faults = recording.keypoints, recording.imus, tuple[StreamFault, ...]()
    if not settings.guard_streams:
        return recording, faults
    if camera and keypoints is not None:
        keypoints, faults = guarded_keypoints(keypoints)
    if imus is not None:
        imus, of_sensors = guarded_imus(imus)
        faults += of_sensors
    return (replace(recording, keypoints=keypoints, imus=imus) if faults else recording), faults


@dataclass(frozen=True)
class _Stages:
    """The stages of a mode that looks at keypoints."""

    recording: Recording
    skeleton: SkeletonModel
    mode: str
    lifter: LifterLike | None
    settings: ReconstructionSettings
    tell: Progress
    calibration: SelfCalibration | None = None
    """What was applied to the recording; of it what takes a pose to apply is applied here."""

    @cached_property
    def keypoints(self) -> KeypointSequence:
        """Evenly spaced in time."""
        if self.recording.keypoints is None:
            raise ShapeError("the recording has no keypoints; without them use mode 'imu'")
        return evenly_spaced(self.recording.keypoints)

    def bone_imus(self) -> BoneImuSequence | None:
        """Calibrated, at the keypoints' times; None in the modes that use none."""
        if self.mode not in ("sf2", "rtof"):
            return None
        found = replace(self.recording, keypoints=self.keypoints).bone_imus()
        if found is None:
            raise ShapeError(
                f"mode {self.mode} needs IMUs and the recording has none; use 'lift' or 'rto'"
            )
        return found

    def run(
        self, bone_imus: BoneImuSequence | None
    ) -> tuple[dict[str, PoseSequence], FragmentSolution | None]:
        """Poses after each stage, and what the fragment solver reports where it is one."""
        skeleton, settings, mode = self.skeleton, self.settings, self.mode
        floor_height = self.recording.floor_height
        self.tell("lift", 0, 1)
        told = bone_imus if settings.lift_with_sensors else None
        lifted, R_lifted = _lift(skeleton, self.keypoints, told, self.lifter, floor_height)
        self.tell("lift", 1, 1)
        poses = {"lift": lifted}
        if bone_imus is not None:
            ik = InertialGuidedIK(skeleton, settings.inertial_ik)
            poses["sf2"] = ik.refine(lifted, bone_imus, R_lifted)
        if mode not in ("rto", "rtof"):
            return poses, None
        solver = FragmentSolver(
            skeleton, settings.frames, _on_floor(settings.fragment, skeleton, floor_height)
        )
        start = poses.get("sf2") or InertialGuidedIK(skeleton).refine(lifted, None, R_lifted)
        seen = self.seen({"sf2": start})
        solution = solver.solve(start, seen, bone_imus, lambda i, n: self.tell(mode, i, n))
        poses[mode] = solution.poses
        return poses, solution

    def seen(self, poses: dict[str, PoseSequence]) -> KeypointSequence:
        """The keypoints as the solver has them."""
        if self.calibration is None:
            return self.keypoints
        return self.calibration.moved(self.keypoints, poses["sf2"])


def _without_camera(
    recording: Recording, skeleton: SkeletonModel, settings: ReconstructionSettings, tell: Progress
) -> Reconstruction:
    """Mode imu."""
    solver = settings.fragment
    if isinstance(solver, FragmentSettings):
        raise ShapeError("mode imu is solved in joint space; give JointSpaceSettings, or none")
    cleaned, faults = _guarded(recording, settings, camera=False)
    found = reconstruct_from_sensors(
        cleaned, skeleton, settings.sensors_alone, solver, settings.frames,
        lambda done, total: tell("imu", done, total),
    )  # fmt: skip
    for warning in (*faults, *found.warnings):
        _log.warning("%s: %s", recording.name, warning)
    motion = skeleton.motion(found.solution.poses)
    stages = {"start": found.start, "imu": motion.poses}
    scores = _scores(recording, _at_truth(recording, stages), skeleton)
    return Reconstruction(
        recording, "imu", motion, stages, None, found.bone_imus, found.solution, scores.get("imu"),
        scores, found.path.sigma, faults, found.warnings,
    )  # fmt: skip


def _at_truth(recording: Recording, stages: dict[str, PoseSequence]) -> dict[str, PoseSequence]:
    """Stages moved so that their roots begin where the true one does: where that is, no sensor knows."""
    if recording.truth is None:
        return stages
    truth, moved = recording.truth, {}
    for name, poses in stages.items():
        root = signals.interpolate(truth.times, truth.p_world_joint[:, 0], poses.times)
        known = np.flatnonzero(np.isfinite(root).all(axis=1))
        if len(known):
            shift = root[known[0]] - poses.p_world_joint[known[0], 0]
            poses = replace(poses, p_world_joint=poses.p_world_joint + shift)
        moved[name] = poses
    return moved


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


def _on_floor(
    settings: JointSpaceSettings | FragmentSettings | None,
    skeleton: SkeletonModel,
    floor_height: float | None,
) -> JointSpaceSettings | FragmentSettings | None:
    """The fragment solver's settings with the recording's floor, where they know floors and have none."""
    if settings is None and has_prior(skeleton.name):
        settings = JointSpaceSettings()
    if isinstance(settings, JointSpaceSettings) and settings.floor_height is None:
        return replace(settings, floor_height=floor_height)
    return settings


def _lift(
    skeleton: SkeletonModel,
    keypoints: KeypointSequence,
    bone_imus: BoneImuSequence | None,
    lifter: LifterLike | None,
    floor_height: float | None,
) -> tuple[PoseSequence, Array]:
    """The lifter's poses, orientations from positions where it gives none, and who saw what; and the
    orientations (T, J, 3, 3) that it gives, NaN where not."""
    if lifter is None:
        lifter = _shipped_lifter()
    result = lifter.predict(
        keypoints, skeleton.joint_offsets, bone_imus=bone_imus, floor_height=floor_height
    )
    p = np.asarray(result.p_world_joint)
    depth = keypoints.camera.to_camera(p)[..., 2]
    if np.any(depth <= 0):
        frame = int(np.argwhere(depth <= 0)[0][0])
        raise ShapeError(f"lifted pose of frame {frame} is behind the camera; check its extrinsics")
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    R = np.where(np.isfinite(result.R_world_bone), result.R_world_bone, R)
    seen = keypoints.select(skeleton.names).seen
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
        orientation_observed=skeleton.orientation_observed() & _enough_points(skeleton, seen),
        sigma_rad=result.sigma_rad,
    )
    return poses, result.R_world_bone


def _enough_points(skeleton: SkeletonModel, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T, J) whether at least three of a segment's joint and children were seen, as its three angles
    need."""
    out = np.zeros_like(seen)
    for j in range(len(skeleton.names)):
        own = [j, *kinematics.children_of(skeleton.parents, j)]
        out[:, j] = seen[:, own].sum(axis=1) >= 3
    return out


def _shipped_lifter() -> Any:
    from lifting.predict import Lifter

    return Lifter.load()


def _scores(
    recording: Recording, stages: dict[str, PoseSequence], skeleton: SkeletonModel
) -> dict[str, Metrics]:
    """Errors of every stage; none without truth, or with fewer than four frames of it."""
    if recording.truth is None:
        return {}
    first, last = recording.truth.times[[0, -1]]
    times = next(iter(stages.values())).times
    if np.count_nonzero((times >= first) & (times <= last)) < 4:
        _log.warning("the truth covers fewer than four frames: nothing is scored")
        return {}
    return {name: evaluate(poses, recording.truth, skeleton) for name, poses in stages.items()}
