"""What the Hessian says of a solution, against dense inverses, perturbed poses and repeated noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.covariance import (
    blended,
    confidence_of,
    segment_pairs,
    state_covariances,
    unseen_covariance,
    unseen_times,
)
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.settings import JointSpaceSettings

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
N = 16
SIGMA_PX, SIGMA_RAD = 3.0, np.radians(3.0)
HONEST = JointSpaceSettings(
    sigma_reprojection=SIGMA_PX,
    robust_reprojection=50.0,
    sigma_swing=SIGMA_RAD,
    sigma_twist=SIGMA_RAD,
    robust_orientation=50.0,
    sigma_torso=None,
    sigma_bone=None,
    prior_inflation=5.0,
    jerk=20.0,
    limits=False,
    refit_root=False,
    smooth_start_hz=29.0,
)
"""Settings with the true sizes of errors and hardly any smoothing."""


def truth(frames: int, seed: int = 0) -> PoseSequence:
    """A human motion of half its usual size."""
    return planted.human(BODY, frames, seed, size=0.5).poses


def observed(poses: PoseSequence, seed: int) -> dict[str, Any]:
    """White errors of the sizes that `HONEST` knows of; no accelerations."""
    imus = planted.bone_imus(BODY, poses, (*planted.LIMBS, "Hips", "Spine3"))
    errors = np.random.default_rng(seed).normal(size=(*imus.R_world_bone.shape[:2], 3)) * SIGMA_RAD
    unmeasured = np.full(imus.a_world.shape, np.nan)
    imus = replace(imus, R_world_bone=imus.R_world_bone @ so3.exp(errors), a_world=unmeasured)
    return {"keypoints": planted.keypoints(poses, SIGMA_PX, seed), "bone_imus": imus}


def solved(poses: PoseSequence, seed: int = 0, **changes: Any) -> FragmentSolution:
    solver = FragmentSolver(BODY, N, HONEST)
    return solver.solve(poses, confidence=True, **{**observed(poses, seed), **changes})


def known(solution: FragmentSolution) -> Confidence:
    return solution.confidence


def test_covariances_of_states_are_blocks_of_the_dense_inverse() -> None:
    poses = truth(N)
    data = Observations(BODY, N, HONEST, InitialGuess(poses, np.zeros(N)), **observed(poses, 1))
    solver = LevenbergMarquardt(data.problem, None)
    data.problem.bind(data.fragment(0)[2])
    answer = solver.solve(data.start, 20, 1e-6)
    found = state_covariances(data.problem, solver, answer)
    D = data.space.size
    expected = np.linalg.inv(data.problem.hessian()).reshape(N, D, N, D)
    for t in (0, 7, N - 1):
        np.testing.assert_allclose(found[t], expected[t, :, t], rtol=1e-4, atol=1e-8)


def test_pose_covariances_equal_those_of_perturbed_states() -> None:
    space = StateSpace(BODY, [n for n in BODY.names if n not in ("LeftHand", "RightHand")], hinged=True)
    poses, h = truth(1), 1e-6
    x = space.from_poses(poses.p_world_joint[:, 0], poses.R_world_bone)
    root = 0.02 * np.random.default_rng(0).normal(size=(space.size, space.size))
    found = confidence_of(space, poses.times, x, (root @ root.T)[None])
    many = np.repeat(x, space.size, axis=0)
    there, back = (space.poses(space.retract(many, s * h * root.T)) for s in (1, -1))
    moved = (there[0] - back[0]) / (2 * h)  # by every column of the covariance's root
    np.testing.assert_allclose(
        np.einsum("dji,djk->jik", moved, moved), found.position_covariance[0], rtol=1e-6, atol=1e-6
    )
    moved = moved - moved[:, :1]
    np.testing.assert_allclose(
        np.einsum("dji,djk->jik", moved, moved), found.relative_covariance[0], rtol=1e-6, atol=1e-6
    )
    for parent, child in found.pairs:
        before, after = (seen_from(R, parent, child) for R in (back[1], there[1]))
        turned = so3.log(np.swapaxes(before, 1, 2) @ after) / (2 * h)
        if child in space.names:
            turn = found.turn(parent, child)[0]
            np.testing.assert_allclose(turned.T @ turned, turn, rtol=1e-5, atol=1e-5)


def seen_from(R: Array, parent: str, child: str) -> Array:
    own = R[:, BODY.names.index(child)]
    return own if parent == WORLD else np.swapaxes(R[:, BODY.names.index(parent)], 1, 2) @ own


def test_covariances_cover_white_errors() -> None:
    """Without inflation, as errors are white."""
    poses = truth(3 * N)
    inside = {name: list[Array]() for name in ("position", "relative", "turn")}
    for seed in range(4):
        solution = solved(poses, seed)
        found, p, R = known(solution), solution.poses.p_world_joint, solution.poses.R_world_bone
        error = p - poses.p_world_joint
        limbs = BODY.index(*planted.LIMBS)
        turned = so3.log(np.swapaxes(poses.R_world_bone[:, limbs], 2, 3) @ R[:, limbs])
        turns = np.stack([found.turn(WORLD, name) for name in planted.LIMBS], axis=1)
        for name, off, covariance in (
            ("position", error, found.position_covariance),
            ("relative", (error - error[:, :1])[:, 1:], found.relative_covariance[:, 1:]),
            ("turn", turned, turns),
        ):
            sigma = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
            inside[name].append(np.abs(off) < 1.96 * sigma)
    for name, hits in inside.items():
        assert 0.92 < np.mean(hits) < 0.985, name


def test_unobserved_root_is_unknown() -> None:
    poses = truth(6 * N)
    seen = planted.unseen(planted.keypoints(poses, SIGMA_PX), slice(N, None))
    found = known(solved(poses, keypoints=seen, bone_imus=None))
    assert np.isfinite(found.position_sigma[: N // 2]).all()
    assert np.isnan(found.position_sigma[-N:]).all()
    assert np.isnan(found.turn_covariance[-N:]).all()


def test_segment_fixed_to_its_parent_is_unknown() -> None:
    found = known(solved(truth(2 * N)))
    for name in ("LeftHand", "RightFoot", "Head"):
        assert np.isnan(found.turn(WORLD, name)).all(), name
    assert np.isfinite(found.position_covariance).all()


def test_active_limit_reduces_the_covariance() -> None:
    """Bent knees on a body whose knees do not bend."""
    poses = truth(2 * N)
    joints = tuple(
        replace(joint, limits=np.tile([-0.02, 0.02], (3, 1))) if joint.name == "LeftLeg" else joint
        for joint in BODY.table.joints
    )
    body, seen, sigma = SkeletonModel(replace(BODY.table, joints=joints)), observed(poses, 0), []
    for settings in (HONEST, replace(HONEST, limits=True)):
        found = known(FragmentSolver(body, N, settings).solve(poses, confidence=True, **seen))
        knee = found.turn("LeftUpLeg", "LeftLeg")
        sigma.append(np.degrees(np.sqrt(np.trace(knee, axis1=1, axis2=2))))
    assert np.all(sigma[0] > 1.0)
    assert np.all(sigma[1] < 0.8 * sigma[0])


def test_confidence_is_optional_and_changes_no_pose() -> None:
    poses = truth(2 * N)
    asked = solved(poses)
    plain = FragmentSolver(BODY, N, HONEST).solve(poses, **observed(poses, 0))
    assert plain.confidence is None
    np.testing.assert_array_equal(asked.poses.p_world_joint, plain.poses.p_world_joint)


def test_blend_is_the_mean_or_the_known_covariance() -> None:
    one, two = np.tile(np.eye(2), (3, 1, 1)), np.tile(4 * np.eye(2), (3, 1, 1))
    two[2] = np.nan
    found = blended(one, two, np.array([0.0, 0.5, 0.5]))
    np.testing.assert_allclose(found[:, 0, 0], [1.0, 2.5, 1.0])
    np.testing.assert_allclose(blended(two, one, np.full(3, 0.5))[2], np.eye(2))


def test_pairs_include_those_of_clinical_angles() -> None:
    from rtof_kin.clinical.angle_table import angle_table

    pairs = segment_pairs(BODY)
    assert {(joint.parent, joint.child) for joint in angle_table(BODY.table).joints} <= set(pairs)
    assert len(pairs) == len(set(pairs))


T, HIDDEN = 150, slice(30, 120)
POSES = planted.human(BODY, T).poses
LEG = ("LeftLeg", "LeftFoot")


def data(keypoints: KeypointSequence, *sensors: str) -> Observations:
    imus = planted.bone_imus(BODY, POSES, sensors) if sensors else None
    return Observations(
        BODY, 8, JointSpaceSettings(refit_root=False), InitialGuess(POSES, np.zeros(T)), keypoints, imus
    )


def hidden() -> KeypointSequence:
    return planted.unseen(planted.keypoints(POSES), HIDDEN, BODY.index(*LEG))


def sigmas(observations: Observations, joint: str) -> NDArray[np.float64]:
    """(T,) rad, root mean square of the axes."""
    space = observations.space
    covariance = unseen_covariance(observations, unseen_times(observations))
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, space.columns(BODY.index(joint)[0])]
    return np.asarray(np.sqrt(variances.mean(axis=1)))


def test_unseen_thigh_and_knee_return_to_the_spread_of_the_prior() -> None:
    for joint in ("LeftLeg", "LeftUpLeg"):
        found = sigmas(data(hidden()), joint)
        assert not found[: HIDDEN.start].any()
        assert not found[HIDDEN.stop :].any()
        middle = found[(HIDDEN.start + HIDDEN.stop) // 2]
        assert np.degrees(middle) > 15
        assert found[HIDDEN.start] < 0.1 * middle  # next to an observation
    assert not sigmas(data(hidden()), "RightLeg").any()


def test_a_sensor_sees_what_turns_its_segment() -> None:
    observations = data(hidden(), "LeftUpLeg", "LeftLeg")
    assert not sigmas(observations, "LeftUpLeg").any()
    assert not sigmas(observations, "LeftLeg").any()
    assert sigmas(data(hidden(), "LeftUpLeg"), "LeftLeg").max() > 0.2


def test_everything_seen_has_no_spread() -> None:
    seen = data(planted.keypoints(POSES))
    assert not unseen_covariance(seen, unseen_times(seen)).any()


def test_what_is_never_seen_has_the_whole_spread() -> None:
    never = replace(hidden(), times=POSES.times)
    never = planted.unseen(never, slice(None), BODY.index(*LEG))
    assert np.ptp(sigmas(data(never), "LeftLeg")) < 1e-9
