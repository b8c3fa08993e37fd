"""A fragment's energy in joint space: value, gradient and Gauss-Newton Hessian, banded in time.

::

    E = sum over frames of E_frame + 1/2 sum rho(|a - a_imu|^2 / sigma_A^2) + 1/2 sum |jerk|^2 / sigma_J^2

Single frames come from `FrameEnergy`. The acceleration of a sensor reaches one frame to each side, so its
blocks of the Hessian lie up to two frames off the diagonal. Jerk (`jerk`) is that of the tangent
coordinates and reaches three frames, but couples each joint with itself alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from rtof_kin import energies
from rtof_kin.errors import SolverError
from rtof_kin.joint_space import frame_energy
from rtof_kin.joint_space.jerk import Jerk
from rtof_kin.joint_space.state import StateSpace

Array = NDArray[np.float64]
TERMS = (*frame_energy.TERMS, "acceleration", "smooth")
_BEYOND = 2
"""Rows below the third block's diagonal that the axes of a joint reach."""


@dataclass(frozen=True)
class FragmentData:
    """Everything observed in a fragment; weights are 0 where there is nothing."""

    observation: dict[str, Array]
    """Name -> (N, ...) as `FrameEnergy.observation` names them."""
    constant: dict[str, Array]
    """Name -> value as `FrameEnergy.constant` names them."""
    a_world: Array
    """(N - 2, S, 3) acceleration of the sensors, m/s^2."""
    w_acceleration: Array
    """(N - 2, S) 1 / sigma^2 of each, s^4/m^2."""
    w_jerk: Array
    """(N - 3,) whether four frames in a row are the recording's."""
    rate_hz: float


