"""The paper's solver on joint positions, over the fragments of a recording."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import Factor, Store
from rtof_kin.core.numerics.c_compiler import BUILDING, Buffered
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import ContactPoints
from rtof_kin.solve.cartesian.problem import TERMS, FragmentProblem, fragment_problem
from rtof_kin.solve.initial_guess import InertialGuidedIK, InertialGuidedIKSettings, InitialGuess
from rtof_kin.solve.settings import CartesianSettings
from rtof_kin.solve.solution import Block, FragmentReport, SolverStatus
from rtof_kin.solve.terms import PointData, PointTerm, check_observed, observed_rows

_NORMAL_MEDIAN: Final = 1.177  #: Median norm of a normal error in two dimensions, in standard deviations of an axis
_DECREASE: Final = 1e-3  #: Relative decrease of the energy at which a fragment is solved, by tolerance of the gradient
_STATUS: Final = {
    "Solve_Succeeded": SolverStatus.CONVERGED,
    "Solved_To_Acceptable_Level": SolverStatus.ACCEPTABLE,
    "Maximum_Iterations_Exceeded": SolverStatus.ITERATION_LIMIT,
}


class _Fragment:
    """The energy of one fragment by its positions x (n,) in the order of its problem, with a banded Hessian, for
    `LevenbergMarquardt`. Values are kept for the array `x` itself.
    """

    def __init__(self, problem: FragmentProblem) -> None:
        self._problem, self._value, self._hessian = problem, Buffered(problem.value), Buffered(problem.hessian)
        rows, columns = problem.entries
        self._matrix = Store(len(problem.order), int(np.max(rows - columns)))
        self._places = rows + columns * self._matrix.step
        self._p, self._known = np.zeros(0), np.zeros(0)

    def bind(self, p: Array) -> None:
        """Set the parameters of the fragment."""
        self._p, self._known = p, np.zeros(0)

    def minimum(self, x: Array) -> tuple[Array, int, SolverStatus]:
        """Return the minimum from a start, the iterations and how it ended."""
        s = self._problem.settings
        solved = LevenbergMarquardt(self).solve(x, s.max_iterations, _DECREASE * s.tolerance)
        return solved.x, solved.iterations, SolverStatus.of(solved)

    def by_ipopt(self, x: Array) -> tuple[Array, int, SolverStatus]:
        """The same by IPOPT; `SolverError` where it fails."""
        with BUILDING:
            found = np.asarray(self._problem.ipopt(x0=x, p=self._p)["x"]).ravel()
            stats = self._problem.ipopt.stats()
        status = _STATUS.get(stats["return_status"], SolverStatus.FAILED)
        if status is SolverStatus.FAILED or not np.all(np.isfinite(found)):
            raise SolverError(f"IPOPT: {stats['return_status']}")
        return found, int(stats["iter_count"]), status

    def energies(self, x: Array) -> Array:
        """Return the energy of each term."""
        if self._known is not x:
            self._terms, self._slope = self._value(x, self._p)
            self._known = x
        return self._terms

    def total(self, x: Array) -> float:
        """Return the energy."""
        return float(self.energies(x).sum())

    def gradient(self, x: Array) -> Array:
        """Return the gradient (n,), 1/m."""
        self.energies(x)
        return self._slope.copy()

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient; keep the Hessian."""
        self._matrix.entries.reshape(-1)[self._places] = self._hessian(x, self._p)[0]
        return self.total(x), self.gradient(x)

    def retract(self, x: Array, step: Array) -> Array:
        """Return the positions after a step."""
        return x + step

    def factorise(self, damping: float) -> Factor:
        """Factorise the Hessian with a damping on its diagonal."""
        return self._matrix.factorise(damping)


