"""Errors of regressed joints: fixed in the body, as the detector's own simulation has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.body import Body
from lifting.training.joint_errors import (
    Draw,
    JointErrors,
    View,
    about_axis,
    exchanged,
    hidden_joints,
    jumps,
    mean_error,
    path_basis,
    smooth_errors,
)
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.simulation.detector_errors import DetectorErrors, simulate_detections
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.vision.landmark_regression import LandmarkRegression

B, W, RATE_HZ = 4000, 27, 60.0
TABLE = JointErrors.fitted()
OFFSETS = torch.from_numpy(support.TABLE.offsets).float()


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


def standing(body: Body, azimuth_deg: float, rows: int = B, side: float = 0.0) -> View:
    """A person who stands in the T-pose, 4 m away, with the camera at an azimuth in the pelvis frame."""
    upright = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    turn = about_axis(2, torch.tensor([np.pi - np.radians(azimuth_deg)]))[0].float()
    R = upright @ turn
    p = torch.zeros(len(body.names), 3)
    for j, parent in enumerate(body.parents[1:], start=1):
        p[j] = p[parent] + OFFSETS[j]
    joints = (R @ p.T + torch.tensor([side, 0.0, 4.0])[:, None]).expand(rows, -1, -1)
    axes = R[:, [0, 2]][..., None].expand(rows, 3, 2, len(body.names))
    return View(joints, axes, OFFSETS.expand(rows, -1, -1))


def draws(rows: int, seed: int = 0) -> Draw:
    return Draw(rows, torch.Generator().manual_seed(seed), torch.device("cpu"))


def errors(body: Body, view: View, table: JointErrors = TABLE, size: float = 1.0, seed: int = 0) -> Tensor:
    rows = len(view.joints)
    amplitude = torch.full((rows,), size)
    return smooth_errors(body, table, view, amplitude, W, draws(rows, seed), RATE_HZ)


def mirrored(body: Body, view: View) -> View:
    """The scene in a mirror."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    offsets = (view.offsets * torch.tensor([1.0, -1.0, 1.0]))[:, body.mirrored]
    return View(
        (view.joints * flip[:, None])[..., body.mirrored],
        (view.axes * flip[:, None, None])[..., body.mirrored],
        offsets,
    )


@pytest.mark.parametrize("azimuth", [10.0, 90.0, 200.0, -60.0])
def test_a_persons_mirror_image_has_mirrored_errors(body: Body, azimuth: float) -> None:
    """In the mean and in the covariance."""
    one, other = standing(body, azimuth), mirrored(body, standing(body, azimuth))
    ones = torch.ones(B)
    flip = torch.tensor([-1.0, 1.0])
    torch.testing.assert_close(
        mean_error(body, TABLE, other, ones)[:, body.mirrored] * flip,
        mean_error(body, TABLE, one, ones),
        atol=2e-4,
        rtol=0,
    )
    pairs = []
    for view, back in ((one, False), (other, True)):
        factor, rest = TABLE.blended(body, view[:1])
        C = (factor @ factor.transpose(-1, -2) + torch.diag_embed(rest**2)).reshape(-1, 21, 2, 21, 2)
        if back:
            C = C[:, body.mirrored][:, :, :, body.mirrored] * flip[:, None, None] * flip
        pairs.append(C)
    torch.testing.assert_close(*pairs, atol=1e-7, rtol=1e-4)


