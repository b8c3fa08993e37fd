"""The peers: PyTorch's L-BFGS, SciPy's least squares, Ceres."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
import pyceres
import torch
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from benchmarks.peers.cartesian import CartesianScene
from benchmarks.peers.fragments import Answer, Fragment, Trace
from benchmarks.peers.joint_space import JointScene
from benchmarks.peers.residuals import Residuals, rows_of
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.c_compiler import Buffered

Scene = CartesianScene | JointScene
Notify = Callable[[Array], None]
"""Called with the variables (N, F), in any shape, at every iteration."""


class Peer(ABC):
    """Minimises the energy of a scene's fragments."""

    scene: Scene

    @abstractmethod
    def _minimised(self, fragment: Fragment, notify: Notify | None) -> tuple[Array, int, bool]:
        """Variables in any shape, iterations, and whether the solver reports convergence."""

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; what a trace costs beside is not in its seconds."""
        began, points = perf_counter(), Trace()

        def notify(z: Array) -> None:
            points.append((perf_counter() - began, np.array(z)))

        z, iterations, converged = self._minimised(fragment, None if trace is None else notify)
        seconds = perf_counter() - began
        if trace is not None:
            trace += [(at, self._state(fragment, then)) for at, then in points]
        return Answer(self._state(fragment, z), seconds, iterations, converged)

    def _state(self, fragment: Fragment, z: Array) -> Array:
        return self.scene.state(fragment, z.reshape(self.scene.frames, -1))


class Lbfgs(Peer):
    """PyTorch's L-BFGS with autograd and a strong Wolfe line search, as the paper has it."""

    def __init__(self, scene: Scene, steps: int, history: int = 100) -> None:
        """Stop after some `steps`, or where nothing changes any more."""
        self.scene, self.steps, self.history = scene, steps, history

    def _minimised(self, fragment: Fragment, notify: Notify | None) -> tuple[Array, int, bool]:
        """Tells of every point evaluated."""
        energy = self.scene.torch_energy(fragment)
        z = torch.from_numpy(self.scene.variables(fragment)).requires_grad_()
        optimiser = torch.optim.LBFGS(
            [z],
            max_iter=self.steps,
            max_eval=4 * self.steps,
            tolerance_grad=1e-9,
            tolerance_change=1e-14,
            history_size=self.history,
            line_search_fn="strong_wolfe",
        )

        def closure() -> float:
            optimiser.zero_grad()
            value = energy(z)
            torch.autograd.backward(value)
            if notify is not None:
                notify(z.detach().numpy())
            return float(value.detach())

        optimiser.step(closure)  # type: ignore[no-untyped-call]
        iterations, evaluations = (int(optimiser.state[z][n]) for n in ("n_iter", "func_evals"))
        by_itself = iterations < self.steps and evaluations < 4 * self.steps
        return z.detach().numpy(), iterations, by_itself


class ScipyLeastSquares(Peer):
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

    def _minimised(self, fragment: Fragment, notify: Notify | None) -> tuple[Array, int, bool]:
        """Tells of every iteration."""
        z0 = self.scene.variables(fragment)
        for r, *functions in zip(self._residuals, self._value, self._jacobian, strict=True):
            for function in functions:
                function.inputs[1][:] = r.values(fragment).ravel()

        def kept(intermediate_result: Any) -> None:
            if notify is not None:
                notify(intermediate_result.x)

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
            method="trf",
            tr_solver="lsmr",
            x_scale="jac",
            max_nfev=self.evaluations,
            ftol=1e-10,
            xtol=1e-12,
            gtol=1e-10,
            callback=kept,
        )
        return np.asarray(result.x), int(result.nfev), result.status > 0

    def _evaluated(self, functions: list[Buffered], z: Array, output: int) -> Array:
        parts = [
            function(rows_of(z, r.width).ravel())[output]
            for r, function in zip(self._residuals, functions, strict=True)
        ]
        return np.concatenate(parts)


class Ceres(Peer):
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

    def _minimised(self, fragment: Fragment, notify: Notify | None) -> tuple[Array, int, bool]:
        """Tells of every iteration."""
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
        if notify is not None:
            options.update_state_every_iteration = True
            options.callbacks = [_Kept(lambda: notify(np.array(self._z)))]
        pyceres.solve(options, self._problem, summary)
        seconds = perf_counter() - began
        inside = summary.residual_evaluation_time_in_seconds
        inside += summary.jacobian_evaluation_time_in_seconds
        self.shares.append(inside / seconds)
        iterations = summary.num_successful_steps + summary.num_unsuccessful_steps
        converged = summary.termination_type == pyceres.TerminationType.CONVERGENCE
        return np.array(self._z), int(iterations), bool(converged)


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

    def Evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None) -> bool:
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

    def __init__(self, notify: Callable[[], None]) -> None:
        super().__init__()
        self._notify = notify

    def __call__(self, summary: Any) -> Any:
        self._notify()
        return pyceres.CallbackReturnType.SOLVER_CONTINUE