class JointProblem:
    """One fragment of N frames. Built once; `bind` gives it a fragment's data."""

    def __init__(
        self, space: StateSpace, functions: list[Any], energy: frame_energy.FrameEnergy, frames: int,
        sigma_jerk: Array, robust_acceleration: float,
    ) -> None:  # fmt: skip
        """Map the functions of one frame (as built, or compiled) over N.

        Args:
            sigma_jerk: (D,) of every tangent coordinate, m/s^3 and rad/s^3.
        """
        self.space, self.energy, self.frames, self.sigma_jerk = space, energy, frames, sigma_jerk
        self._jerk = Jerk(space, frames, sigma_jerk)
        full, value, gradient = (_Buffered(function.map(frames)) for function in functions)
        self._full, self._value, self._gradient = full, value, gradient
        self._temporal = _Buffered(
            _temporal(3 * len(energy.shape.sensors), space.size, frames, robust_acceleration)
        )
        self._band = np.zeros((frames, space.size, 4 * space.size + _BEYOND))

    def bind(self, data: FragmentData) -> None:
        """Take the data of the fragment that is asked about from now on."""
        self._data = data
        names, shape = self.energy.observation, (self.frames, -1)
        rows = np.concatenate([data.observation[n].reshape(shape) for n in names], axis=1)
        fixed = np.concatenate(
            [np.ravel(data.constant[n], order="F") for n in self.energy.constant]
        )
        for mapped in (self._full, self._value, self._gradient):
            mapped.inputs[1][:] = rows.ravel()
            mapped.inputs[2].reshape(self.frames, -1)[:] = fixed
        self._jerk.bind(data.w_jerk, data.rate_hz)

    def reweigh(self, name: str, weight: Array) -> None:
        """Replace the weights (N, ...) of one kind of observation."""
        first = 0
        for other, symbol in self.energy.observation.items():
            if other == name:
                break
            first += symbol.numel()
        rows = weight.reshape(self.frames, -1)
        for mapped in (self._full, self._value, self._gradient):
            inputs = mapped.inputs[1].reshape(self.frames, -1)
            inputs[:, first : first + rows.shape[1]] = rows

    def value(self, x: Array) -> tuple[dict[str, float], Array]:
        """Energy per term, and the reprojection residuals (N, L, 2), px."""
        terms, points, residuals = self._value(x.ravel())
        steps = self._steps(x)
        acceleration, smooth, *_ = self._temporal_at(points, steps)
        values = [*terms.reshape(self.frames, -1).sum(axis=0).tolist(), acceleration, smooth]
        return dict(zip(TERMS, values, strict=True)), residuals.reshape(self.frames, -1, 2).copy()

    def total(self, x: Array) -> float:
        """The energy."""
        return sum(self.value(x)[0].values())

    def gradient(self, x: Array) -> Array:
        """(N, D) of the energy in tangent coordinates at x."""
        _, points, _ = self._value(x.ravel())
        steps = self._steps(x)
        _, _, force, pull, _ = self._temporal_at(points, steps)
        self._gradient.inputs[3][:] = force.ravel()
        (g,) = self._gradient(x.ravel())
        return np.asarray(g.reshape(self.frames, -1) + self._jerk.gradient(steps, pull))

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Energy and gradient (N, D); the Hessian is kept for `solve`."""
        N, D = self.frames, self.space.size
        terms, g, H, points, J, _ = self._full(x.ravel())
        steps = self._steps(x)
        acceleration, smooth, force, pull, slope = self._temporal_at(points, steps)
        A = J.reshape(N, D, -1)
        gradient = g.reshape(N, D) + self._jerk.gradient(steps, pull)
        if A.shape[2]:
            gradient += np.matmul(A, force[:, :, None])[..., 0]
        self._assemble(H.reshape(N, D, D), A, slope)
        self._jerk.add_hessian(steps, self._band)
        return float(terms.sum()) + acceleration + smooth, gradient

    def add_to_diagonal(self, blocks: Array) -> None:
        """Add (N, D, D) to the diagonal blocks of the Hessian kept."""
        D = self.space.size
        self._band[:, :, :D] += np.swapaxes(blocks, 1, 2)

    def lower_block(self, k: int) -> Array:
        """(N - k, D, D) blocks k frames below the diagonal of the Hessian kept: [t, r, c]."""
        D = self.space.size
        block = np.swapaxes(self._band[: self.frames - k, :, k * D : (k + 1) * D], 1, 2)
        return np.tril(block) + np.swapaxes(np.tril(block, -1), 1, 2) if k == 0 else block

    def factorise(self, damping: float) -> Factor:
        """Cholesky factor of the Hessian kept, plus `damping` on its diagonal."""
        N, D = self.frames, self.space.size
        frame, column, row = self._band.strides
        # Column c of a block begins at its diagonal: row c of the block.
        shifted = np.lib.stride_tricks.as_strided(
            self._band, (N, D, 3 * D + 1 + _BEYOND), (frame, column + row, row)
        )
        band = np.ascontiguousarray(shifted).reshape(N * D, -1)
        band[:, 0] += damping
        factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info:
            raise SolverError("the fragment's Hessian is not positive definite")
        return Factor(factor, (N, D))

    # --- parts -----------------------------------------------------------------------------------

    def _steps(self, x: Array) -> Array:
        """(N - 1, 3 + 3A) m and rad."""
        return self.space.steps(x)

    def _tangent(self, steps: Array) -> Array:
        """(N - 1, D): of hinges, the turn about their axis."""
        return np.concatenate([steps[:, :3], steps[:, 3:] @ self.space.expand], axis=1)

    def _temporal_at(self, points: Array, steps: Array) -> tuple[float, float, Array, Array, Array]:
        """Energies of acceleration and jerk, derivatives by positions and steps, slopes of the loss."""
        N, data = self.frames, self._data
        out = self._temporal(
            points, self._tangent(steps).ravel(), data.a_world.ravel(), data.w_acceleration.ravel(),
            data.w_jerk, np.array([data.rate_hz]), self.sigma_jerk,
        )  # fmt: skip
        shapes = (N, N - 1, N - 2)
        force, pull, slope = (v.reshape(n, -1) for v, n in zip(out[2:], shapes, strict=True))
        return float(out[0][0]), float(out[1][0]), force, pull, slope

    def _assemble(self, H: Array, A: Array, slope: Array) -> None:
        """Fill the band: [t, c, r] holds row r, counted from frame t, of column (t, c)."""
        N, D, band = self.frames, self.space.size, self._band
        band[:, :, :D] = H
        w = np.zeros((N + 2, slope.shape[1]))
        w[2:-2] = slope * self._data.rate_hz**4
        spread = [w[2:] + 4 * w[1:-1] + w[:-2], -2 * (w[1:-2] + w[2:-1]), w[2:-2]]
        band[:, :, D:] = 0.0
        for k in range(3 if A.shape[2] else 0):
            left = A[: N - k] * np.repeat(spread[k], 3, axis=1)[:, None, :]
            band[: N - k, :, k * D : (k + 1) * D] += left @ np.swapaxes(A[k:], 1, 2)


@dataclass(frozen=True)
class Factor:
    """A factorised banded system."""

    band: Array
    shape: tuple[int, int]

    def solve(self, right: Array) -> Array:
        """(N, D) solution for a right-hand side (N, D)."""
        x, info = lapack.dpbtrs(self.band, right.ravel(), lower=1)
        if info:
            raise SolverError("the banded system could not be solved")
        return np.asarray(x.reshape(self.shape))


class _Buffered:
    """A CasADi function on buffers of its own: no conversions, no copies of what does not change."""

    def __init__(self, function: Any) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._function = function
        self.inputs = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]

    def __call__(self, *values: Array) -> list[Array]:
        """Evaluate with these as the first inputs; the outputs hold until the next call."""
        for array, value in zip(self.inputs, values, strict=False):
            array[:] = value
        self._evaluate()
        return self.outputs


def _temporal(points: int, size: int, frames: int, robust: float) -> Any:
    """(positions (3S, N), steps (D, N - 1), data) -> energies, their derivatives, slopes of the loss."""
    p, steps = ca.SX.sym("p", points, frames), ca.SX.sym("v", size, frames - 1)
    a, w = ca.SX.sym("a", points, frames - 2), ca.SX.sym("w", points // 3, frames - 2)
    w_jerk, rate, sigma = ca.SX.sym("wj", frames - 3), ca.SX.sym("f"), ca.SX.sym("s", size)
    value: Any = ca.SX(0)
    slopes = []
    for s in range(points // 3):
        rows = slice(3 * s, 3 * s + 3)
        r = energies.acceleration(p[rows, :], a[rows, :], rate)
        squared = w[s, :] * ca.sum1(r**2)
        own: Any = ca.sum2(energies.pseudo_huber(squared, robust))
        value += 0.5 * own
        slopes.append(w[s, :] * energies.pseudo_huber_weight(squared, robust))
    jerk: Any = energies.step_jerk(steps, rate) / ca.repmat(sigma, 1, frames - 3)
    squares: Any = ca.dot(ca.sum1(jerk**2).T, w_jerk)
    smooth = 0.5 * squares
    force = (
        ca.reshape(ca.gradient(value, ca.vec(p)), points, frames) if points else ca.SX(0, frames)
    )
    pull = ca.reshape(ca.gradient(smooth, ca.vec(steps)), size, frames - 1)
    slope = ca.vertcat(*slopes) if slopes else ca.SX(0, frames - 2)
    outputs = [value, smooth, force, pull, slope]
    return ca.Function(
        "temporal", [p, steps, a, w, w_jerk, rate, sigma], [ca.densify(v) for v in outputs]
    )
