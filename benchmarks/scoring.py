"""Figures of one stage of a reconstruction beside its truth: the metrics, the torso, and the bands.

========================  =========================================================================  ====
hips_deg, trunk_deg       mean angle between estimated and true orientation in world, of the pelvis  deg
                          and of the upper trunk (Spine3)
inside_relative, _world   share of the errors of joints' positions, relative to the root and in      1
                          world, that lie inside their 95 % band, axis by axis
sigma_relative_mm, ...    root mean square of the size of an error, as stated                        mm
rms_relative_mm, ...      the same of the errors: beside sigma it says how sharp bands are           mm
rho_relative, _world      Spearman's correlation of stated and actual size within the recording      1
========================  =========================================================================  ====
"""

from __future__ import annotations

import numpy as np

from benchmarks.verdicts.scores import rank_correlation
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.result import Reconstruction

EVERY = 6
"""Step between the frames that bands are evaluated in; neighbours are correlated."""


def figures(result: Reconstruction, stage: str) -> dict[str, float]:
    """All figures of a stage; those of bands only for the stage that states them.

    Args:
        result: of a recording with truth. stage: one of its stages.
    """
    truth, poses = result.recording.truth, result.stages[stage]
    assert truth is not None
    found = dict(result.stage_metrics[stage]) | torso(poses, truth)
    if stage == result.mode and result.motion.confidence is not None:
        found |= bands(result.motion, truth)
    return found


def torso(estimate: PoseSequence, truth: PoseSequence) -> dict[str, float]:
    """Mean angles between orientations in world of pelvis and upper trunk, degrees."""
    joints = [estimate.names.index(name) for name in ("Hips", "Spine3")]
    R_true = at_times(truth, estimate.times).R_world_bone
    off = so3.angle_between(estimate.R_world_bone[:, joints], R_true[:, joints])
    hips, trunk = np.degrees(np.nanmean(off, axis=0))
    return {"hips_deg": float(hips), "trunk_deg": float(trunk)}


def bands(motion: Motion, truth: PoseSequence) -> dict[str, float]:
    """Coverage, sharpness and rank correlation of the stated errors of positions."""
    motion = motion[::EVERY]
    stated = motion.confidence
    assert stated is not None
    p, p_true = motion.poses.p_world_joint, at_times(truth, motion.times).p_world_joint
    relative = (p - p[:, :1]) - (p_true - p_true[:, :1])
    return _told("relative", relative[:, 1:], stated.relative_covariance[:, 1:]) | _told(
        "world", p - p_true, stated.position_covariance
    )


def _told(kind: str, error: Array, covariance: Array) -> dict[str, float]:
    """Figures of errors (T, n, 3) with covariances (T, n, 3, 3), m and m^2."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    known = np.isfinite(error + variance).all(axis=-1)
    error, variance = 1e3 * error[known], 1e6 * variance[known]
    size, sigma = np.linalg.norm(error, axis=-1), np.sqrt(variance.sum(axis=-1))
    return {
        f"inside_{kind}": float(np.mean(np.abs(error) <= BAND_95 * np.sqrt(variance))),
        f"sigma_{kind}_mm": float(np.sqrt(np.mean(sigma**2))),
        f"rms_{kind}_mm": float(np.sqrt(np.mean(size**2))),
        f"rho_{kind}": rank_correlation(sigma, size),
    }
