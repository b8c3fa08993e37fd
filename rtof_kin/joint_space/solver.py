"""The joint-space solver over a recording: fragments, their start, noise estimation, blending."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.compiled import compiled
from rtof_kin.errors import SolverError
from rtof_kin.fragment_solution import FragmentReport, SolverStatus
from rtof_kin.joint_space.frame_energy import FEET, TORSO, FrameEnergy, Shape
from rtof_kin.joint_space.ipopt import Ipopt
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.prior import shipped_prior
from rtof_kin.joint_space.problem import TERMS, FragmentData, JointProblem
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.root_position import refit_root
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

Array = NDArray[np.float64]
Block = tuple[PoseSequence, list[FragmentReport]]
_NORMAL_MEDIAN = 1.177
"""Median norm of a normal error in two dimensions, in standard deviations of an axis."""
_FEWEST = 20
_LIMBS = tuple(
    side + part
    for side in ("Left", "Right")
    for part in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
)
_SETTLED = 0.05
"""Relative change below which the reprojection sigma is taken as found."""


class JointSpaceSolver:
    """Optimises the configuration of a skeleton; see `rtof_kin.fragment.FragmentSolver`."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int,
        settings: JointSpaceSettings,
        sensor_joints: tuple[str, ...],
    ) -> None:
        self.skeleton, self.frames, self.settings = skeleton, frames, settings
        self.sensor_joints = sensor_joints
        self.prior = shipped_prior(skeleton.names)

    def run(
        self,
        start: PoseSequence,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None,
        progress: Callable[[int, int], None] | None,
    ) -> Iterator[Block]:
        """Blocks of N/2 frames with the reports that came in since the block before."""
        if not set(keypoints.names) & set(self.skeleton.landmarks):
            raise SolverError("keypoints: none of the landmarks is one of the skeleton")
        data = _Observations(self, start, keypoints, bone_imus)
        half, T = self.frames // 2, len(start)
        i = np.arange(self.frames)
        taper = np.minimum(i + 0.5, self.frames - i - 0.5) ** 2
        firsts, previous = range(-half, T, half), None
        reports: list[FragmentReport] = []
        for done, first in enumerate(firsts, start=1):
            x, report = self._fragment(data, first)
            reports.append(report)
            if progress is not None:
                progress(done, len(firsts))
            if previous is not None:
                stop = min(first + half, T)
                blended = data.space.blend(previous[half:], x[:half], taper[half:], taper[:half])
                p, R = data.space.poses(blended[: stop - first])
                yield start.posed(slice(first, stop), p, R), reports
                reports = []
            previous = x

    def oriented(self, poses: PoseSequence, bone_imus: BoneImuSequence | None) -> PoseSequence:
        """The poses as they are: their orientations are part of the solution."""
        return poses

    def _fragment(self, data: _Observations, first: int) -> tuple[Array, FragmentReport]:
        """(N, 3 + 4A) states of the frames from `first`, and what happened."""
        s, problem, backend = self.settings, data.problem, data.backend
        index, inside, values = data.fragment(first)
        began = perf_counter()
        problem.bind(values)
        annealing = _Annealing(s, problem, data.confidence[index], values.observation)
        x, most = data.start[index], s.annealing if s.sigma_reprojection is None else 0
        try:
            if backend is None:
                solved = data.annealer.solve(x, most + s.max_iterations, s.tolerance, None, annealing)
                solved = self._best(data, solved, index)
            else:
                begun = data.annealer.solve(x, most, s.tolerance, None, annealing)
                solved = backend.solve(begun.x, s.max_iterations, s.tolerance)
                solved = replace(solved, iterations=begun.iterations + solved.iterations)
            failed = not np.isfinite(solved.x).all()
        except SolverError:
            failed = True
        if failed:
            solved = Solved(x, 0, False, np.zeros((len(x), len(data.limits.names) if data.limits else 0)))
        seconds = perf_counter() - began
        report = self._report(data, solved, first, annealing.sigma, seconds, inside)
        return solved.x, replace(report, status=SolverStatus.FAILED) if failed else report

    def _best(self, data: _Observations, solved: Solved, index: NDArray[np.intp]) -> Solved:
        """The lowest of this solution and those from the turned starts, with the same weights."""
        s, iterations = self.settings, solved.iterations
        for start in data.turned:
            other = data.annealer.solve(start[index], s.max_iterations, s.tolerance)
            iterations += other.iterations
            if other.converged and data.problem.total(other.x) < data.problem.total(solved.x):
                solved = other
        return replace(solved, iterations=iterations)

    def _report(
        self, data: _Observations, solved: Solved, first: int, sigma: float, seconds: float,
        inside: NDArray[np.bool_],
    ) -> FragmentReport:  # fmt: skip
        """Everything measured at the point returned."""
        energy, _ = data.problem.value(solved.x)
        gradient, infeasibility = data.problem.gradient(solved.x), 0.0
        if data.limits is not None:
            angles = data.limits.values(solved.x)
            gradient = gradient + data.limits.force(solved.x, solved.multipliers)
            infeasibility = float(np.abs(data.limits.excess(angles)).max(initial=0.0))
        status = SolverStatus.CONVERGED if solved.converged else SolverStatus.ITERATION_LIMIT
        if not data.anything_seen(first, inside):
            status = SolverStatus.UNOBSERVED
        return FragmentReport(
            first_frame=first,
            status=status,
            energy={term: energy[term] for term in TERMS},
            iterations=solved.iterations,
            seconds=seconds,
            sigma_reprojection=sigma,
            optimality=float(np.abs(gradient).max()),
            infeasibility=infeasibility,
        )


