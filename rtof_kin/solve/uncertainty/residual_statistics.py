"""Statistics of a recording's errors for `CovarianceInflation.apply`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.array_types import Array
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.energy.frame_energy import TORSO
from rtof_kin.solve.uncertainty.covariance_inflation import USUAL_TORSO_SIGMA, ResidualStatistics
from rtof_kin.vision.image_points import image_points, measurements

_LAG: Final = 1 / 15
"""[s] Lag of the autocorrelation."""
_DETECTORS_CORRELATION: Final = 0.8
"""Autocorrelation with a detector: the median of the fitted recordings."""
_NORMAL_MEDIAN: Final = 0.6745
"""Median of the absolute values of a standard normal distribution."""
_OUTLIER: Final = 3.0
"""[sigma] at which residuals are clipped."""
_FEWEST: Final = 100
"""Residuals that an estimate needs."""


def residual_statistics(
    keypoints: KeypointSequence, motion: MotionSequence, lifted: PoseSequence, sensors: Sequence[str] = ()
) -> ResidualStatistics:
    """Return the statistics of a reconstructed recording.

    Args:
        keypoints: as used, evenly spaced, at the motion's times. motion: compared with them.
        lifted: the lifter's poses with their standard deviations (`PoseSequence.sigma_rad`).
        sensors: joints whose segments carry one.
    """
    keypoints = measurements(keypoints, motion.skeleton)
    points, poses = image_points(motion.skeleton, keypoints.names), motion.poses
    at = points.positions(poses.p_world_joint, poses.R_world_bone)
    r = autocorrelation(keypoints.uv_px - keypoints.camera.project(at), keypoints.times)
    torso = lifted.sigma_rad[:, motion.skeleton.index(*TORSO)]
    sigmas = torso[np.isfinite(torso)]
    return ResidualStatistics(
        tuple(sensors),
        1.0 if r is None else float(np.clip(r / _DETECTORS_CORRELATION, 0.0, 1.0)),
        float(np.median(sigmas)) if len(sigmas) else USUAL_TORSO_SIGMA,
    )


def autocorrelation(residuals_px: Array, times: Array) -> float | None:
    """Return the autocorrelation of residuals about zero, at a fifteenth of a second; None for too few.

    Args:
        residuals_px: (T, L, 2) px, NaN where unobserved. times: (T,) s, evenly spaced.
    """
    step = max(1, round(_LAG * (len(times) - 1) / (times[-1] - times[0]))) if len(times) > 1 else 1
    size = np.nanmedian(np.abs(residuals_px)) if np.isfinite(residuals_px).any() else 0.0
    most = _OUTLIER * size / _NORMAL_MEDIAN
    cut = np.clip(residuals_px, -most, most)
    earlier, later = cut[:-step], cut[step:]
    both = np.isfinite(earlier + later)
    if both.sum() < _FEWEST or size == 0.0:
        return None
    return float(np.sum(earlier[both] * later[both]) / np.sum(later[both] ** 2))
