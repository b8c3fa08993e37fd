"""Views: a body's points as cameras see them, as a pinhole camera around it would."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detector_support import walking
from numpy.typing import NDArray

from benchmarks.views import MIRROR, Views, ViewSettings
from rtof_kin.body import kinematics
from rtof_kin.vision.layouts import detector_table, mirrored, own

Array = NDArray[np.float64]
STILL = ViewSettings(
    distance=(4.0, 4.0), height=(1.0, 1.0), roll=0.0, tilt_share=0.0, bone_scale=0.0, place=0.0, mirror=False
)
FRAMES = (0, 20, 40)


def seen(settings: ViewSettings, seed: int = 0) -> tuple[Views, Array, Array]:
    views, poses = Views(detector_table(), settings), walking().poses
    rng = np.random.default_rng(seed)
    return views, *views.see(poses.p_world_joint[:, 0], poses.R_world_bone, rng)


def joints(views: Views, flipped: bool = False) -> Array:
    """(T, 21, 3) joints of the walk, or of its mirror image."""
    poses, skeleton = walking().poses, views.skeleton
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, poses.p_world_joint[:, 0], poses.R_world_bone)
    if not flipped:
        return p
    return np.asarray(p[:, [skeleton.names.index(mirrored(n)) for n in skeleton.names]] @ MIRROR)


def camera_residual(points: Array, image: Array) -> float:
    """How badly any projective camera maps points (N, 3) to (N, 2): the direct linear transform."""
    ones = np.column_stack([points, np.ones(len(points))])
    u, v = image.T[..., None]
    rows = np.concatenate([np.hstack([ones, 0 * ones, -u * ones]), np.hstack([0 * ones, ones, -v * ones])])
    singular = np.linalg.svd(rows, compute_uv=False)
    return float(singular[-1] / singular[0])


def test_a_frame_is_a_projection_of_all_joints() -> None:
    views, points, depth = seen(STILL)
    p = joints(views)
    for t in FRAMES:
        assert camera_residual(p[t], points[t, :21]) < 1e-12
        assert camera_residual(p[t], points[t, np.roll(np.arange(21), 1)]) > 1e-5
    assert np.all((depth > 3.6) & (depth < 4.1))


def test_half_of_the_views_are_mirrored() -> None:
    flipped = []
    for seed in range(8):
        views, points, _ = seen(replace(STILL, mirror=True), seed)
        fits = [camera_residual(joints(views, flip)[20], points[20, :21]) < 1e-12 for flip in (False, True)]
        assert sum(fits) == 1
        flipped.append(fits[1])
    assert 0 < sum(flipped) < 8


def test_people_are_upright_and_seen_from_all_directions() -> None:
    views, points, _ = seen(STILL)
    at = {name: points[:, i] for i, name in enumerate(views.names)}
    assert np.all(at["Nose"][:, 1] < at["LeftHip"][:, 1])
    assert np.all(at["LeftHip"][:, 1] < at["LeftAnkle"][:, 1])
    to_the_right = at["LeftShoulder"][:, 0] > at["RightShoulder"][:, 0]
    assert 10 < to_the_right.sum() < 40


def test_detector_points_are_near_their_landmarks() -> None:
    views, points, _ = seen(STILL)
    at = {name: points[:, i] for i, name in enumerate(views.names)}
    for point, landmark in (
        ("RightElbow", "RightForeArm"),
        ("Nose", "Nose"),
        ("RightAnkle", "RightFoot"),
        ("LeftBigToe", "LeftToe"),
    ):
        far = np.linalg.norm(at[point] - at[own(landmark)], axis=-1) * 4
        assert np.all(far < 0.08)  # m, as seen from 4 m
        assert far.max() > 0.005


@pytest.mark.parametrize("name", ["bone_scale", "place", "roll", "tilt_share"])
def test_every_setting_changes_the_view(name: str) -> None:
    before = seen(STILL)[1]
    np.testing.assert_array_equal(before, seen(STILL)[1])
    after = seen(replace(STILL, **{name: 0.5}))[1]
    assert np.abs(before - after).max() > 1e-3
