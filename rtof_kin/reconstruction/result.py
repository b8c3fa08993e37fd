"""The result of a reconstruction, and the choices that made it. It knows no file format and no figure."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rtof_kin.body.metrics import Metrics, at_times, stage_metrics
from rtof_kin.body.skeleton import Motion
from rtof_kin.calibration.camera_estimate import CameraEstimate
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.core.choices import Calibrate, Mode
from rtof_kin.core.environment import threads
from rtof_kin.core.numerics.c_compiler import evaluated
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.external_lift import Agreement
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.solution import FragmentSolution

if TYPE_CHECKING:
    from rtof_kin.reconstruction.certificate import Certificate

_NOT_ENERGY = ("compile", "floor_height", "ankle_height", "tolerance", "max_iterations")
"""Fields of the solver's settings that leave the energy the same."""


@dataclass(frozen=True)
class Choices:
    """How a reconstruction was made."""

    calibrate: Calibrate = "no"
    known: bool = False  #: A calibration of another recording of the same person was applied
    lifter: str | None = None  #: Name or file of the lifter
    settings: ReconstructionSettings | None = None
    """As used, with those of the fragment solver in the modes that optimise."""

    def plain(self) -> dict[str, Any]:
        """Return the choices as JSON values; null is what was not used."""
        s = self.settings or ReconstructionSettings()
        fragment = s.fragment
        space = {JointSpaceSettings: "joint", CartesianSettings: "cartesian"}.get(type(fragment))
        return {
            "space": space,
            "energy": None if fragment is None else _energy_name(fragment),
            "frames": None if fragment is None else s.frames,
            "guards": ",".join(s.guards),
            "lift_with_sensors": s.lift_with_sensors,
            "lifter": self.lifter,
            "calibrate": self.calibrate,
            "known_of_another_recording": self.known,
            "threads": threads(),
            "fragment": None if fragment is None else asdict(fragment),
        }


@dataclass(frozen=True)
class Reconstruction:
    """The result of `reconstruct`."""

    recording: Recording  #: Input after self-calibration
    mode: Mode
    motion: Motion  #: Configurations, poses, flags and, in modes rto and rtof in joint space, pose covariances
    stages: dict[str, PoseSequence]  #: Poses after each stage by mode name; the first one of mode imu is 'start'
    keypoints: KeypointSequence | None  #: Keypoints as used, evenly spaced in time; None in mode imu
    bone_imus: BoneImuSequence | None  #: Calibrated sensors at the motion's times; None in modes without sensors
    solution: FragmentSolution | None  #: Report of the fragment solver, in the modes that optimise
    root_sigma: Array | None = None
    """(T,) m, standard deviation of each horizontal root coordinate since the first frame, in mode imu,
    where it drifts; NaN where the root is unobserved."""
    faults: tuple[StreamFault, ...] = ()  #: Faults of keypoints and sensors, and how they were handled
    warnings: tuple[str, ...] = ()  #: Limitations of the motion, in sentences
    calibration: SelfCalibration | None = None  #: The self-calibration that was applied
    delay: Quantity | None = None
    """Delay of the video relative to the sensors' clock, found before the calibration; None without sensors
    or where the motion does not show it."""
    camera: CameraEstimate | None = None
    """What was assumed and found of a camera that is not calibrated; None for a calibrated one."""
    checks: tuple[Check, ...] = ()  #: Checks of what the recording declares; failed ones name a likely cause
    choices: Choices = field(default_factory=Choices)
    certificate: Certificate | None = None  #: What left-out sensors say; None where it was not asked for
    position_errors: PositionErrors | None = None  #: What is left open of positions in world; None without keypoints
    lifts: tuple[Agreement, ...] = ()  #: How the points of other models agree; of a long recording in its first part
    parts: tuple[Reconstruction, ...] = ()  #: Those that a long recording was reconstructed in
    evaluated: str = field(default_factory=evaluated)  #: How its process evaluated the energy: compiled, or not
    stage_metrics: dict[str, Metrics] = field(default_factory=dict)
    """Errors of every stage against the recording's truth; empty without one."""

    def __post_init__(self) -> None:
        if self.motion.corrections != self.recording.corrections:
            object.__setattr__(self, "motion", replace(self.motion, corrections=self.recording.corrections))

    @property
    def metrics(self) -> Metrics | None:
        """Errors of the motion; None without a truth."""
        return self.stage_metrics.get(self.mode)

    def scored(self) -> Reconstruction:
        """Return the reconstruction with its errors."""
        truth, body = self.recording.truth, self.motion.skeleton
        return replace(self, stage_metrics=stage_metrics(self.stages, truth, body, self.mode))


def _energy_name(settings: JointSpaceSettings | CartesianSettings) -> str:
    """'default', 'as printed' or 'own'."""
    usual: dict[str, JointSpaceSettings | CartesianSettings] = {
        "default": type(settings)(),
        "as printed": CartesianSettings.paper(),
    }
    own, *of_usual = (
        {name: value for name, value in vars(one).items() if name not in _NOT_ENERGY}
        for one in (settings, *usual.values())
    )
    return next((name for name, other in zip(usual, of_usual, strict=True) if other == own), "own")


def measurements_of(result: Reconstruction) -> Measurements:
    """Return the measurements at the times of the motion, corrected by the calibration that was applied."""
    recording, times = result.recording, result.motion.poses.times
    seen = () if result.keypoints is None else (result.keypoints, *recording.views)
    measured, calibration = result.bone_imus, recording.calibration
    sensors: dict[str, Any] = {}
    if measured is not None and calibration is not None:
        measured = measured.resample(times)
        names = (calibration.sensors[calibration.joints.index(joint)] for joint in measured.joints)
        own = calibration.select(tuple(names))
        R_bone_sensor = np.swapaxes(own.R_sensor_bone, -1, -2)
        sensors = {
            "sensors": own.sensors,
            "segments": measured.joints,
            "R_world_sensor": measured.R_world_bone @ R_bone_sensor,
            "R_bone_sensor": R_bone_sensor,
            "p_bone_sensor": own.p_bone_sensor,
        }
    return Measurements(
        times=times,
        views=tuple(view.resample(times).landmarks for view in seen),
        **sensors,
        truth=None if recording.truth is None else at_times(recording.truth, times),
        faults=result.faults,
        floor_height=recording.floor_height,
    )
