"""The reference solver: IPOPT on the same energy, limits as inequalities.

IPOPT's variables are the step d (N D) from the starting state, in millimetres and milliradians, so the
energy at d is that of the state retracted by d. Its derivatives are the problem's own, which are taken at
the state itself, times the Jacobian T of the retraction: g = T^T g_local, H = T^T H_local T
(Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import quaternions as quat
from rtof_kin.core.numerics.c_compiler import BUILDING
from rtof_kin.core.numerics.levenberg_marquardt import Solved
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.joint_space.limits import Limits

Array = NDArray[np.float64]
_UNIT = 1e-3
"""m and rad of IPOPT's variables."""
_GRADIENT = 100.0
"""Largest derivative of the energy by a millimetre or milliradian that is left, in tolerances."""
_METIS = 5
"""MUMPS' number of the ordering that fills this band least: half the time of the usual one."""


class Ipopt:
    """Solves one problem for any data bound to it, as `LevenbergMarquardt` does."""

    def __init__(self, problem: FragmentEnergy, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        names = ("nlp", "grad_f", "jac_g", "hess_lag")
        with BUILDING:
            self._point = _Point(problem, limits)
            self._functions = {name: _Oracle(name, self._point) for name in names}
        self._solvers: dict[tuple[int, float], Any] = {}

    def solve(
        self, x: Array, max_iterations: int, tolerance: float, multipliers: Array | None = None
    ) -> Solved:
        """Minimise from a state.

        Args:
            tolerance: a hundredth of the largest derivative of the Lagrangian that is left, by a
                millimetre or milliradian.
            multipliers: are not used: IPOPT finds its own.
        """
        self._point.begin(x)
        problem, limits, N = self.problem, self.limits, len(x)
        solver = self._solver(max_iterations, tolerance)
        bounds: dict[str, Any] = {}
        if limits is not None:
            bounds = {"lbg": np.tile(limits.lower, N), "ubg": np.tile(limits.upper, N)}
        with BUILDING:
            result = solver(x0=np.zeros(N * problem.space.size), **bounds)
            stats = solver.stats()
        state = self._point.state(np.asarray(result["x"]).ravel())
        multipliers = np.zeros((N, 0))
        if limits is not None:
            multipliers = np.asarray(result["lam_g"]).reshape(N, -1)
        ended = str(stats["return_status"])
        return Solved(
            state, int(stats["iter_count"]), ended == "Solve_Succeeded", multipliers,
            out_of_iterations=ended == "Maximum_Iterations_Exceeded",
        )  # fmt: skip

    def _solver(self, max_iterations: int, tolerance: float) -> Any:
        key = (max_iterations, tolerance)
        if key not in self._solvers:
            functions = dict(self._functions)
            nlp = functions.pop("nlp")
            options: dict[str, Any] = {
                **functions, "print_time": False, "error_on_fail": False, "show_eval_warnings": False,
                "calc_lam_p": False, "calc_lam_x": False, "no_nlp_grad": True,
                "ipopt": {
                    "print_level": 0, "sb": "yes", "linear_solver": "mumps",
                    "tol": _GRADIENT * tolerance,
                    "max_iter": max_iterations, "nlp_scaling_method": "none", "mu_init": 1e-3,
                    "mumps_scaling": 0, "mumps_permuting_scaling": 0, "mumps_pivot_order": _METIS,
                },
            }  # fmt: skip
            with BUILDING:
                self._solvers[key] = ca.nlpsol("joint_fragment", "ipopt", nlp, options)
        return self._solvers[key]


class _Point:
    """Everything IPOPT asks about a step d, from the problem at the state it leads to."""

    def __init__(self, problem: FragmentEnergy, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        rest = np.zeros((problem.frames, 3 + 4 * len(problem.space.joints)))
        rest[:, 3::4] = 1.0
        N, D = problem.frames, problem.space.size
        self.size, self.constraints = N * D, 0 if limits is None else N * len(limits.names)
        self.begin(rest)
        self._mask = self._hessian_mask()
        self.hessian_sparsity = self._hessian_sparsity()
        M = 0 if limits is None else len(limits.names)
        self._jacobian_mask = np.zeros((M, D), dtype=bool)
        if limits is not None:
            rng = np.random.default_rng(0)
            y = rng.normal(size=N * D) * 0.3 / _UNIT
            J = limits.jacobian(self.state(y)) @ self._tangent(y)
            self._jacobian_mask = (J != 0).any(axis=0)
        self.jacobian_sparsity = self._jacobian_sparsity()

    def begin(self, x: Array) -> None:
        """Take the state that steps are from."""
        self.start = x
        self._last = np.zeros(self.size), x

    def state(self, y: Array) -> Array:
        """The state after IPOPT's variables."""
        if not np.array_equal(self._last[0], y):
            step = _UNIT * y.reshape(self.problem.frames, -1)
            self._last = y.copy(), self.problem.space.retract(self.start, step)
        return self._last[1]

    def _tangent(self, y: Array) -> Array:
        """T (N, D, D): step at the state per change of IPOPT's variables."""
        space, N = self.problem.space, self.problem.frames
        turns = (_UNIT * y.reshape(N, -1)[:, 3:] @ space.expand.T).reshape(N, -1, 3)
        J = quat.right_jacobian(turns)
        A = J.shape[1]
        block = np.zeros((N, A, 3, A, 3))
        i = np.arange(A)
        block[:, i, :, i, :] = np.swapaxes(J, 0, 1)
        T = np.zeros((N, space.size, space.size))
        T[:, [0, 1, 2], [0, 1, 2]] = 1.0
        T[:, 3:, 3:] = space.expand.T @ block.reshape(N, 3 * A, 3 * A) @ space.expand
        return _UNIT * T

    def energy(self, y: Array) -> float:
        return self.problem.total(self.state(y))

    def angles(self, y: Array) -> Array:
        return np.zeros(0) if self.limits is None else self.limits.values(self.state(y)).ravel()

    def gradient(self, y: Array) -> Array:
        g = self.problem.gradient(self.state(y))
        return np.asarray(np.einsum("tab,ta->tb", self._tangent(y), g)).ravel()

    def jacobian(self, y: Array) -> Array:
        """Nonzeros of the limits' Jacobian, column by column."""
        if self.limits is None:
            return np.zeros(0)
        J = self.limits.jacobian(self.state(y)) @ self._tangent(y)
        return np.asarray(np.swapaxes(J, 1, 2)[:, self._jacobian_mask.T]).ravel()

    def _jacobian_sparsity(self) -> Any:
        N, mask = self.problem.frames, ca.DM(self._jacobian_mask.astype(float))
        return (
            ca.diagcat(*[ca.sparsify(mask)] * N).sparsity() if self.constraints else ca.Sparsity(0, self.size)
        )

    def hessian(self, y: Array) -> Array:
        """Nonzeros of the upper triangle, column by column."""
        problem, T = self.problem, self._tangent(y)
        N, D = problem.frames, problem.space.size
        problem.linearise(self.state(y))
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

    def _hessian_sparsity(self) -> Any:
        N, D = self.problem.frames, self.problem.space.size
        t, c, r = np.nonzero(self._mask)
        rows = (t - 3) * D + r
        return ca.Sparsity.triplet(N * D, N * D, rows.tolist(), (t * D + c).tolist())


class _Oracle(ca.Callback):
    """One of the functions IPOPT calls, answered by a point; numbers pass through buffers."""

    def __init__(self, kind: str, point: _Point) -> None:
        ca.Callback.__init__(self)
        self._kind, self._at = kind, point
        dense, size, M = ca.Sparsity.dense, point.size, point.constraints
        self._in = (dense(size, 1), dense(0, 0), dense(1, 1), dense(M, 1))
        self._out = {
            "nlp": (dense(1, 1), dense(M, 1)),
            "grad_f": (dense(1, 1), dense(size, 1)),
            "jac_g": (dense(M, 1), point.jacobian_sparsity),
            "hess_lag": (point.hessian_sparsity,),
        }[kind]
        self._answers: tuple[Callable[[Array], Any], ...] = {
            "nlp": (point.energy, point.angles),
            "grad_f": (point.energy, point.gradient),
            "jac_g": (point.angles, point.jacobian),
            "hess_lag": (point.hessian,),
        }[kind]
        self.construct(kind, {})

    def get_n_in(self) -> int:
        return 4 if self._kind == "hess_lag" else 2

    def get_n_out(self) -> int:
        return len(self._out)

    def get_name_in(self, i: int) -> str:
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        names = {
            "nlp": ("f", "g"), "grad_f": ("f", "grad_f_x"), "jac_g": ("g", "jac_g_x"),
            "hess_lag": ("triu_hess_gamma_x_x",),
        }  # fmt: skip
        return names[self._kind][i]

    def get_sparsity_in(self, i: int) -> Any:
        return self._in[i]

    def get_sparsity_out(self, i: int) -> Any:
        return self._out[i]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        y = np.frombuffer(arguments[0])
        factor = np.frombuffer(arguments[2])[0] if self._kind == "hess_lag" else 1.0
        for result, answer in zip(results, self._answers, strict=True):
            if result is not None and len(result):  # None is what nobody asked for
                np.frombuffer(result)[:] = factor * np.asarray(answer(y)).ravel()
        return 0
