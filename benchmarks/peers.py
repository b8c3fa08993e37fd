"""Other solvers on the fragment solver's own energies: PyTorch's L-BFGS, SciPy, Ceres.

A scene holds a recording's fragments in one space, and scores every solver's answer with the package's
own energy and gradient. L-BFGS minimises the energy as such: the Cartesian one written once more in
PyTorch and differentiated by autograd, the joint-space one through the package's value and gradient in an
`autograd.Function`. SciPy's least squares and Ceres get the residuals, whose squares sum to twice the
energy, as small CasADi functions of one, three or four frames in a row (`Residuals`), compiled like the
package's own, with their derivatives by CasADi. Robust losses are in them: a residual times
sqrt(loss / square).

Variables z (N, F) are joint positions (F = 3J), or in joint space the step from the start in tangent
coordinates (F = D). The peers know no limits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from time import perf_counter
from typing import Any, Protocol

import casadi as ca
import numpy as np
import pyceres
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from rtof_kin import energies
from rtof_kin import quaternions as quat
from rtof_kin.cartesian import CartesianSolver
from rtof_kin.compiled import Buffered, compiled
from rtof_kin.errors import ShapeError
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.problem import FragmentData, JointProblem
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.joint_space.solver import JointSpaceSolver, _Observations
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.root_position import refit_root
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

Array = NDArray[np.float64]
Trace = list[tuple[float, Array]]
"""Seconds since a solver began, and the variables or state it had then."""


@dataclass(frozen=True)
class Fragment:
    """One fragment's start and observations."""

    first: int
    """Index of its first frame; negative in the padding."""
    x0: Array
    """(N, ...) the starting state, the same for all solvers."""
    data: Any
    """Named parameters of `FragmentProblem`, or `FragmentData`."""


@dataclass(frozen=True)
class Answer:
    """Where a solver stopped."""

    x: Array
    """(N, ...) the state."""
    seconds: float
    iterations: int
    converged: bool
    """Whether the solver says so."""
    multipliers: Array | None = None
    """(N, M) of the limits."""


@dataclass(frozen=True)
class Score:
    """What an answer is worth, by the package's own energy."""

    energy: float
    """[1]"""
    gradient: float
    """Largest component of the energy's gradient, of the Lagrangian's with multipliers; 1/m or 1/rad."""
    violation_deg: float
    """Largest violation of a limit."""


class Solver(Protocol):
    """Minimises a fragment's energy from its start; fills the trace where one is given."""

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer: ...


# --- Cartesian -----------------------------------------------------------------------------------


