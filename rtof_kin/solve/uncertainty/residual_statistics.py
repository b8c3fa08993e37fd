"""Statistics of a recording's errors for `CovarianceInflation.apply`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.energy.frame_energy import TORSO
from rtof_kin.solve.uncertainty.covariance_inflation import USUAL_TORSO_SIGMA, ResidualStatistics, unsided
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
_MEAN_S, _NEAR_S, _KNOWN = 2.0, 4.0, 0.2
"""[s] over which residuals of the legs are averaged, [s] before and after for which the largest average
counts, and the share of frames that an average needs."""
_USUAL_M, _USUAL_ALONE_M = 0.045, 0.1
"""[m] Misfit of the legs that right recordings of people whom nothing was fitted on hardly exceed, with
sensors on the thighs and without."""
_LEGS, _SENSED_LEGS, _REST, _TURNS = 2.5, 0.7, 0.3, 0.5
"""Errors relative to the misfit beyond the usual: of knees and feet without and with a sensor on the thigh,
of all other joints; and of turns relative to the knee's. Of six of those recordings with displaced legs."""


def residual_statistics(
    keypoints: KeypointSequence, motion: Motion, lifted: PoseSequence, sensors: Sequence[str] = ()
) -> ResidualStatistics:
    """Return the statistics of a reconstructed recording.

    Args:
        keypoints: as used, evenly spaced, at the motion's times.
        lifted: the lifter's poses with their standard deviations (`PoseSequence.sigma_rad`).
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


@dataclass(frozen=True)
class LegMisfit:
    """Mean residuals of the legs' points in the image, as far as both sides agree; 0 where unseen.

    A detector that is wrong about the legs as a whole, with confidence, leaves little residual at knees and
    feet, which the motion follows; bones cannot follow everywhere, and hips are pulled off their own points.
    """

    thighs: Array
    """(T,) m, of the knees less those of the hips."""
    shanks: Array
    """(T,) m, of the ankles less those of the knees."""
    px_per_m: float
    """Size of the person in the image."""

    def excess(self, rate_hz: float, sensed: bool = True) -> Array:
        """Return by how much the thighs' misfit exceeds the usual (T,), m, at its largest near a frame."""
        usual = _USUAL_M if sensed else _USUAL_ALONE_M
        near = maximum_filter1d(self.thighs, 2 * round(_NEAR_S * rate_hz) + 1)
        return np.asarray(np.sqrt(np.maximum(near**2 - usual**2, 0.0)))


def leg_misfit(keypoints: KeypointSequence, motion: Motion) -> LegMisfit:
    """Return the misfit of the legs; arguments as for `residual_statistics`."""
    keypoints, poses = measurements(keypoints, motion.skeleton), motion.poses
    points, camera = image_points(motion.skeleton, keypoints.names), keypoints.camera
    at = points.positions(poses.p_world_joint, poses.R_world_bone)
    off = points.displaced(camera, poses.p_world_joint, poses.R_world_bone)
    scale = camera.to_camera(at)[..., 2:] / camera.K[0, 0]
    residuals = (keypoints.uv_px - camera.project(at) - off) * scale
    anchors, width = [motion.skeleton.names[j] for j in points.anchors], round(_MEAN_S * poses.rate_hz) | 1

    def of(joint: str) -> Array:
        """Return the mean residual (T, 2) of a joint's points, m; NaN where too few are seen."""
        at = [i for i, name in enumerate(anchors) if name == joint]
        own = residuals[:, at]
        known = np.isfinite(own) * keypoints.confidence[:, at, None]
        total, share = (
            uniform_filter1d(values, width, axis=0, mode="nearest").sum(axis=1)
            for values in (known * np.nan_to_num(own), known)
        )
        return np.where(share > _KNOWN, total / np.maximum(share, _KNOWN), np.nan)

    def shared(upper: str, lower: str) -> Array:
        left, right = (of(f"{side}{lower}") - of(f"{side}{upper}") for side in ("Left", "Right"))
        return np.asarray(np.sqrt(np.maximum(np.nan_to_num(np.sum(left * right, axis=-1)), 0.0)))

    seen = np.isfinite(scale)
    px_per_m = 1 / float(np.median(scale[seen])) if seen.any() else np.nan
    return LegMisfit(shared("UpLeg", "Leg"), shared("Leg", "Foot"), px_per_m)


def leg_spread(
    confidence: Confidence, misfit: LegMisfit, motion: Motion, sensors: Collection[str] = ()
) -> Confidence | None:
    """Return the covariances that a misfit of the legs adds, isotropic; None where it is usual."""
    excess = misfit.excess(motion.poses.rate_hz, bool({"LeftUpLeg", "RightUpLeg"} & {*sensors}))
    if not excess.any():
        return None
    skeleton = motion.skeleton

    def factor(name: str) -> float:
        if unsided(name) not in ("UpLeg", "Leg", "Foot"):
            return _REST
        return _SENSED_LEGS if name.replace(unsided(name), "UpLeg") in sensors else _LEGS

    joints = [_REST if name.endswith("UpLeg") else factor(name) for name in confidence.names]
    length = skeleton.bone_lengths
    turns = [
        max(
            (
                _TURNS * factor(name) / length[name.replace("UpLeg", "Leg")]
                for name in pair
                if name.endswith("Leg") and name not in sensors
            ),
            default=0.0,
        )
        for pair in confidence.pairs
    ]
    position, turn = ((excess[:, None] * factors)[..., None, None] ** 2 * np.eye(3) for factors in (joints, turns))
    relative = position.copy()
    relative[:, 0] = 0.0
    return replace(confidence, position_covariance=position, relative_covariance=relative, turn_covariance=turn)