class _Annealing:
    """Weighs the landmarks by what is left of them, after every step that changes it."""

    def __init__(
        self, settings: JointSpaceSettings, problem: JointProblem, confidence: Array,
        observation: dict[str, Array],
    ) -> None:  # fmt: skip
        self._settings, self._problem, self._confidence = settings, problem, confidence
        self._seen, self._others = observation["w_visual"] > 0, observation
        given = settings.sigma_reprojection
        self.sigma = settings.sigma_reprojection_range[1] if given is None else given
        """[px] of a landmark per axis."""
        self._left = settings.annealing if given is None else 0
        self._found = self.sigma
        self._weigh(None)

    def __call__(self, x: Array) -> bool:
        """Whether the weights were changed for a state."""
        if self._left == 0:
            return False
        size, factor = self._estimated(self._problem.value(x)[1])
        first = self._left == self._settings.annealing
        if abs(size * factor / self._found - 1) < _SETTLED and not first:
            return False
        self._left -= 1
        self._found = size * factor
        self.sigma = float(np.clip(self._found, *self._settings.sigma_reprojection_range))
        self._weigh(factor)
        return True

    def _weigh(self, factor: float | None) -> None:
        """Weights for errors that correlation in time makes count as if larger by a factor.

        Outliers are landmarks that are far out by the size of the others. A sensor's error and the
        distance from the prior's mean stay for a whole fragment; counted once a frame, their standard
        deviations hold beside a vision whose errors stay too. Where those average out they give way.
        """
        self._problem.reweigh("w_visual", self._confidence * self._seen / self.sigma**2)
        knee = self._settings.robust_reprojection / (factor or 1.0)
        self._problem.reweigh("knee_visual", np.full(len(self._seen), knee))
        largest = self._settings.largest_correlation_factor
        share = (factor or largest) / largest
        for name in ("w_sensor", "w_prior"):
            self._problem.reweigh(name, share * self._others[name])

    def _estimated(self, residuals: Array) -> tuple[float, float]:
        """Size of a landmark's residual per axis, px, and the factor for its correlation in time.

        Errors that stay (biases, drifts) do not average out over a fragment; with a correlation r from
        frame to frame they weigh like white ones that are sqrt((1 + r) / (1 - r)) times larger.
        """
        seen = self._seen
        if seen.sum() < _FEWEST:
            return self._found, 1.0
        norm = np.linalg.norm(residuals, axis=-1)
        size = float(np.median(norm[seen])) / _NORMAL_MEDIAN
        clipped = np.clip(residuals, -3 * size, 3 * size) * seen[..., None]
        both = seen[1:] & seen[:-1]
        product = np.sum(clipped[1:] * clipped[:-1], axis=-1)[both].mean() if both.any() else 0.0
        square = np.sum(clipped**2, axis=-1)[seen].mean()
        r = float(np.clip(product / max(square, 1e-12), 0.0, 0.99))
        return size, float(min(np.sqrt((1 + r) / (1 - r)), self._settings.largest_correlation_factor))


