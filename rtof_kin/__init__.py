"""3D human motion from one camera and a few IMUs.

`reconstruct` runs the whole pipeline; `SkeletonModel` and `FragmentSolver` are its main parts. The names
below are imported when they are first used; torch and plotting libraries are not loaded.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtof_kin.body.metrics import Metrics, evaluate
    from rtof_kin.body.skeleton import Motion, SkeletonModel
    from rtof_kin.calibration.priors import CalibrationPriors
    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.core.errors import InvalidInputError, RtofError
    from rtof_kin.data.camera import Camera
    from rtof_kin.data.imu import BoneImuSequence, ImuCalibration, ImuSequence
    from rtof_kin.data.keypoints import KeypointSequence
    from rtof_kin.data.poses import PoseSequence, Provenance
    from rtof_kin.live.estimator import OnlineEstimator
    from rtof_kin.live.online_settings import OnlineSettings
    from rtof_kin.live.samples import FrameSample, ImuSample
    from rtof_kin.reconstruction.pipeline import reconstruct
    from rtof_kin.reconstruction.result import Reconstruction
    from rtof_kin.reconstruction.self_calibration import calibrate_recording
    from rtof_kin.reconstruction.settings import ReconstructionSettings
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.export import export
    from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver, SolverStatus
    from rtof_kin.solve.initial_guess import InertialGuidedIK, InertialGuidedIKSettings
    from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings

_MODULES = {
    "body.metrics": ("Metrics", "evaluate"),
    "body.skeleton": ("Motion", "SkeletonModel"),
    "calibration.priors": ("CalibrationPriors",),
    "calibration.result": ("SelfCalibration",),
    "core.errors": ("InvalidInputError", "RtofError"),
    "data.camera": ("Camera",),
    "data.imu": ("BoneImuSequence", "ImuCalibration", "ImuSequence"),
    "data.keypoints": ("KeypointSequence",),
    "data.poses": ("PoseSequence", "Provenance"),
    "live.estimator": ("OnlineEstimator",),
    "live.online_settings": ("OnlineSettings",),
    "live.samples": ("FrameSample", "ImuSample"),
    "reconstruction.pipeline": ("reconstruct",),
    "reconstruction.result": ("Reconstruction",),
    "reconstruction.settings": ("ReconstructionSettings",),
    "reconstruction.self_calibration": ("calibrate_recording",),
    "recording.recording": ("Recording",),
    "reporting.export": ("export",),
    "solve.fragment_solver": ("FragmentSolution", "FragmentSolver", "SolverStatus"),
    "solve.initial_guess": ("InertialGuidedIK", "InertialGuidedIKSettings"),
    "solve.settings": ("CartesianSettings", "JointSpaceSettings"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = [
    "BoneImuSequence",
    "CalibrationPriors",
    "Camera",
    "CartesianSettings",
    "FragmentSolution",
    "FragmentSolver",
    "FrameSample",
    "ImuCalibration",
    "ImuSample",
    "ImuSequence",
    "InertialGuidedIK",
    "InertialGuidedIKSettings",
    "InvalidInputError",
    "JointSpaceSettings",
    "KeypointSequence",
    "Metrics",
    "Motion",
    "OnlineEstimator",
    "OnlineSettings",
    "PoseSequence",
    "Provenance",
    "Reconstruction",
    "ReconstructionSettings",
    "Recording",
    "RtofError",
    "SelfCalibration",
    "SkeletonModel",
    "SolverStatus",
    "calibrate_recording",
    "evaluate",
    "export",
    "reconstruct",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _HOME:
        raise AttributeError(f"module 'rtof_kin' has no attribute {name!r}")
    return getattr(import_module(f"rtof_kin.{_HOME[name]}"), name)


def _version() -> str:
    """Return the installed version."""
    from importlib.metadata import PackageNotFoundError, version  # slow to import

    try:
        return version("rtof_kin")
    except PackageNotFoundError:  # a checkout that is not installed
        return "0+unknown"


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
