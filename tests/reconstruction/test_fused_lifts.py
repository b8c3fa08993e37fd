"""Lifts of several cameras as one, against planted errors along their rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.reconstruction.lift import Lifted, fused

BODY = SkeletonModel.default()
T = 10
POSES = planted.moving(BODY, T).poses
CAMERAS = (planted.camera(), Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], 1250.0))
SIGMA_M = np.broadcast_to([0.01, 0.2], (T, 21, 2))


def keypoints(camera: Camera) -> KeypointSequence:
    uv = camera.project(POSES.p_world_joint)
    return KeypointSequence(camera, POSES.times, uv, np.ones(uv.shape[:2]), POSES.names)


def lifted(camera: Camera, seed: int, valid: bool = True, turn: float = 0.0) -> Lifted:
    """The truth with errors along the rays, and orientations turned."""
    p = POSES.p_world_joint
    ray = so3.unit(p - camera.center_world)
    off = 0.15 * np.random.default_rng(seed).normal(size=(*p.shape[:2], 1)) * ray
    off[:, 1:] += off[:, :1]
    R = POSES.R_world_bone @ so3.exp([0.0, 0.0, turn])
    sigma = np.full(p.shape[:2], 0.1 if valid else np.nan)
    source = Provenance.CAMERA if valid else Provenance.BRIDGED
    poses = replace(
        POSES,
        p_world_joint=p + off,
        R_world_bone=R,
        sigma_rad=sigma,
        valid=np.full(sigma.shape, valid),
        provenance=np.full(sigma.shape, source),
    )
    return Lifted(poses, R, SIGMA_M)


SEEN = tuple(map(keypoints, CAMERAS))


def test_one_lift_is_kept_as_it_is() -> None:
    one = lifted(CAMERAS[0], 0)
    assert fused([one], SEEN[:1], BODY) is one


def test_errors_along_one_ray_are_corrected_by_the_other() -> None:
    lifts = [lifted(camera, seed) for seed, camera in enumerate(CAMERAS)]
    both = fused(lifts, SEEN, BODY).poses
    alone = min(planted.mpjpe_mm(one.poses.p_world_joint, POSES.p_world_joint) for one in lifts)
    assert planted.mpjpe_mm(both.p_world_joint, POSES.p_world_joint) < 0.1 * alone


def test_orientations_are_averaged_and_surer() -> None:
    lifts = [lifted(camera, 0, turn=turn) for camera, turn in zip(CAMERAS, (0.2, -0.2), strict=True)]
    both = fused(lifts, SEEN, BODY)
    assert np.max(so3.angle_between(both.R_world_bone, POSES.R_world_bone)) < 1e-6
    assert both.poses.sigma_rad == pytest.approx(0.1 / np.sqrt(2))


def test_a_camera_that_saw_nobody_hardly_counts() -> None:
    sees, blind = lifted(CAMERAS[0], 0), lifted(CAMERAS[1], 1, valid=False, turn=1.0)
    both = fused([sees, blind], SEEN, BODY).poses
    assert planted.mpjpe_mm(both.p_world_joint, sees.poses.p_world_joint) < 1.0
    assert np.max(so3.angle_between(both.R_world_bone, POSES.R_world_bone)) < 1e-3
    assert both.valid.all()
    assert np.all(both.provenance == Provenance.CAMERA)
