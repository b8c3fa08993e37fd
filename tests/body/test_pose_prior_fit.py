"""Priors fitted to motions: planted ones recovered, postures, rigs, and the formula written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body import kinematics, pose_prior_fit
from rtof_kin.body.pose_prior import HIPS, SPINE, NeutralPosture
from rtof_kin.body.pose_prior_fit import PersonMotion, fit_pose_prior, of_one_rig, shrunk
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
NAMES, PARENTS = BODY.names, BODY.parents
SIZE, RATE_HZ, FRAMES = 3 * (len(NAMES) - 1), 60.0, 800
OTHER = [NAMES.index(n.replace("Left", "?").replace("Right", "Left").replace("?", "Right")) for n in NAMES]
MIRROR = np.diag([1.0, -1.0, 1.0])
SWAP = np.kron(np.eye(len(NAMES) - 1)[np.array(OTHER[1:]) - 1], np.diag([-1.0, 1.0, -1.0]))


def symmetric_covariance(seed: int) -> Array:
    """A covariance of rotation vectors of a few degrees, the same in a mirror."""
    root = np.random.default_rng(seed).normal(size=(SIZE, SIZE)) * np.radians(1.5)
    covariance = root @ root.T + np.radians(2.0) ** 2 * np.eye(SIZE)
    return np.asarray((covariance + SWAP @ covariance @ SWAP.T) / 2)


def motion(subject: str, mean: Array, covariance: Array) -> PersonMotion:
    """Some seconds in which slow sines have this covariance exactly, about mean rotations (J - 1, 3, 3)."""
    cycles = 2 * np.pi * np.arange(1, SIZE + 1) * np.arange(FRAMES)[:, None] / FRAMES
    vectors = np.sqrt(2) * np.sin(cycles) @ np.linalg.cholesky(covariance).T
    local = np.tile(np.eye(3), (FRAMES, len(NAMES), 1, 1))
    local[:, 1:] = mean @ so3.exp(vectors.reshape(FRAMES, -1, 3))
    p = np.stack([np.sin(cycles[:, k]) for k in (0, 1, 2)], axis=1)
    return PersonMotion(subject, kinematics.world_rotations(PARENTS, local), p, RATE_HZ)


def mean_of(seed: int) -> Array:
    """Mean rotations (J - 1, 3, 3), the same in a mirror."""
    vector = np.random.default_rng(seed).normal(size=SIZE) * np.radians(15.0)
    return so3.exp(((vector + SWAP @ vector) / 2).reshape(-1, 3))


def rows(*joints: str) -> Array:
    return np.ravel([3 * (NAMES.index(joint) - 1) + np.arange(3) for joint in joints])


def test_a_planted_prior_is_recovered() -> None:
    mean, covariance = mean_of(0), symmetric_covariance(1)
    fitted = fit_pose_prior(NAMES, PARENTS, [motion("a", mean, covariance)], even_spine=False)
    np.testing.assert_allclose(so3.from_quat_wxyz(fitted.mean_quat_wxyz), mean, atol=2e-3)
    np.testing.assert_allclose(fitted.covariance, covariance, atol=0.04 * covariance.max())
    assert fitted.covariance_about_posture is None


def test_the_spread_about_postures_is_that_within_persons() -> None:
    """Persons bend their spines and hips otherwise; each moves alike about that."""
    covariance = symmetric_covariance(2)
    motions, postures = [], {}
    for subject, pitch in zip("abcd", np.radians([-12.0, -4.0, 4.0, 12.0]), strict=True):
        mean = mean_of(3)
        own = so3.about_axis("y", pitch)
        for joint in (*SPINE, *HIPS):
            mean[NAMES.index(joint) - 1] = own @ mean[NAMES.index(joint) - 1]
        motions.append(motion(subject, mean, covariance))
        in_t_pose = [mean[NAMES.index(j) - 1] if j in SPINE else own for j in (*SPINE, *HIPS)]
        postures[subject] = NeutralPosture((*SPINE, *HIPS), so3.to_quat_wxyz(np.array(in_t_pose)))
    fitted = fit_pose_prior(NAMES, PARENTS, motions, False, postures)
    assert fitted.covariance_about_posture is not None
    index = rows(*SPINE, *HIPS)
    block = np.ix_(index, index)
    np.testing.assert_allclose(fitted.covariance_about_posture[block], covariance[block], atol=0.03 * covariance.max())
    between = np.trace(fitted.covariance[block]) - np.trace(covariance[block])
    assert between == pytest.approx(6 * np.var(np.radians([-12.0, -4.0, 4.0, 12.0])), rel=0.05)
    exact = replace(postures["a"], sigma=np.full(len(index) // 3, 1e-4))
    own_prior = fitted.about(exact)
    np.testing.assert_allclose(
        own_prior.covariance[block], fitted.covariance_about_posture[block], atol=0.01 * covariance.max()
    )
    assert own_prior.covariance_about_posture is None
    two = {subject: postures[subject] for subject in "ab"}
    assert fit_pose_prior(NAMES, PARENTS, motions, False, two).covariance_about_posture is None
    wrong = {one: postures[other] for one, other in zip("abcd", "dcba", strict=True)}
    assert fit_pose_prior(NAMES, PARENTS, motions, False, wrong).covariance_about_posture is None


def test_the_spread_between_persons_is_that_of_their_means(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hips of four persons are flexed otherwise, and their arms, which is what they do."""
    monkeypatch.setattr(pose_prior_fit, "PERSON_S", FRAMES / RATE_HZ)
    monkeypatch.setattr(pose_prior_fit, "PERSONS", 4)
    motions, pitches = [], np.radians(np.linspace(-10.0, 10.0, 4))
    for number, pitch in enumerate(pitches):
        mean = mean_of(3)
        for joint in (*HIPS, "LeftArm", "RightArm"):
            mean[NAMES.index(joint) - 1] = mean[NAMES.index(joint) - 1] @ so3.about_axis("y", pitch)
        motions.append(motion(str(number), mean, symmetric_covariance(2)))
    fitted = fit_pose_prior(NAMES, PARENTS, motions)
    assert fitted.between_and_within is not None
    between, _ = fitted.between_and_within
    left, right, arm = (rows(joint)[1] for joint in (*HIPS, "LeftArm"))
    assert between[left, left] == pytest.approx(np.var(pitches), rel=0.05)
    assert between[left, right] == pytest.approx(0.5 * np.var(pitches), rel=0.05)  # four of 4 + 4 persons
    assert between[arm, arm] < np.radians(1.0) ** 2
    assert fit_pose_prior(NAMES, PARENTS, motions[1:-1]).covariance_about_posture is None


