"""Fragments of the Cartesian energy as printed, in PyTorch and as residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
import torch

from benchmarks.peers.fragments import Fragment, Material, Score
from benchmarks.peers.residuals import Residuals, Window, built, column, symbols
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.inertial.initial_poses import refit_root
from rtof_kin.solve import terms as energies
from rtof_kin.solve.cartesian.solver import CartesianSolver
from rtof_kin.solve.settings import CartesianSettings


class CartesianScene:
    """Fragments of the printed energy; a state is (N, 3J), its variables are the state itself."""

    def __init__(self, material: Material, frames: int, settings: CartesianSettings) -> None:
        """Take a recording.

        Raises:
            InvalidInputError: the settings are not those of the energy as printed.
        """
        s = settings
        if not s.as_printed or s.huber_reprojection is not None or s.sigma_reprojection is None:
            raise InvalidInputError("peers have the printed energy only: use CartesianSettings.paper()")
        m, self.settings, self.frames = material, settings, frames
        self.start = refit_root(m.start, m.keypoints) if s.refit_root else m.start
        self.solver = CartesianSolver(m.skeleton, frames, settings, m.imus.joints)
        self.problem = self.solver._problem
        self.observations = self.solver._observations(self.start, m.keypoints, m.imus)

    def fragment(self, first: int) -> Fragment:
        """The fragment of the frames from `first`."""
        frame = np.arange(first, first + self.frames)
        inside = (frame >= 0) & (frame < len(self.start))
        index = np.clip(frame, 0, len(self.start) - 1)
        values = self.solver._fragment_values(index, inside, self.start, self.observations)
        values = values | {"sigma_reprojection": np.array([self.settings.sigma_reprojection])}
        return Fragment(first, self.start.p_world_joint[index].reshape(self.frames, -1), values)

    def score(self, fragment: Fragment, x: Array, multipliers: Array | None = None) -> Score:
        """Score by `FragmentProblem.value`."""
        energy, gradient = self.problem.value(x.ravel()[self.problem.order], self.problem.pack(fragment.data))
        return Score(float(np.sum(np.asarray(energy))), float(np.abs(np.asarray(gradient)).max()), 0.0)

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
                ("uv_px", N, 2),
                ("a_world", N - 2, 3),
                ("b_world", N, 3),
                ("j_world", N - 3, 3),
                ("p_prior", N, 3),
            )
        )
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
                + k[1] * torch.sum(v["w_acceleration"].T[..., None] * acceleration**2) / s.sigma_acceleration**2
                + k[2] * torch.sum(v["w_bone"].T[..., None] * bone**2) / s.sigma_bone**2
                + k[3] * torch.sum(v["w_smooth"][:, None, None] * smooth**2) / s.sigma_jerk**2
                + k[5] * torch.mean(((X - prior) / s.sigma_prior) ** 2)
            )

        return energy

    @cached_property
    def residuals(self) -> Sequence[Residuals]:
        """Residuals of one frame, of three (acceleration) and of four (jerk)."""
        return built([self._frame(), self._acceleration(), self._jerk()])

    def _frame(self) -> Window:
        s, N, J = self.settings, self.frames, len(self.problem.parents)
        bones = self.problem.sensor_bones
        X = ca.SX.sym("X", 3, J)
        P = symbols(
            w=(J + len(bones) + 1, 1),
            R_camera_world=(3, 3),
            t_camera_world=(3, 1),
            K=(3, 3),
            uv_px=(2, J),
            b_world=(3, len(bones)),
            p_prior=(3, J),
        )
        weight = P["w"]
        camera = P["R_camera_world"] @ X + ca.repmat(P["t_camera_world"], 1, J)
        rows = [energies.reprojection(camera, P["uv_px"], P["K"]) * ca.repmat(weight[:J].T, 2, 1)]
        rows += [
            energies.bone_vector(X[:, a], X[:, b], P["b_world"][:, i]) * weight[J + i] for i, (a, b) in enumerate(bones)
        ]
        rows.append(energies.position(X, P["p_prior"]) * weight[-1])

        def parameters(f: Fragment) -> Array:
            d = f.data
            k = np.sqrt(2 * d["k"])
            w = np.column_stack(
                [
                    k[0] / d["sigma_reprojection"] * np.sqrt(d["w_visual"]).reshape(N, J),
                    k[2] / s.sigma_bone * np.sqrt(d["w_bone"]).T,
                    np.full(N, k[5] / s.sigma_prior / np.sqrt(3 * J * N)),
                ]
            )
            camera = [column(d[n], N) for n in ("R_camera_world", "t_camera_world", "K")]
            uv = d["uv_px"].T.reshape(N, -1)
            return np.column_stack([w, *camera, uv, d["b_world"].T, d["p_prior"].T])

        r = ca.vertcat(*(ca.vec(row) for row in rows))
        return Window("cartesian_frame", 1, r, ca.vec(X), tuple(P.values()), parameters)

    def _acceleration(self) -> Window:
        s, J, bones = self.settings, len(self.problem.parents), self.problem.sensor_bones
        z = ca.SX.sym("z", 3 * J, 3)
        P = symbols(w=(len(bones), 1), shares=(len(bones), 1), rate_hz=(1, 1), a_world=(3, len(bones)))
        rows = []
        for i, (a, b) in enumerate(bones):
            share = P["shares"][i]
            sensor = (1 - share) * z[3 * a : 3 * a + 3, :] + share * z[3 * b : 3 * b + 3, :]
            rows.append(P["w"][i] * energies.acceleration(sensor, P["a_world"][:, i], P["rate_hz"]))

        def parameters(f: Fragment) -> Array:
            d = f.data
            w = np.sqrt(2 * d["k"][1] * d["w_acceleration"].T) / s.sigma_acceleration
            same = [column(d[name], len(w)) for name in ("shares", "rate_hz")]
            return np.column_stack([w, *same, d["a_world"].T])

        r = ca.vertcat(*rows)
        return Window("cartesian_acceleration", 3, r, ca.vec(z), tuple(P.values()), parameters)

    def _jerk(self) -> Window:
        s, J = self.settings, len(self.problem.parents)
        z = ca.SX.sym("z", 3 * J, 4)
        P = symbols(weight=(1, 1), rate_hz=(1, 1), j_world=(3 * J, 1))

        def parameters(f: Fragment) -> Array:
            d = f.data
            w = np.sqrt(2 * d["k"][3] * d["w_smooth"]) / s.sigma_jerk
            return np.column_stack([w, column(d["rate_hz"], len(w)), d["j_world"].T])

        r = P["weight"] * energies.jerk(z, P["j_world"], P["rate_hz"])
        return Window("cartesian_jerk", 4, r, ca.vec(z), tuple(P.values()), parameters)
