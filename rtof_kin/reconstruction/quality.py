"""Stated quality of a motion: warnings of the fragment solver, and covariances."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.solution import FragmentSolution, misfits
from rtof_kin.solve.uncertainty import CovarianceInflation, LegMisfit, disagreement, leg_spread, residual_statistics

_SURE_DEG = 4.0  # [deg] Largest standard deviation of a hinge's zero without a warning


def quality_warnings(
    prepared: Prepared, solution: FragmentSolution | None, settings: ReconstructionSettings
) -> tuple[str, ...]:
    """Return quality warnings (sensors without samples, joints far from their keypoints); None: no optimisation."""
    found: tuple[str, ...] = ()
    if prepared.bone_imus is not None and not np.isfinite(prepared.bone_imus.R_world_bone).any():
        found += (
            "no sensor has samples at the times of the video: the motion is estimated from the image "
            "alone; check the sensors' values and clock",
        )
    found += zero_warnings(prepared)
    if solution is None:
        return found
    off = reprojection_errors(prepared.recording.video, prepared.skeleton, solution.poses)
    return found + misfit_warnings(solution, off, settings)


def reprojection_errors(keypoints: KeypointSequence, skeleton: SkeletonModel, poses: PoseSequence) -> Array:
    """Return reprojection errors (T, L) of the landmarks, px; NaN where unknown."""
    keypoints, known = keypoints.landmarks, skeleton.landmarks
    at = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    at = at[:, [list(known).index(name) for name in keypoints.names]]
    error = np.linalg.norm(keypoints.camera.project(at) - keypoints.uv_px, axis=-1)
    error[~poses.valid[:, skeleton.index(*(known[name][0] for name in keypoints.names))]] = np.nan
    return np.asarray(error)


def misfit_warnings(solution: FragmentSolution, off_px: Array, settings: ReconstructionSettings) -> tuple[str, ...]:
    """Return warnings of intervals in which joints are far from keypoints, by `reprojection_errors` (T, L), px."""
    s = settings.fragment
    if not isinstance(s, JointSpaceSettings) or s.sigma_reprojection is not None:
        return ()
    seen, by_frame = np.isfinite(off_px).any(axis=1), np.full(len(off_px), np.nan)
    by_frame[seen] = np.nanmedian(off_px[seen], axis=1)
    limit = s.sigma_reprojection_range[1]
    return misfits(solution.fragments, solution.poses.times, settings.frames, limit, by_frame)


def with_covariances(
    motion: Motion,
    prepared: Prepared,
    solution: FragmentSolution | None,
    others: Iterable[PoseSequence],
    position: PositionErrors,
    misfit: LegMisfit | None = None,
) -> tuple[Motion, PositionErrors]:
    """Return the motion with its pose covariances, inflated for autocorrelated errors and what is unverified.

    Args:
        solution: None in modes that do not optimise.
        others: poses with the clocks, or a camera that is not calibrated, one standard deviation off.
        position: what is open of positions in world; it comes back with that in words.
    """
    if solution is None or solution.confidence is None:
        return motion, position
    sensors = () if prepared.bone_imus is None else prepared.bone_imus.joints
    statistics = residual_statistics(prepared.recording.video, motion, prepared.stages["lift"], sensors)
    start = prepared.stages.get("sf2", prepared.stages["lift"])
    apart = disagreement(motion.poses, start, solution.confidence)
    p_camera_joint = motion.poses.p_world_joint - prepared.recording.video.camera.center_world
    inflated = CovarianceInflation.shipped().apply(solution.confidence, statistics, apart, p_camera_joint)
    kept = {*sensors} - {fault.what for fault in prepared.rejected}
    legs = None if misfit is None else leg_spread(inflated, misfit, motion, kept)
    for spread in (solution.spread, legs):
        if spread is not None:
            inflated = inflated.plus(spread)
    if variances := mounting_variances(prepared):  # constant errors of orientations
        added = np.array([sum(variances.get(name, 0.0) for name in pair) for pair in inflated.pairs])
        turns = inflated.turn_covariance + added[:, None, None] * np.eye(3)
        inflated = inflated.changed(turn_covariance=turns)
    wide, position = position.added(inflated, motion.poses)
    for other in others:
        wide = wide.plus(disagreement(motion.poses, other, wide))
    return replace(motion, confidence=wide), position


def mounting_variances(prepared: Prepared) -> dict[str, float]:
    """Return the variance, rad^2, about each axis of how a used sensor sits on its segment, by segment.

    It is the larger of what the recording states and what a self-calibration leaves: the video that refines a
    mounting has the errors of the one that it was found by.
    """
    given, found, sensors = prepared.recording.calibration, prepared.calibration, prepared.bone_imus
    variances = {} if found is None else found.mounting_variances(prepared.skeleton)
    if sensors is not None and given is not None and given.mounting_sd_deg is not None:
        known = np.asarray(np.isfinite(sensors.R_world_bone).any(axis=(0, 2, 3)))
        used = [joint for joint, measured in zip(sensors.joints, known, strict=True) if measured]
        for joint, sd in zip(given.joints, np.radians(given.mounting_sd_deg).tolist(), strict=True):
            if joint in used and sd > 0:
                variances[joint] = max(variances.get(joint, 0.0), sd**2)
    return variances


def zero_warnings(prepared: Prepared) -> tuple[str, ...]:
    """Return that the zero of flexion is uncertain where the mounting of its sensors was estimated."""
    skeleton, variances, wide = prepared.skeleton, mounting_variances(prepared), dict[str, float]()
    for j in hinges(skeleton):
        pair = skeleton.names[skeleton.parents[j]], skeleton.names[j]
        sigma = float(np.degrees(np.sqrt(sum(variances.get(name, 0.0) for name in pair))))
        angles = [dof.clinical for dof in skeleton.table.joints[j].dofs]
        (name,) = (angle.split()[-2] for angle in angles if angle.endswith("flexion"))
        if sigma >= _SURE_DEG:
            wide[name] = max(wide.get(name, 0.0), BAND_95 * sigma)
    if not wide:
        return ()
    return (
        f"the zero of {' and '.join(wide)} flexion is not known to better than "
        f"{' and '.join(f'+-{band:.0f}' for band in wide.values())} deg: how the sensors sit on the limbs "
        "was estimated from the video, or in a pose held by eye, and not measured at a known angle; "
        "changes of an angle within the recording are not affected",
    )
