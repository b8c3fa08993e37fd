"""Energy of a fragment in joint space on whole arrays, with its Gauss-Newton Hessian as a band.

::

    E = sum over frames of E_frame + 1/2 sum rho(|a - a_imu|^2 / sigma_A^2) + 1/2 sum |jerk|^2 / sigma_J^2

Single frames come from `FrameEnergy`. The acceleration of a sensor couples neighbouring frames, so its
blocks of the Hessian lie up to two frames off the diagonal. Jerk (`jerk`) is that of the tangent
coordinates; it couples frames up to three apart, but each joint with itself only.

This is the plain reference of the compiled `rtof_kin.solve.compiled.simd_problem`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Final

import casadi as ca
import numpy as np

from rtof_kin.core import quaternions as quat
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.numerics.banded import Factor, factorise
from rtof_kin.core.numerics.c_compiler import Buffered
from rtof_kin.solve import residuals as energies
from rtof_kin.solve.energy import frame_energy
from rtof_kin.solve.energy.jerk import LAGS, Jerk
from rtof_kin.solve.energy.state import StateSpace

TEMPORAL: Final = ("acceleration", "smooth")
TERMS: Final = (*frame_energy.TERMS, *TEMPORAL)
"""Built-in energy terms; further ones of a frame stand before those that couple frames."""
BEYOND: Final = 2
"""Rows below the third block's diagonal that the axes of a joint reach."""


@dataclass(frozen=True)
class FragmentData:
    """Observations of a fragment of N frames; weights are 0 where there are none."""

    observation: dict[str, Array]
    """Name -> (N, ...), with the names of `FrameEnergy.observation`."""
    constant: dict[str, Array]
    """Name -> value, with the names of `FrameEnergy.constant`."""
    a_world: Array
    """(N - 2, S, 3) acceleration of the sensors, m/s^2."""
    w_acceleration: Array
    """(N - 2, S) 1 / sigma^2 of each, s^4/m^2."""
    w_jerk: Array
    """(N - 3,) weight of the jerk of four frames in a row."""
    rate_hz: float
    length_scale: float = 1.0
    """[1] Factor on the body's size: the jerk of the root is measured in body lengths."""


