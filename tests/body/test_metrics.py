"""Metrics against values computed by hand and by SciPy, and with missing data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import procrustes as scipy_procrustes
from scipy.spatial.transform import Rotation

from rtof_kin.body import metrics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import over_time
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.over_time import ALL, Stream
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T, J = 30, len(BODY.names)
TIME = np.arange(T)[:, None, None] / planted.RATE_HZ
DIRECTION = np.array([2.0, -1.0, 2.0]) / 3


@pytest.fixture(scope="module")
def truth() -> PoseSequence:
    return planted.moving(BODY, T).poses


def shifted(poses: PoseSequence, by: ArrayLike) -> PoseSequence:
    return replace(poses, p_world_joint=poses.p_world_joint + np.asarray(by))


def evaluate(estimate: metrics.Poses, truth: PoseSequence) -> metrics.Metrics:
    return metrics.evaluate(estimate, truth, BODY)


def whole(poses: metrics.Poses) -> PoseSequence:
    return Stream.of(poses).part(ALL)


def test_estimate_of_mode_imu_is_shifted_to_the_first_common_frame(truth: PoseSequence) -> None:
    drifting = shifted(truth, [5.0, -3.0, 1.0] + 0.1 * TIME * DIRECTION)
    error = whole(metrics.comparable(drifting, truth, "imu")).p_world_joint - truth.p_world_joint
    np.testing.assert_allclose(error, np.broadcast_to(0.1 * TIME * DIRECTION, error.shape), atol=1e-12)
    p, valid = np.array(truth.p_world_joint), np.array(truth.valid)
    p[:3], valid[3:5] = np.nan, False
    prepared = whole(metrics.comparable(drifting, replace(truth, p_world_joint=p, valid=valid), "imu"))
    np.testing.assert_allclose(prepared.p_world_joint[5], truth.p_world_joint[5], atol=1e-12)
    invalid = replace(truth, valid=np.zeros_like(valid))
    assert metrics.comparable(drifting, invalid, "imu") is drifting
    assert metrics.comparable(truth, shifted(truth, 1.0), "rtof") is truth


def test_worlds_that_differ_by_a_turn_and_a_shift_are_aligned(truth: PoseSequence) -> None:
    R = so3.about_axis("z", 2.0)
    elsewhere = replace(
        truth, p_world_joint=truth.p_world_joint @ R.T + [4.0, -3.0, 0.5], R_world_bone=R @ truth.R_world_bone
    )
    moved, angle, shift = metrics.aligned_worlds(elsewhere, truth)
    assert angle == pytest.approx(-2.0)
    assert shift == pytest.approx(-R.T @ [4.0, -3.0, 0.5])
    assert evaluate(elsewhere, truth)["mpjpe_mm"] > 4000
    aligned = evaluate(moved, truth)
    assert (aligned["mpjpe_mm"], aligned["angle_deg"]) == pytest.approx((0, 0), abs=1e-4)
    tilted = replace(truth, p_world_joint=truth.p_world_joint @ so3.about_axis("x", 0.2).T)
    assert evaluate(metrics.aligned_worlds(tilted, truth)[0], truth)["mpjpe_mm"] > 20  # tilt is an error


def test_truth_has_no_error_and_a_constant_shift_only_an_absolute_one(truth: PoseSequence) -> None:
    for shift in (0.0, 0.05):
        figures = evaluate(shifted(truth, shift * DIRECTION), truth)
        assert figures["coverage"] == 1.0
        assert figures["mpjpe_mm"] == pytest.approx(1000 * shift)
        for name in set(figures) - {"coverage", "mpjpe_mm"}:
            assert figures[name] == pytest.approx(0.0, abs=1e-5), name


@pytest.mark.parametrize(
    "joint, absolute, relative",
    [
        ("Head", 1 / J, 1 / J),
        ("Hips", 1 / J, (J - 1) / J),  # the root counts as zero, and all others are off relative to it
    ],
)
def test_error_of_one_joint_is_averaged_over_all(
    truth: PoseSequence, joint: str, absolute: float, relative: float
) -> None:
    p = np.array(truth.p_world_joint)
    p[:, BODY.index(joint)] += 0.021 * DIRECTION
    figures = evaluate(replace(truth, p_world_joint=p), truth)
    assert figures["mpjpe_mm"] == pytest.approx(21.0 * absolute)
    assert figures["mpjpe_rr_mm"] == pytest.approx(21.0 * relative)
    assert figures.per_joint[joint]["mpjpe_mm"] == pytest.approx(21.0)
    assert figures.per_joint["Neck"]["mpjpe_mm"] == pytest.approx(0.0, abs=1e-9)
    assert figures.per_joint["Hips"]["mpjpe_rr_mm"] == 0.0


@pytest.mark.parametrize("step", [1, 3])
def test_acceleration_and_jerk_are_per_second_and_per_frame(step: int) -> None:
    truth, rate = planted.moving(BODY, 60).poses[::step], 60 / step
    t = truth.times[:, None, None]
    accelerated = evaluate(shifted(truth, 3.0 * DIRECTION * t**2 / 2), truth)
    assert accelerated["mpjae"] == pytest.approx(3.0)
    assert accelerated["mpjae_frame_mm"] == pytest.approx(3.0 * 1000 / rate**2)
    assert accelerated["mpjje"] == pytest.approx(0.0, abs=1e-6)
    jerked = evaluate(shifted(truth, 40.0 * DIRECTION * t**3 / 6), truth)
    assert jerked["mpjje"] == pytest.approx(40.0)
    assert jerked["mpjje_frame_mm"] == pytest.approx(40.0 * 1000 / rate**3)


def test_angle_error_is_that_of_the_relative_rotation(truth: PoseSequence) -> None:
    turned = replace(truth, R_world_bone=so3.about_axis("z", 0.3) @ truth.R_world_bone)
    figures = evaluate(turned, truth)
    assert figures["angle_deg"] == pytest.approx(np.degrees(0.3) / J)
    assert figures.per_joint["Hips"]["angle_deg"] == pytest.approx(np.degrees(0.3))
    assert figures.per_joint["Spine"]["angle_deg"] == pytest.approx(0.0, abs=1e-5)
    R, foot = np.array(truth.R_world_bone), BODY.index("LeftFoot")[0]
    R[:, foot] = R[:, foot] @ so3.exp([0.0, 0.2, 0.0])
    assert evaluate(replace(truth, R_world_bone=R), truth)["angle_deg"] == pytest.approx(np.degrees(0.2) / J)


def test_flexion_is_the_angle_between_adjacent_bones_and_averaged_over_four_hinges() -> None:
    truth = planted.standing(BODY, 4).poses
    p = np.array(truth.p_world_joint)
    hip, knee, foot = BODY.index("LeftUpLeg", "LeftLeg", "LeftFoot")
    p[:, hip], p[:, knee] = [0, 0, 1.0], [0, 0, 0.6]
    p[:, foot] = [[0, 0, 0.2], [-0.4, 0, 0.6], [0, 0.4, 1.0], [0, 0, 1.0]]
    np.testing.assert_allclose(np.degrees(metrics.flexion(p, BODY)[:, knee]), [0, 90, 135, 180], atol=1e-9)
    elsewhere = [j for j in range(J) if j not in metrics.hinges(BODY)]
    assert np.isnan(metrics.flexion(p, BODY)[:, elsewhere]).all()
    p_straight = np.array(p)
    p_straight[:, foot] = [0, 0, 0.2]
    straight = replace(truth, p_world_joint=p_straight)
    figures = evaluate(replace(truth, p_world_joint=p), straight)
    assert figures["flexion_deg"] == pytest.approx((0 + 90 + 135 + 180) / 4 / 4)
    assert figures.per_joint["LeftLeg"]["flexion_deg"] == pytest.approx((0 + 90 + 135 + 180) / 4)
    assert "flexion_deg" not in figures.per_joint["Head"]


def test_zero_motion_has_the_mean_pose(truth: PoseSequence) -> None:
    still = metrics.motionless(truth)
    figures = evaluate(still, truth)
    p = truth.p_world_joint
    assert figures["mpjpe_mm"] == pytest.approx(planted.mpjpe_mm(np.mean(p, axis=0), p))
    acceleration = np.linalg.norm(np.diff(p, n=2, axis=0), axis=-1).mean() * 60**2
    assert figures["mpjae"] == pytest.approx(acceleration)
    assert np.ptp(still.R_world_bone, axis=0).max() == 0.0
    mean = Rotation.from_matrix(truth.R_world_bone[:, 5]).mean().as_matrix()
    np.testing.assert_allclose(still.R_world_bone[0, 5], mean, atol=1e-9)


def test_zero_motion_is_the_mean_of_what_is_there(truth: PoseSequence) -> None:
    p, R = np.array(truth.p_world_joint), np.array(truth.R_world_bone)
    p[:10], p[:, 6], R[:, 5] = np.nan, np.nan, np.nan
    still = metrics.motionless(replace(truth, p_world_joint=p, R_world_bone=R))
    np.testing.assert_allclose(still.p_world_joint[0, 3], p[10:, 3].mean(axis=0))
    assert np.isnan(still.p_world_joint[:, 6]).all()
    assert np.isnan(still.R_world_bone[:, 5]).all()
    assert np.isfinite(still.R_world_bone[:, 4]).all()


def test_procrustes_equals_scipy() -> None:
    rng = np.random.default_rng(1)
    p_true = rng.normal(size=(5, J, 3))
    p = 1.3 * p_true @ so3.exp([0.3, 2.0, -1.0]).T + rng.normal(size=(5, J, 3)) * 0.2
    aligned = metrics.procrustes(p, p_true)
    for frame in range(5):
        _, _, disparity = scipy_procrustes(p_true[frame], p[frame])  # SciPy normalises the truth
        centred = p_true[frame] - p_true[frame].mean(axis=0)
        residual = np.sum((aligned[frame] - p_true[frame]) ** 2) / np.sum(centred**2)
        assert residual == pytest.approx(disparity)


def test_procrustes_never_mirrors() -> None:
    p_true = np.random.default_rng(2).normal(size=(1, J, 3))
    mirrored = p_true * [1.0, -1.0, 1.0]
    assert np.abs(metrics.procrustes(mirrored, p_true) - p_true).max() > 0.1


@settings(max_examples=20, deadline=None)
@given(
    rotvec=st.tuples(*[st.floats(-3, 3)] * 3), translation=st.tuples(*[st.floats(-5, 5)] * 3), scale=st.floats(0.3, 3.0)
)
def test_aligned_error_is_invariant_to_similarity_transforms(
    rotvec: tuple[float, ...], translation: tuple[float, ...], scale: float
) -> None:
    truth = planted.moving(BODY, 4).poses
    noisy = shifted(truth, np.random.default_rng(0).normal(size=(4, J, 3)) * 0.02)
    moved = scale * noisy.p_world_joint @ so3.exp(rotvec).T + np.array(translation)
    one = evaluate(noisy, truth)
    two = evaluate(replace(noisy, p_world_joint=moved), truth)
    assert two["mpjpe_pa_mm"] == pytest.approx(one["mpjpe_pa_mm"], rel=1e-6)


def test_truth_at_other_times_is_interpolated_and_only_common_frames_count(truth: PoseSequence) -> None:
    fine = planted.moving(BODY, 121).poses
    estimate = fine[10:100:2]
    figures = evaluate(estimate, fine)
    assert figures["mpjpe_mm"] == pytest.approx(0.0, abs=1e-9)
    assert figures["angle_deg"] == pytest.approx(0.0, abs=1e-5)
    between = replace(estimate, times=estimate.times + 0.25 / planted.RATE_HZ)
    velocity = np.linalg.norm(np.diff(fine.p_world_joint, axis=0), axis=-1)[10:99:2].mean()
    assert evaluate(between, fine)["mpjpe_mm"] == pytest.approx(250 * velocity)
    wrong_outside = np.where(np.arange(T)[:, None, None] < 10, 1.0, 0.01) * DIRECTION
    figures = evaluate(shifted(truth, wrong_outside), truth[10:])
    assert figures["mpjpe_mm"] == pytest.approx(10.0)
    assert np.isnan(figures.over_time["mpjpe_mm"][:10]).all()


def test_frames_with_any_nan_are_excluded_from_every_metric(truth: PoseSequence) -> None:
    p, R = np.array(truth.p_world_joint) + 0.01 * DIRECTION, np.array(truth.R_world_bone)
    p[12:15], R[12:15] = np.nan, np.nan
    p[5] += 0.5
    p[5, 3] = np.nan
    figures = evaluate(replace(truth, p_world_joint=p, R_world_bone=R), truth)
    assert figures["mpjpe_mm"] == pytest.approx(10.0)
    for name in ("mpjpe_rr_mm", "mpjpe_pa_mm"):
        assert figures[name] == pytest.approx(0.0, abs=1e-6), name
    assert np.isfinite(list(figures.values())).all()
    valid = np.ones((T, J), dtype=bool)
    valid[:15, :7] = False
    figures = evaluate(replace(truth, valid=valid), truth)
    assert figures["coverage"] == pytest.approx(1 - 15 * 7 / (T * J))


@pytest.mark.parametrize("kept", [[0, 2, 4, 6, 8], [0, 1, 3, 4, 6, 7]])
def test_scattered_frames_have_no_jerk(truth: PoseSequence, kept: list[int]) -> None:
    p = np.full((T, J, 3), np.nan)
    p[kept] = truth.p_world_joint[kept]
    figures = evaluate(replace(truth, p_world_joint=p), truth)
    assert figures["mpjpe_mm"] == 0.0
    assert np.isnan(figures["mpjje"])
    assert "mpjje" not in figures.per_joint["Head"]


def test_truth_without_orientations_has_no_angle_metric(truth: PoseSequence) -> None:
    blind = replace(truth, R_world_bone=np.full_like(truth.R_world_bone, np.nan))
    figures = evaluate(truth, blind)
    assert np.isnan(figures["angle_deg"])
    assert figures["mpjpe_mm"] == 0.0
    assert "angle_deg" not in figures.per_joint["Head"]


def test_metrics_are_a_mapping_with_joints_and_frames(truth: PoseSequence) -> None:
    figures = evaluate(shifted(truth, 0.01 * DIRECTION), truth)
    assert isinstance(figures, Mapping)
    assert list(figures) == [
        "mpjpe_mm",
        "mpjpe_rr_mm",
        "mpjpe_pa_mm",
        "mpjae",
        "mpjje",
        "mpjae_frame_mm",
        "mpjje_frame_mm",
        "angle_deg",
        "flexion_deg",
        "coverage",
    ]
    assert tuple(figures.per_joint) == BODY.names
    assert figures.over_time["mpjpe_rr_mm"].shape == (T,)
    mean = np.mean([figures.per_joint[name]["mpjpe_mm"] for name in BODY.names])
    assert figures["mpjpe_mm"] == pytest.approx(mean)


def test_poses_of_other_joints_or_order_are_refused(truth: PoseSequence) -> None:
    other = planted.moving(SkeletonModel.human36m(), T).poses
    with pytest.raises(UnknownNameError, match=r"unknown joint .*'RWrist'"):
        evaluate(other, truth)
    names = (*truth.names[1:], truth.names[0])
    with pytest.raises(InvalidInputError, match="truth: need all joints, in this order: Hips, Spine, "):
        evaluate(truth, replace(truth, names=names))


@pytest.mark.parametrize("seconds", [100.0, (T - 3.5) / 60])
def test_fewer_than_four_common_frames_are_refused(truth: PoseSequence, seconds: float) -> None:
    with pytest.raises(InvalidInputError, match="fewer than four frames in common"):
        evaluate(replace(truth, times=truth.times + seconds), truth)


@pytest.mark.parametrize("shift", [0.0, 0.25 / planted.RATE_HZ])
def test_frames_with_invalid_truth_are_not_scored(shift: float) -> None:
    """A glitch of 5 m of one joint, at the times of the truth and at others."""
    truth = planted.standing(BODY, 60).poses
    estimate = replace(shifted(truth, 0.01 * DIRECTION), times=truth.times + shift)
    p, valid = np.array(truth.p_world_joint), np.array(truth.valid)
    p[20:25, 3] += 5.0
    valid[20:25] = False
    glitched = replace(truth, p_world_joint=p, valid=valid)
    scores = evaluate(estimate, glitched)
    assert scores["mpjpe_mm"] == pytest.approx(10.0, abs=1e-6)
    assert scores["mpjje"] == pytest.approx(0.0, abs=1e-6)
    assert np.isnan(scores.over_time["joint_mm"][20:24]).all()
    assert np.abs(metrics.motionless(glitched).p_world_joint[0, 3] - p[0, 3]).max() < 0.5


@pytest.mark.parametrize("later", [0.0, 0.004])
def test_metrics_by_blocks_are_those_of_the_whole(
    truth: PoseSequence, later: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    p, valid = truth.p_world_joint + rng.normal(0, 0.02, (T, J, 3)), np.ones((T, J), dtype=bool)
    p[11:14], valid[20:23, 4] = np.nan, False
    estimate, known = (
        replace(shifted(truth, 0), p_world_joint=p),
        replace(truth, valid=valid, times=truth.times + later),
    )
    found = []
    for block in (T, 7):
        monkeypatch.setattr(over_time, "BLOCK", block)
        monkeypatch.setattr(metrics, "BLOCK", block)
        begun = metrics.comparable(estimate, known, "imu")
        moved, angle, shift = metrics.aligned_worlds(begun, known)
        scores = [evaluate(one, known) for one in (estimate, begun, moved, metrics.motionless(known))]
        found.append([angle, *shift, *(value for one in scores for value in one.values())])
        found[-1] += [value for one in scores for series in one.over_time.values() for value in series.ravel()]
        found[-1] += [value for one in scores for row in one.per_joint.values() for value in row.values()]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-12)
