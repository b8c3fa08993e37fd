"""Human motion from one ordinary camera and a handful of IMUs.

``from rtof_kin import SkeletonModel, FragmentSolver`` is the front door; `reconstruct` runs the whole
pipeline. Importing the package loads neither torch nor a plotting library, and what is named below only
when it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtof_kin.body.metrics import Metrics, evaluate
    from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
    from rtof_kin.calibration.priors import CalibrationPriors
    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.core.errors import RtofError
    from rtof_kin.data.camera import Camera
    from rtof_kin.data.imu import BoneImuSequence, ImuSequence
    from rtof_kin.data.imu_calibration import ImuCalibration
    from rtof_kin.data.keypoints import KeypointSequence
    from rtof_kin.data.poses import PoseSequence, Provenance
    from rtof_kin.reconstruction.pipeline import calibrate_recording, reconstruct
    from rtof_kin.reconstruction.result import Reconstruction
    from rtof_kin.reconstruction.settings import ReconstructionSettings
    from rtof_kin.recording.recording import Recording
    from rtof_kin.report.export import export
    from rtof_kin.solve.cartesian.settings import CartesianSettings
    from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver, SolverStatus
    from rtof_kin.solve.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
    from rtof_kin.solve.joint_space.settings import JointSpaceSettings

_HOME = {
    "BoneImuSequence": "data.imu",
    "CalibrationPriors": "calibration.priors",
    "Camera": "data.camera",
    "CartesianSettings": "solve.cartesian.settings",
    "FragmentSolution": "solve.fragment_solver",
    "FragmentSolver": "solve.fragment_solver",
    "ImuCalibration": "data.imu_calibration",
    "ImuSequence": "data.imu",
    "InertialGuidedIK": "solve.inertial_ik",
    "InertialGuidedIKSettings": "solve.inertial_ik",
    "JointSpaceSettings": "solve.joint_space.settings",
    "KeypointSequence": "data.keypoints",
    "Metrics": "body.metrics",
    "MotionSequence": "body.skeleton",
    "PoseSequence": "data.poses",
    "Provenance": "data.poses",
    "Reconstruction": "reconstruction.result",
    "ReconstructionSettings": "reconstruction.settings",
    "Recording": "recording.recording",
    "RtofError": "core.errors",
    "SelfCalibration": "calibration.result",
    "SkeletonModel": "body.skeleton",
    "SolverStatus": "solve.fragment_solver",
    "calibrate_recording": "reconstruction.pipeline",
    "evaluate": "body.metrics",
    "export": "report.export",
    "reconstruct": "reconstruction.pipeline",
}
__all__ = [
    "BoneImuSequence",
    "CalibrationPriors",
    "Camera",
    "CartesianSettings",
    "FragmentSolution",
    "FragmentSolver",
    "ImuCalibration",
    "ImuSequence",
    "InertialGuidedIK",
    "InertialGuidedIKSettings",
    "JointSpaceSettings",
    "KeypointSequence",
    "Metrics",
    "MotionSequence",
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
    from importlib.metadata import (  # takes longer than the rest of this file
        PackageNotFoundError,
        version,
    )

    try:
        return version("rtof_kin")
    except PackageNotFoundError:  # a clone that was not installed
        return "0+unknown"


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
