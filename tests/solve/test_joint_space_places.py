"""Places of a detector's points: planted ones are recovered, and the motion improves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.keypoints import KeypointSequence, detector_point
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.joint_space.annealing import estimated_places
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.vision.image_points import detector_points, image_points

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
MOTION = planted.human(BODY, 100)
CAMERA = planted.camera()
NAMES = tuple(detector_point("mediapipe33", name) for name in detector_points("mediapipe33"))


def seen(offsets: Array | float = 0.0, sigma_px: float = 0.0) -> KeypointSequence:
    """What the detector sees of a person whose points lie off their usual places."""
    points, poses = image_points(BODY, NAMES), MOTION.poses
    p, R = poses.p_world_joint, poses.R_world_bone
    own = replace(points, places=points.places + offsets)
    uv = CAMERA.project(own.positions(p, R)) + points.displaced(CAMERA, p, R)
    uv += sigma_px * np.random.default_rng(0).normal(size=uv.shape)
    return KeypointSequence(CAMERA, poses.times, uv, np.ones(uv.shape[:2]), NAMES)


@pytest.mark.parametrize("memory", [1, 40])
def test_planted_places_are_recovered_as_far_as_frames_are_independent(memory: int) -> None:
    rng = np.random.default_rng(0)
    T, planted_offset = 2000, np.array([0.03, -0.02, 0.01])
    turns = so3.exp(planted.smooth_noise(1, (T, 3), 20, 1.0))
    slopes = 300.0 * turns[:, None, :2]
    errors = 4.0 * np.repeat(rng.normal(size=(T // memory, 1, 2)), memory, axis=0)
    residuals = slopes @ planted_offset + errors
    covariance = 0.03**2 * np.eye(3)[None]
    found = estimated_places(residuals, slopes, np.ones((T, 1)), covariance)[0]
    np.testing.assert_allclose(found, planted_offset, atol=2e-3 * np.sqrt(memory))
    weak = estimated_places(residuals, slopes, np.ones((T, 1)), 1e-4**2 * np.eye(3)[None])[0]
    assert np.linalg.norm(weak) < (0.15 if memory == 1 else 0.02) * np.linalg.norm(planted_offset)
    unseen = estimated_places(residuals, slopes, np.zeros((T, 1)), covariance)
    assert not unseen.any()


def solved(keypoints: KeypointSequence, places: bool) -> FragmentSolution:
    settings = JointSpaceSettings(landmark_places=places, refit_root=False)
    imus = planted.bone_imus(BODY, MOTION.poses, planted.LIMBS)
    return FragmentSolver(BODY, 50, settings).solve(MOTION.poses, keypoints, imus)


def error(solution: FragmentSolution) -> float:
    apart = solution.poses.p_world_joint - MOTION.poses.p_world_joint
    return float(np.linalg.norm(apart, axis=-1).mean())


def test_exact_points_give_the_motion_and_planted_places_are_taken_into_account() -> None:
    assert error(solved(seen(sigma_px=0.5), False)) < 0.015
    spread = np.sqrt(np.diagonal(image_points(BODY, NAMES).place_covariance, axis1=1, axis2=2))
    offsets = spread * np.random.default_rng(1).choice([-1.0, 1.0], spread.shape)
    usual, own = (solved(seen(offsets, 0.5), places) for places in (False, True))
    assert error(own) < 0.9 * error(usual)
    sizes = [[f.sigma_reprojection for f in s.fragments] for s in (usual, own)]
    assert np.all(np.array(sizes[1]) >= np.array(sizes[0]) - 1e-9)
