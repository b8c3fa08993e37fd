"""The shipped pose prior, its precision, and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import body_paths
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import (
    CLAVICLES,
    HIPS,
    JOINTS,
    RHYTHM,
    SPINE,
    NeutralPosture,
    PosePrior,
    has_prior,
    posture_from_t_pose,
    shipped_prior,
)
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import all_observed, clinical_angles, relative_to_standing
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PRIOR = shipped_prior(BODY.names)


def arrays(**changes: Any) -> dict[str, Any]:
    """Of a small prior of three joints."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    return {
        "mean_quat_wxyz": np.tile([1.0, 0, 0, 0], (2, 1)),
        "covariance": root @ root.T / 50,
        "sigma_jerk": np.array([300.0, 400.0, 500.0]),
        "sigma_root_jerk": np.array(50.0),
        **changes,
    }


def saved(folder: Path, **changes: Any) -> Path:
    path = folder / "prior.npz"
    write_npz(path, {k: np.asarray(v) for k, v in arrays(**changes).items() if v is not None})
    return path


def test_prior_is_shipped_for_the_21_joints_only() -> None:
    assert has_prior("total_capture")
    assert not has_prior("human36m")
    assert PRIOR.joints == BODY.names
    assert shipped_prior(BODY.names) is PRIOR


def test_covariance_and_jerk_are_physiological() -> None:
    assert np.linalg.eigvalsh(PRIOR.covariance)[0] > -1e-12
    sigma = np.sqrt(np.diag(PRIOR.covariance)).reshape(-1, 3)
    assert sigma.max() < np.radians(90.0)
    arm, spine = (BODY.index(name)[0] - 1 for name in ("LeftArm", "Spine1"))
    assert np.linalg.norm(sigma[arm]) > 3 * np.linalg.norm(sigma[spine])
    for name, axis in (("LeftLeg", 1), ("RightLeg", 1), ("LeftForeArm", 2), ("RightForeArm", 2)):
        own = sigma[BODY.index(name)[0] - 1]
        assert own[axis] > 3 * np.delete(own, axis).max(), f"{name} is no hinge"
    left, right = ([j - 1 for j in BODY.index(side + "Arm", side + "Leg")] for side in ("Left", "Right"))
    np.testing.assert_allclose(sigma[left], sigma[right], rtol=0.02, atol=1e-3)
    assert np.all((PRIOR.sigma_jerk >= 200.0) & (PRIOR.sigma_jerk < 20000.0))
    assert 5.0 < PRIOR.sigma_root_jerk < 500.0


@pytest.mark.parametrize("joints, scale", [(BODY.names[1:], 2.0), (("LeftArm", "Spine", "Head"), 1.0)])
def test_precision_is_the_inverse_of_the_inflated_marginal(joints: tuple[str, ...], scale: float) -> None:
    rows = np.concatenate([3 * (BODY.index(n)[0] - 1) + np.arange(3) for n in joints])
    inflated = scale**2 * PRIOR.covariance[np.ix_(rows, rows)] + np.radians(3.0) ** 2 * np.eye(len(rows))
    P = PRIOR.precision(joints, scale, np.radians(3.0))
    np.testing.assert_allclose(P @ inflated, np.eye(len(rows)), atol=1e-8)
    assert np.linalg.eigvalsh(P)[0] > 0


def test_precision_of_an_unknown_joint_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown joint of the pose prior 'LeftShin'"):
        PRIOR.precision(("LeftArm", "LeftShin"), 1.0, 0.1)


def test_prior_from_a_file_is_read_as_written(tmp_path: Path) -> None:
    path = saved(tmp_path)
    prior = PosePrior.load(("a", "b", "c"), path)
    for name, value in arrays().items():
        np.testing.assert_allclose(getattr(prior, name), value)
    with pytest.raises(ValueError, match="read-only"):
        prior.covariance[0, 0] = 1.0


