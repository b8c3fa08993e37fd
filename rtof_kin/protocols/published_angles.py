"""Published errors of joint angles from one camera, each with its metric; degrees.

A value stands beside this package's value of the same metric only. Those whose source could not be looked up
say so; movements, references and angles are those of their authors, so that even one metric is not a ranking.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from rtof_kin.clinical.angle_errors import ALL

Metric = Literal["rmse", "mae", "median"]
METRICS: Final[dict[Metric, str]] = {"rmse": "RMSE", "mae": "mean absolute error", "median": "median absolute error"}
_ONE_CAMERA: Final = "one camera, a monocular work of 2024 to 2026"
_NOT_VERIFIED: Final = "published value, source not verified"


@dataclass(frozen=True)
class PublishedError:
    """One published value."""

    system: str
    angle: str
    """Joint angle of this package, or `ALL`."""
    metric: Metric
    degrees: float
    source: str


PUBLISHED: Final = (
    PublishedError(_ONE_CAMERA, ALL, "median", 2.7, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "knee_flexion", "median", 2.1, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "ankle_dorsiflexion", "median", 3.6, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "elbow_flexion", "median", 3.9, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "hip_flexion", "median", 4.8, _NOT_VERIFIED),
    PublishedError(
        "OpenCap Monocular, one phone; walking, squats, sit-to-stand",
        ALL,
        "mae",
        4.8,
        "Gilon et al. 2026, arXiv:2603.24733, abstract",
    ),
    PublishedError(
        "video alone (MotionAGFormer) on VIDIMU, against its sensors",
        ALL,
        "rmse",
        9.3,
        "Medrano-Paredes et al. 2025, arXiv:2510.02264, abstract",
    ),
    PublishedError(
        "video alone (MotionAGFormer) on VIDIMU, against its sensors",
        ALL,
        "mae",
        7.9,
        "Medrano-Paredes et al. 2025, arXiv:2510.02264, abstract",
    ),
)
WITHOUT_METRIC: Final = (
    "A camera with uncalibrated sensors (Peiffer et al. 2024, arXiv:2405.17368): knee 2.9 degrees; "
    "published value, number and metric not verified, so that it stands beside none of ours."
)