class CartesianSolver:
    """Optimises joint positions; see `rtof_kin.solve.fragment_solver.FragmentSolver`."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int,
        settings: CartesianSettings,
        sensor_joints: tuple[str, ...],
        terms: tuple[PointTerm, ...] = (),
    ) -> None:
        """Build the problem, with a place for a sensor on each of `sensor_joints` and further terms."""
        self.skeleton, self.frames, self.settings = skeleton, frames, settings
        self.sensor_joints = sensor_joints
        bones = [
            (joint, child)
            for joint in skeleton.index(*sensor_joints)
            for child in kinematics.children_of(skeleton.parents, joint)
        ]  # a sensor on a leaf (head, foot) has no bone and is not used
        with BUILDING:
            points = tuple((tuple(skeleton.index(*term.joints)), term) for term in terms)
            self._problem = fragment_problem(skeleton.parents, frames, tuple(bones), self.settings, points)
            self._fragment = _Fragment(self._problem)
        self._one_at_a_time = threading.Lock()
        p = skeleton.forward_kinematics(skeleton.t_pose()[None])[0][0]
        a, b = np.array(self._problem.pairs).T
        self._lengths = np.linalg.norm(p[b] - p[a], axis=1)

    def run(
        self,
        guess: InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | None,
        contact_points: ContactPoints | None,
        progress: Callable[[int, int], None] | None,
        confidence: bool = False,  # noqa: ARG002 - this space has no covariances
        views: Sequence[KeypointSequence] = (),  # noqa: ARG002 - `FragmentSolver` has refused them
        observed: Mapping[str, PointData] | None = None,
    ) -> Iterator[Block]:
        """Yield blocks of N/2 frames; the arguments are those of `FragmentSolver.solve`."""
        if keypoints is None or contact_points is not None:
            raise SolverError("space 'cartesian' needs keypoints and has no contact points; use 'joint'")
        if not set(keypoints.names) & set(self.skeleton.names):
            raise SolverError("keypoints: none of the landmarks is a joint of the skeleton")
        start = guess.poses
        data = self._observations(start, keypoints, bone_imus)
        terms = [term for _, term in self._problem.points]
        check_observed(terms, observed or {})
        data |= observed_rows(terms, observed or {}, len(start))
        half, T = self.frames // 2, len(start)
        firsts = range(-half, T, half)
        i = np.arange(self.frames)  # weights (N,) of a fragment's frames in the blend:
        taper = np.minimum(i + 0.5, self.frames - i - 0.5) ** 2
        if self.settings.as_printed:
            taper = np.ones(self.frames)
        previous: Array | None = None
        reports: list[FragmentReport] = []
        for done, first in enumerate(firsts, start=1):
            with self._one_at_a_time:  # the buffers are shared by all threads
                X, report = self._solve_fragment(first, start, data, previous)
            reports.append(report)
            if progress is not None:
                progress(done, len(firsts))
            if previous is not None:
                frames = slice(first, min(first + half, T))
                weights = taper[half:, None, None], taper[:half, None, None]
                blended = (weights[0] * previous[half:] + weights[1] * X[:half]) / sum(weights)
                p = blended[: frames.stop - first]
                yield Block(frames, p, start.R_world_bone[frames], tuple(reports))
                reports = []
            previous = X

    def _solve_fragment(
        self, first: int, start: PoseSequence, data: dict[str, Array], previous: Array | None = None
    ) -> tuple[Array, FragmentReport]:
        """(N, J, 3) optimised positions, and the report; shared frames start from the fragment before."""
        frame = np.arange(first, first + self.frames)
        inside = (frame >= 0) & (frame < len(start))
        index = np.clip(frame, 0, len(start) - 1)
        x, half = start.p_world_joint[index].ravel(), self.frames // 2
        if previous is not None:
            x = np.concatenate([previous[half:].ravel(), x[previous[half:].size :]])
        values = self._fragment_values(index, inside, start, data)
        sigma = self.settings.sigma_reprojection or self.settings.sigma_reprojection_first
        x, report = self._call(x, values | {"sigma_reprojection": np.array([sigma])}, first)
        if previous is not None and report.status is SolverStatus.FAILED:
            return self._solve_fragment(first, start, data)
        if self.settings.sigma_reprojection is None and report.status is not SolverStatus.FAILED:
            sigma = self._estimated_sigma(x, values, sigma)
            x, again = self._call(x, values | {"sigma_reprojection": np.array([sigma])}, first)
            report = replace(
                again, iterations=report.iterations + again.iterations, seconds=report.seconds + again.seconds
            )
        if not (values["w_visual"].any() or values["w_bone"].any() or values["w_acceleration"].any()):
            report = replace(report, status=SolverStatus.UNOBSERVED)
        return x.reshape(self.frames, -1, 3), report

    def _call(self, x0: Array, values: dict[str, Array], first: int) -> tuple[Array, FragmentReport]:
        """One solution, with a report measured at the returned point."""
        fragment, order, began = self._fragment, self._problem.order, perf_counter()
        fragment.bind(self._problem.pack(values))
        x, iterations, status = x0[order], 0, SolverStatus.FAILED
        with suppress(SolverError):
            x, iterations, status = fragment.by_ipopt(x) if self.settings.ipopt else fragment.minimum(x)
        X = np.empty_like(x)
        X[order] = x
        return X, FragmentReport(
            first_frame=first,
            status=status,
            energy=dict(zip(self._problem.terms, fragment.energies(x).tolist(), strict=True)),
            iterations=iterations,
            seconds=perf_counter() - began,
            sigma_reprojection=float(values["sigma_reprojection"][0]),
            optimality=float(np.abs(fragment.gradient(x)).max()),
            infeasibility=0.0,
        )

    def _estimated_sigma(self, x: Array, values: dict[str, Array], sigma: float) -> float:
        """Twice the size of the reprojection residuals at x, px; `sigma` for fewer than 20 landmarks."""
        p_camera = values["R_camera_world"] @ x.reshape(-1, 3).T + values["t_camera_world"][:, None]
        homogeneous = values["K"] @ p_camera
        error = np.linalg.norm(homogeneous[:2] / homogeneous[2] - values["uv_px"], axis=0)
        seen = values["w_visual"] > 0
        if seen.sum() < 20:
            return sigma
        low, high = self.settings.sigma_reprojection_range
        return float(np.clip(2 * np.median(error[seen]) / _NORMAL_MEDIAN, low, high))

    def _observations(
        self, start: PoseSequence, keypoints: KeypointSequence, bone_imus: BoneImuSequence | None
    ) -> dict[str, Array]:
        """Observations of every frame; weights are 0 where there are none."""
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
                    # The lever arm's part across the bone moves as the sensor turns.
                    beside = R @ (lever - shares[k] * rest)
                    own = np.full((T, 3), np.nan)
                    own[1:-1] = signals.derivative(beside, start.rate_hz, 2)
                    b[:, k], a[:, k] = R @ rest, bone_imus.a_world[:, s] - own
        return {
            "rate_hz": np.array([start.rate_hz]),
            "shares": shares,
            "uv_px": np.where(seen.seen[..., None], uv, 0.0),
            "w_visual": np.where(seen.seen, seen.confidence, 0.0),
            "a_world": np.nan_to_num(a),
            "w_acceleration": np.isfinite(a).all(axis=-1).astype(float),
            "b_world": np.nan_to_num(b),
            "w_bone": np.isfinite(b).all(axis=-1).astype(float),
            **{name: getattr(camera, name) for name in ("R_camera_world", "t_camera_world", "K")},
        }

    def _fragment_values(
        self, index: Index, inside: Mask, start: PoseSequence, data: dict[str, Array]
    ) -> dict[str, Array]:
        """Parameters of the problem for the frames `index`, of which those not `inside` are padding."""
        present = np.ones_like(inside) if self.settings.as_printed else inside
        smooth = (np.convolve(present, [1] * 4, mode="valid") == 4).astype(float)
        J, columns = len(self.skeleton.names), (len(index), -1)
        return {
            **{n: data[n] for n in ("R_camera_world", "t_camera_world", "K", "rate_hz", "shares")},
            "uv_px": data["uv_px"][index].reshape(-1, 2).T,
            "w_visual": _mean(data["w_visual"][index] * present[:, None], 2).ravel(),
            "a_world": data["a_world"][index].reshape(columns).T[:, 1:-1],
            "w_acceleration": _mean(data["w_acceleration"][index][1:-1].T, 3),  # 0 at both ends
            "b_world": data["b_world"][index].reshape(columns).T,
            "w_bone": _mean((data["w_bone"][index] * present[:, None]).T, 3),
            "w_smooth": _mean(smooth, 3 * J),
            "j_world": self._jerk_target(index, data),
            "w_length": _mean(present.astype(float), len(self._problem.pairs)),
            "lengths": self._lengths,
            "p_prior": start.p_world_joint[index].reshape(columns).T,
            "k": np.array([self.settings.term_weights()[term] for term in TERMS]),
            **{term.observed: data[term.observed][index].T for _, term in self._problem.points},
            **{term.weight: data[term.weight][index] * present for _, term in self._problem.points},
        }

    def _jerk_target(self, index: Index, data: dict[str, Array]) -> Array:
        """(3J, N - 3) m/s^3: differentiated acceleration of each joint with a sensor; 0 where missing."""
        J, N = len(self.skeleton.names), len(index)
        if not self.settings.as_printed:
            return np.zeros((3 * J, 0))
        a, known = data["a_world"][index][1:-1], data["w_acceleration"][index][1:-1] > 0
        both = (known[1:] & known[:-1])[..., None]
        jerk = np.where(both, np.diff(a, axis=0) * data["rate_hz"], 0.0)
        target = np.zeros((N - 3, J, 3))
        for k, (joint, _) in enumerate(self._problem.sensor_bones):
            target[:, joint] = jerk[:, k]
        return target.reshape(N - 3, -1).T

    def oriented(
        self,
        poses: PoseSequence,
        _: KeypointSequence | None,
        bone_imus: BoneImuSequence | None,
        __: Sequence[KeypointSequence] = (),
    ) -> PoseSequence:
        """Return the poses with orientations from their positions, and twist from the sensors."""
        never = InertialGuidedIKSettings(threshold=np.pi)
        return InertialGuidedIK(self.skeleton, never).orient(poses, bone_imus)


def _mean(weight: Array, components: int) -> Array:
    """Weights divided by the number of weighted residuals, so that the term is their mean."""
    count = components * np.count_nonzero(weight)
    return weight / count if count else weight
