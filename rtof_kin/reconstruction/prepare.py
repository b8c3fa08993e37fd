"""`Job`: what `reconstruct` was called with, and its stages; `Prepared`: clean streams, lift, SF2 and the start."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.outlier_rejection import mask_faults, merge_faults, missing_samples, reject_imu_outliers
from rtof_kin.inertial.root_path import FEET, ContactPoints, Contacts, by_hand, contact_points
from rtof_kin.reconstruction.camera_evidence import without_heading_drift
from rtof_kin.reconstruction.external_lift import Agreement, external
from rtof_kin.reconstruction.lift import Lifted, LifterLike, fused, lift
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.initial_guess import InertialGuidedIK, InitialGuess, initial_guess
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.solution import FragmentSolution
from rtof_kin.vision.outlier_rejection import gaps, reject_keypoint_outliers

Progress = Callable[[str, int, int], None]  #: Called with (stage, steps done, steps in all)
_SLOWEST_HZ, _FASTEST_HZ = 2.0, 2000.0  #: Frame rates that a video of a moving person may have
_LOWEST_ANKLE: Final = 0.02  #: [m] Lowest ankle over a floor; a lower estimate has another cause
_log = logging.getLogger(__name__)


def silent(*_: object) -> None:
    """Take progress and say nothing; a process that is started can be given it."""


@dataclass(frozen=True)
class Job:
    """What `reconstruct` was called with; the bodies have the lifter's pose prior if it has one."""

    recording: Recording
    skeleton: SkeletonModel | None
    lifter: LifterLike | None
    settings: ReconstructionSettings
    progress: Progress
    times: Array | None = None
    """(T,) s of the frames, evenly spaced, on the clock of the keypoints; in mode imu, of the sensors. None:
    those of the recording, evenly spaced where they are not."""

    @classmethod
    def of(
        cls,
        recording: Recording,
        skeleton: SkeletonModel | None = None,
        lifter: LifterLike | None = None,
        settings: ReconstructionSettings | None = None,
        progress: Progress | None = None,
    ) -> Job:
        """Return the job for arguments of `reconstruct`; None stands for their defaults."""
        prior = getattr(lifter, "prior", None)
        if prior is not None:
            recording = replace(recording, model_prior=prior)
            skeleton = None if skeleton is None else skeleton.with_prior(prior)
        return cls(recording, skeleton, lifter, settings or ReconstructionSettings(), progress or silent)

    def sensed(self, mode: Mode) -> bool:
        """Return whether a mode uses the recording's sensors beside the image."""
        return mode in ("sf2", "rtof") and self.recording.imus is not None

    @property
    def subject(self) -> SkeletonModel:
        """The skeleton that was given, else that of the recording."""
        return self.skeleton or self.recording.skeleton

    def prepare(
        self, mode: Mode, rejected: tuple[StreamFault, ...] = (), calibration: SelfCalibration | None = None
    ) -> Prepared:
        """Clean the streams, lift the video and, with sensors, correct the lift by SF2.

        `rejected`: intervals of sensors that are not used, by segment. `calibration`: that was applied before.
        `InvalidInputError`: times or points are in another unit; there are no keypoints, or no IMUs in a mode that
        needs them. `ViewError`: the person is behind the camera.
        """
        if self.recording.keypoints is None:
            raise InvalidInputError("the recording has no keypoints; without them use mode 'imu'")
        settings, skeleton = self.settings, self.subject
        _check_units(self.recording.video)
        recording, faults = cleaned(self.recording, settings)
        keypoints = evenly_spaced(recording.video, self.times)
        views = tuple(view.resample(keypoints.times) for view in recording.views)
        recording = replace(recording, keypoints=keypoints, views=views)
        bone_imus = recording.bone_imus() if mode in ("sf2", "rtof") else None
        if mode in ("sf2", "rtof") and bone_imus is None:
            raise InvalidInputError(f"mode {mode} needs IMUs and the recording has none; use 'lift' or 'rto'")
        if bone_imus is not None and rejected:
            bone_imus = mask_faults(bone_imus, rejected)
        if bone_imus is not None and keypoints.camera.heading_drift:
            keypoints = without_heading_drift(keypoints, bone_imus, skeleton, self.lifter)
            recording = replace(recording, keypoints=keypoints)
        sensors = bone_imus if settings.lift_with_sensors else None
        lifts, cameras = [], (keypoints, *views)
        for i, seen in enumerate(cameras):
            self.progress("lift", i, len(cameras))
            lifts.append(lift(seen, skeleton, self.lifter, sensors, recording.floor_height))
        self.progress("lift", len(cameras), len(cameras))
        others = [external(other, lifts[0], keypoints, skeleton, bone_imus) for other in recording.lifts]
        used = [other for other, agreement in others if not agreement.doubt]
        lifted = fused([*lifts, *used], [*cameras, *(keypoints for _ in used)], skeleton)
        stages, start = _refined(lifted, skeleton, mode, bone_imus)
        agreements = tuple(agreement for _, agreement in others)
        return Prepared(
            recording, skeleton, lifted, bone_imus, stages, start, faults, settings, calibration, rejected, agreements
        )

    def calibrated(self, calibration: SelfCalibration | None) -> Job:
        """Return the job on the calibrated recording, or as it is for None, with its fragment solver's settings."""
        job = self
        if calibration is not None:
            skeleton = None if calibration.of_kind("bones") else self.skeleton
            times = None if self.times is None else calibration.on_clock(self.times)
            recording = calibration.apply(self.recording)
            job = replace(self, recording=recording, skeleton=skeleton, times=times)
        return job.with_solver(calibration)

    def with_solver(self, calibration: SelfCalibration | None) -> Job:
        """Return the job with the settings of the fragment solver, on the recording's floor if it has one;
        `calibration`: of the recording, which may have raised the ankles.
        """
        solver = self.settings.solver(self.subject)
        if isinstance(solver, JointSpaceSettings) and solver.floor_height is None:
            higher = 0.0 if calibration is None else calibration.ankle_height
            ankles = max(solver.ankle_height + higher, _LOWEST_ANKLE)
            solver = replace(solver, floor_height=self.recording.floor_height, ankle_height=ankles)
        return replace(self, settings=self.settings.with_fragment(solver))

    def solve(self, prepared: Prepared, confidence: bool, stage: str = "") -> FragmentSolution:
        """Optimise the prepared poses; progress is reported under the name `stage`, unless empty."""
        places = None  # Cartesian space: all segments that may carry a sensor
        if isinstance(self.settings.fragment, JointSpaceSettings):
            places = self._sensor_places(prepared.skeleton)
        solver = FragmentSolver(prepared.skeleton, self.settings.frames, self.settings.fragment, places)
        report, clean = (lambda i, n: self.progress(stage, i, n)) if stage else None, prepared.recording
        stand = self._standing_by_hand(prepared.guess.poses)
        return solver.solve(
            prepared.guess, clean.video, prepared.bone_imus, report, stand, confidence=confidence, views=clean.views
        )

    def _standing_by_hand(self, poses: PoseSequence) -> ContactPoints | None:
        """Return where feet stand that were said to; None where none was, or there is no term for them."""
        solver, feet = self.settings.fragment, tuple(name for name in FEET if name in poses.names)
        nowhere = Contacts(feet, np.zeros((len(poses), len(feet)), dtype=bool))
        contacts = by_hand(nowhere, poses.times, self.recording.corrections)
        if not isinstance(solver, JointSpaceSettings) or not contacts.standing.any():
            return None
        height = None if solver.floor_height is None else solver.floor_height + solver.ankle_height
        return contact_points(contacts, poses.p_world_joint[:, [poses.names.index(foot) for foot in feet]], height)

    def solved_again(
        self,
        recording: Recording,
        mode: Mode,
        rejected: tuple[StreamFault, ...] = (),
        calibration: SelfCalibration | None = None,
    ) -> tuple[Prepared, PoseSequence]:
        """Prepare and solve another version of the recording, without covariances and progress."""
        own = replace(self, recording=recording, progress=silent)
        prepared = own.prepare(mode, rejected, calibration)
        return prepared, own.solve(prepared, confidence=False).poses

    def _sensor_places(self, skeleton: SkeletonModel) -> tuple[str, ...]:
        """Segments for which the problem has room for a sensor: those that the recording or the settings
        name, used in this mode or not, so that all modes share one compilation.
        """
        places, imus = {*self.settings.sensor_joints}, self.recording.imus
        if self.recording.calibration is not None and imus is not None:
            pairs = zip(self.recording.calibration.sensors, self.recording.calibration.joints, strict=True)
            places |= {joint for sensor, joint in pairs if sensor in imus.names}
        return tuple(joint for joint, _ in skeleton.sensors.values() if joint in places)


