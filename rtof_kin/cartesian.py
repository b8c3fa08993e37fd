"""`FragmentSolver`: the paper's temporal optimisation, in overlapping fragments of N frames.

Fragments begin every N/2 frames, so every frame is solved twice; the two answers are blended. The problem
is built once (`fragment_problem`); solving only passes numbers, and two equal calls give equal answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics, signals
from rtof_kin.errors import ShapeError, SolverError, UnknownNameError
from rtof_kin.fragment_problem import TERMS, fragment_problem
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
from rtof_kin.root_position import refit_root
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with (fragments done, fragments in all)."""


class SolverStatus(Enum):
    """How a fragment's optimisation ended."""

    CONVERGED = "The gradient at the returned point is below the tolerance."
    ACCEPTABLE = "The solver stopped at a looser tolerance; see the optimality."
    ITERATION_LIMIT = "The iteration limit was reached before the tolerance."
    FAILED = "The solver gave up; the starting poses are returned for this fragment."


@dataclass(frozen=True)
class FragmentReport:
    """What happened to one fragment."""

    first_frame: int
    """Index of its first frame; negative where it begins in the padding."""
    status: SolverStatus
    energy: dict[str, float]
    """Weighted energy per term at the returned point."""
    iterations: int
    seconds: float
    """Time of the solver."""
    sigma_reprojection: float
    """Standard deviation of a landmark that was used, px; given, or estimated from the fragment."""
    optimality: float
    """Largest derivative of the energy at the returned point, 1/m, measured there; with bone lengths as
    constraints, of the Lagrangian."""
    infeasibility: float
    """Largest violation of a squared bone length, m^2; 0 without constraints."""


@dataclass(frozen=True)
class FragmentSolution:
    """Optimised poses of a recording and how they came about."""

    poses: PoseSequence
    """Blended joint positions; orientations from them, twist from the sensors."""
    fragments: tuple[FragmentReport, ...]
    """One report for every fragment."""

    @property
    def status(self) -> SolverStatus:
        """The worst status of all fragments."""
        order = list(SolverStatus)
        return max((f.status for f in self.fragments), key=order.index)

    @property
    def energy(self) -> dict[str, float]:
        """Mean over the fragments of each weighted energy term."""
        return {t: float(np.mean([f.energy[t] for f in self.fragments])) for t in TERMS}

    @property
    def optimality(self) -> float:
        """Largest of the fragments' optimalities, 1/m."""
        return max(f.optimality for f in self.fragments)

    @property
    def iterations(self) -> int:
        """Iterations of all fragments together."""
        return sum(f.iterations for f in self.fragments)

    @property
    def seconds(self) -> float:
        """Solver time of all fragments together, s."""
        return sum(f.seconds for f in self.fragments)


