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
    from rtof_kin.body.metrics import evaluate as evaluate
    from rtof_kin.body.skeleton import Motion as Motion
    from rtof_kin.body.skeleton import SkeletonModel as SkeletonModel
    from rtof_kin.calibration.result import SelfCalibration as SelfCalibration
    from rtof_kin.clinical.analysis import analyse as analyse
    from rtof_kin.core.errors import InvalidInputError as InvalidInputError
    from rtof_kin.core.errors import RtofError as RtofError
    from rtof_kin.data.camera import Camera as Camera
    from rtof_kin.data.imu import ImuCalibration as ImuCalibration
    from rtof_kin.data.imu import ImuSequence as ImuSequence
    from rtof_kin.data.keypoints import KeypointSequence as KeypointSequence
    from rtof_kin.data.poses import PoseSequence as PoseSequence
    from rtof_kin.live.estimator import OnlineEstimator as OnlineEstimator
    from rtof_kin.reconstruction.pipeline import reconstruct as reconstruct
    from rtof_kin.reconstruction.result import Reconstruction as Reconstruction
    from rtof_kin.reconstruction.settings import ReconstructionSettings as ReconstructionSettings
    from rtof_kin.recording.recording import Recording as Recording
    from rtof_kin.reporting.comparison import compare as compare
    from rtof_kin.reporting.export import export as export
    from rtof_kin.reporting.page import report as report
    from rtof_kin.setup.init import make_recording as make_recording
    from rtof_kin.setup.run import run as run
    from rtof_kin.solve.fragment_solver import FragmentSolver as FragmentSolver

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
__all__ = tuple(_HOME)


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
