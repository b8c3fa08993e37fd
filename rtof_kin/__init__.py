"""Human motion from one ordinary camera and a handful of IMUs.

``from rtof_kin import SkeletonModel, FragmentSolver`` is the front door; `reconstruct` runs the whole
pipeline. Importing the package loads neither torch nor a plotting library, and what is named below only
when it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtof_kin.calibration import ImuCalibration
    from rtof_kin.calibration_priors import CalibrationPriors
    from rtof_kin.errors import RtofError
    from rtof_kin.fragment import FragmentSolution, FragmentSolver, SolverStatus
    from rtof_kin.fragment_settings import FragmentSettings
    from rtof_kin.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
    from rtof_kin.joint_space.settings import JointSpaceSettings
    from rtof_kin.metrics import Metrics, evaluate
    from rtof_kin.pipeline import (
        Reconstruction,
        ReconstructionSettings,
        calibrate_recording,
        reconstruct,
    )
    from rtof_kin.recording import Recording
    from rtof_kin.self_calibration import SelfCalibration
    from rtof_kin.skeleton import MotionSequence, SkeletonModel
    from rtof_kin.types import (
        BoneImuSequence,
        Camera,
        ImuSequence,
        KeypointSequence,
        PoseSequence,
        Provenance,
    )

_HOME = {
    "BoneImuSequence": "types",
    "CalibrationPriors": "calibration_priors",
    "Camera": "types",
    "FragmentSettings": "fragment_settings",
    "FragmentSolution": "fragment",
    "FragmentSolver": "fragment",
    "ImuCalibration": "calibration",
    "ImuSequence": "types",
    "InertialGuidedIK": "inertial_ik",
    "InertialGuidedIKSettings": "inertial_ik",
    "JointSpaceSettings": "joint_space.settings",
    "KeypointSequence": "types",
    "Metrics": "metrics",
    "MotionSequence": "skeleton",
    "PoseSequence": "types",
    "Provenance": "types",
    "Reconstruction": "pipeline",
    "ReconstructionSettings": "pipeline",
    "Recording": "recording",
    "RtofError": "errors",
    "SelfCalibration": "self_calibration",
    "SkeletonModel": "skeleton",
    "SolverStatus": "fragment",
    "calibrate_recording": "pipeline",
    "evaluate": "metrics",
    "reconstruct": "pipeline",
}
__all__ = [
    "BoneImuSequence",
    "CalibrationPriors",
    "Camera",
    "FragmentSettings",
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
