"""Published figures: the tables of the RTOF paper (Bao, Zhao, Qian, 2024), and errors of joint angles, degrees.

MPJPE in mm. MPJAE and MPJJE as printed: "per second" on Total Capture, "per frame" on Human3.6M; see
`TOTAL_CAPTURE_CAVEATS` for their units. A published error of an angle stands beside this package's value of the same
metric only. Those whose source could not be looked up say so; movements, references and angles are those of their
authors, so that even one metric is not a ranking.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from rtof_kin.clinical.angle_errors import ALL

NAMES_1 = ("seen W2", "seen A3", "seen FS3", "unseen W2", "unseen A3", "unseen FS3", "average")
"""Columns of table 1. The average of the paper's own rows is weighted by frames, that of IMUPVH is a plain
mean, and those of LSTM-AE and VP3D are neither."""

TABLE_1: dict[str, tuple[float | None, ...]] = {
    "LSTM-AE (4 cameras)": (13.0, 23.0, 47.0, 21.8, 40.9, 68.5, 34.1),
    "IMUPVH (8 cameras + IMUs)": (19.2, 42.3, 48.8, 24.7, 58.8, 61.8, 42.6),
    "Fusion-RPSM (4 cameras)": (19.0, 21.0, 28.0, 32.0, 33.0, 54.0, 29.0),
    "LWCDR (4 cameras)": (10.6, 16.3, 30.4, 27.0, 34.2, 65.0, 27.5),
    "DeepFuse (8 cameras + IMUs)": (None, None, None, None, None, None, 28.9),
    "GeoFuse (4 cameras + IMUs)": (14.3, 17.5, 25.9, 23.9, 27.8, 49.3, 24.6),
    "VIP (1 camera + IMUs)": (None, None, None, None, None, None, 26.0),
    "VP3D-SN, the paper's baseline (1 camera)": (23.6, 43.6, 89.9, 49.1, 87.8, 123.6, 64.6),
    "RTOF-SN, the paper's (1 camera + IMUs)": (15.7, 20.1, 47.3, 24.5, 50.5, 60.2, 33.7),
    "RTOF-GT, the paper's (1 camera + IMUs)": (10.8, 13.9, 32.6, 16.9, 34.8, 41.5, 23.2),
}
"""MPJPE on Total Capture. SN: 2D of a detector (SimpleNet); GT: ground-truth 2D."""

INERTIAL_ONLY: dict[str, tuple[float, float]] = {
    "DIP (6 IMUs)": (87.6, 159.1),
    "TransPose (6 IMUs)": (54.2, 77.2),
    "TIP (6 IMUs)": (52.7, 53.6),
    "RTOF-SN, the paper's (8 IMUs + 1 camera)": (33.7, 63.8),
}
"""MPJPE and MPJJE on Total Capture. (The paper's ablation gives 63.8 to RTOF-GT.)"""

ABLATION: dict[str, tuple[float, float, float]] = {
    "lift": (53.7, 2.70, 87.3),
    "rto": (40.6, 1.79, 55.2),
    "sf2": (34.5, 3.96, 185.4),
    "rtof": (23.2, 1.54, 63.8),
}
"""MPJPE, MPJAE, MPJJE on Total Capture with ground-truth 2D, by mode of this package."""

FRAGMENT_LENGTH: dict[int, tuple[float, float, float]] = {
    200: (227, 23.64, 59.01),
    100: (423, 23.27, 60.03),
    50: (743, 23.23, 63.84),
    20: (1256, 23.19, 77.31),
}
"""Output frames per second, MPJPE and MPJJE by N, frames in a fragment."""

VISUAL_WEIGHT: dict[float, tuple[float, float]] = {
    1.0: (23.29, 104.9),
    0.9: (23.23, 63.84),
    0.8: (23.23, 68.46),
    0.7: (23.24, 72.74),
    0.6: (23.26, 77.19),
}
"""MPJPE and MPJJE by k_V; k_I is 1 - k_V."""

HUMAN36M: dict[str, tuple[float, float, float]] = {
    "VideoPose3D (243 frames)": (46.8, 5.85, 47.74),
    "Anatomy3D": (44.1, 4.65, 37.25),
    "RTO-SN, the paper's": (46.1, 2.03, 11.25),
}
"""MPJPE, MPJAE, MPJJE on Human3.6M with detected 2D, root-aligned, "per frame"."""

TOTAL_CAPTURE_CAVEATS = (
    "The paper does not say whether its MPJPE is absolute or root-relative: both of ours are given.",
    "MPJAE in m/s2, MPJJE in m/s3: the units in which the paper's ranges are plausible; it prints none.",
    "Against the raw ground truth no output without motion above 15 Hz can have an MPJJE much below 90: "
    "compare the rows of the truth itself, low-passed at 6 Hz, and of no motion at all, computed by the "
    "same code. The paper's 55.2 and 63.8 were taken on smoother ground truth, or normalised otherwise.",
)
"""Notes under every table with the paper's figures on Total Capture."""

HUMAN36M_CAVEATS = (
    "MPJPE after aligning the roots. MPJAE and MPJJE per frame: mm/frame2 and mm/frame3 at 50 Hz.",
    "The mean jerk error is at most twice the mean acceleration error per frame, so the paper's pairs "
    "(such as 2.03 and 11.25) cannot be these two figures of one method in one unit.",
)
"""Notes under the table of Human3.6M."""

Metric = Literal["rmse", "mae", "median"]
METRICS: Final[dict[Metric, str]] = {"rmse": "RMSE", "mae": "mean absolute error", "median": "median absolute error"}
_ONE_CAMERA: Final = "one camera, a monocular work of 2024 to 2026"
_OPENCAP: Final = "OpenCap Monocular, one phone; walking, squats, sit-to-stand"
_VIDIMU: Final = "video alone (MotionAGFormer) on VIDIMU, against its sensors"
_NOT_VERIFIED: Final = "published value, source not verified"


class PublishedError(NamedTuple):
    """One published error of joint angles from one camera."""

    system: str
    angle: str  #: Joint angle of this package, or `ALL`
    metric: Metric
    degrees: float
    source: str


PUBLISHED: Final = (
    PublishedError(_ONE_CAMERA, ALL, "median", 2.7, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "knee_flexion", "median", 2.1, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "ankle_dorsiflexion", "median", 3.6, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "elbow_flexion", "median", 3.9, _NOT_VERIFIED),
    PublishedError(_ONE_CAMERA, "hip_flexion", "median", 4.8, _NOT_VERIFIED),
    PublishedError(_OPENCAP, ALL, "mae", 4.8, "Gilon et al. 2026, arXiv:2603.24733, abstract"),
    PublishedError(_VIDIMU, ALL, "rmse", 9.3, "Medrano-Paredes et al. 2025, arXiv:2510.02264, abstract"),
    PublishedError(_VIDIMU, ALL, "mae", 7.9, "Medrano-Paredes et al. 2025, arXiv:2510.02264, abstract"),
)
WITHOUT_METRIC: Final = (
    "A camera with uncalibrated sensors (Peiffer et al. 2024, arXiv:2405.17368): knee 2.9 degrees; "
    "published value, number and metric not verified, so that it stands beside none of ours."
)
