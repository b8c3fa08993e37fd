"""Stated quality of a motion: warnings of the fragment solver, and covariances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95, Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.reconstruction.uncalibrated import with_camera_uncertainty
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.solution import FragmentSolution, misfits
from rtof_kin.solve.uncertainty.covariance_inflation import CovarianceInflation
from rtof_kin.solve.uncertainty.disagreement import disagreement
from rtof_kin.solve.uncertainty.residual_statistics import residual_statistics

_SURE_DEG: Final = 4.0
"""[deg] Largest standard deviation of a hinge's zero without a warning: mountings by a known pose."""


def quality_warnings(
    prepared: Prepared, solution: FragmentSolution | None, settings: ReconstructionSettings
) -> tuple[str, ...]:
    """Return quality warnings: sensors without samples, joints far from their keypoints.

    Args:
        prepared: what was solved. solution: None in modes that do not optimise. settings: used.
    """
    found: tuple[str, ...] = ()
    if prepared.bone_imus is not None and not np.isfinite(prepared.bone_imus.R_world_bone).any():
        found += (
            "no sensor has samples at the times of the video: the motion is estimated from the image "
            "alone; check the sensors' values and clock",
        )
    found += zero_warnings(prepared)
    return found if solution is None else found + misfit_warnings(solution, prepared.start.times, settings)


def misfit_warnings(
    solution: FragmentSolution, times: Array, settings: ReconstructionSettings
) -> tuple[str, ...]:
    """Return warnings about intervals in which joints lie far from their keypoints.

    Args:
        solution: of the fragment solver. times: (T,) s of its frames. settings: used.
    """
    s = settings.fragment
    if not isinstance(s, JointSpaceSettings) or s.sigma_reprojection is not None:
        return ()
    return misfits(solution.fragments, times, settings.frames, s.sigma_reprojection_range[1])


def with_covariances(
    motion: MotionSequence, prepared: Prepared, solution: FragmentSolution | None,
    others: Iterable[PoseSequence] = (),
) -> MotionSequence:  # fmt: skip
    """Return the motion with its pose covariances, inflated for autocorrelated errors.

    Args:
        motion: of the solution. prepared: what was solved. solution: None in modes that do not optimise.
        others: poses with cameras one standard deviation off, of a camera that is not calibrated.
    """
    if solution is None or solution.confidence is None:
        return motion
    sensors = () if prepared.bone_imus is None else prepared.bone_imus.joints
    statistics = residual_statistics(prepared.keypoints, motion, prepared.stages["lift"], sensors)
    start = prepared.stages.get("sf2", prepared.stages["lift"])
    apart = disagreement(motion.poses, start, solution.confidence.pairs)
    p_camera_joint = motion.poses.p_world_joint - prepared.keypoints.camera.center_world
    inflated = CovarianceInflation.shipped().apply(solution.confidence, statistics, apart, p_camera_joint)
    if solution.spread is not None:
        inflated = inflated.plus(solution.spread)
    if prepared.calibration is not None:
        inflated = _with_places(inflated, prepared.calibration.place_variances(prepared.skeleton))
    return replace(motion, confidence=with_camera_uncertainty(inflated, motion.poses, others))


def _with_places(confidence: Confidence, variances: Mapping[str, float]) -> Confidence:
    """Covariances of orientations with the constant error of mountings that were estimated with a detector.

    Args:
        variances: of the segments' orientations, by joint, rad^2.
    """
    added = np.array([sum(variances.get(name, 0.0) for name in pair) for pair in confidence.pairs])
    turns = confidence.turn_covariance + added[:, None, None] * np.eye(3)
    return replace(confidence, turn_covariance=turns)


def zero_warnings(prepared: Prepared) -> tuple[str, ...]:
    """Return that the zero of flexion is uncertain where the mounting of its sensors was estimated with the
    video and no known pose.

    Args:
        prepared: what was solved.
    """
    if prepared.calibration is None:
        return ()
    skeleton, variances = prepared.skeleton, prepared.calibration.place_variances(prepared.skeleton)
    pairs = [(skeleton.names[skeleton.parents[j]], skeleton.names[j]) for j in hinges(skeleton)]
    worst = max((sum(variances.get(name, 0.0) for name in pair) for pair in pairs), default=0.0)
    sigma = float(np.degrees(np.sqrt(worst)))
    if sigma < _SURE_DEG:
        return ()
    return (
        f"the zero of knee and elbow flexion is not known to better than +-{BAND_95 * sigma:.0f} deg: how "
        "the sensors sit on the limbs was estimated from this video, and no pose with a known angle "
        "(standing, T-pose or N-pose) fixed it; changes of an angle within the recording are not affected",
    )
