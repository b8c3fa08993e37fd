"""IPOPT on the joint-space energy, with limits as inequalities.

IPOPT's variables are the step d (N D) from the initial state, in millimetres and milliradians, so the energy at d is
that of the state retracted by d. Derivatives at the state are multiplied by the Jacobian T
of the retraction: g = T^T g_local, H = T^T H_local T (Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import casadi as ca
import numpy as np

from rtof_kin.core import quaternions as quat
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.numerics.c_compiler import BUILDING
from rtof_kin.core.numerics.levenberg_marquardt import Solved
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.joint_space.layout import LAGS
from rtof_kin.solve.joint_space.state import Limits

_UNIT: Final = 1e-3  #: m and rad of IPOPT's variables
_GRADIENT: Final = 100.0  #: Largest remaining derivative of the energy by a variable, in tolerances
_METIS: Final = 5  #: MUMPS' number of the ordering with the least fill-in for this band


class Ipopt:
    """Solves one problem for any data bound to it."""

    def __init__(self, problem: FragmentEnergy, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        names = ("nlp", "grad_f", "jac_g", "hess_lag")
        with BUILDING:
            self._point = _Point(problem, limits)
            self._functions = {name: _Oracle(name, self._point) for name in names}
        self._solvers: dict[tuple[int, float], Any] = {}

    def solve(self, x: Array, max_iterations: int, tolerance: float) -> Solved:
        """Minimise from a state; `x`: (N, 3 + 4A) initial state; `tolerance`: a hundredth of the largest remaining
        derivative of the Lagrangian, by a millimetre or milliradian.
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
            state,
            int(stats["iter_count"]),
            ended == "Solve_Succeeded",
            multipliers,
            out_of_iterations=ended == "Maximum_Iterations_Exceeded",
        )

    def _solver(self, max_iterations: int, tolerance: float) -> Any:
        key = (max_iterations, tolerance)
        if key not in self._solvers:
            functions = dict(self._functions)
            nlp = functions.pop("nlp")
            options: dict[str, Any] = {
                **functions,
                "print_time": False,
                "error_on_fail": False,
                "show_eval_warnings": False,
                "calc_lam_p": False,
                "calc_lam_x": False,
                "no_nlp_grad": True,
                "ipopt": {
                    "print_level": 0,
                    "sb": "yes",
                    "linear_solver": "mumps",
                    "tol": _GRADIENT * tolerance,
                    "max_iter": max_iterations,
                    "nlp_scaling_method": "none",
                    "mu_init": 1e-5,
                    "mumps_scaling": 0,
                    "mumps_permuting_scaling": 0,
                    "mumps_pivot_order": _METIS,
                },
            }
            with BUILDING:
                self._solvers[key] = ca.nlpsol("joint_fragment", "ipopt", nlp, options)
        return self._solvers[key]


class _Point:
    """Energy, limits and their derivatives by IPOPT's variables y (N D)."""

    def __init__(self, problem: FragmentEnergy, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits
        N, D = problem.frames, problem.space.size
        columns = np.zeros(0, int) if limits is None else limits.columns
        self.size, self.constraints = N * D, N * len(columns)
        at = (np.arange(N)[:, None] * D + columns).ravel().tolist()
        self.jacobian_sparsity = ca.Sparsity.triplet(self.constraints, N * D, list(range(len(at))), at)
        self._mask = self._hessian_mask()
        t, c, r = np.nonzero(self._mask)
        rows = (t - LAGS + 1) * D + r
        self.hessian_sparsity = ca.Sparsity.triplet(N * D, N * D, rows.tolist(), (t * D + c).tolist())

    def begin(self, x: Array) -> None:
        """Set the state that steps are from."""
        self.start = x
        self._last = np.zeros(self.size), x

    def state(self, y: Array) -> Array:
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

    def jacobian(self, _: Array) -> Array:
        """Nonzeros of the limits' Jacobian: a hinge's angle is a variable."""
        return np.full(self.constraints, _UNIT)

    def hessian(self, y: Array) -> Array:
        """Nonzeros of the upper triangle, column by column."""
        problem, T = self.problem, self._tangent(y)
        N, D = problem.frames, problem.space.size
        problem.linearise(self.state(y))
        H, frames = problem.hessian().reshape(N, D, N, D), np.arange(N)
        columns = np.zeros((N, D, LAGS, D))
        for k in range(LAGS):  # block (t, t + k) of the upper triangle
            block = H[frames[k:], :, frames[: N - k]]  # [t, r, c] = H[(t + k, r), (t, c)]
            columns[k:, :, LAGS - 1 - k] = np.swapaxes(T[k:], 1, 2) @ block @ T[: N - k]
        return columns.reshape(N, D, LAGS * D)[self._mask]

    def _hessian_mask(self) -> Mask:
        """(N, D, 4D): nonzero rows, of this frame and the three before, of each column."""
        N, D = self.problem.frames, self.problem.space.size
        mask = np.ones((N, D, LAGS, D), dtype=bool)
        kept = self.problem.space.expand.reshape(-1, 3, D - 3).any(axis=1)  # joint of each tangent
        same = np.eye(D, dtype=bool)
        same[3:, 3:] |= kept.T.astype(float) @ kept.astype(float) > 0
        mask[:, :, 0] = same
        mask[:, :, LAGS - 1] = np.tril(np.ones((D, D), dtype=bool))
        for k in range(1, LAGS):
            mask[:k, :, LAGS - 1 - k] = False
        return mask.reshape(N, D, LAGS * D)


class _Oracle(ca.Callback):
    """A function that IPOPT calls, evaluated by a `_Point`; numbers pass through buffers."""

    def __init__(self, kind: str, point: _Point) -> None:
        ca.Callback.__init__(self)
        self._kind = kind
        dense, size, M = ca.Sparsity.dense, point.size, point.constraints
        self._in = (dense(size, 1), dense(0, 0), dense(1, 1), dense(M, 1))
        answer = Callable[[Array], Any]
        outputs: dict[str, tuple[tuple[str, Any, answer], ...]] = {
            "nlp": (("f", dense(1, 1), point.energy), ("g", dense(M, 1), point.angles)),
            "grad_f": (("f", dense(1, 1), point.energy), ("grad_f_x", dense(size, 1), point.gradient)),
            "jac_g": (("g", dense(M, 1), point.angles), ("jac_g_x", point.jacobian_sparsity, point.jacobian)),
            "hess_lag": (("triu_hess_gamma_x_x", point.hessian_sparsity, point.hessian),),
        }
        self._outputs = outputs[kind]
        self.construct(kind, {})

    def get_n_in(self) -> int:
        return 4 if self._kind == "hess_lag" else 2

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> Any:
        return self._in[i]

    def get_sparsity_out(self, i: int) -> Any:
        return self._outputs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        y = np.frombuffer(arguments[0])
        factor = np.frombuffer(arguments[2])[0] if self._kind == "hess_lag" else 1.0
        for result, (_, _, answer) in zip(results, self._outputs, strict=True):
            if result is not None and len(result):  # None where IPOPT does not need it
                np.frombuffer(result)[:] = factor * np.asarray(answer(y)).ravel()
        return 0