class FragmentSolver:
    """Optimises pose sequences of one skeleton with keypoints and any subset of its sensors."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int = 50,
        settings: FragmentSettings | None = None,
        sensor_joints: tuple[str, ...] | None = None,
    ) -> None:
        """Build the problem.

        Args:
            skeleton: gives the joints and the bone lengths.
            frames: N, even, at least 8.
            settings: weights, sigmas, cropping and blending.
            sensor_joints: segments whose sensors the problem has a place for; every segment that
                usually carries one where not given. A recording may have any subset of them.

        Raises:
            ShapeError: N is odd or too small. UnknownNameError: a segment that does not exist.
        """
        if frames < 8 or frames % 2:
            raise ShapeError(f"frames: N = {frames} must be even and at least 8")
        self.skeleton, self.frames = skeleton, frames
        self.settings = settings or FragmentSettings()
        usual = tuple(joint for joint, _ in skeleton.sensors.values())
        self.sensor_joints = usual if sensor_joints is None else tuple(sensor_joints)
        bones = [
            (joint, child)
            for joint in skeleton.index(*self.sensor_joints)
            for child in kinematics.children_of(skeleton.parents, joint)
        ]  # leaves (head, feet) have no bone here: a sensor there does not enter
        self._problem = fragment_problem(skeleton.parents, frames, tuple(bones), self.settings)
        p = skeleton.forward_kinematics(skeleton.t_pose()[None])[0][0]
        a, b = np.array(self._problem.pairs).T
        self._lengths = np.linalg.norm(p[b] - p[a], axis=1)

    def solve(
        self,
        start: PoseSequence,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None = None,
        progress: Progress | None = None,
    ) -> FragmentSolution:
        """Optimise a whole sequence: RTOF with sensors, RTO (no E_A, no E_B) without.

        Args:
            start: finite poses of this skeleton, usually SF2's; also the weak prior's centre.
            keypoints: one sample a frame of `start`, landmarks named like joints; NaN where unseen.
            bone_imus: any subset of the sensors, at any times. None for vision alone.
            progress: told after every fragment.

        Returns:
            The poses and a report for each fragment.

        Raises:
            ShapeError: start and keypoints differ in their times, a pose is not finite, or the person
                is behind the camera. UnknownNameError: joints or sensors of another skeleton.
            SolverError: none of the landmarks is a joint.
        """
        blocks, reports = [], []
        for block, finished in self._run(start, keypoints, bone_imus, progress):
            blocks.append(block)
            reports += finished
        joined = np.concatenate([block.p_world_joint for block in blocks])
        poses = self._with_orientations(replace(start, p_world_joint=joined), bone_imus)
        return FragmentSolution(poses, tuple(reports))

    def stream(
        self,
        start: PoseSequence,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None = None,
    ) -> Iterator[PoseSequence]:
        """The poses of `solve`, N/2 frames at a time, each as soon as both its fragments are solved."""
        for block, _ in self._run(start, keypoints, bone_imus, None):
            yield self._with_orientations(block, bone_imus)

    # --- the run over fragments ------------------------------------------------------------------

    def _run(
        self,
        start: PoseSequence,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None,
        progress: Progress | None,
    ) -> Iterator[tuple[PoseSequence, list[FragmentReport]]]:
        """Blocks of N/2 frames with the reports that came in since the block before."""
        self._check(start, keypoints, bone_imus)
        if self.settings.refit_root:
            start = refit_root(start, keypoints)
        data = self._observations(start, keypoints, bone_imus)
        half, T = self.frames // 2, len(start)
        firsts = range(-half, T, half)
        taper = self._taper()
        previous: Array | None = None
        reports: list[FragmentReport] = []
        for done, first in enumerate(firsts, start=1):
            X, report = self._solve_fragment(first, start, data)
            reports.append(report)
            if progress is not None:
                progress(done, len(firsts))
            if previous is not None:
                stop = min(first + half, T)
                weights = taper[half:], taper[:half]
                blended = (
                    weights[0][:, None, None] * previous[half:]
                    + weights[1][:, None, None] * X[:half]
                ) / (weights[0] + weights[1])[:, None, None]
                yield (
                    replace(start[first:stop], p_world_joint=blended[: stop - first]),
                    reports,
                )
                reports = []
            previous = X

    def _taper(self) -> Array:
        """(N,) weight of a fragment's frames when blended with its neighbours'."""
        i = np.arange(self.frames)
        if self.settings.blend == "average":
            return np.ones(self.frames)
        return np.asarray(np.minimum(i + 0.5, self.frames - i - 0.5) ** 2)

    def _solve_fragment(
        self, first: int, start: PoseSequence, data: dict[str, Array]
    ) -> tuple[Array, FragmentReport]:
        """(N, J, 3) optimised positions, and what happened."""
        frame = np.arange(first, first + self.frames)
        inside = (frame >= 0) & (frame < len(start))
        index = np.clip(frame, 0, len(start) - 1)
        x = start.p_world_joint[index].ravel()
        values = self._fragment_values(index, inside, start, data)
        sigma = self.settings.sigma_reprojection or self.settings.sigma_reprojection_first
        x, report = self._call(x, values | {"sigma_reprojection": np.array([sigma])}, first)
        if self.settings.sigma_reprojection is None and report.status is not SolverStatus.FAILED:
            sigma = self._estimated_sigma(x, values, sigma)
            x, again = self._call(x, values | {"sigma_reprojection": np.array([sigma])}, first)
            report = replace(
                again,
                iterations=report.iterations + again.iterations,
                seconds=report.seconds + again.seconds,
            )
        return x.reshape(self.frames, -1, 3), report

    def _call(
        self, x0: Array, values: dict[str, Array], first: int
    ) -> tuple[Array, FragmentReport]:
        """One call of IPOPT; everything in the report is measured at the point returned."""
        problem, p = self._problem, self._problem.pack(values)
        began = perf_counter()
        bounds = 0.0 if self.settings.bone_lengths == "constraint" else ()
        result = problem.solver(x0=x0, p=p, lbg=bounds, ubg=bounds)
        seconds = perf_counter() - began
        x = np.asarray(result["x"]).ravel()
        stats = problem.solver.stats()
        status = _status(stats["return_status"])
        if status is SolverStatus.FAILED or not np.all(np.isfinite(x)):
            status, x = SolverStatus.FAILED, x0
        gradient = np.asarray(problem.gradient(x, p)).ravel()
        g = np.asarray(problem.constraints(x, p)).ravel()
        if len(g):
            gradient = gradient + np.asarray(problem.constraint_gradient(x, p, result["lam_g"])).ravel()
        return x, FragmentReport(
            first_frame=first,
            status=status,
            energy=dict(zip(TERMS, np.asarray(problem.energy(x, p)).ravel().tolist(), strict=True)),
            iterations=int(stats["iter_count"]),
            seconds=seconds,
            sigma_reprojection=float(values["sigma_reprojection"][0]),
            optimality=float(np.abs(gradient).max()),
            infeasibility=float(np.abs(g).max(initial=0.0)),
        )

    def _estimated_sigma(self, x: Array, values: dict[str, Array], sigma: float) -> float:
        """Twice the size of the reprojection residuals at x, px; `sigma` where hardly any are seen.

        The median norm of a normal error in two dimensions is 1.177 of its standard deviation.
        """
        p_camera = values["R_camera_world"] @ x.reshape(-1, 3).T + values["t_camera_world"][:, None]
        homogeneous = values["K"] @ p_camera
        error = np.linalg.norm(homogeneous[:2] / homogeneous[2] - values["uv_px"], axis=0)
        seen = values["w_visual"] > 0
        if seen.sum() < 20:
            return sigma
        low, high = self.settings.sigma_reprojection_range
        return float(np.clip(2 * np.median(error[seen]) / 1.177, low, high))

    # --- observations ----------------------------------------------------------------------------

    def _check(
        self, start: PoseSequence, keypoints: KeypointSequence, bone_imus: BoneImuSequence | None
    ) -> None:
        names = self.skeleton.names
        self.skeleton.check_joints(start.names, "start")
        if not np.array_equal(start.times, keypoints.times):
            raise ShapeError("start and keypoints: must have the same times, one sample a frame")
        if not np.all(np.isfinite(start.p_world_joint)):
            frame = int(np.argwhere(~np.isfinite(start.p_world_joint))[0][0])
            raise ShapeError(f"start: the pose of frame {frame} is not finite; bridge gaps first")
        if len(start) > 1:
            steps = np.diff(start.times) * start.rate_hz
            if np.any(np.abs(steps - 1) > 0.1):
                raise ShapeError("start: frames are not evenly spaced; resample the keypoints first")
        if bone_imus is not None:
            unknown = [j for j in bone_imus.joints if j not in self.sensor_joints]
            if unknown:
                raise UnknownNameError("IMU segment", unknown, self.sensor_joints)
        if not set(keypoints.names) & set(names):
            raise SolverError("keypoints: none of the landmarks is a joint of the skeleton")
        depth = keypoints.camera.to_camera(start.p_world_joint)[..., 2]
        if np.any(depth < 0.05):
            frame = int(np.argwhere(depth < 0.05)[0][0])
            raise ShapeError(
                f"start: frame {frame} is behind the camera or in it; check R_camera_world, "
                "t_camera_world (world to camera, metres) and the world's z axis"
            )

    def _observations(
        self, start: PoseSequence, keypoints: KeypointSequence, bone_imus: BoneImuSequence | None
    ) -> dict[str, Array]:
        """Everything observed, per frame of the recording; weights 0 where there is nothing."""
        camera, seen = keypoints.camera, keypoints.select(self.skeleton.names)
        uv = camera.normalise(seen.uv_px) @ camera.K[:2, :2].T + camera.K[:2, 2]
        T, B = len(start), len(self._problem.sensor_bones)
        shares = np.full(B, 0.5)
        a, b = np.full((T, B, 3), np.nan), np.full((T, B, 3), np.nan)
        if bone_imus is not None:
            if not np.array_equal(bone_imus.times, start.times):
                bone_imus = bone_imus.resample(start.times)
            for k, (joint, child) in enumerate(self._problem.sensor_bones):
                if (name := self.skeleton.names[joint]) in bone_imus.joints:
                    s = bone_imus.joints.index(name)
                    R, rest = bone_imus.R_world_bone[:, s], self.skeleton.joint_offsets[child]
                    lever = bone_imus.p_bone_sensor[s]
                    shares[k] = np.clip(lever @ rest / (rest @ rest), 0, 1)
                    # What the lever arm has across the bone moves as the sensor says it turns.
                    beside = R @ (lever - shares[k] * rest)
                    own = np.full((T, 3), np.nan)
                    own[1:-1] = signals.derivative(beside, start.rate_hz, 2)
                    b[:, k], a[:, k] = R @ rest, bone_imus.a_world[:, s] - own
        return {
            "shares": shares,
            "uv_px": np.where(seen.seen[..., None], uv, 0.0),
            "w_visual": np.where(seen.seen, seen.confidence, 0.0),
            "a_world": np.nan_to_num(a),
            "w_acceleration": np.isfinite(a).all(axis=-1).astype(float),
            "b_world": np.nan_to_num(b),
            "w_bone": np.isfinite(b).all(axis=-1).astype(float),
            "R_camera_world": camera.R_camera_world,
            "t_camera_world": camera.t_camera_world,
            "K": camera.K,
        }

    def _fragment_values(
        self,
        index: NDArray[np.intp],
        inside: NDArray[np.bool_],
        start: PoseSequence,
        data: dict[str, Array],
    ) -> dict[str, Array]:
        """The problem's parameters for the frames `index`, of which some lie in the padding."""
        present = np.ones_like(inside) if self.settings.padding == "replicate" else inside
        visual = data["w_visual"][index] * present[:, None]
        # 0 at the recording's first and last frame, and so at their copies beyond the ends.
        acceleration = data["w_acceleration"][index][1:-1].T
        bone = (data["w_bone"][index] * present[:, None]).T
        smooth = (np.convolve(present, [1] * 4, mode="valid") == 4).astype(float)
        length = present.astype(float)
        J = len(self.skeleton.names)
        columns = (len(index), -1)
        a = data["a_world"][index].reshape(columns).T
        return {
            "R_camera_world": data["R_camera_world"],
            "t_camera_world": data["t_camera_world"],
            "K": data["K"],
            "rate_hz": np.array([start.rate_hz]),
            "uv_px": data["uv_px"][index].reshape(-1, 2).T,
            "w_visual": _mean(visual, 2).ravel(),
            "shares": data["shares"],
            "a_world": a[:, 1:-1],
            "w_acceleration": _mean(acceleration, 3),
            "b_world": data["b_world"][index].reshape(columns).T,
            "w_bone": _mean(bone, 3),
            "w_smooth": _mean(smooth, 3 * J),
            "j_world": self._jerk_target(index, start, data),
            "w_length": _mean(length, len(self._problem.pairs)),
            "lengths": self._lengths,
            "p_prior": start.p_world_joint[index].reshape(columns).T,
            "k": np.array([self.settings.term_weights()[term] for term in TERMS]),
        }

    def _jerk_target(
        self, index: NDArray[np.intp], start: PoseSequence, data: dict[str, Array]
    ) -> Array:
        """(3J, N - 3) m/s^3: the differentiated acceleration of each joint that carries a sensor.

        Zero where one of the two accelerations is missing.
        """
        J, N = len(self.skeleton.names), len(index)
        if self.settings.jerk_target != "sensor":
            return np.zeros((3 * J, 0))
        a, known = data["a_world"][index][1:-1], data["w_acceleration"][index][1:-1] > 0
        both = (known[1:] & known[:-1])[..., None]
        jerk = np.where(both, np.diff(a, axis=0) * start.rate_hz, 0.0)
        target = np.zeros((N - 3, J, 3))
        for k, (joint, _) in enumerate(self._problem.sensor_bones):
            target[:, joint] = jerk[:, k]
        return target.reshape(N - 3, -1).T

    def _with_orientations(
        self, poses: PoseSequence, bone_imus: BoneImuSequence | None
    ) -> PoseSequence:
        """Orientations from the optimised positions, twist from the sensors; positions as they are."""
        never = InertialGuidedIKSettings(threshold=np.pi)
        oriented = InertialGuidedIK(self.skeleton, never).refine(poses, bone_imus)
        return replace(oriented, p_world_joint=poses.p_world_joint)


def _mean(weight: Array, components: int) -> Array:
    """Weights divided by the number of residuals that have any, so that the term is their mean."""
    count = components * np.count_nonzero(weight)
    return weight / count if count else weight


def _status(text: str) -> SolverStatus:
    return {
        "Solve_Succeeded": SolverStatus.CONVERGED,
        "Solved_To_Acceptable_Level": SolverStatus.ACCEPTABLE,
        "Maximum_Iterations_Exceeded": SolverStatus.ITERATION_LIMIT,
    }.get(text, SolverStatus.FAILED)