@dataclass(frozen=True)
class Prepared:
    """A recording made ready for calibration and the fragment solver."""

    recording: Recording
    """Streams without outliers, keypoints evenly spaced, those of further cameras at the same times."""
    skeleton: SkeletonModel
    lifted: Lifted
    bone_imus: BoneImuSequence | None  #: Calibrated sensors at the keypoints' times, in the modes that use sensors
    stages: dict[str, PoseSequence]  #: Poses after 'lift' and, with sensors, 'sf2'
    start: PoseSequence  #: Poses that the solver starts from: those of SF2; without sensors the lift with rigid bones
    outliers: tuple[StreamFault, ...]
    settings: ReconstructionSettings
    calibration: SelfCalibration | None = None  #: The self-calibration that was applied to the recording before
    rejected: tuple[StreamFault, ...] = ()
    """Intervals of sensors that are not used because they contradict the motion, by segment."""
    others: tuple[Agreement, ...] = ()  #: How the points of other models agree with the own lift

    @property
    def faults(self) -> tuple[StreamFault, ...]:
        """Outliers and rejected sensors."""
        return (*self.outliers, *self.rejected)

    @cached_property
    def guess(self) -> InitialGuess:
        """What the fragment solver and the calibration start from."""
        solver = self.settings.solver(self.skeleton)
        sensors = self.bone_imus if isinstance(solver, JointSpaceSettings) else None
        return initial_guess(
            self.start,
            self.recording.video,
            sensors,
            self.skeleton,
            refit_root=solver.refit_root,
            views=self.recording.views,
        )

    def without(self, wrong: tuple[StreamFault, ...]) -> Prepared:
        """Return the same with further intervals of sensors rejected, by segment; SF2 runs again on the same lift."""
        assert self.bone_imus is not None
        bone_imus = mask_faults(self.bone_imus, wrong)
        stages, start = _refined(self.lifted, self.skeleton, "rtof", bone_imus)
        rejected = merge_faults((*self.rejected, *wrong))
        return replace(self, bone_imus=bone_imus, stages=stages, start=start, rejected=rejected)