def test_drawn_errors_have_the_tables_mean_and_covariance(body: Body) -> None:
    view = standing(body, 30.0)
    quiet = replace(TABLE, hidden=torch.ones(21))
    drawn = errors(body, view, quiet)
    np.testing.assert_allclose(drawn.mean(dim=(0, 2)).T, mean_error(body, TABLE, view, torch.ones(B))[0], atol=0.0025)
    now = drawn[:, :, W // 2].transpose(1, 2).flatten(1)  # (B, 42)
    factor, rest = quiet.blended(body, view[:1])
    C = (factor @ factor.transpose(-1, -2) + torch.diag_embed(rest**2)).sum(dim=1)[0]
    sd = C.diagonal().sqrt()
    np.testing.assert_allclose(now.std(dim=0), sd, rtol=0.1)
    correlation = torch.corrcoef(now.T) - C / sd / sd[:, None]
    assert correlation.abs().mean() < 0.06, "amplitudes differ between limbs, so a little is lost"


def test_limbs_jump_rarely_briefly_and_far(body: Body) -> None:
    view = standing(body, 0.0, rows=20_000)
    error = jumps(body, view, W, draws(20_000), RATE_HZ)
    arm, leg = body.arms[0], body.legs[0]
    there = error[:, 0] != 0
    # Starts per minute times the window, its run included.
    for limb, per_minute in ((arm, 26.0), (leg, 5.0)):
        expected = per_minute / 60 * (W / RATE_HZ + 0.056)
        assert there[..., limb[2]].any(dim=1).float().mean() == pytest.approx(expected, rel=0.15)
    assert there.sum(dim=1)[there.any(dim=1)].float().median() <= 4
    assert error[:, 0, :, arm[2]][there[..., arm[2]]].abs().median() == pytest.approx(0.115, rel=0.3)
    assert not there[..., arm[0]].any()


def test_drawn_errors_are_as_large_as_those_of_the_simulated_detector(body: Body) -> None:
    """Independent reference: points of a held-out person's motion, regressed to joints."""
    clip = read_mocap(Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh")
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    R_bone_shared = shared_frames(body.names, clip.joint_offsets)
    offsets = to_shared(R_bone_shared, body.parents, clip.joint_offsets)
    R_shared, p_root = clip.poses.R_world_bone @ R_bone_shared, clip.poses.p_world_joint[:, 0].mean(axis=0)
    seen, drawn = [], []
    for seed in range(16):
        eye = p_root + np.array([4 * np.cos(seed * 0.4), 4 * np.sin(seed * 0.4), 0.7])
        camera = Camera.looking_at(eye, p_root, 1250.0)
        quiet = DetectorErrors(jumps=0.0, exchanges=0.0, camera=0.0, delay_frames=(0.0,))
        found = simulate_detections(np.random.default_rng(seed), clip.poses, skeleton, camera, quiet)
        joints = LandmarkRegression.default().apply("mediapipe33", found.uv_px[:, 0], found.confidence[:, 0])
        p = camera.to_camera(clip.poses.p_world_joint)
        error = joints.uv_px[:, :21] - camera.project(clip.poses.p_world_joint)
        seen.append(error * p[..., 2:] / 1250.0)
        axes = (camera.R_camera_world @ R_shared)[..., [0, 2]].transpose(0, 2, 3, 1)
        known = (torch.from_numpy(np.ascontiguousarray(x)).float() for x in (p.swapaxes(1, 2), axes))
        view = View(*known, torch.from_numpy(offsets).float().expand(len(p), -1, -1))
        drawn.append(errors(body, view, seed=seed)[:, :, W // 2].transpose(1, 2).numpy())
    rms = [np.sqrt(np.nanmean(np.concatenate(x) ** 2, axis=(0, 2))) for x in (seen, drawn)]
    np.testing.assert_allclose(np.log(rms[1] / rms[0]), 0.0, atol=0.5)
    assert abs(np.median(np.log(rms[1] / rms[0]))) < 0.2


def test_paths_are_ornstein_uhlenbeck_or_constant() -> None:
    for memory in (0.5, 0.3):
        basis = path_basis(W, RATE_HZ, memory)
        lag = (torch.arange(W)[:, None] - torch.arange(W)).abs() / RATE_HZ
        np.testing.assert_allclose(basis @ basis.T, torch.exp(-lag / memory), atol=0.12)
    assert torch.equal(path_basis(W, RATE_HZ, float("inf")), torch.ones(W, 1))


def test_a_place_is_projected_as_a_camera_does(body: Body) -> None:
    """Independent reference: move the joint and project."""
    view = standing(body, 50.0, rows=1, side=0.8)
    zero = {name: torch.zeros_like(getattr(TABLE, name)) for name in ("view", "follows")}
    found = mean_error(body, replace(TABLE, **zero), view, torch.ones(1))[0]
    p = view.joints[0].T
    moved = p + torch.einsum("jab,jb->ja", view.segments()[0], 0.01 * TABLE.place)
    shift = (moved[:, :2] / moved[:, 2:] - p[:, :2] / p[:, 2:]) * p[:, 2:]
    np.testing.assert_allclose(found * 0.01, shift, atol=1e-5)


def test_the_far_arm_is_hidden_in_profile(body: Body) -> None:
    view = standing(body, 90.0, rows=1)  # from the left
    hidden = {body.names[j] for j in hidden_joints(body, view)[0].nonzero()[:, 0]}
    assert "RightArm" in hidden
    assert not {name for name in hidden if name.startswith("Left")}
    assert not hidden_joints(body, standing(body, 0.0, rows=1)).any()
    table = replace(TABLE, hidden=TABLE.hidden * 3)
    larger = errors(body, view, table).std() / errors(body, view).std()
    assert larger > 1.01


@pytest.mark.parametrize(("azimuth", "per_minute"), [(90.0, 106.0), (0.0, 0.0)])
def test_sides_are_exchanged_in_profile(body: Body, azimuth: float, per_minute: float) -> None:
    view = standing(body, azimuth, rows=20_000)
    names = torch.arange(21.0).expand(20_000, 2, W, 21)
    out = exchanged(body, view, names, draws(20_000), RATE_HZ)
    swapped = out != names
    other = torch.tensor(body.mirrored, dtype=torch.float32)
    assert torch.equal(out[swapped], other.expand(names.shape)[swapped])
    share = swapped[:, 0].float().mean(dim=(0, 1))
    assert share[:7].max() == 0
    assert share[body.legs[0][1]] == pytest.approx(per_minute / 60 * 0.055, rel=0.2)