def test_prior_of_another_skeleton_or_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    with pytest.raises(FileFormatError, match=r"prior\.npz.*no pose prior of 21 joints"):
        PosePrior.load(BODY.names, path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FileFormatError, match="damaged, or no NPZ archive"):
        PosePrior.load(BODY.names, path)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"covariance": None}, "covariance"),
        ({"sigma_jerk": np.ones(2)}, r"prior sigma_jerk: expected shape \(3\)"),
        ({"sigma_root_jerk": np.ones(2)}, "sigma_root_jerk"),
        ({"covariance": -np.eye(6)}, "not symmetric and positive semidefinite"),
        ({"covariance": np.triu(np.ones((6, 6))) + 5 * np.eye(6)}, "not symmetric"),
        ({"covariance": np.full((6, 6), np.nan)}, "not symmetric"),
        ({"mean_quat_wxyz": np.zeros((2, 4))}, "not unit quaternions"),
        ({"sigma_jerk": np.array([300.0, 0.0, 1.0])}, "jerk must be positive and finite"),
        ({"sigma_root_jerk": np.array(np.nan)}, "jerk must be positive and finite"),
    ],
)
def test_invalid_prior_is_refused_with_its_field(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = saved(tmp_path, **change)
    with pytest.raises(FileFormatError, match=rf"prior\.npz.*no pose prior of 3 joints.*{message}"):
        PosePrior.load(("a", "b", "c"), path)


RATE_HZ = 60.0


def bent(degrees: dict[str, tuple[float, float, float]], frames: int) -> PoseSequence:
    """Poses with some joints turned by rotation vectors from the rig's T-pose."""
    local = np.tile(np.eye(3), (frames, len(BODY.names), 1, 1))
    for joint, vector in degrees.items():
        local[:, BODY.names.index(joint)] = so3.exp(np.radians(vector))
    R = kinematics.world_rotations(BODY.parents, local)
    p = kinematics.positions(BODY.parents, BODY.joint_offsets, np.zeros((frames, 3)), R)
    return PoseSequence(np.arange(frames) / RATE_HZ, p, R, BODY.names)


def joined(*parts: PoseSequence) -> PoseSequence:
    p, R = (np.concatenate([getattr(x, n) for x in parts]) for n in ("p_world_joint", "R_world_bone"))
    return PoseSequence(np.arange(len(p)) / RATE_HZ, p, R, BODY.names)


OWN = {
    "Spine1": (0.0, 9.0, 0.0),
    "Spine3": (0.0, -4.0, 1.0),
    "LeftShoulder": (12.0, 0.0, 3.0),
    "RightUpLeg": (0.0, -8.0, 0.0),
}
HANGING = {"LeftArm": (-75.0, 0.0, 0.0), "RightArm": (75.0, 0.0, 0.0)}


def test_the_first_still_t_pose_gives_the_posture() -> None:
    posture = posture_from_t_pose(joined(bent(HANGING, 40), bent(OWN, 30), bent({}, 30)), BODY.parents)
    assert posture is not None
    for joint, R in zip(JOINTS, posture.R_parent_bone, strict=True):
        np.testing.assert_allclose(so3.log(R), np.radians(OWN.get(joint, (0, 0, 0))), atol=1e-9)


def test_hanging_arms_and_short_or_moving_t_poses_are_none() -> None:
    assert posture_from_t_pose(bent(HANGING, 90), BODY.parents) is None
    assert posture_from_t_pose(joined(bent(HANGING, 40), bent(OWN, 8), bent(HANGING, 40)), BODY.parents) is None
    swaying = [bent({"Spine": (0.0, 2.0 * t, 0.0)}, 1) for t in range(20)]
    assert posture_from_t_pose(joined(*swaying), BODY.parents) is None


def test_the_prior_of_a_person_has_the_spine_of_the_posture_and_lowered_clavicles() -> None:
    posture = NeutralPosture.of(bent(OWN, 3), BODY.parents)
    population = replace(shipped_prior(BODY.names), covariance_about_posture=None)
    own = BODY.with_prior(population).with_posture(posture).table.prior
    means = {n: R for n, R in zip(BODY.names[1:], so3.from_quat_wxyz(own.mean_quat_wxyz), strict=True)}
    before = {n: R for n, R in zip(BODY.names[1:], so3.from_quat_wxyz(population.mean_quat_wxyz), strict=True)}
    for joint in SPINE:
        np.testing.assert_allclose(so3.log(means[joint]), np.radians(OWN.get(joint, (0, 0, 0))), atol=1e-9)
    for joint in HIPS:
        np.testing.assert_allclose(
            means[joint] @ before[joint].T, so3.exp(np.radians(OWN.get(joint, (0.0, 0, 0)))), atol=1e-9
        )
    lowered = {j: np.degrees(so3.log(so3.exp(np.radians(OWN.get(j, (0.0, 0, 0)))).T @ means[j]))[0] for j in CLAVICLES}
    assert -20 < lowered["LeftShoulder"] < -12
    assert 12 < lowered["RightShoulder"] < 20
    assert {n for n in means if not np.allclose(means[n], before[n])} <= set(JOINTS)
    np.testing.assert_array_equal(own.covariance, population.covariance)


def planted_means(count: int) -> tuple[PosePrior, Array, Array]:
    """The shipped prior, and means b (count, J - 1, 3) of persons drawn from it, and theirs as rotations."""
    prior = shipped_prior(BODY.names)
    assert prior.between_and_within is not None
    between = 0.25 * prior.between_and_within[0]  # small turns, for which rotation vectors add
    prior = replace(prior, covariance=prior.between_and_within[1] + between)
    b = np.random.default_rng(1).multivariate_normal(np.zeros(len(between)), between, count, method="cholesky")
    return prior, b, so3.from_quat_wxyz(prior.mean_quat_wxyz) @ so3.exp(b.reshape(count, -1, 3))


def in_t_pose(prior: PosePrior, means: Array) -> Array:
    """Rotations (J - 1, 3, 3) in the T-pose of a person with these means."""
    out, usual = np.array(means), dict(zip(BODY.names[1:], so3.from_quat_wxyz(prior.mean_quat_wxyz), strict=True))
    for joint in HIPS:
        j = BODY.names.index(joint) - 1
        out[j] = means[j] @ usual[joint].T
    for joint in CLAVICLES:
        j = BODY.names.index(joint) - 1
        out[j] = means[j] @ so3.exp(RHYTHM @ so3.log(usual[joint.replace("Shoulder", "Arm")])).T
    return out


def errors_of(prior: PosePrior, own: PosePrior, b: Array) -> tuple[float, float, float]:
    """Mean squares of a person's mean before and after, deg^2, and of the error over its stated standard deviation."""
    mean = so3.from_quat_wxyz(prior.mean_quat_wxyz)
    off = so3.log(np.swapaxes(mean, -1, -2) @ so3.from_quat_wxyz(own.mean_quat_wxyz)).ravel() - b
    assert prior.between_and_within is not None
    left = np.diagonal(own.covariance - prior.between_and_within[1])
    rows = np.ravel([3 * (BODY.names.index(joint) - 1) + np.arange(3) for joint in JOINTS])
    return tuple(float(np.mean(v[rows])) for v in (np.degrees(b) ** 2, np.degrees(off) ** 2, off**2 / left))


@pytest.mark.parametrize("sigma_deg", [0.5, 3.0])
def test_a_posture_measured_with_errors_tells_a_persons_mean_with_the_stated_ones(sigma_deg: float) -> None:
    prior, persons, means = planted_means(60)
    rng, index, rows = np.random.default_rng(2), [BODY.names.index(joint) - 1 for joint in JOINTS], []
    for b, R in zip(persons, means, strict=True):
        told = in_t_pose(prior, R)[index] @ so3.exp(np.radians(rng.normal(0, sigma_deg, (len(JOINTS), 3))))
        posture = NeutralPosture(JOINTS, so3.to_quat_wxyz(told), np.full(len(JOINTS), np.radians(sigma_deg)))
        rows.append(errors_of(prior, prior.about(posture), b))
    before, after, ratio = np.mean(rows, axis=0)
    assert after < {0.5: 0.2, 3.0: 0.7}[sigma_deg] * before
    assert ratio == pytest.approx(1.0, abs=0.2)


def test_one_known_joint_leaves_the_spread_of_others() -> None:
    prior = shipped_prior(BODY.names)
    own = prior.about(NeutralPosture(("Spine1",), so3.to_quat_wxyz(np.eye(3)[None]), np.array([0.01])))
    share = np.diagonal(own.covariance) / np.diagonal(prior.covariance)
    hips = slice(3 * (BODY.names.index("LeftUpLeg") - 1), 3 * BODY.names.index("LeftUpLeg"))
    assert np.all(share < 1.02)
    assert np.all(share[hips] > 0.9)


@pytest.mark.parametrize(("seconds", "least"), [(30.0, 0.5), (300.0, 0.25)])
def test_long_motion_tells_a_persons_mean(seconds: float, least: float) -> None:
    prior, persons, means = planted_means(60)
    assert prior.between_and_within is not None
    within, rng, rows = prior.between_and_within[1], np.random.default_rng(3), []
    independent = round(seconds / 15)
    for b, R in zip(persons, means, strict=True):
        turns = rng.multivariate_normal(np.zeros(len(b)), 0.1 * within, independent, method="cholesky")
        posture = prior.posture_of(R @ so3.exp(turns.reshape(independent, -1, 3)), 10 * seconds, np.zeros((len(R), 3)))
        assert posture is not None
        rows.append(errors_of(prior, prior.about(posture), b))
    before, after, ratio = np.mean(rows, axis=0)
    assert after < least * before
    assert 0.5 < ratio < 1.5


def test_motion_that_does_not_show_a_joint_tells_nothing_of_it() -> None:
    prior, _, means = planted_means(1)
    posture = prior.posture_of(means, 60.0, np.full((len(BODY.names) - 1, 3), np.pi))
    assert posture is not None
    assert np.all(posture.sigma > np.radians(90))
    assert replace(prior, covariance_about_posture=None).posture_of(means, 60.0, np.zeros((20, 3))) is None


def test_angles_relative_to_standing_vanish_there_and_keep_their_range() -> None:
    tilted = {"Spine1": (0.0, 9.0, 0.0), **HANGING}
    sitting = {"LeftUpLeg": (0.0, -80.0, 0.0), "RightUpLeg": (0.0, -80.0, 0.0), **tilted}
    poses = joined(bent(sitting, 20), bent(tilted, 45), bent(sitting, 20))
    plain = clinical_angles(all_observed(poses), BODY)
    own = relative_to_standing(plain, body_paths(poses, BODY, standing=True))
    assert abs(plain["spine_flexion"][40]) == pytest.approx(np.radians(9.0), abs=0.02)
    assert own["spine_flexion"][40] == pytest.approx(0.0, abs=1e-9)
    for name in ("right_hip_flexion", "left_shoulder_elevation"):
        assert np.ptp(own[name]) == pytest.approx(np.ptp(plain[name]))
    np.testing.assert_array_equal(own["left_shoulder_elevation"], plain["left_shoulder_elevation"])
    assert "from 0.35 to 1.05 s" in own.notes[-1]
    with pytest.raises(InvalidInputError, match="nobody stands upright and still"):
        seated = all_observed(bent(sitting, 60))
        relative_to_standing(clinical_angles(seated, BODY), body_paths(seated, BODY, standing=True))


def test_scaled_bodies_keep_their_posture_and_wrong_ones_are_refused() -> None:
    posture = NeutralPosture.of(bent(OWN, 3), BODY.parents)
    assert BODY.with_posture(posture).with_height(1.6).table.posture is posture
    with pytest.raises(InvalidInputError, match="not unit quaternions"):
        NeutralPosture(("Spine",), np.array([[2.0, 0, 0, 0]]))
    with pytest.raises(InvalidInputError, match="no frame of the T-pose is complete"):
        NeutralPosture.of(
            bent({}, 3).with_poses(slice(None), np.full((3, 21, 3), np.nan), np.full((3, 21, 3, 3), np.nan)),
            BODY.parents,
        )