class CartesianScene:
    """Fragments of the printed energy; a state is (N, 3J), its variables are the state itself."""

    def __init__(
        self, skeleton: SkeletonModel, frames: int, settings: FragmentSettings, start: PoseSequence,
        keypoints: KeypointSequence, imus: BoneImuSequence,
    ) -> None:  # fmt: skip
        """Take a recording.

        Raises:
            ShapeError: the settings are not those of the energy as printed.
        """
        s = settings
        printed = s.bone_lengths == "free" and s.prior == "positions" and s.jerk_target == "sensor"
        if not printed or s.huber_reprojection is not None or s.sigma_reprojection is None:
            raise ShapeError("peers know the energy as printed alone: use FragmentSettings.paper()")
        self.settings, self.frames = settings, frames
        self.start = refit_root(start, keypoints) if s.refit_root else start
        self.solver = CartesianSolver(skeleton, frames, settings, imus.joints)
        self.problem = self.solver._problem
        self.observations = self.solver._observations(self.start, keypoints, imus)

    def fragment(self, first: int) -> Fragment:
        """The fragment of the frames from `first`."""
        frame = np.arange(first, first + self.frames)
        inside = (frame >= 0) & (frame < len(self.start))
        index = np.clip(frame, 0, len(self.start) - 1)
        values = self.solver._fragment_values(index, inside, self.start, self.observations)
        values = values | {"sigma_reprojection": np.array([self.settings.sigma_reprojection])}
        return Fragment(first, self.start.p_world_joint[index].reshape(self.frames, -1), values)

    def score(self, fragment: Fragment, x: Array, multipliers: Array | None = None) -> Score:
        """By `FragmentProblem.energy` and `gradient`."""
        p, x = self.problem.pack(fragment.data), x.ravel()
        energy = float(np.sum(np.asarray(self.problem.energy(x, p))))
        return Score(energy, float(np.abs(np.asarray(self.problem.gradient(x, p))).max()), 0.0)

    def positions(self, x: Array) -> Array:
        """(N, J, 3) m."""
        return x.reshape(self.frames, -1, 3)

    def variables(self, fragment: Fragment) -> Array:
        """(N, 3J) m."""
        return fragment.x0.copy()

    def state(self, fragment: Fragment, z: Array) -> Array:
        """The variables themselves."""
        return z

    def torch_energy(self, fragment: Fragment) -> Callable[[torch.Tensor], torch.Tensor]:
        """The paper's eqs. 2-7 as the method reads them, for autograd."""
        N, s = self.frames, self.settings
        v = {name: torch.from_numpy(np.array(value)) for name, value in fragment.data.items()}
        joint, child = np.array(self.problem.sensor_bones, dtype=np.intp).reshape(-1, 2).T
        share, rate, k = v["shares"][:, None], v["rate_hz"], v["k"]
        uv, a, b, j, prior = (
            v[name].T.reshape(n, -1, c)
            for name, n, c in (
                ("uv_px", N, 2), ("a_world", N - 2, 3), ("b_world", N, 3), ("j_world", N - 3, 3),
                ("p_prior", N, 3),
            )
        )  # fmt: skip
        w_visual = v["w_visual"].reshape(N, -1)

        def energy(z: torch.Tensor) -> torch.Tensor:
            X = z.reshape(N, -1, 3)
            homogeneous = (X @ v["R_camera_world"].T + v["t_camera_world"]) @ v["K"].T
            visual = (homogeneous[..., :2] / homogeneous[..., 2:] - uv) / v["sigma_reprojection"]
            sensor = (1 - share) * X[:, joint] + share * X[:, child]
            acceleration = torch.diff(sensor, n=2, dim=0) * rate**2 - a
            bone = X[:, child] - X[:, joint] - b
            smooth = torch.diff(X, n=3, dim=0) * rate**3 - j
            return torch.as_tensor(
                k[0] * torch.sum(w_visual[..., None] * visual**2)
                + k[1] * torch.sum(v["w_acceleration"].T[..., None] * acceleration**2)
                / s.sigma_acceleration**2
                + k[2] * torch.sum(v["w_bone"].T[..., None] * bone**2) / s.sigma_bone**2
                + k[3] * torch.sum(v["w_smooth"][:, None, None] * smooth**2) / s.sigma_jerk**2
                + k[5] * torch.mean(((X - prior) / s.sigma_prior) ** 2)
            )  # fmt: skip

        return energy

    @cached_property
    def residuals(self) -> Sequence[Residuals]:
        """Of a frame, of three (acceleration) and of four (jerk)."""
        return _built([self._frame(), self._acceleration(), self._jerk()])

    def _frame(self) -> _Window:
        s, N, J = self.settings, self.frames, len(self.problem.parents)
        bones = self.problem.sensor_bones
        X, weight = ca.SX.sym("X", 3, J), ca.SX.sym("w", J + len(bones) + 1)
        P = _symbols(
            R_camera_world=(3, 3), t_camera_world=(3, 1), K=(3, 3), uv_px=(2, J),
            b_world=(3, len(bones)), p_prior=(3, J),
        )  # fmt: skip
        camera = P["R_camera_world"] @ X + ca.repmat(P["t_camera_world"], 1, J)
        rows = [energies.reprojection(camera, P["uv_px"], P["K"]) * ca.repmat(weight[:J].T, 2, 1)]
        rows += [
            energies.bone_vector(X[:, a], X[:, b], P["b_world"][:, i]) * weight[J + i]
            for i, (a, b) in enumerate(bones)
        ]
        rows.append(energies.position(X, P["p_prior"]) * weight[-1])

        def parameters(f: Fragment) -> Array:
            d = f.data
            k = np.sqrt(2 * d["k"])
            w = np.column_stack([
                k[0] / d["sigma_reprojection"] * np.sqrt(d["w_visual"]).reshape(N, J),
                k[2] / s.sigma_bone * np.sqrt(d["w_bone"]).T,
                np.full(N, k[5] / s.sigma_prior / np.sqrt(3 * J * N)),
            ])  # fmt: skip
            camera = [_column(d[n], N) for n in ("R_camera_world", "t_camera_world", "K")]
            uv = d["uv_px"].T.reshape(N, -1)
            return np.column_stack([w, *camera, uv, d["b_world"].T, d["p_prior"].T])

        r = ca.vertcat(*(ca.vec(row) for row in rows))
        return _Window("cartesian_frame", 1, r, ca.vec(X), (weight, *P.values()), parameters)

    def _acceleration(self) -> _Window:
        s, J, bones = self.settings, len(self.problem.parents), self.problem.sensor_bones
        z, weight = ca.SX.sym("z", 3 * J, 3), ca.SX.sym("w", len(bones))
        P = _symbols(shares=(len(bones), 1), rate_hz=(1, 1), a_world=(3, len(bones)))
        rows = []
        for i, (a, b) in enumerate(bones):
            share = P["shares"][i]
            sensor = (1 - share) * z[3 * a : 3 * a + 3, :] + share * z[3 * b : 3 * b + 3, :]
            r = energies.acceleration(sensor, P["a_world"][:, i], P["rate_hz"])
            rows.append(weight[i] * r)

        def parameters(f: Fragment) -> Array:
            d = f.data
            w = np.sqrt(2 * d["k"][1] * d["w_acceleration"].T) / s.sigma_acceleration
            same = [_column(d[name], len(w)) for name in ("shares", "rate_hz")]
            return np.column_stack([w, *same, d["a_world"].T])

        symbols = (weight, *P.values())
        return _Window(
            "cartesian_acceleration", 3, ca.vertcat(*rows), ca.vec(z), symbols, parameters
        )

    def _jerk(self) -> _Window:
        s, J = self.settings, len(self.problem.parents)
        z, weight, rate, j = (
            ca.SX.sym(n, *shape)
            for n, shape in (("z", (3 * J, 4)), ("w", (1, 1)), ("f", (1, 1)), ("j", (3 * J, 1)))
        )

        def parameters(f: Fragment) -> Array:
            d = f.data
            w = np.sqrt(2 * d["k"][3] * d["w_smooth"]) / s.sigma_jerk
            return np.column_stack([w, _column(d["rate_hz"], len(w)), d["j_world"].T])

        r = weight * energies.jerk(z, j, rate)
        return _Window("cartesian_jerk", 4, r, ca.vec(z), (weight, rate, j), parameters)


