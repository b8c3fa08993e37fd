"""What `reconstruct` and `calibrate_recording` were called with, and the stages on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Prepared, Progress, prepare
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.solution import FragmentSolution

_LOWEST_ANKLE: Final = 0.02  #: [m] Lowest ankle over a floor; a lower estimate has another cause


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
        skeleton: SkeletonModel | None,
        lifter: LifterLike | None,
        settings: ReconstructionSettings | None,
        progress: Progress | None,
    ) -> Job:
        """Return the job for arguments of `reconstruct`; None stands for their defaults."""
        prior = getattr(lifter, "prior", None)
        if prior is not None:
            recording = replace(recording, model_prior=prior)
            skeleton = None if skeleton is None else skeleton.with_prior(prior)
        progress = progress or (lambda *_: None)
        return cls(recording, skeleton, lifter, settings or ReconstructionSettings(), progress)

    @property
    def subject(self) -> SkeletonModel:
        """The skeleton that was given, else that of the recording."""
        return self.skeleton or self.recording.skeleton

    def prepare(
        self, mode: Mode, rejected: tuple[StreamFault, ...] = (), calibration: SelfCalibration | None = None
    ) -> Prepared:
        """Prepare the recording."""
        return prepare(
            self.recording,
            self.subject,
            mode,
            self.lifter,
            self.settings,
            self.progress,
            rejected=rejected,
            calibration=calibration,
            times=self.times,
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
        return solver.solve(
            prepared.guess, clean.video, prepared.bone_imus, report, confidence=confidence, views=clean.views
        )

    def solved_again(
        self,
        recording: Recording,
        mode: Mode,
        rejected: tuple[StreamFault, ...] = (),
        calibration: SelfCalibration | None = None,
    ) -> tuple[Prepared, PoseSequence]:
        """Prepare and solve another version of the recording, without covariances."""
        own = replace(self, recording=recording)
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