def _refined(
    lifted: Lifted, skeleton: SkeletonModel, mode: Mode, bone_imus: BoneImuSequence | None
) -> tuple[dict[str, PoseSequence], PoseSequence]:
    """Poses by stage, and those that the solver starts from."""
    stages = {"lift": lifted.poses}
    if bone_imus is not None:
        stages["sf2"] = InertialGuidedIK(skeleton).refine(lifted.poses, bone_imus, lifted.R_world_bone)
    elif mode == "rto":
        return stages, InertialGuidedIK(skeleton).refine(lifted.poses, None, lifted.R_world_bone)
    return stages, stages.get("sf2", lifted.poses)


def _check_units(keypoints: KeypointSequence) -> None:
    """Raise where times or points are surely in another unit."""
    times, uv = keypoints.times, keypoints.uv_px
    seconds = float(times[-1] - times[0])
    if len(times) > 1 and not _SLOWEST_HZ <= (len(times) - 1) / seconds <= _FASTEST_HZ:
        raise InvalidInputError(
            f"keypoints: times make {(len(times) - 1) / seconds:.3g} frames a second; give them in "
            "seconds (are they milliseconds, or frame numbers?)"
        )
    if keypoints.seen.any() and np.nanmax(np.nanmax(uv, axis=(0, 1)) - np.nanmin(uv, axis=(0, 1))) < 3.0:
        raise InvalidInputError(
            "keypoints: all points of all frames lie within 3 px; where they are shares of the image, "
            "multiply x by its width and y by its height"
        )