# --- joint space ---------------------------------------------------------------------------------


class JointScene:
    """Fragments of the joint-space energy; a state is (N, 3 + 4A), its variables the step (N, D)."""

    def __init__(
        self, skeleton: SkeletonModel, frames: int, settings: JointSpaceSettings, start: PoseSequence,
        keypoints: KeypointSequence, imus: BoneImuSequence,
    ) -> None:  # fmt: skip
        """Take a recording.

        Raises:
            ShapeError: the settings estimate the reprojection error, know a floor or no limits.
        """
        if settings.sigma_reprojection is None or settings.floor_height is not None:
            raise ShapeError("peers want sigma_reprojection given, and no floor")
        if not settings.limits:
            raise ShapeError("peers want limits=True: a solver leaves them out by itself")
        self.settings, self.frames = settings, frames
        solver = JointSpaceSolver(skeleton, frames, settings, imus.joints)
        self.observations = _Observations(solver, start, keypoints, imus)
        self.problem: JointProblem = self.observations.problem
        self.space: StateSpace = self.observations.space
        assert self.observations.limits is not None
        self.limits: Limits = self.observations.limits

    def fragment(self, first: int) -> Fragment:
        """The fragment of the frames from `first`, landmarks weighed by the sigma given."""
        index, _, data = self.observations.fragment(first)
        seen, sigma = data.observation["w_visual"] > 0, self.settings.sigma_reprojection
        assert sigma is not None
        weight = self.observations.confidence[index] * seen / sigma**2
        data = replace(data, observation=data.observation | {"w_visual": weight})
        return Fragment(first, self.observations.start[index], data)

    def score(self, fragment: Fragment, x: Array, multipliers: Array | None = None) -> Score:
        """By `JointProblem.total` and `gradient`; with multipliers the Lagrangian's gradient."""
        self.problem.bind(fragment.data)
        energy, gradient = self.problem.total(x), self.problem.gradient(x)
        angles = self.limits.values(x)
        if multipliers is not None and multipliers.size:
            gradient = gradient + self.limits.force(x, multipliers)
        violation = np.degrees(np.abs(self.limits.excess(angles)).max(initial=0.0))
        return Score(energy, float(np.abs(gradient).max()), float(violation))

    def positions(self, x: Array) -> Array:
        """(N, J, 3) m."""
        return self.space.poses(x)[0]

    def variables(self, fragment: Fragment) -> Array:
        """(N, D) zeros."""
        return np.zeros((self.frames, self.space.size))

    def state(self, fragment: Fragment, z: Array) -> Array:
        """The state after the step."""
        return self.space.retract(fragment.x0, z)

    def energy_and_gradient(self, fragment: Fragment, z: Array) -> tuple[float, Array]:
        """At a step z (N, D) from the start, for data already bound; the gradient is by z."""
        x = self.state(fragment, z)
        g, expand = self.problem.gradient(x), self.space.expand
        turns = (z[:, 3:] @ expand.T).reshape(len(z), -1, 3)
        torque = (g[:, 3:] @ expand.T).reshape(turns.shape)
        pulled = np.einsum("taij,tai->taj", quat.right_jacobian(turns), torque)
        gradient = np.concatenate([g[:, :3], pulled.reshape(len(z), -1) @ expand], axis=1)
        return self.problem.total(x), gradient

    def torch_energy(self, fragment: Fragment) -> Callable[[torch.Tensor], torch.Tensor]:
        """The package's own value and gradient: there is no second energy to differentiate."""
        self.problem.bind(fragment.data)
        return lambda z: torch.as_tensor(_Package.apply(z, self, fragment))  # type: ignore[no-untyped-call]

    @cached_property
    def residuals(self) -> Sequence[Residuals]:
        """Of a frame, of three (acceleration) and of four (jerk)."""
        return _built([self._frame(), self._acceleration(), self._jerk()])

    def _moved(self, x: Any, z: Any) -> tuple[Any, list[Any]]:
        """Position of the root and a quaternion for every moving joint after a step."""
        turns = ca.DM(self.space.expand) @ z[3:]
        quats = []
        for a in range(len(self.space.joints)):
            v = turns[3 * a : 3 * a + 3]
            angle = ca.sqrt(ca.sumsqr(v) + 1e-18)
            turn = ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) / angle * v)
            quats.append(energies.quat_multiply(x[3 + 4 * a : 7 + 4 * a], turn))
        return x[:3] + z[:3], quats

    def _posed(self, p_root: Any, quats: list[Any], offsets: Any) -> tuple[list[Any], list[Any]]:
        """Position and quaternion of every segment in world."""
        local = dict(zip(self.space.joints, quats, strict=True))
        p, q = [p_root], [local[0]]
        for j, parent in enumerate(self.space.skeleton.parents[1:], start=1):
            p.append(p[parent] + energies.quat_matrix(q[parent]) @ offsets[:, j])
            q.append(energies.quat_multiply(q[parent], local[j]) if j in local else q[parent])
        return p, q

    def _frame(self) -> _Window:
        energy, shape = self.problem.energy, self.problem.energy.shape
        x, z = ca.SX.sym("x", 3 + 4 * len(self.space.joints)), ca.SX.sym("z", self.space.size)
        O = {n: ca.SX.sym(n, *v.shape) for n, v in energy.observation.items()}
        C = {n: ca.SX.sym(n, *v.shape) for n, v in energy.constant.items()}
        p_root, quats = self._moved(x, z)
        p, q = self._posed(p_root, quats, C["offsets"])
        rows = []
        for i, (j, is_joint) in enumerate(shape.landmarks):
            point = p[j] if is_joint else p[j] + energies.quat_matrix(q[j]) @ C["places"][:, i]
            camera = C["R_camera_world"] @ point + C["t_camera_world"]
            r = energies.reprojection(camera, O["uv_px"][:, i], C["K"])
            rows.append(_huber(r, O["w_visual"][i], O["knee_visual"]))
        for s, j in enumerate(shape.sensors):
            r = energies.orientation(q[j], O["quat_sensor"][:, s])
            r = ca.reshape(C["whitening"][:, s], 3, 3) @ r
            rows.append(_huber(r, O["w_sensor"][s], shape.robust_orientation))
        for i, j in enumerate(shape.torso):
            r = energies.orientation(q[j], O["quat_torso"][:, i])
            rows.append(_cauchy(r, O["w_torso"]))
        for i, (j, child) in enumerate(shape.bones):
            rows.append(
                _cauchy(energies.bone_vector(p[j], p[child], O["b_world"][:, i]), O["w_bone"])
            )
        rows.append(_cauchy(energies.position(p[0], O["p_root"]), O["w_root"]))
        vectors = [
            energies.rotation_vector(quats[a + 1], C["quat_mean"][:, a])
            for a in range(len(quats) - 1)
        ]
        # C["precision"] is given as its Cholesky factor, transposed (`parameters`).
        rows.append(ca.sqrt(O["w_prior"]) * (C["precision"] @ ca.vertcat(*vectors)))

        def parameters(f: Fragment) -> Array:
            data: FragmentData = f.data
            root = np.asarray(np.linalg.cholesky(data.constant["precision"]).T)
            constant = data.constant | {"precision": root}
            columns = [data.observation[n].reshape(self.frames, -1) for n in O]
            columns += [_column(constant[n], self.frames) for n in C]
            return np.column_stack([f.x0, *columns])

        symbols = (x, *O.values(), *C.values())
        return _Window("joint_frame", 1, ca.vertcat(*rows), z, symbols, parameters)

    def _acceleration(self) -> _Window:
        energy, shape, A = self.problem.energy, self.problem.energy.shape, len(self.space.joints)
        S, robust = len(shape.sensors), self.settings.robust_acceleration
        x, z = ca.SX.sym("x", 3 + 4 * A, 3), ca.SX.sym("z", self.space.size, 3)
        P = _symbols(
            a_world=(3, S), w=(S, 1), rate_hz=(1, 1), offsets=energy.constant["offsets"].shape,
            levers=(3, S),
        )  # fmt: skip
        frames = [self._posed(*self._moved(x[:, t], z[:, t]), P["offsets"]) for t in range(3)]
        rows = []
        for s, j in enumerate(shape.sensors):
            path = ca.horzcat(
                *(p[j] + energies.quat_matrix(q[j]) @ P["levers"][:, s] for p, q in frames)
            )
            r = energies.acceleration(path, P["a_world"][:, s], P["rate_hz"])
            rows.append(_huber(r, P["w"][s], robust))

        def parameters(f: Fragment) -> Array:
            data: FragmentData = f.data
            n = self.frames - 2
            same = [_column(data.constant[name], n) for name in ("offsets", "levers")]
            rate = np.full(n, data.rate_hz)
            a, w = data.a_world.reshape(n, -1), data.w_acceleration
            return np.column_stack([_windows(f.x0, 3), a, w, rate, *same])

        symbols = (x, *P.values())
        return _Window("joint_acceleration", 3, ca.vertcat(*rows), ca.vec(z), symbols, parameters)

    def _jerk(self) -> _Window:
        D, A, expand = self.space.size, len(self.space.joints), ca.DM(self.space.expand)
        x, z = ca.SX.sym("x", 3 + 4 * A, 4), ca.SX.sym("z", D, 4)
        P = _symbols(w=(1, 1), rate_hz=(1, 1), sigma=(D, 1))
        frames = [self._moved(x[:, t], z[:, t]) for t in range(4)]
        steps = []
        for (p, q), (p_next, q_next) in pairwise(frames):
            turns = [energies.rotation_vector(b, a) for a, b in zip(q, q_next, strict=True)]
            steps.append(ca.vertcat(p_next - p, expand.T @ ca.vertcat(*turns)))
        r = energies.step_jerk(ca.horzcat(*steps), P["rate_hz"]) / P["sigma"] * ca.sqrt(P["w"])

        def parameters(f: Fragment) -> Array:
            data: FragmentData = f.data
            n = self.frames - 3
            sigma = np.tile(self.problem.sigma_jerk, (n, 1))
            rate = np.full(n, data.rate_hz)
            return np.column_stack([_windows(f.x0, 4), data.w_jerk, rate, sigma])

        return _Window("joint_jerk", 4, r, ca.vec(z), (x, *P.values()), parameters)