class _Observations:
    """A recording as the problem wants it, and the problem that fits what it has."""

    def __init__(
        self,
        solver: JointSpaceSolver,
        start: PoseSequence,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None,
    ) -> None:
        skeleton, s = solver.skeleton, solver.settings
        self.settings, self.frames, self.rate_hz = s, solver.frames, start.rate_hz
        start = refit_root(start, keypoints) if s.refit_root else start
        known = skeleton.landmarks
        extra = tuple(n for n in keypoints.names if n in known and n not in skeleton.names)
        names = (*skeleton.names, *extra)
        sensors = tuple(name for name in skeleton.names if name in _speaking(bone_imus))
        moving = [
            name for j, name in enumerate(skeleton.names)
            if kinematics.children_of(skeleton.parents, j) or name in sensors
            or any(known[n][0] == name for n in extra)
        ]  # fmt: skip
        self.space = StateSpace(skeleton, moving, s.hinges)
        self.problem, functions = _problem(solver, tuple(moving), names, sensors)
        self.limits = Limits(self.space, functions) if s.limits else None
        self.annealer = LevenbergMarquardt(self.problem, self.limits)
        self.backend = Ipopt(self.problem, self.limits) if s.backend == "ipopt" else None
        self._observe(solver, start, keypoints.select(names), bone_imus, sensors)
        x = self.space.from_poses(start.p_world_joint[:, 0], start.R_world_bone)
        self.start = self.space.low_passed(x, start.rate_hz, s.smooth_start_hz)
        self.turned = [
            self.space.low_passed(self._turned(start, yaw), start.rate_hz, s.smooth_start_hz)
            for yaw in s.torso_yaws
        ]

    def _turned(self, start: PoseSequence, yaw: float) -> Array:
        """States of the start with its trunk turned about the vertical, the limbs as they are."""
        R = start.R_world_bone.copy()
        trunk = [j for j, name in enumerate(start.names) if not name.startswith(_LIMBS)]
        R[:, trunk] = so3.about_axis("z", yaw) @ R[:, trunk]
        return self.space.from_poses(start.p_world_joint[:, 0], R)

    def _observe(
        self, solver: JointSpaceSolver, start: PoseSequence, seen: KeypointSequence,
        bone_imus: BoneImuSequence | None, sensors: tuple[str, ...],
    ) -> None:  # fmt: skip
        skeleton, s, camera, T = solver.skeleton, solver.settings, seen.camera, len(start)
        uv = camera.normalise(seen.uv_px) @ camera.K[:2, :2].T + camera.K[:2, 2]
        self.confidence = np.where(seen.seen, seen.confidence, 0.0)
        quat, has, a, w, levers = _sensor_data(start, bone_imus, sensors, s)
        torso = skeleton.index(*[name for name in TORSO if name in skeleton.names])
        sensed = np.zeros(T, dtype=bool)
        for j in torso:
            if skeleton.names[j] in sensors:
                sensed |= has[:, sensors.index(skeleton.names[j])] > 0
        weight = 0.0 if s.sigma_torso is None else 1 / s.sigma_torso**2
        rows = {
            "uv_px": np.where(seen.seen[..., None], uv, 0.0),
            "w_visual": seen.seen.astype(float),
            "knee_visual": np.full(T, s.robust_reprojection),
            "quat_sensor": quat,
            "w_sensor": has,
            "quat_torso": so3.to_quat_wxyz(start.R_world_bone[:, torso]),
            "w_torso": np.where(sensed, 0.0, weight),
            "b_world": _bone_vectors(start, _bones(skeleton, sensors)),
            "w_bone": np.full(T, 0.0 if s.sigma_bone is None else 1 / s.sigma_bone**2),
            "p_root": start.p_world_joint[:, 0],
            "w_root": np.full(T, 0.0 if s.sigma_root is None or sensors else 1 / s.sigma_root**2),
            "w_floor": np.full(T, 0.0 if s.floor_height is None else 1 / s.sigma_floor**2),
            "w_prior": np.ones(T),
        }
        self.rows = rows
        self.a_world, self.w_acceleration = a, w
        prior, moving = solver.prior, self.space.names[1:]
        mean = prior.mean_quat_wxyz[[prior.joints.index(name) - 1 for name in moving]]
        self.constant = {
            "offsets": skeleton.joint_offsets.T,
            "K": camera.K,
            "R_camera_world": camera.R_camera_world,
            "t_camera_world": camera.t_camera_world,
            "whitening": _whitening(skeleton, sensors, s),
            "levers": levers.T,
            "places": np.array([skeleton.landmarks[name][1] for name in seen.names]).T,
            "quat_mean": mean.T,
            "precision": prior.precision(moving, s.prior_inflation, s.sigma_prior_least),
            "floor": np.array([(s.floor_height or 0.0) + s.ankle_height]),
        }

    def fragment(self, first: int) -> tuple[NDArray[np.intp], NDArray[np.bool_], FragmentData]:
        """Indices of a fragment's frames, which of them exist, and their data."""
        frame = np.arange(first, first + self.frames)
        inside = (frame >= 0) & (frame < len(self.start))
        index = np.clip(frame, 0, len(self.start) - 1)
        observation = {name: values[index] for name, values in self.rows.items()}
        for name in ("w_visual", "w_sensor", "w_torso", "w_bone", "w_root", "w_floor"):
            observation[name] = (observation[name].T * inside).T
        whole = inside[2:] & inside[1:-1] & inside[:-2]
        return index, inside, FragmentData(
            observation, self.constant, self.a_world[index][1:-1],
            self.w_acceleration[index][1:-1] * whole[:, None],
            (np.convolve(inside, np.ones(4), mode="valid") == 4).astype(float), self.rate_hz,
        )  # fmt: skip

    def anything_seen(self, first: int, inside: NDArray[np.bool_]) -> bool:
        """Whether a landmark or a sensor says anything in a fragment."""
        index = np.arange(first, first + self.frames)[inside]
        rows = self.rows["w_visual"], self.rows["w_sensor"], self.w_acceleration
        return any(row[index].any() for row in rows)


