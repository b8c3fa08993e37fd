"""3D human motion from one camera and a few IMUs.

`run` goes from a video and sensors to a report; `make_recording`, `reconstruct`, `analyse`, `report`, `export`,
`compare` and `evaluate` are its steps and what follows. `SkeletonModel` and `FragmentSolver` are the main parts.
The names below are imported when they are first used; torch and plotting libraries are not loaded. Settings and
internals are in the modules.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtof_kin.body.metrics import evaluate
    from rtof_kin.body.skeleton import Motion, SkeletonModel
    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.clinical.analysis import analyse
    from rtof_kin.core.errors import InvalidInputError, RtofError
    from rtof_kin.data.camera import Camera
    from rtof_kin.data.imu import ImuCalibration, ImuSequence
    from rtof_kin.data.keypoints import KeypointSequence
    from rtof_kin.data.poses import PoseSequence
    from rtof_kin.live.estimator import OnlineEstimator
    from rtof_kin.reconstruction.pipeline import reconstruct
    from rtof_kin.reconstruction.result import Reconstruction
    from rtof_kin.reconstruction.settings import ReconstructionSettings
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.comparison import compare
    from rtof_kin.reporting.export import export
    from rtof_kin.reporting.page import report
    from rtof_kin.setup.init import make_recording
    from rtof_kin.setup.run import run
    from rtof_kin.solve.fragment_solver import FragmentSolver

_HOME = {
    "Camera": "data.camera",
    "FragmentSolver": "solve.fragment_solver",
    "ImuCalibration": "data.imu",
    "ImuSequence": "data.imu",
    "InvalidInputError": "core.errors",
    "KeypointSequence": "data.keypoints",
    "Motion": "body.skeleton",
    "OnlineEstimator": "live.estimator",
    "PoseSequence": "data.poses",
    "Reconstruction": "reconstruction.result",
    "ReconstructionSettings": "reconstruction.settings",
    "Recording": "recording.recording",
    "RtofError": "core.errors",
    "SelfCalibration": "calibration.result",
    "SkeletonModel": "body.skeleton",
    "analyse": "clinical.analysis",
    "compare": "reporting.comparison",
    "evaluate": "body.metrics",
    "export": "reporting.export",
    "make_recording": "setup.init",
    "reconstruct": "reconstruction.pipeline",
    "report": "reporting.page",
    "run": "setup.run",
}
__all__ = [
    "Camera",
    "FragmentSolver",
    "ImuCalibration",
    "ImuSequence",
    "InvalidInputError",
    "KeypointSequence",
    "Motion",
    "OnlineEstimator",
    "PoseSequence",
    "Reconstruction",
    "ReconstructionSettings",
    "Recording",
    "RtofError",
    "SelfCalibration",
    "SkeletonModel",
    "analyse",
    "compare",
    "evaluate",
    "export",
    "make_recording",
    "reconstruct",
    "report",
    "run",
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