class _Package(torch.autograd.Function):
    """The package's joint-space energy for autograd."""

    @staticmethod
    def forward(ctx: Any, z: torch.Tensor, scene: JointScene, fragment: Fragment) -> torch.Tensor:
        step = z.detach().numpy().reshape(scene.frames, -1)
        energy, gradient = scene.energy_and_gradient(fragment, step)
        ctx.gradient = torch.from_numpy(gradient.reshape(z.shape))
        return torch.tensor(energy, dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *outer: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return outer[0] * ctx.gradient, None, None


Scene = CartesianScene | JointScene


# --- residuals -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Window:
    """Residuals of some frames in a row, as symbols."""

    name: str
    width: int
    residual: Any
    z: Any
    """(width F,) variables, frame by frame."""
    parameters: tuple[Any, ...]
    values: Callable[[Fragment], Array]
    """Fragment -> (windows, P) values of the parameters."""


@dataclass(frozen=True)
class Residuals:
    """The same residuals at every frame; half their squares are a part of the energy."""

    width: int
    """Frames in a row that they see."""
    values: Callable[[Fragment], Array]
    """Fragment -> (windows, P) parameters."""
    value: Any
    """(z (width F,), parameters (P,)) -> residuals (R,)."""
    jacobian: Any
    """The same -> residuals and their sparse Jacobian (R, width F)."""

    def windows(self, frames: int) -> int:
        """How many there are in N frames."""
        return frames - self.width + 1


def _built(windows: Sequence[_Window]) -> list[Residuals]:
    """CasADi functions of the residuals, compiled together as the package's are."""
    functions = []
    for w in windows:
        inputs, option = [w.z, ca.vertcat(*(ca.vec(p) for p in w.parameters))], {"cse": True}
        r = ca.densify(ca.vec(w.residual))
        functions.append(ca.Function(f"{w.name}_value", inputs, [r], option))
        functions.append(
            ca.Function(f"{w.name}_jacobian", inputs, [r, ca.jacobian(r, w.z)], option)
        )
    built = compiled(functions)
    return [
        Residuals(w.width, w.values, built[2 * i], built[2 * i + 1]) for i, w in enumerate(windows)
    ]


def _symbols(**shapes: tuple[int, int]) -> dict[str, Any]:
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def _column(value: Array, count: int) -> Array:
    """The same value, column-major, for every window."""
    return np.tile(np.ravel(value, order="F"), (count, 1))


def _windows(z: Array, width: int) -> Array:
    """(N - width + 1, width F) rows of some frames in a row."""
    view = np.lib.stride_tricks.sliding_window_view(z, width, axis=0)
    return np.swapaxes(view, 1, 2).reshape(len(view), -1)


def _huber(r: Any, weight: Any, delta: float) -> Any:
    """Residuals whose squares sum to `energies.pseudo_huber` of the weighted square."""
    factor = 2 / (1 + ca.sqrt(1 + weight * ca.sumsqr(r) / delta**2))
    return ca.sqrt(weight) * ca.sqrt(factor) * r


def _cauchy(r: Any, weight: Any) -> Any:
    """Residuals whose squares sum to `energies.cauchy` of the weighted square."""
    squared = weight * ca.sumsqr(r) + 1e-12
    return ca.sqrt(weight) * ca.sqrt(ca.log1p(squared) / squared) * r


# --- the peers -----------------------------------------------------------------------------------


class Lbfgs:
    """PyTorch's L-BFGS with autograd and a strong Wolfe line search, as the paper has it."""

    def __init__(self, scene: Scene, steps: int, history: int = 100) -> None:
        """Stop after some `steps`, or where nothing changes any more."""
        self.scene, self.steps, self.history = scene, steps, history

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; the trace has every point evaluated."""
        began = perf_counter()
        energy = self.scene.torch_energy(fragment)
        z = torch.from_numpy(self.scene.variables(fragment)).requires_grad_()
        optimiser = torch.optim.LBFGS(
            [z], max_iter=self.steps, max_eval=4 * self.steps, tolerance_grad=1e-9,
            tolerance_change=1e-14, history_size=self.history, line_search_fn="strong_wolfe",
        )  # fmt: skip

        def closure() -> float:
            optimiser.zero_grad()
            value = energy(z)
            torch.autograd.backward(value)
            if trace is not None:
                trace.append((perf_counter() - began, z.detach().numpy().copy()))
            return float(value.detach())

        optimiser.step(closure)  # type: ignore[no-untyped-call]
        seconds = perf_counter() - began
        iterations, evaluations = (int(optimiser.state[z][n]) for n in ("n_iter", "func_evals"))
        x = self.scene.state(fragment, z.detach().numpy())
        if trace is not None:
            trace[:] = [(t, self.scene.state(fragment, at)) for t, at in trace]
        by_itself = iterations < self.steps and evaluations < 4 * self.steps
        return Answer(x, seconds, iterations, by_itself)


class ScipyLeastSquares:
    """SciPy's trust-region reflective least squares with a sparse Jacobian (LSMR inside)."""

    def __init__(self, scene: Scene, evaluations: int) -> None:
        """Stop after some `evaluations`, or where the energy changes by less than 1e-10 of itself."""
        self.scene, self.evaluations = scene, evaluations
        N = len(scene.variables(scene.fragment(0)))
        self._residuals = scene.residuals
        self._value = [Buffered(r.value.map(r.windows(N))) for r in self._residuals]
        self._jacobian = [Buffered(r.jacobian.map(r.windows(N))) for r in self._residuals]
        size = self._residuals[0].value.numel_in(0)
        rows, columns, first = [], [], 0
        for r in self._residuals:
            row, column = (np.array(v) for v in r.jacobian.sparsity_out(1).get_triplet())
            window = np.arange(r.windows(N))[:, None]
            rows.append((first + window * r.value.numel_out(0) + row).ravel())
            columns.append((window * size + column).ravel())
            first += r.windows(N) * r.value.numel_out(0)
        row, column = np.concatenate(rows), np.concatenate(columns)
        # 1-based, so that no entry of the pattern is a zero.
        pattern = csr_matrix((np.arange(1.0, len(row) + 1), (row, column)), (first, N * size))
        self._order, self._pattern = pattern.data.astype(np.intp) - 1, pattern

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; the trace has every iteration."""
        began = perf_counter()
        z0 = self.scene.variables(fragment)
        for r, *functions in zip(self._residuals, self._value, self._jacobian, strict=True):
            for function in functions:
                function.inputs[1][:] = r.values(fragment).ravel()

        def kept(intermediate_result: Any) -> None:
            if trace is not None:
                trace.append((perf_counter() - began, np.array(intermediate_result.x)))

        def value(z: Array) -> Array:
            return self._evaluated(self._value, z.reshape(z0.shape), 0)

        def jacobian(z: Array) -> Any:
            values = self._evaluated(self._jacobian, z.reshape(z0.shape), 1)
            p = self._pattern
            return csr_matrix((values[self._order], p.indices, p.indptr), p.shape)

        result = least_squares(
            value,
            z0.ravel(),
            jac=jacobian,
            method="trf", tr_solver="lsmr", x_scale="jac", max_nfev=self.evaluations,
            ftol=1e-10, xtol=1e-12, gtol=1e-10, callback=kept,
        )  # fmt: skip
        seconds = perf_counter() - began
        if trace is not None:
            trace[:] = [(t, self.scene.state(fragment, z.reshape(z0.shape))) for t, z in trace]
        x = self.scene.state(fragment, np.asarray(result.x).reshape(z0.shape))
        return Answer(x, seconds, int(result.nfev), result.status > 0)

    def _evaluated(self, functions: list[Buffered], z: Array, output: int) -> Array:
        parts = [
            function(_windows(z, r.width).ravel())[output]
            for r, function in zip(self._residuals, functions, strict=True)
        ]
        return np.concatenate(parts)


class Ceres:
    """Ceres' Levenberg-Marquardt: a parameter block a frame, sparse Cholesky, residuals from Python.

    Attributes:
        shares: of every solve's time, the part spent in the residuals and Jacobians.
    """

    def __init__(self, scene: Scene, iterations: int) -> None:
        """Stop after some `iterations`, or where the energy changes by less than 1e-10 of itself.

        Blocks of a frame are mostly zeros in Cartesian space, where joints hardly know of each other:
        Ceres looks at single entries there (a seventh of the time), and at blocks in joint space (three
        quarters of the time).
        """
        self.scene, self.iterations = scene, iterations
        self.shares: list[float] = []
        self._z = [row.copy() for row in scene.variables(scene.fragment(0))]
        N, F = len(self._z), len(self._z[0])
        self._problem = pyceres.Problem()
        self._residuals = scene.residuals
        self._costs: list[list[_Cost]] = []
        for r in self._residuals:
            self._costs.append([_Cost(r, F) for _ in range(r.windows(N))])
            for t, cost in enumerate(self._costs[-1]):
                self._problem.add_residual_block(cost, None, self._z[t : t + r.width])

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; the trace has every iteration."""
        began = perf_counter()
        for block, row in zip(self._z, self.scene.variables(fragment), strict=True):
            block[:] = row
        for r, costs in zip(self._residuals, self._costs, strict=True):
            for cost, values in zip(costs, r.values(fragment), strict=True):
                cost.take(values)
        options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
        options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
        options.dynamic_sparsity = isinstance(self.scene, CartesianScene)
        options.max_num_iterations, options.num_threads = self.iterations, 1
        options.function_tolerance, options.parameter_tolerance = 1e-10, 1e-12
        options.gradient_tolerance, options.minimizer_progress_to_stdout = 1e-9, False
        if trace is not None:
            options.update_state_every_iteration = True
            options.callbacks = [
                _Kept(lambda: trace.append((perf_counter() - began, np.array(self._z))))
            ]
        pyceres.solve(options, self._problem, summary)
        seconds = perf_counter() - began
        if trace is not None:
            trace[:] = [(t, self.scene.state(fragment, z)) for t, z in trace]
        inside = summary.residual_evaluation_time_in_seconds
        inside += summary.jacobian_evaluation_time_in_seconds
        self.shares.append(inside / seconds)
        iterations = summary.num_successful_steps + summary.num_unsuccessful_steps
        converged = summary.termination_type == pyceres.TerminationType.CONVERGENCE
        x = self.scene.state(fragment, np.array(self._z))
        return Answer(x, seconds, int(iterations), bool(converged))


class _Cost(pyceres.CostFunction):  # type: ignore[misc]
    """Residuals of one window for Ceres."""

    def __init__(self, residuals: Residuals, size: int) -> None:
        super().__init__()
        self.set_num_residuals(residuals.value.numel_out(0))
        self.set_parameter_block_sizes([size] * residuals.width)
        self._value, self._jacobian = Buffered(residuals.value), Buffered(residuals.jacobian)
        row, column = (np.array(v) for v in residuals.jacobian.sparsity_out(1).get_triplet())
        self._chosen, self._places = [], []
        for k in range(residuals.width):
            chosen = np.flatnonzero(column // size == k)
            self._chosen.append(chosen)
            self._places.append(row[chosen] * size + column[chosen] % size)

    def take(self, parameters: Array) -> None:
        """Another fragment's values."""
        self._value.inputs[1][:] = parameters
        self._jacobian.inputs[1][:] = parameters

    def Evaluate(
        self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None
    ) -> bool:
        z = np.concatenate(parameters)
        if jacobians is None:
            residuals[:] = self._value(z)[0]
            return True
        r, values = self._jacobian(z)
        residuals[:] = r
        for block, chosen, places in zip(jacobians, self._chosen, self._places, strict=True):
            if block is not None:
                block[:] = 0.0
                block[places] = values[chosen]
        return True


class _Kept(pyceres.IterationCallback):  # type: ignore[misc]
    """Tells of every iteration."""

    def __init__(self, told: Callable[[], None]) -> None:
        super().__init__()
        self._told = told

    def __call__(self, summary: Any) -> Any:
        self._told()
        return pyceres.CallbackReturnType.SOLVER_CONTINUE