class JointProblem:
    """A `FragmentEnergy` of N frames that evaluates whole arrays."""

    def __init__(
        self,
        space: StateSpace,
        functions: list[Any],
        energy: frame_energy.FrameEnergy,
        frames: int,
        sigma_jerk: Array,
        robust_acceleration: float,
    ) -> None:
        """Map the functions of one frame over N.

        Args:
            functions: those of `energy`, interpreted or compiled.
            sigma_jerk: (D,) of every tangent coordinate, m/s^3 and rad/s^3.
        """
        self.space, self.energy, self.frames, self.sigma_jerk = space, energy, frames, sigma_jerk
        self._jerk = Jerk(space, frames, sigma_jerk)
        self._full, self._value, self._gradient = (Buffered(f.map(frames)) for f in functions)
        sensors = 3 * len(energy.shape.sensors)
        self._temporal = Buffered(_temporal(sensors, space.size, frames, robust_acceleration))
        self._band = np.zeros((frames, space.size, 4 * space.size + BEYOND))
        self._now: _Evaluation | None = None

    def bind(self, data: FragmentData) -> None:
        """Set the data of the fragment to be evaluated."""
        self._data, self._now = data, None
        names, shape = self.energy.observation, (self.frames, -1)
        rows = np.concatenate([data.observation[n].reshape(shape) for n in names], axis=1)
        fixed = np.concatenate([np.ravel(data.constant[n], order="F") for n in self.energy.constant])
        for mapped in (self._full, self._value, self._gradient):
            mapped.inputs[1][:] = rows.ravel()
            mapped.inputs[2].reshape(self.frames, -1)[:] = fixed
        self._jerk.bind(data.w_jerk, data.rate_hz, data.length_scale)

    def reweigh(self, name: str, weight: Array) -> None:
        """Replace the weights (N, ...) of one kind of observation."""
        self._now = None
        for mapped in (self._full, self._value, self._gradient):
            inputs = mapped.inputs[1].reshape(self.frames, -1)
            inputs[:, self.energy.rows[name]] = weight.reshape(self.frames, -1)

    def retract(self, x: Array, step: Array) -> Array:
        """Return the state after a step (N, D)."""
        return self.space.retract(x, step)

    def value(self, x: Array) -> tuple[dict[str, float], Array]:
        """Return the energy per term and the reprojection residuals (N, L, 2), px."""
        now = self._at(x)
        names = (*self.energy.terms, *TEMPORAL)
        return dict(zip(names, now.terms, strict=True)), now.residuals.reshape(self.frames, -1, 2).copy()

    def total(self, x: Array) -> float:
        """Return the energy."""
        return sum(self._at(x).terms)

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N, D) in tangent coordinates."""
        now, N = self._at(x), self.frames
        self._gradient.inputs[3][:] = now.force.ravel()
        (g,) = self._gradient(x.ravel())
        return np.asarray(g.reshape(N, -1) + self._jerk.gradient(now.inverse, now.pull))

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient (N, D); keep the Hessian."""
        now, N, D = self._at(x), self.frames, self.space.size
        _, g, H, _, J, _ = self._full(x.ravel())
        A = J.reshape(N, D, -1)
        gradient = g.reshape(N, D) + self._jerk.gradient(now.inverse, now.pull)
        if A.shape[2]:
            gradient += np.matmul(A, now.force[:, :, None])[..., 0]
        self._assemble(H.reshape(N, D, D), A, now.slope)
        self._jerk.add_hessian(now.inverse, self._band)
        return sum(now.terms), gradient

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the diagonal blocks of the Hessian."""
        np.add.at(self._band, (frames, columns, rows), values)

    def add_to_first(self, matrix: Array) -> None:
        """Add a symmetric matrix (k D, k D), k <= 3, to the blocks of the Hessian of the first k frames."""
        D = self.space.size
        for t in range(len(matrix) // D):
            below = matrix[t * D :, t * D : (t + 1) * D]
            self._band[t, :, : len(below)] += below.T

    def lower_block(self, k: int) -> Array:
        """Return the Hessian's blocks (N - k, D, D) k frames below the diagonal: [t, r, c]."""
        D = self.space.size
        block = np.swapaxes(self._band[: self.frames - k, :, k * D : (k + 1) * D], 1, 2)
        return np.tril(block) + np.swapaxes(np.tril(block, -1), 1, 2) if k == 0 else block

    def hessian(self) -> Array:
        """Return the whole Hessian (N D, N D), for a few frames."""
        N, D = self.frames, self.space.size
        lower = np.zeros((N, D, N, D))
        for k in range(min(LAGS, N)):
            t = np.arange(N - k)
            lower[t + k, :, t] = self.lower_block(k)
        square = np.tril(lower.reshape(N * D, N * D))
        return np.asarray(square + np.tril(square, -1).T)

    def factorise(self, damping: float) -> Factor:
        """Return the Cholesky factor of the Hessian plus `damping` on its diagonal."""
        N, D = self.frames, self.space.size
        frame, column, row = self._band.strides
        # Column c of a block begins at its diagonal: row c of the block.
        shifted = np.lib.stride_tricks.as_strided(self._band, (N, D, 3 * D + 1 + BEYOND), (frame, column + row, row))
        band = np.ascontiguousarray(shifted).reshape(N * D, -1)
        band[:, 0] += damping
        return factorise(band)

    def _at(self, x: Array) -> _Evaluation:
        """The energy at x, kept until another state or other data are given."""
        if self._now is not None and self._now.x is x:
            return self._now
        N, data, steps = self.frames, self._data, self.space.steps(x)
        tangent = np.concatenate([steps[:, :3], steps[:, 3:] @ self.space.expand], axis=1)
        terms, points, residuals = self._value(x.ravel())
        out = self._temporal(
            points,
            tangent.ravel(),
            data.a_world.ravel(),
            data.w_acceleration.ravel(),
            data.w_jerk,
            np.array([data.rate_hz]),
            self._jerk.sigma,
        )
        shapes = (N, N - 1, N - 2)
        force, pull, slope = (v.reshape(n, -1) for v, n in zip(out[2:], shapes, strict=True))
        values = [*terms.reshape(N, -1).sum(axis=0).tolist(), float(out[0][0]), float(out[1][0])]
        self._now = _Evaluation(x, values, residuals, steps, force, pull, slope)
        return self._now

    def _assemble(self, H: Array, A: Array, slope: Array) -> None:
        """Fill the band: [t, c, r] holds row r, counted from frame t, of column (t, c)."""
        N, D, band = self.frames, self.space.size, self._band
        w = np.zeros((N + 2, slope.shape[1]))
        w[2:-2] = slope * self._data.rate_hz**4
        spread = [w[2:] + 4 * w[1:-1] + w[:-2], -2 * (w[1:-2] + w[2:-1]), w[2:-2]]
        right = np.ascontiguousarray(np.swapaxes(A, 1, 2))
        for k in range(3):
            left = A[: N - k] * np.repeat(spread[k], 3, axis=1)[:, None, :]
            np.matmul(left, right[k:], out=band[: N - k, :, k * D : (k + 1) * D])
        band[:, :, :D] += H


@dataclass
class _Evaluation:
    """Quantities at one state; views of buffers that the next evaluation overwrites."""

    x: Array
    terms: list[float]
    """Energies of the terms of a frame, then of `TEMPORAL`."""
    residuals: Array
    """(2 L N,) of reprojection, px."""
    steps: Array
    """(N - 1, 3 + 3A) m and rad."""
    force: Array
    """(N, 3S) derivative of the acceleration's energy by the sensors' positions."""
    pull: Array
    """(N - 1, D) derivative of the jerk's energy by the steps."""
    slope: Array
    """(N - 2, S) weights of the accelerations in the Hessian."""

    @cached_property
    def inverse(self) -> Array:
        """(N - 1, A, 3, 3) inverse right Jacobians of the steps' rotation vectors."""
        turns = self.steps[:, 3:].reshape(len(self.steps), -1, 3)
        return quat.right_jacobian_inverse(turns)


@cache
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
    force = ca.reshape(ca.gradient(value, ca.vec(p)), points, frames) if points else ca.SX(0, frames)
    pull = ca.reshape(ca.gradient(smooth, ca.vec(steps)), size, frames - 1)
    slope = ca.vertcat(*slopes) if slopes else ca.SX(0, frames - 2)
    outputs = [value, smooth, force, pull, slope]
    return ca.Function("temporal", [p, steps, a, w, w_jerk, rate, sigma], [ca.densify(v) for v in outputs])
