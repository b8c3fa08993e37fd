"""Fragments of the joint-space energy: the package's own value and gradient, and its residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import torch

from benchmarks.peers.fragments import Fragment, Material, Score
from benchmarks.peers.residuals import Residuals, Window, built, cauchy, column, huber, rows_of, symbols
from rtof_kin.core import quaternions as quat
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve import terms as energies
from rtof_kin.solve.initial_guess import initial_guess
from rtof_kin.solve.joint_space.fragment import FragmentData, FragmentEnergy
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import Limits, StateSpace
from rtof_kin.solve.settings import JointSpaceSettings


class JointScene:
    """Fragments of the joint-space energy; a state is (N, 3 + 4A), its variables the step (N, D)."""

    def __init__(self, material: Material, frames: int, settings: JointSpaceSettings) -> None:
        """Take a recording.

        Raises:
            InvalidInputError: the settings estimate the reprojection error, know a floor or no limits.
        """
        if settings.sigma_reprojection is None or settings.floor_height is not None:
            raise InvalidInputError("peers need sigma_reprojection given, and no floor")
        if not settings.limits:
            raise InvalidInputError("peers need limits=True; solvers leave them out themselves")
        m, self.settings, self.frames = material, settings, frames
        guess = initial_guess(m.start, m.keypoints, m.imus, m.skeleton, refit_root=settings.refit_root)
        self.observations = Observations(m.skeleton, frames, settings, guess, m.keypoints, m.imus)
        self.problem: FragmentEnergy = self.observations.problem
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
        """Score by `FragmentEnergy.total` and `gradient`; with multipliers the Lagrangian's gradient."""
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
        """Residuals of one frame, of three (acceleration) and of four (jerk)."""
        return built([self._frame(), self._acceleration(), self._jerk()])

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

    def _frame(self) -> Window:
        energy = self.problem.energy
        x, z = ca.SX.sym("x", 3 + 4 * len(self.space.joints)), ca.SX.sym("z", self.space.size)
        O = symbols(**energy.observation)
        C = symbols(**energy.constant)
        p_root, quats = self._moved(x, z)
        p, q = self._posed(p_root, quats, C["offsets"])
        rows = []
        for i, (j, is_joint) in enumerate(energy["visual"].landmarks):
            point = p[j] if is_joint else p[j] + energies.quat_matrix(q[j]) @ C["places"][:, i]
            camera = C["R_camera_world"] @ point + C["t_camera_world"]
            r = energies.reprojection(camera, O["uv_px"][:, i], C["K"])
            rows.append(huber(r, O["w_visual"][i], O["knee_visual"]))
        for s, j in enumerate(energy["orientation"].sensors):
            r = energies.orientation(q[j], O["quat_sensor"][:, s])
            r = ca.reshape(C["whitening"][:, s], 3, 3) @ r
            rows.append(huber(r, O["w_sensor"][s], energy["orientation"].robust))
        for i, j in enumerate(energy["torso"].segments):
            r = energies.orientation(q[j], O["quat_torso"][:, i])
            rows.append(cauchy(r, O["w_torso"][i]))
        for i, (j, child) in enumerate(energy["bone"].bones):
            r = energies.bone_vector(p[j], p[child], O["b_world"][:, i])
            rows.append(cauchy(r, O["w_bone"][i]))
        rows.append(cauchy(energies.position(p[0], O["p_root"]), O["w_root"]))
        vectors = [energies.rotation_vector(quats[a + 1], C["quat_mean"][:, a]) for a in range(len(quats) - 1)]
        # C["precision"] is given as its Cholesky factor, transposed (`parameters`).
        rows.append(ca.sqrt(O["w_prior"]) * (C["precision"] @ ca.vertcat(*vectors)))

        def parameters(f: Fragment) -> Array:
            data: FragmentData = f.data
            root = np.asarray(np.linalg.cholesky(data.constant["precision"]).T)
            constant = data.constant | {"precision": root}
            columns = [data.observation[n].reshape(self.frames, -1) for n in O]
            columns += [column(constant[n], self.frames) for n in C]
            return np.column_stack([f.x0, *columns])

        given = (x, *O.values(), *C.values())
        return Window("joint_frame", 1, ca.vertcat(*rows), z, given, parameters)

    def _acceleration(self) -> Window:
        energy, A = self.problem.energy, len(self.space.joints)
        sensors = energy["orientation"].sensors
        S, robust = len(sensors), self.settings.robust_acceleration
        x, z = ca.SX.sym("x", 3 + 4 * A, 3), ca.SX.sym("z", self.space.size, 3)
        P = symbols(a_world=(3, S), w=(S, 1), rate_hz=(1, 1), offsets=energy.constant["offsets"], levers=(3, S))
        frames = [self._posed(*self._moved(x[:, t], z[:, t]), P["offsets"]) for t in range(3)]
        rows = []
        for s, j in enumerate(sensors):
            path = ca.horzcat(*(p[j] + energies.quat_matrix(q[j]) @ P["levers"][:, s] for p, q in frames))
            r = energies.acceleration(path, P["a_world"][:, s], P["rate_hz"])
            rows.append(huber(r, P["w"][s], robust))

        def parameters(f: Fragment) -> Array:
            data: FragmentData = f.data
            n = self.frames - 2
            same = [column(data.constant[name], n) for name in ("offsets", "levers")]
            rate = np.full(n, data.rate_hz)
            a, w = data.a_world.reshape(n, -1), data.w_acceleration
            return np.column_stack([rows_of(f.x0, 3), a, w, rate, *same])

        given = (x, *P.values())
        return Window("joint_acceleration", 3, ca.vertcat(*rows), ca.vec(z), given, parameters)

    def _jerk(self) -> Window:
        D, A, expand = self.space.size, len(self.space.joints), ca.DM(self.space.expand)
        x, z = ca.SX.sym("x", 3 + 4 * A, 4), ca.SX.sym("z", D, 4)
        P = symbols(w=(1, 1), rate_hz=(1, 1), sigma=(D, 1))
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
            return np.column_stack([rows_of(f.x0, 4), data.w_jerk, rate, sigma])

        return Window("joint_jerk", 4, r, ca.vec(z), (x, *P.values()), parameters)


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
