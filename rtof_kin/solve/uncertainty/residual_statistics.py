"""What a recording tells of its own errors, for `CovarianceInflation.apply`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.uncertainty.covariance_inflation import USUAL_TORSO_SIGMA, ResidualStatistics

Array = NDArray[np.float64]
_TORSO = "Hips", "Spine3"
"""Pelvis and upper trunk."""
_LAG = 1 / 15
"""[s] after which a residual is looked at again."""
_DETECTORS_CORRELATION = 0.8
"""Of residuals that far apart, with a detector: the median of the fit's recordings."""
_NORMAL_MEDIAN = 0.6745
"""Median of the absolute values of a standard normal distribution."""
_OUTLIER = 3.0
"""[1] where residuals are cut off, in sizes of a usual one."""
_FEWEST = 100
"""Residuals that tell anything."""


def residual_statistics(
    keypoints: KeypointSequence, motion: MotionSequence, lifted: PoseSequence,
    sensors: Sequence[str] = (),
) -> ResidualStatistics:  # fmt: skip
    """Those of a recording that was reconstructed.

    Args:
        keypoints: as they were used, evenly spaced, at the motion's times.
        motion: its landmarks are compared with them.
        lifted: what the lifter made of them, and how sure it is (`PoseSequence.sigma_rad`); as usual
            where it does not tell.
        sensors: joints whose segments carry one.
    """
    known = list(motion.skeleton.landmarks)
    at = motion.skeleton.landmark_positions(motion.poses.p_world_joint, motion.poses.R_world_bone)
    at = at[:, [known.index(name) for name in keypoints.names]]
    lasting = correlation(keypoints.uv_px - keypoints.camera.project(at), keypoints.times)
    torso = lifted.sigma_rad[:, motion.skeleton.index(*_TORSO)]
    told = torso[np.isfinite(torso)]
    return ResidualStatistics(
        tuple(sensors),
        1.0 if lasting is None else float(np.clip(lasting / _DETECTORS_CORRELATION, 0.0, 1.0)),
        float(np.median(told)) if len(told) else USUAL_TORSO_SIGMA,
    )


def correlation(residuals_px: Array, times: Array) -> float | None:
    """Of residuals (T, L, 2) px with themselves a fifteenth of a second later, about 0 and not about
    their mean, as what is constant lasts too; None where too few are known.

    Args:
        residuals_px: NaN where a landmark was not seen. times: (T,) s, evenly spaced.
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