def test_half_of_a_known_prior_is_that_of_both_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_prior_fit, "SHRINK_S", FRAMES / RATE_HZ)
    small = 0.1 * symmetric_covariance(5), 0.1 * symmetric_covariance(6)
    mean = mean_of(4)
    moved = mean @ so3.exp((np.radians(2.0) * (np.eye(SIZE) + SWAP) @ np.ones(SIZE)).reshape(-1, 3))
    motions = [motion("a", mean, small[0]), motion("b", moved, small[1])]
    one, two, both = (fit_pose_prior(NAMES, PARENTS, m, False) for m in (motions[:1], motions[1:], motions))
    half = shrunk(one, two, 0.5)
    np.testing.assert_allclose(half.mean_quat_wxyz, both.mean_quat_wxyz, atol=2e-4)
    np.testing.assert_allclose(half.covariance, both.covariance, atol=0.02 * both.covariance.max())
    np.testing.assert_allclose(half.sigma_jerk, both.sigma_jerk, rtol=1e-2)
    assert half.sigma_root_jerk == pytest.approx(both.sigma_root_jerk)
    shorter = fit_pose_prior(NAMES, PARENTS, motions[:1], False, known=two)
    for name, value in shorter.arrays().items():
        np.testing.assert_allclose(value, half.arrays()[name], err_msg=name)


def test_skeletons_of_one_rig_divide_the_trunk_alike() -> None:
    short, tall = (BODY.with_height(height).joint_offsets for height in (1.5, 1.9))
    assert of_one_rig(NAMES, np.stack([short, tall, tall]))
    long_back = BODY.with_bone_lengths({"Spine2": 0.2}).joint_offsets
    assert not of_one_rig(NAMES, np.stack([short, tall, long_back]))


