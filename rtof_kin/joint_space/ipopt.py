"""The reference solver: IPOPT on the same energy, limits as inequalities.

IPOPT's variables are the step d (N D) from the starting state, so the energy at d is that of the state
retracted by d. Its derivatives are the problem's own, which are taken at the state itself, times the
Jacobian T of the retraction: g = T^T g_local, H = T^T H_local T (Gauss-Newton).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin import quaternions as quat
from rtof_kin.joint_space.levenberg_marquardt import Solved
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.problem import JointProblem

Array = NDArray[np.float64]


class Ipopt:
    """Solves one problem for any data bound to it, as `LevenbergMarquardt` does."""

    def __init__(self, problem: JointProblem, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        self._point = _Point(problem, limits)
        names = ("nlp", "grad_f", "jac_g", "hess_lag")
        self._functions = {name: _Oracle(name, self._point) for name in names}
        self._solvers: dict[tuple[int, float], Any] = {}

    def solve(
        self,
        x: Array,
        max_iterations: int,
        tolerance: float,
        multipliers: Array | None = None,
    ) -> Solved:
        """Minimise from a state; `tolerance` is IPOPT's, on the scaled gradient.

        Args:
            multipliers: are not used: IPOPT finds its own.
        """
        self._point.start = x
        problem, limits, N = self.problem, self.limits, len(x)
        solver = self._solver(max_iterations, tolerance)
        bounds: dict[str, Any] = {}
        if limits is not None:
            bounds = {"lbg": np.tile(limits.lower, N), "ubg": np.tile(limits.upper, N)}
        result = solver(x0=np.zeros(N * problem.space.size), **bounds)
        stats = solver.stats()
        d = np.asarray(result["x"]).reshape(N, -1)
        state = problem.space.retract(x, d)
        multipliers = np.zeros((N, 0))
        if limits is not None:
            multipliers = np.asarray(result["lam_g"]).reshape(N, -1)
        return Solved(state, int(stats["iter_count"]), bool(stats["success"]), multipliers)

    def _solver(self, max_iterations: int, tolerance: float) -> Any:
        key = (max_iterations, tolerance)
        if key not in self._solvers:
            functions = dict(self._functions)
            nlp = functions.pop("nlp")
            options: dict[str, Any] = {
                **functions, "print_time": False, "error_on_fail": False, "show_eval_warnings": False,
                "calc_lam_p": False, "calc_lam_x": False, "no_nlp_grad": True,
                "ipopt": {
                    "print_level": 0, "sb": "yes", "linear_solver": "mumps", "tol": tolerance,
                    "max_iter": max_iterations, "nlp_scaling_method": "none", "mu_init": 1e-3,
                    "mumps_scaling": 0, "mumps_permuting_scaling": 0, "mumps_pivot_order": 0,
                },
            }  # fmt: skip
            self._solvers[key] = ca.nlpsol("joint_fragment", "ipopt", nlp, options)
        return self._solvers[key]


class _Point:
    """Everything IPOPT asks about a step d, from the problem at the state it leads to."""

    def __init__(self, problem: JointProblem, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        self.start: Array = np.zeros((problem.frames, 3 + 4 * len(problem.space.joints)))
        self.start[:, 3::4] = 1.0
        N, D = problem.frames, problem.space.size
        self.size, self.constraints = N * D, 0 if limits is None else N * len(limits.names)
        self._mask = self._hessian_mask()
        M = 0 if limits is None else len(limits.names)
        self._jacobian_mask = np.zeros((M, D), dtype=bool)
        if limits is not None:
            rng = np.random.default_rng(0)
            d = rng.normal(size=(N, D)) * 0.3
            J = limits.jacobian(problem.space.retract(self.start, d)) @ self._tangent(d)
            self._jacobian_mask = (J != 0).any(axis=0)

    def state(self, d: Array) -> Array:
        """The state after the step."""
        return self.problem.space.retract(self.start, d.reshape(self.problem.frames, -1))

    def _tangent(self, d: Array) -> Array:
        """T (N, D, D): step at the state per change of d."""
        space, N = self.problem.space, self.problem.frames
        turns = (d.reshape(N, -1)[:, 3:] @ space.expand.T).reshape(N, -1, 3)
        J = quat.right_jacobian(turns)
        A = J.shape[1]
        block = np.zeros((N, A, 3, A, 3))
        i = np.arange(A)
        block[:, i, :, i, :] = np.swapaxes(J, 0, 1)
        T = np.zeros((N, space.size, space.size))
        T[:, [0, 1, 2], [0, 1, 2]] = 1.0
        T[:, 3:, 3:] = space.expand.T @ block.reshape(N, 3 * A, 3 * A) @ space.expand
        return T

    def energy(self, d: Array) -> float:
        return self.problem.total(self.state(d))

    def angles(self, d: Array) -> Array:
        return np.zeros(0) if self.limits is None else self.limits.values(self.state(d)).ravel()

    def gradient(self, d: Array) -> Array:
        g = self.problem.gradient(self.state(d))
        return np.asarray(np.einsum("tab,ta->tb", self._tangent(d), g)).ravel()

    def jacobian(self, d: Array) -> Array:
        """Nonzeros of the limits' Jacobian, column by column."""
        if self.limits is None:
            return np.zeros(0)
        J = self.limits.jacobian(self.state(d)) @ self._tangent(d)
        return np.asarray(np.swapaxes(J, 1, 2)[:, self._jacobian_mask.T]).ravel()

    def jacobian_sparsity(self) -> Any:
        N, mask = self.problem.frames, ca.DM(self._jacobian_mask.astype(float))
        return (
            ca.diagcat(*[ca.sparsify(mask)] * N).sparsity()
            if self.constraints
            else ca.Sparsity(0, self.size)
        )

    def hessian(self, d: Array) -> Array:
        """Nonzeros of the upper triangle, column by column."""
        problem, T = self.problem, self._tangent(d)
        N, D = problem.frames, problem.space.size
        problem.linearise(self.state(d))
        columns = np.zeros((N, D, 4, D))
        for k in range(4):  # block (t, t + k) of the upper triangle
            block = problem.lower_block(k)  # [t, r, c] = H[(t + k, r), (t, c)]
            turned = np.swapaxes(T[k:], 1, 2) @ block @ T[: N - k]
            columns[k:, :, 3 - k] = turned
        return columns.reshape(N, D, 4 * D)[self._mask]

    def _hessian_mask(self) -> NDArray[np.bool_]:
        """(N, D, 4D): of each column, which rows of this frame and the three before are kept."""
        N, D = self.problem.frames, self.problem.space.size
        mask = np.ones((N, D, 4, D), dtype=bool)
        kept = self.problem.space.expand.reshape(-1, 3, D - 3).any(axis=1)  # joint of each tangent
        same = np.eye(D, dtype=bool)
        same[3:, 3:] |= kept.T.astype(float) @ kept.astype(float) > 0
        mask[:, :, 0] = same
        mask[:, :, 3] = np.tril(np.ones((D, D), dtype=bool))
        for k in range(1, 4):
            mask[:k, :, 3 - k] = False
        return mask.reshape(N, D, 4 * D)

    def hessian_sparsity(self) -> Any:
        N, D = self.problem.frames, self.problem.space.size
        t, c, r = np.nonzero(self._mask)
        rows = (t - 3) * D + r
        return ca.Sparsity.triplet(N * D, N * D, rows.tolist(), (t * D + c).tolist())


