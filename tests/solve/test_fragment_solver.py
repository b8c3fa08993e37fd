"""Fragment solvers of either space: choice of the space, refused input and progress."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.choices import SPACES
from rtof_kin.core.errors import InvalidInputError, SolverError, UnknownNameError, ViewError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.solve.cartesian.solver import CartesianSolver
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.initial_guess import initial_guess
from rtof_kin.solve.joint_space.solver import JointSpaceSolver
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings

Array = NDArray[np.float64]
BODY, SMALL = SkeletonModel.default(), SkeletonModel.human36m()
T = 40
QUICK = {
    "joint": JointSpaceSettings(annealing=1, max_iterations=1),
    "cartesian": CartesianSettings(sigma_reprojection=8.0, max_iterations=1),
}


class Scene:
    """A motion, what was observed of it, and poses to start from."""

    def __init__(self) -> None:
        self.truth: Motion = planted.human(BODY, T)
        self.seen = planted.keypoints(self.truth.poses, 3.0)
        self.imus = planted.bone_imus(BODY, self.truth.poses)
        self.start = self.truth.poses


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(params=SPACES)
def solver(request: pytest.FixtureRequest) -> FragmentSolver:
    return quick(request.param)


@cache
def quick(space: str) -> FragmentSolver:
    return FragmentSolver(BODY, 8, QUICK[space], space=space)


def test_default_space_is_joint_where_a_pose_prior_exists() -> None:
    for skeleton, kind, settings in (
        (BODY, JointSpaceSolver, JointSpaceSettings()),
        (SMALL, CartesianSolver, CartesianSettings()),
    ):
        solver = FragmentSolver(skeleton, 8)
        assert isinstance(solver._solver, kind)
        assert solver.settings == settings


@pytest.mark.parametrize("space", SPACES)
def test_space_and_settings_imply_each_other(space: str) -> None:
    settings = QUICK[space]
    assert FragmentSolver(BODY, 8, settings).space == space
    assert type(FragmentSolver(BODY, 8, space=space).settings) is type(settings)
    assert FragmentSolver(BODY, 8, settings, space=space).settings is settings


@pytest.mark.parametrize("space", SPACES)
def test_settings_of_the_other_space_are_refused(space: str) -> None:
    other = QUICK["cartesian" if space == "joint" else "joint"]
    wrong = f"settings: {type(other).__name__} are not those of space '{space}'"
    with pytest.raises(InvalidInputError, match=wrong):
        FragmentSolver(BODY, 8, other, space=space)


def test_joint_space_needs_a_pose_prior() -> None:
    with pytest.raises(InvalidInputError, match="no pose prior is shipped for 'human36m'; use 'cartesian'"):
        FragmentSolver(SMALL, 8, space="joint")


@pytest.mark.parametrize("frames", [0, 6, 9, 51])
def test_a_fragment_must_be_even_and_long_enough(frames: int) -> None:
    with pytest.raises(InvalidInputError, match=f"frames: N = {frames} must be even and at least 8"):
        FragmentSolver(BODY, frames)


def test_unknown_sensor_segment_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"'LeftShin'.*Known: .*LeftLeg"):
        FragmentSolver(BODY, 8, sensor_joints=("LeftShin",))


@pytest.mark.parametrize("space", SPACES)
def test_sensor_without_a_place_is_refused(scene: Scene, space: str) -> None:
    solver = FragmentSolver(BODY, 8, sensor_joints=("LeftArm", "LeftLeg"), space=space)
    with pytest.raises(UnknownNameError, match=r"IMU segment .*'RightArm'.* Known: LeftArm, LeftLeg"):
        solver.solve(scene.start, scene.seen, scene.imus)


def test_start_and_keypoints_need_the_same_times(scene: Scene, solver: FragmentSolver) -> None:
    with pytest.raises(InvalidInputError, match="start and keypoints: must have the same times"):
        solver.solve(scene.start[:20], scene.seen[1:21])


def changed(array: Array, where: Any, by: float) -> Array:
    out = np.array(array)
    out[where] += by
    return out


@pytest.mark.parametrize(
    ("what", "where", "by", "error", "message"),
    [
        ("p_world_joint", (13, 4, 1), np.nan, InvalidInputError, "pose of frame 13 is not finite; bridge"),
        ("p_world_joint", (7, slice(None), 0), 8.0, ViewError, "frame 7 is behind the camera or in it"),
        ("times", slice(30, None), 0.008, InvalidInputError, "not evenly spaced; resample the keypoints"),
    ],
)
def test_wrong_initial_poses_are_refused(
    scene: Scene, solver: FragmentSolver, what: str, where: Any, by: float, error: Any, message: str
) -> None:
    start = replace(scene.start, **{what: changed(getattr(scene.start, what), where, by)})
    with pytest.raises(error, match=message):
        solver.solve(start, replace(scene.seen, times=start.times))


def test_unknown_landmarks_only_are_refused(scene: Scene, solver: FragmentSolver) -> None:
    with pytest.raises(SolverError, match="keypoints: none of the landmarks is "):
        solver.solve(scene.start, replace(scene.seen, names=tuple(f"point {i}" for i in range(21))))


def test_only_joint_space_needs_the_orientations_of_the_start(scene: Scene) -> None:
    R = np.array(scene.start.R_world_bone)
    R[9, 2] = np.nan
    start = replace(scene.start, R_world_bone=R)
    assert np.isfinite(quick("cartesian").solve(start, scene.seen).poses.p_world_joint).all()
    with pytest.raises(InvalidInputError, match="pose of frame 9 is not finite; bridge gaps first"):
        quick("joint").solve(start, scene.seen)


def test_sensors_may_be_several_sequences(scene: Scene, solver: FragmentSolver) -> None:
    joints = scene.imus.joints
    whole = solver.solve(scene.start, scene.seen, scene.imus)
    parts = [one_sensor(scene.imus, joint) for joint in joints]
    split = solver.solve(scene.start, scene.seen, parts)
    np.testing.assert_allclose(split.poses.p_world_joint, whole.poses.p_world_joint, atol=1e-9)
    later = [replace(part, times=part.times + 0.004 * i) for i, part in enumerate(parts)]
    own = BoneImuSequence.joined(later, scene.start.times)
    assert own.joints == joints
    alone = later[3].resample(scene.start.times)
    np.testing.assert_array_equal(own.a_world[:, 3], alone.a_world[:, 0])
    for wrong in ([], [parts[0], parts[0]]):
        with pytest.raises(InvalidInputError, match="there must be some, each of another segment"):
            solver.solve(scene.start, scene.seen, wrong)


def one_sensor(imus: BoneImuSequence, joint: str) -> BoneImuSequence:
    s = [imus.joints.index(joint)]
    return replace(
        imus,
        joints=(joint,),
        R_world_bone=imus.R_world_bone[:, s],
        a_world=imus.a_world[:, s],
        p_bone_sensor=imus.p_bone_sensor[s],
    )


@pytest.mark.parametrize("frames", [1, 4, 11])
def test_progress_is_reported_after_every_fragment(scene: Scene, solver: FragmentSolver, frames: int) -> None:
    reports: list[tuple[int, int]] = []
    solution = solver.solve(scene.start[:frames], scene.seen[:frames], None, lambda *at: reports.append(at))
    count = -(-frames // 4) + 1
    assert reports == [(i + 1, count) for i in range(count)]
    assert [f.first_frame for f in solution.fragments] == [4 * i - 4 for i in range(count)]
    np.testing.assert_array_equal(solution.poses.times, scene.start.times[:frames])


def test_equal_calls_give_equal_results(scene: Scene, solver: FragmentSolver) -> None:
    def solve(space: str = solver.space) -> FragmentSolution:
        return quick(space).solve(scene.start[:12], scene.seen[:12], scene.imus[:12])

    first = solve()
    solver.solve(scene.start[8:30], scene.seen[8:30])
    for space in SPACES:
        solve(space)
    again = solve()
    for field in ("p_world_joint", "R_world_bone"):
        np.testing.assert_array_equal(getattr(again.poses, field), getattr(first.poses, field))
    for one, two in zip(first.fragments, again.fragments, strict=True):
        assert replace(one, seconds=0.0) == replace(two, seconds=0.0)


@pytest.mark.parametrize("joints", [(), ("LeftLeg",), planted.LIMBS[::-1]])
def test_sensors_may_have_any_order(scene: Scene, solver: FragmentSolver, joints: tuple[str, ...]) -> None:
    start, seen, imus = scene.start[:12], scene.seen[:12], scene.imus[:12].select(joints)
    energy = solver.solve(start, seen, imus).energy
    assert (energy["acceleration"] > 0) == bool(joints)
    in_order = [joint for joint in planted.LIMBS if joint in joints]
    one, two = (
        solver.solve(start, seen, given).poses.p_world_joint
        for given in (imus, imus.select(in_order) if joints else None)
    )
    np.testing.assert_array_equal(one, two)


def test_initial_guess_may_be_given_instead_of_poses(scene: Scene, solver: FragmentSolver) -> None:
    start, seen, imus = scene.start[:12], planted.unseen(scene.seen[:12], slice(5, 9)), scene.imus[:12]
    guess = initial_guess(start, seen, imus if solver.space == "joint" else None, BODY)
    given, made = (solver.solve(poses, seen, imus).poses for poses in (guess, start))
    np.testing.assert_array_equal(given.p_world_joint, made.p_world_joint)