def _speaking(bone_imus: BoneImuSequence | None) -> set[str]:
    """Segments whose sensor says anything at all."""
    if bone_imus is None:
        return set()
    turns = np.isfinite(bone_imus.R_world_bone).all(axis=(2, 3)).any(axis=0)
    moves = np.isfinite(bone_imus.a_world).all(axis=2).any(axis=0)
    return {bone_imus.joints[s] for s in np.flatnonzero(turns | moves)}


def _sensor_data(
    start: PoseSequence, bone_imus: BoneImuSequence | None, sensors: tuple[str, ...],
    settings: JointSpaceSettings,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Quaternions (T, S, 4), their weights (T, S), accelerations (T, S, 3), weights, levers (S, 3)."""
    T, S = len(start), len(sensors)
    quat = np.zeros((T, S, 4))
    quat[..., 0] = 1.0
    has, a, w, levers = np.zeros((T, S)), np.zeros((T, S, 3)), np.zeros((T, S)), np.zeros((S, 3))
    if bone_imus is None:
        return quat, has, a, w, levers
    if not np.array_equal(bone_imus.times, start.times):
        bone_imus = bone_imus.resample(start.times)
    for k, joint in enumerate(sensors):
        if joint not in bone_imus.joints:
            continue
        s = bone_imus.joints.index(joint)
        R, known = bone_imus.R_world_bone[:, s], np.isfinite(bone_imus.R_world_bone[:, s, 0, 0])
        quat[known, k] = so3.to_quat_wxyz(R[known])
        has[:, k] = known
        measured = np.isfinite(bone_imus.a_world[:, s]).all(axis=-1)
        a[:, k] = np.nan_to_num(bone_imus.a_world[:, s])
        w[:, k] = measured / settings.sigma_acceleration**2
        levers[k] = bone_imus.p_bone_sensor[s]
    return quat, has, a, w, levers


def _bones(skeleton: SkeletonModel, sensors: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Joint and child of the limbs' bones that carry no sensor: those of the usual sensors' segments."""
    usual = {joint for joint, _ in skeleton.sensors.values()} - {*sensors, *TORSO}
    pairs = [
        (joint, kinematics.children_of(skeleton.parents, joint)) for joint in skeleton.index(*usual)
    ]
    return tuple(sorted((joint, children[0]) for joint, children in pairs if len(children) == 1))


def _bone_vectors(start: PoseSequence, bones: tuple[tuple[int, int], ...]) -> Array:
    """(T, B, 3) of the start, m."""
    p = start.p_world_joint
    return (
        np.stack([p[:, child] - p[:, joint] for joint, child in bones], axis=1)
        if bones
        else (np.zeros((len(p), 0, 3)))
    )


def _whitening(skeleton: SkeletonModel, sensors: tuple[str, ...], s: JointSpaceSettings) -> Array:
    """(9, S) column-major matrices from an orientation's error, rad, to swing and twist in sigmas.

    Of a segment with several children or none, all three axes have the swing's sigma.
    """
    columns = []
    for joint in skeleton.index(*sensors):
        children = kinematics.children_of(skeleton.parents, joint)
        W = np.eye(3) / s.sigma_swing
        if len(children) == 1:
            bone = so3.unit(skeleton.joint_offsets[children[0]])
            along = np.outer(bone, bone)
            W = (np.eye(3) - along) / s.sigma_swing + along / s.sigma_twist
        columns.append(W.ravel(order="F"))
    return np.array(columns).reshape(-1, 9).T


def _problem(
    solver: JointSpaceSolver, moving: tuple[str, ...], names: tuple[str, ...],
    sensors: tuple[str, ...],
) -> tuple[JointProblem, list[Any]]:  # fmt: skip
    """The problem for some moving joints, landmarks and sensors, and the functions of their limits."""
    skeleton, s = solver.skeleton, solver.settings
    index = skeleton.names.index
    shape = Shape(
        landmarks=tuple((index(skeleton.landmarks[n][0]), n in skeleton.names) for n in names),
        sensors=tuple(map(index, sensors)),
        torso=tuple(index(name) for name in TORSO if name in skeleton.names),
        bones=_bones(skeleton, sensors),
        feet=tuple(index(name) for name in FEET if name in skeleton.names),
        robust_orientation=s.robust_orientation,
        floor_cutoff=s.floor_cutoff,
    )
    return _cached_problem(
        skeleton.name, shape, moving, solver.frames, s.hinges, s.compile,
        s.jerk if sensors else s.jerk_without_sensors, s.robust_acceleration,
    )  # fmt: skip


@lru_cache(maxsize=8)
def _cached_problem(
    name: str, shape: Shape, moving: tuple[str, ...], frames: int, hinges: bool, compile: str,
    jerk: float, robust_acceleration: float,
) -> tuple[JointProblem, list[Any]]:  # fmt: skip
    """The problem of a fragment, built once for all bodies and recordings that it fits."""
    energy, functions, of_limits = _functions(name, shape, moving, hinges, compile)
    space, prior = energy.space, shipped_prior(SkeletonModel.named(name).names)
    sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
    tangent = np.repeat(sigma, 3) @ (space.expand != 0)
    sigma_jerk = jerk * np.concatenate([np.full(3, prior.sigma_root_jerk), tangent])
    problem = JointProblem(space, functions, energy, frames, sigma_jerk, robust_acceleration)
    return problem, of_limits


@lru_cache(maxsize=8)
def _functions(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, compile: str
) -> tuple[FrameEnergy, list[Any], list[Any]]:
    """A frame's functions and those of its limits, built (and compiled) once for all bodies."""
    space = StateSpace(SkeletonModel.named(name), moving, hinges)
    energy = FrameEnergy(space, shape)
    functions = [*energy.functions(), *Limits(space).functions]
    functions = compiled(functions) if compile == "auto" else functions
    count = len(energy.functions())
    return energy, functions[:count], functions[count:]