def cleaned(
    recording: Recording, settings: ReconstructionSettings, camera: bool = True
) -> tuple[Recording, tuple[StreamFault, ...]]:
    """Return the recording without outliers, and what was found."""
    guards, faults, cameras = settings.guards, list[StreamFault](), list[KeypointSequence]()
    imus, keypoints, missing = recording.imus, recording.keypoints, missing_data(recording)
    for i, view in enumerate((keypoints, *recording.views) if camera and keypoints is not None else ()):
        clean, found = reject_keypoint_outliers(view, sides="sides" in guards, person="person" in guards)
        cameras.append(clean)
        faults += (replace(fault, what=f"{fault.what} of view {i}") for fault in found) if i else found
    if "samples" in guards and imus is not None:
        imus, of_sensors = reject_imu_outliers(imus)
        faults += of_sensors
    faults += missing
    if cameras:
        recording = replace(recording, keypoints=cameras[0], views=tuple(cameras[1:]))
    return replace(recording, imus=imus), tuple(faults)


def missing_data(recording: Recording) -> Iterator[StreamFault]:
    """Yield intervals of the video in which nobody is seen, and those without samples of sensors."""
    if recording.keypoints is None:
        return
    yield from gaps(recording.keypoints)
    if recording.imus is not None:
        a, b = recording.keypoints.times[[0, -1]]
        yield from missing_samples(recording.imus, float(a), float(b))


def evenly_spaced(keypoints: KeypointSequence, times: Array | None = None) -> KeypointSequence:
    """Return keypoints at even time steps, as finite differences need them.

    Positions are interpolated between neighbouring samples; dropped frames are NaN with confidence 0.

    Args:
        keypoints: at increasing times. times: (T,) s, evenly spaced; by default `even_times`.
    """
    even = even_times(keypoints.times) if times is None else times
    if np.array_equal(even, keypoints.times):
        return keypoints
    step = float(np.median(np.diff(even)))
    if times is None:
        _log.warning(
            "keypoint times are uneven: %d samples resampled to %d even frames of %.1f ms",
            len(keypoints),
            len(even),
            1000 * step,
        )
    at = _snapped(even, keypoints.times, 0.01 * step)
    return keypoints.interpolated(even, at, 1.5 * step)


def even_times(times: Array) -> Array:
    """Return times (T',) s that jitter by less than 1 % of a frame as they are, others evenly spaced at the mean rate,
    dropped frames counted; `times`: (T,) s, increasing.
    """
    if len(times) < 3:
        return times
    steps = np.diff(times)
    usual = np.median(steps)
    if np.all(np.abs(steps - usual) < 0.01 * usual):
        return times
    frames = max(int(np.round(steps / usual).sum()), 1)
    return np.linspace(times[0], times[-1], frames + 1)


def _snapped(at: Array, times: Array, tolerance: float) -> Array:
    """Instants `at`, moved onto a sample time that is closer than the tolerance: rounding is no gap."""
    right = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    left = right - 1
    nearest = np.where(at - times[left] < times[right] - at, times[left], times[right])
    return np.where(np.abs(nearest - at) < tolerance, nearest, at)