def test_the_prior_of_several_rigs_is_the_formula_written_out() -> None:
    """Of the two motions the first bends at two joints of the spine alone, and clavicles do not move."""
    rigid = symmetric_covariance(7)
    index = rows("Spine", "Spine2", "LeftShoulder", "RightShoulder")
    rigid[index], rigid[:, index] = 0.0, 0.0
    rigid += 1e-12 * np.eye(SIZE)
    motions = [motion("a", mean_of(8), rigid), motion("b", mean_of(9), symmetric_covariance(10))]
    fitted, expected = fit_pose_prior(NAMES, PARENTS, motions), written_out(motions)
    for name, value in expected.items():
        np.testing.assert_allclose(fitted.arrays()[name], value, rtol=1e-12, atol=1e-12, err_msg=name)


def written_out(motions: list[PersonMotion]) -> dict[str, Array]:
    """The arrays of the shipped prior, step by step."""
    local, jerk, root_jerk = [], [], []
    for m in motions:
        R = so3.nearest_rotation(signals.low_pass(m.R_world_bone, 60.0, 10.0))
        own = kinematics.local_rotations(PARENTS, R)
        local += [own, MIRROR @ own[:, OTHER] @ MIRROR]
        jerk.append(np.diff(so3.log(np.swapaxes(own[:-1], -1, -2) @ own[1:]), 2, axis=0) * 60.0**3)
        root_jerk.append(np.diff(signals.low_pass(m.p_world_root, 60.0, 10.0), 3, axis=0) * 60.0**3)
    every = np.concatenate(local)[:, 1:]
    mean = so3.nearest_rotation(every.mean(axis=0))
    for _ in range(10):
        vectors = so3.log(np.swapaxes(mean, -1, -2) @ every)
        mean = mean @ so3.exp(vectors.mean(axis=0))
    spine = [NAMES.index(joint) - 1 for joint in SPINE]
    bend = so3.log(mean[spine[0]] @ mean[spine[1]] @ mean[spine[2]] @ mean[spine[3]])
    mean[spine] = so3.exp(bend / 4)
    vectors[:, spine] = vectors[:, spine].mean(axis=1, keepdims=True)
    own_spread = np.zeros((SIZE, SIZE))
    for a in spine:
        for b in spine:
            block = np.ix_(3 * a + np.arange(3), 3 * b + np.arange(3))
            own_spread[block] = ((a == b) - 1 / 4) * np.diag(np.radians([2.0, 3.0, 2.0]) ** 2)
    covariance = np.cov(vectors.reshape(len(vectors), -1).T) + own_spread
    apart = np.zeros(SIZE)
    for side, sign in (("Left", -1), ("Right", 1)):
        clavicle, arm = (NAMES.index(side + name) - 1 for name in ("Shoulder", "Arm"))
        vectors[:, clavicle] = vectors[:, arm] * [0.25, 0.0, 0.15]
        index = 3 * clavicle + np.arange(3)
        apart[index] = so3.log(mean[clavicle].T @ so3.exp(np.radians([4.0 * sign, 0, 0])))
        own_spread[index, index] = np.radians([6.0, 5.0, 6.0]) ** 2
    following = np.cov(vectors.reshape(len(vectors), -1).T) + own_spread
    mean = mean @ so3.exp(apart.reshape(-1, 3) / 2)
    values, axes = np.linalg.eigh((covariance + following) / 2 + np.outer(apart, apart) / 4)
    size = np.sqrt((np.concatenate(jerk) ** 2).sum(axis=-1).mean(axis=0) / 3)
    return {
        "mean_quat_wxyz": so3.to_quat_wxyz(mean),
        "covariance": axes * np.maximum(values, np.radians(0.3) ** 2) @ axes.T,
        "sigma_jerk": np.maximum((size + size[OTHER]) / 2, 200.0),
        "sigma_root_jerk": np.sqrt((np.concatenate(root_jerk) ** 2).mean()),
    }


def test_a_person_counts_for_a_while_at_most() -> None:
    """Three recordings of one person weigh as much as one of another."""
    one, other = (motion(s, mean_of(11 + i), 0.1 * symmetric_covariance(13 + i)) for i, s in enumerate("ab"))
    even, often = (
        fit_pose_prior(NAMES, PARENTS, [*[one] * n, other], False, longest_s=FRAMES / RATE_HZ) for n in (1, 3)
    )
    np.testing.assert_allclose(often.mean_quat_wxyz, even.mean_quat_wxyz, atol=2e-3)
    np.testing.assert_allclose(often.covariance, even.covariance, atol=0.02 * even.covariance.max())