class _Oracle(ca.Callback):
    """One of the functions IPOPT calls, answered by a point."""

    def __init__(self, kind: str, point: _Point) -> None:
        ca.Callback.__init__(self)
        self._kind, self._at = kind, point
        self.construct(kind, {})

    def get_n_in(self) -> int:
        return 4 if self._kind == "hess_lag" else 2

    def get_n_out(self) -> int:
        return 1 if self._kind == "hess_lag" else 2

    def get_name_in(self, i: int) -> str:
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        names = {
            "nlp": ("f", "g"), "grad_f": ("f", "grad_f_x"), "jac_g": ("g", "jac_g_x"),
            "hess_lag": ("triu_hess_gamma_x_x",),
        }  # fmt: skip
        return names[self._kind][i]

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(
            *((self._at.size, 1), (0, 0), (1, 1), (self._at.constraints, 1))[i]
        )

    def get_sparsity_out(self, i: int) -> Any:
        point = self._at
        shapes = {
            "nlp": (ca.Sparsity.dense(1, 1), ca.Sparsity.dense(point.constraints, 1)),
            "grad_f": (ca.Sparsity.dense(1, 1), ca.Sparsity.dense(point.size, 1)),
        }
        if self._kind == "jac_g":
            return (ca.Sparsity.dense(point.constraints, 1), point.jacobian_sparsity())[i]
        return point.hessian_sparsity() if self._kind == "hess_lag" else shapes[self._kind][i]

    def eval(self, arguments: Any) -> list[Any]:
        point, d = self._at, np.asarray(arguments[0]).ravel()
        if self._kind == "nlp":
            return [point.energy(d), ca.DM(point.angles(d))]
        if self._kind == "grad_f":
            return [point.energy(d), ca.DM(point.gradient(d))]
        if self._kind == "jac_g":
            return [ca.DM(point.angles(d)), ca.DM(point.jacobian_sparsity(), point.jacobian(d))]
        return [ca.DM(point.hessian_sparsity(), float(arguments[2]) * point.hessian(d))]
