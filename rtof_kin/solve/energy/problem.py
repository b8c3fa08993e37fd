"""A fragment's energy in joint space: value, gradient and Gauss-Newton Hessian, banded in time.

::

    E = sum over frames of E_frame + 1/2 sum rho(|a - a_imu|^2 / sigma_A^2) + 1/2 sum |jerk|^2 / sigma_J^2

Single frames come from `FrameEnergy`. The acceleration of a sensor reaches one frame to each side, so its
blocks of the Hessian lie up to two frames off the diagonal. Jerk (`jerk`) is that of the tangent
coordinates and reaches three frames, but couples each joint with itself alone.

Unknowns of the whole fragment (`frame_energy.UNKNOWNS`) stay what `bind` or `set_unknowns` says; what a
solver that moves them needs beside (`bordered`) is in `gradients` and `border`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import ShapeError
from rtof_kin.core.numerics.banded import Factor, factorise
from rtof_kin.core.numerics.c_compiler import Buffered
from rtof_kin.solve import residuals as energies
from rtof_kin.solve.energy import frame_energy
from rtof_kin.solve.energy.jerk import Jerk
from rtof_kin.solve.energy.state import StateSpace

Array = NDArray[np.float64]
Index = NDArray[np.intp]
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
    length_scale: float = 1.0
    """[1] By how much longer than it is held to be the body is taken to be: the jerk of its root is
    judged in body lengths."""


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
        full, value, gradient = (Buffered(function.map(frames)) for function in functions)
        self._full, self._value, self._gradient = full, value, gradient
        self._temporal = Buffered(
            _temporal(3 * len(energy.shape.sensors), space.size, frames, robust_acceleration)
        )
        self._band = np.zeros((frames, space.size, 4 * space.size + _BEYOND))
        self._heading = energy.shape.columns.get("heading")
        self._y = np.zeros(energy.shape.unknown_count)
        self._border = (np.zeros(0), np.zeros((0, 0, 0)), np.zeros((0, 0)))
        self._now: _Evaluation | None = None

    def bind(self, data: FragmentData) -> None:
        """Take the data of the fragment that is asked about from now on."""
        self._data, self._now = data, None
        names, shape = self.energy.observation, (self.frames, -1)
        rows = np.concatenate([data.observation[n].reshape(shape) for n in names], axis=1)
        fixed = np.concatenate([np.ravel(data.constant[n], order="F") for n in self.energy.constant])
        for mapped in (self._full, self._value, self._gradient):
            mapped.inputs[1][:] = rows.ravel()
            mapped.inputs[2].reshape(self.frames, -1)[:] = fixed
        self._jerk.bind(data.w_jerk, data.rate_hz, data.length_scale)
        self._y = np.array(data.constant["unknowns"], float) if len(self._y) else self._y

    def reweigh(self, name: str, weight: Array) -> None:
        """Replace the weights (N, ...) of one kind of observation."""
        self._now = None
        for mapped in (self._full, self._value, self._gradient):
            inputs = mapped.inputs[1].reshape(self.frames, -1)
            inputs[:, self.energy.rows[name]] = weight.reshape(self.frames, -1)

    def set_unknowns(self, y: Array) -> None:
        """Replace the value (G,) of the unknowns.

        Raises:
            ShapeError: there is another number of them.
        """
        if y.shape != self._y.shape:
            raise ShapeError(f"unknowns {y.shape}: give all {len(self._y)}")
        if np.array_equal(y, self._y):
            return
        self._now, self._y = None, np.array(y, float)
        for mapped in (self._full, self._value, self._gradient):
            mapped.inputs[2].reshape(self.frames, -1)[:, -len(y) :] = y

    def retract(self, x: Array, step: Array) -> Array:
        """The state after a step (N, D)."""
        return self.space.retract(x, step)

    def value(self, x: Array) -> tuple[dict[str, float], Array]:
        """Energy per term, and the reprojection residuals (N, L, 2), px."""
        now = self._at(x)
        return dict(zip(TERMS, now.terms, strict=True)), now.residuals.reshape(self.frames, -1, 2).copy()

    def total(self, x: Array) -> float:
        """The energy."""
        return sum(self._at(x).terms)

    def gradient(self, x: Array) -> Array:
        """(N, D) of the energy in tangent coordinates at x."""
        return self.gradients(x)[0]

    def gradients(self, x: Array) -> tuple[Array, Array]:
        """The same, and the gradient (G,) by the unknowns."""
        now, N = self._at(x), self.frames
        self._gradient.inputs[3][:] = now.force.ravel()
        g, *more = self._gradient(x.ravel())
        gradient = np.asarray(g.reshape(N, -1) + self._jerk.gradient(now.inverse, now.pull))
        if not more:
            return gradient, np.zeros(0)
        by_y = more[0].reshape(N, -1).sum(axis=0)
        if (part := self._heading) is not None:
            pulled = np.repeat(now.slope, 3, axis=1) * self._off(now)
            turned = _z_cross(self._a_world).reshape(pulled.shape)
            by_y[part] -= np.sum(turned * pulled, axis=0).reshape(-1, 3).sum(axis=1)
        return gradient, by_y

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Energy and gradient (N, D); the Hessian is kept for `factorise`."""
        now, N, D = self._at(x), self.frames, self.space.size
        _, g, H, _, J, _, *border = self._full(x.ravel())
        A = J.reshape(N, D, -1)
        gradient = g.reshape(N, D) + self._jerk.gradient(now.inverse, now.pull)
        if A.shape[2]:
            gradient += np.matmul(A, now.force[:, :, None])[..., 0]
        self._assemble(H.reshape(N, D, D), A, now.slope)
        self._jerk.add_hessian(now.inverse, self._band)
        if border:
            self._border = self._bordered(now, A, border)
        return sum(now.terms), gradient

    def border(self) -> tuple[Array, Array, Array]:
        """What borders the Hessian kept: the gradient (G,) by the unknowns, the Hessian's columns
        (N, D, G) of the unknowns, and its corner (G, G).
        """
        return self._border

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the diagonal blocks of the Hessian kept."""
        np.add.at(self._band, (frames, columns, rows), values)

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
        return factorise(band)

    # --- parts -----------------------------------------------------------------------------------

    def _steps(self, x: Array) -> Array:
        """(N - 1, 3 + 3A) m and rad."""
        return self.space.steps(x)

    def _tangent(self, steps: Array) -> Array:
        """(N - 1, D): of hinges, the turn about their axis."""
        return np.concatenate([steps[:, :3], steps[:, 3:] @ self.space.expand], axis=1)

    def _at(self, x: Array) -> _Evaluation:
        """The energy at x: kept until another state or other data are asked about."""
        if self._now is not None and self._now.x is x:
            return self._now
        N, data, steps = self.frames, self._data, self._steps(x)
        terms, points, residuals = self._value(x.ravel())
        out = self._temporal(
            points, self._tangent(steps).ravel(), self._a_world.ravel(), data.w_acceleration.ravel(),
            data.w_jerk, np.array([data.rate_hz]), self._jerk.sigma,
        )  # fmt: skip
        shapes = (N, N - 1, N - 2)
        force, pull, slope = (v.reshape(n, -1) for v, n in zip(out[2:], shapes, strict=True))
        values = [*terms.reshape(N, -1).sum(axis=0).tolist(), float(out[0][0]), float(out[1][0])]
        self._now = _Evaluation(x, values, points, residuals, steps, force, pull, slope)
        return self._now

    @property
    def _a_world(self) -> Array:
        """(N - 2, S, 3) as measured, turned by the sensors' headings."""
        part, a = self._heading, self._data.a_world
        return a if part is None else (so3.about_axis("z", self._y[part]) @ a[..., None])[..., 0]

    def _off(self, now: _Evaluation) -> Array:
        """(N - 2, 3S) acceleration minus the measured one, m/s^2."""
        p = now.points.reshape(self.frames, -1)
        return np.asarray(
            np.diff(p, n=2, axis=0) * self._data.rate_hz**2 - self._a_world.reshape(len(p) - 2, -1)
        )

    def _bordered(self, now: _Evaluation, A: Array, parts: list[Array]) -> tuple[Array, Array, Array]:
        """The sum over frames, and the accelerations: with Y their derivative by y, A^T W Y and so on."""
        N, D, G, square = self.frames, self.space.size, len(self._y), self._data.rate_hz**2
        g, C, H = parts[0].reshape(N, G), parts[1].reshape(N, G, D), parts[2].reshape(N, G, G)
        by_y, rows, corner = g.sum(axis=0), np.swapaxes(C, 1, 2).copy(), H.sum(axis=0)
        if not A.shape[2]:
            return by_y, rows, corner
        Y = np.swapaxes(np.diff(parts[3].reshape(N, G, -1), n=2, axis=0), 1, 2) * square
        if (part := self._heading) is not None:
            turned = _z_cross(self._a_world)
            for s in range(turned.shape[1]):
                Y[:, 3 * s : 3 * s + 3, part.start + s] -= turned[:, s]
        w = np.repeat(now.slope, 3, axis=1)
        weighted = (w[:, :, None] * Y).reshape(-1, G)
        by_y += weighted.T @ self._off(now).ravel()
        corner += weighted.T @ Y.reshape(-1, G)
        pushed = square * weighted.reshape(Y.shape)
        spread = np.zeros((N, *Y.shape[1:]))
        for k, factor in enumerate((1.0, -2.0, 1.0)):
            spread[k : N - 2 + k] += factor * pushed
        return by_y, rows + A @ spread, corner

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
    """What is known about one state; views of buffers that the next evaluation overwrites."""

    x: Array
    terms: list[float]
    """Energies as in `TERMS`."""
    points: Array
    """(3 S N,) positions of the sensors, m."""
    residuals: Array
    """(2 L N,) of reprojection, px."""
    steps: Array
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


def _z_cross(a: Array) -> Array:
    """Derivative of vectors (..., 3) by a turn about world's z."""
    return np.stack([-a[..., 1], a[..., 0], np.zeros_like(a[..., 0])], axis=-1)


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
