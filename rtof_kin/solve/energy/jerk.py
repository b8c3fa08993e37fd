"""Jerk of the tangent coordinates: gradient and Gauss-Newton Hessian by the states.

With v_t the step from frame t to t + 1, the energy is that of the second differences of v. A step changes by L_t with
the tangent of the later frame and by -L_t^T with that of the earlier one, where L_t is the inverse right Jacobian of
its rotation vector. Approximating L by 1 in the Hessian slows convergence of slow motions of the whole fragment.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.solve.energy.state import StateSpace

LAGS: Final = 4
"""Frames from 0 to 3 apart are coupled."""


class Jerk:
    """Derivatives of the jerk of N frames.

    Attributes:
        sigma: (D,) of every tangent coordinate, m/s^3 and rad/s^3, equal for the axes of a joint; those
            of the root's displacement are multiplied by the bound length scale.
    """

    def __init__(self, space: StateSpace, frames: int, sigma: Array) -> None:
        self.space, self.frames, self.sigma, self._sigma = space, frames, sigma, sigma
        ball = space.hinge_axis < 0
        self._balls = np.flatnonzero(ball)
        self._columns = space.first[self._balls][:, None] + np.arange(3)
        self._straight = np.setdiff1d(np.arange(space.size), self._columns)
        self._bound: tuple[Array, float] | None = None
        self._precision = 1 / sigma[self._columns[:, 0]] ** 2

    def bind(self, w_jerk: Array, rate_hz: float, length_scale: float = 1.0) -> None:
        """Set the fragment to be evaluated.

        Args:
            w_jerk: (N - 3,) weights. rate_hz: frames per second.
        """
        N = self.frames
        if length_scale != 1 or self.sigma is not self._sigma:
            self.sigma = self._sigma * np.where(np.arange(len(self._sigma)) < 3, length_scale, 1.0)
        if self._bound is not None and self._bound[1] == rate_hz and (self._bound[0] == w_jerk).all():
            return
        self._bound = w_jerk.copy(), rate_hz
        second = np.sqrt(w_jerk)[:, None] * np.diff(np.eye(N - 1), n=2, axis=0) * rate_hz**3
        # S of the steps, padded with rows and columns of zeros.
        S = np.zeros((N + 4, N + 4))
        S[1:N, 1:N] = second.T @ second
        t = np.arange(N)
        self._later = [S[t + m + 1, t] for m in range(-1, LAGS - 1)]
        self._earlier = [S[t + m + 1, t + 1] for m in range(-1, LAGS - 1)]
        third = np.sqrt(w_jerk)[:, None] * np.diff(np.eye(N), n=3, axis=0) * rate_hz**3
        square = third.T @ third
        self._plain = [np.diag(square, -k)[:, None] for k in range(LAGS)]

    def coefficients(self) -> Array:
        """Return (N, 12) coefficients of the blocks 0 to 3 frames later: of a frame's derivative of the step
        before it, of the step after it, and of both for steps about one axis; 0 beyond the end.
        """
        out = np.zeros((self.frames, 3 * LAGS))
        parts = [*self._later, *self._earlier, *(plain[:, 0] for plain in self._plain)]
        for k, part in enumerate(parts):
            out[: len(part), k] = part
        return out

    def gradient(self, inverse: Array, pull: Array) -> Array:
        """Return the gradient (N, D).

        Args:
            inverse: (N - 1, A, 3, 3) inverse right Jacobians of the steps.
            pull: (N - 1, D) derivative of the energy by the steps.
        """
        g = np.zeros((self.frames, self.space.size))
        g[1:, :3] += pull[:, :3]
        g[:-1, :3] -= pull[:, :3]
        torque = (pull[:, 3:] @ self.space.expand.T).reshape(inverse.shape[:-1])
        later = np.einsum("taij,tai->taj", inverse, torque).reshape(len(pull), -1)
        earlier = np.einsum("taij,taj->tai", inverse, torque).reshape(len(pull), -1)
        g[1:, 3:] += later @ self.space.expand
        g[:-1, 3:] -= earlier @ self.space.expand
        return g

    def add_hessian(self, inverse: Array, band: Array) -> None:
        """Add the Hessian to a band; blocks three frames apart are set, as nothing else is there.

        Args:
            inverse: (N - 1, A, 3, 3) inverse right Jacobians of the steps; 1 for displacements and hinges.
            band: (N, D, >= 4D), where [t, c, k D + r] is row r of frame t + k, column c of t.
        """
        N, D, s = self.frames, self.space.size, self._straight
        L = inverse[:, self._balls]
        later, earlier = np.zeros((2, N, len(self._balls), 3, 3))
        later[1:], earlier[:-1] = L, np.swapaxes(L, -1, -2)
        scaled = self._precision[:, None, None] * np.stack([later, earlier])
        SJ = [
            a[:, None, None, None] * scaled[0] - b[:, None, None, None] * scaled[1]
            for a, b in zip(self._later, self._earlier, strict=True)
        ]
        rows, columns = self._columns[:, None, :], self._columns[:, :, None]
        later_T, earlier_T = np.swapaxes(later, -1, -2), np.swapaxes(earlier, -1, -2)
        band[: N - LAGS + 1, :, (LAGS - 1) * D : LAGS * D] = 0.0
        for k in range(LAGS):
            block = later_T[k:] @ SJ[k][: N - k]
            if k + 1 < LAGS:
                block -= earlier_T[k:] @ SJ[k + 1][: N - k]
            band[: N - k, columns, k * D + rows] += np.swapaxes(block, -1, -2)
            band[: N - k, s, k * D + s] += self._plain[k] / self.sigma[s] ** 2
