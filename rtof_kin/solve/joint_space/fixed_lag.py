"""Fixed-lag smoother: the joint-space energy of the last N frames, with a prior of the frames before them.

Frames are appended one by one. The frame that leaves the window is marginalised (`marginalised`); a few
Levenberg-Marquardt iterations from the states of the last call follow. Observations of frames within the
window may change until they leave it. The residuals are those of `FragmentSolver`, and so are the weights,
but for accelerations of the last 0.2 s. In `finish` these count too: with a window as long as the recording
the result is that of one fragment.

Of a long window only the newest frames are solved. Those before them keep the linearisation with which they were
eliminated, and follow what is learned later by back substitution (a smoother of Rauch, Tung and Striebel).

The prior of the frames before the solved ones is a `fragment.MarginalPrior`: all terms that contain the leaving frame
are linearised at the present states, robust weights included, and the frame is eliminated by the Schur complement.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import lapack

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import Factor
from rtof_kin.core.numerics.levenberg_marquardt import STIFFNESS, LevenbergMarquardt
from rtof_kin.solve.joint_space.annealing import CameraErrors
from rtof_kin.solve.joint_space.fragment import MEMORY, FragmentData, FragmentEnergy, MarginalPrior, symmetric
from rtof_kin.solve.joint_space.layout import LAGS
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import Limits


@dataclass(frozen=True)
class Eliminated:
    """A frame that has left, d = b + A d' by the tangents d' (3D,) of the three frames after it."""

    x: Array  #: (3 + 4A,) linearisation point
    after: Array  #: (3, 3 + 4A) those of the three frames
    factor: Array  #: (D, D) Cholesky factor of its Hessian
    A: Array  #: (D, 3D)
    b: Array  #: (D,)

    @classmethod
    def of(cls, x: Array, factor: Array, half: Array) -> Eliminated:
        """Return the first of four frames at states x (4, 3 + 4A), of what `marginalised` returns."""
        back = -lapack.dtrtrs(factor, half, lower=1, trans=1)[0]
        return cls(x[0].copy(), x[1:].copy(), np.tril(factor), back[:, :-1], back[:, -1].copy())

    def columns(self, width: int) -> Array:
        """Return its columns (width, D) of the band of the window's factor."""
        D = len(self.b)
        below = [-self.A[:, k : k + D].T @ self.factor for k in range(0, MEMORY * D, D)]
        rows = np.concatenate([self.factor, *below, np.zeros((width, D))])
        step, word = rows.strides
        return np.lib.stride_tricks.as_strided(rows, (width, D), (step, step + word))


def marginalised(
    prior: MarginalPrior, slope: Array, leaving: FragmentEnergy, limits: Limits | None, x: Array, multipliers: Array
) -> tuple[MarginalPrior, Array, Array]:
    """Return the prior of frames 1 to 3 after frame 0 has left; the Cholesky factor (D, D) of the Hessian of frame 0,
    and its inverse times (D, 3D + 1) the coupling with those frames and the gradient. `SolverError`: the frame's
    Hessian is not positive definite.

    Args:
        prior: of frames 0 to 2. slope: (3, D) its gradient at x.
        leaving: energy of frames 0 to 3 with the terms that contain frame 0 bound.
        x: (4, 3 + 4A) present states. multipliers: (4, M) of the limits.
    """
    space = leaving.space
    D, kept = space.size, MEMORY * space.size
    gradient = leaving.linearise(x)[1].ravel()
    H = leaving.lower_hessian()
    H[:kept, :kept] += prior.precision
    gradient[:kept] += slope.ravel()
    if limits is not None:
        excess = limits.excess(limits.values(x[:1]) + multipliers[:1] / STIFFNESS)
        gradient[:D] += STIFFNESS * limits.force(x[:1], excess)[0]
        _, rows, columns, values = limits.curvature(x[:1], excess != 0)
        H[rows, columns] += STIFFNESS * values
    H.ravel()[: D * (len(H) + 1) : len(H) + 1] += _DAMPING  # its root may be unobserved
    factor, failed = lapack.dpotrf(H[:D, :D], lower=1)
    if failed:
        raise SolverError("the Hessian of the frame that leaves is not positive definite")
    right = np.concatenate([H[D:, :D], gradient[None, :D]]).T
    half, _ = lapack.dtrtrs(factor, right, lower=1)
    precision = H[D:, D:] - half[:, :-1].T @ half[:, :-1]
    return MarginalPrior(x[1:].copy(), symmetric(precision), gradient[D:] - half[:, :-1].T @ half[:, -1]), factor, half


_DAMPING: Final = 1e-6
"""Added to the Hessian's diagonal for covariances and where a frame is eliminated: an unobserved root gets a
sigma of 1 km."""
_EVERY: Final = 6  #: Frames between estimates of the landmarks' errors
_MEMORY_S: Final = 1.0  #: [s] over which those estimates are averaged


_EARLY_S: Final = 0.2  #: [s] Age of a frame up to which its accelerations have a smaller weight
_EARLY_SHARE: Final = 0.01
"""That weight, relative to the usual one. Errors of accelerations are autocorrelated; at full weight they
bend the free end of a motion: at lag 0 the root-relative error of motions of validation is then 26 to 32 %
above that of `FragmentSolver`, and 10 to 17 % with this."""


class FixedLagSmoother:
    """Smoother of N frames with the residuals of an `Observations`.

    Attributes:
        first: the first frame that is solved; observations of those before it do not count any more.
        solved: (M, 3 + 4A) states of the frames from there on.
        inside: (N,) which frames exist; before N frames were appended, the first ones do not.
        rows: name -> (N, ...) observations, a_world, w_acceleration: (N, P, 3) and (N, P); as those of
            `Observations`, but `w_visual` relative to the landmarks' errors. They may be written.
        sigma_px: standard deviation of a landmark, px.
    """

    def __init__(self, data: Observations, frames: int, solved: int | None = None) -> None:
        """Begin without frames.

        Args:
            data: its problem, constants, limits and settings are used, and its first row as a template.
            frames: N, at least 5. solved: how many of the newest ones are solved, at least 5; None: all.
        """
        self.space, self.limits, self.constant = data.space, data.limits, dict(data.constant)
        self.frames, self.rate_hz, self._settings = frames, data.rate_hz, data.settings
        M = frames if solved is None else solved
        self.first = frames - M
        self._window, self._leaving = data.energy(M), data.energy(LAGS)
        self.rows = {name: np.repeat(values[:1], frames, axis=0) for name, values in data.rows.items()}
        self._weights = [name for name in self.rows if name.startswith("w_")]
        for name in self._weights:
            self.rows[name][:] = 0.0
        P = data.a_world.shape[1]
        self.a_world, self.w_acceleration = np.zeros((frames, P, 3)), np.zeros((frames, P))
        self.inside = np.zeros(frames, dtype=bool)
        self.solved = np.repeat(data.start[:1], M, axis=0)
        self._left = deque[Eliminated](maxlen=self.first)
        self._smoothed: Array | None = None
        self._multipliers = np.zeros((M, len(self.limits.names) if self.limits else 0))
        self.prior = MarginalPrior.none(self.space, self.solved[: LAGS - 1])
        self._errors = _RunningErrors(data)
        age = np.arange(M - 2, 0, -1)
        self._early = np.where(age < _EARLY_S * data.rate_hz, _EARLY_SHARE, 1.0)
        self._appended = 0

    @property
    def x(self) -> Array:
        """(N, 3 + 4A) states, oldest first."""
        if not self.first:
            return self.solved
        if self._smoothed is None:
            self._smoothed = np.concatenate([self._followed(), self.solved])
        return self._smoothed

    def state(self, frame: int) -> Array:
        """Return the state (1, 3 + 4A) of a frame, -N to N - 1; of one that is solved without the others."""
        own = frame % self.frames - self.first
        return self.solved[own : own + 1] if own >= 0 else self.x[frame : frame + 1]

    def _followed(self) -> Array:
        """States of the frames before the solved ones, by back substitution; the oldest known one before them."""
        space, left = self.space, list(self._left)
        if not left:
            return np.repeat(self.solved[:1], self.first, axis=0)
        d = np.zeros((len(left) + MEMORY, space.size))
        for i in range(len(left) - 1, -1, -1):
            ahead, own = d[i + 1 : i + LAGS], max(i + LAGS - len(left), 0)  # successors that are still solved
            if own:
                ahead = ahead.copy()
                ahead[-own:] = space.difference(left[i].after[-own:], self.solved[:own])
            d[i] = left[i].b + left[i].A @ ahead.ravel()
        x = space.retract(np.stack([one.x for one in left]), d[: len(left)])
        x = x if self.limits is None else self.limits.within(x)
        return np.concatenate([np.repeat(x[:1], self.first - len(x), axis=0), x])

    def _leave(self, left: Eliminated) -> None:
        """Keep a frame that is not solved any more; those before it are relative to where it was linearised."""
        D = self.space.size
        for k, before in enumerate(reversed([*self._left][-MEMORY:])):
            moved = self.space.difference(before.after[k : k + 1], left.x[None])[0]
            before.b[:] += before.A[:, k * D : (k + 1) * D] @ moved
        self._left.append(left)

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a landmark with the factor for autocorrelation, px."""
        return self._errors.sigma

    def append(self, x: Array, rows: Mapping[str, Array], a_world: Array, w_acceleration: Array) -> None:
        """Append a frame; the oldest one leaves the window.

        Args:
            x: (3 + 4A,) initial state. rows: name -> (...) observations; those left out have no weight.
            a_world: (S, 3) m/s^2. w_acceleration: (S,).
        """
        if not self.inside[-1]:
            self.solved[:] = x
        prior = MarginalPrior.none(self.space, self.solved[1:LAGS])
        if self.inside[self.first]:
            self._leaving.bind(self._first_terms())
            self._window.condition(self.prior)
            slope, present = self._window.before(self.solved)[1], (self.solved[:LAGS], self._multipliers[:LAGS])
            prior, *parts = marginalised(self.prior, slope, self._leaving, self.limits, *present)
            if self.first:
                self._leave(Eliminated.of(present[0], *parts))
        self.prior = prior
        for array in (*self.rows.values(), self.a_world, self.w_acceleration, self.inside, self._multipliers):
            array[:-1] = array[1:]
        for name, values in self.rows.items():
            if name in rows:
                values[-1] = rows[name]
            elif name in self._weights:
                values[-1] = 0.0
        self.a_world[-1], self.w_acceleration[-1], self.inside[-1] = a_world, w_acceleration, True
        self.solved, self._smoothed = np.concatenate([self.solved[1:], x[None]]), None
        self._appended += 1

    def restart(self, x: Array) -> None:
        """Forget all frames and begin at a state (3 + 4A,); estimates of the landmarks' errors are kept."""
        self.solved, self._smoothed = np.repeat(x[None], len(self.solved), axis=0), None
        self._left.clear()
        self.inside[:] = False
        self._multipliers = np.zeros_like(self._multipliers)
        for name in self._weights:
            self.rows[name][:] = 0.0
        self.w_acceleration[:] = 0.0
        self.prior = MarginalPrior.none(self.space, self.solved[: LAGS - 1])

    def translate(self, shift: Array) -> None:
        """Move the root of all frames, and of what is known of them from before, by (3,) m. Where not all are solved,
        only the solved ones begin anew there: what was seen before a gap holds the frames in it.
        """
        moved = np.concatenate([shift, np.zeros(self.solved.shape[1] - 3)])
        self.solved, self._smoothed = self.solved + moved, None
        if not self.first:
            self.prior = replace(self.prior, x=self.prior.x + moved)

    def predicted(self) -> Array:
        """Return the state (3 + 4A,) of the next frame at the speed of the last two, hinges within limits."""
        if not self.inside[-2:].all():
            return np.array(self.solved[-1])
        step = self.space.difference(self.solved[-2:-1], self.solved[-1:])
        x = self.space.retract(self.solved[-1:], step)
        return np.asarray((x if self.limits is None else self.limits.within(x))[0])

    def iterate(self, iterations: int, tolerance: float | None = None) -> bool:
        """Improve the states; return whether they have converged. `SolverError`: the energy is not finite; the states
        are unchanged.

        Args:
            tolerance: by default that of the settings.
        """
        self._window.bind(self._data())
        if self._appended % _EVERY == 0 or self._appended < self.frames:
            residuals = self._window.value(self.solved)[1]
            self._errors.estimate(residuals, self.rows["w_visual"][self.first :] > 0, self._share())
            self._window.bind(self._data())
        self._window.condition(self.prior)
        solver = LevenbergMarquardt(self._window, self.limits)
        tolerance = self._settings.tolerance if tolerance is None else tolerance
        solved = solver.solve(self.solved, iterations, tolerance, self._multipliers)
        if not np.isfinite(solved.x).all():
            raise SolverError("the window's states are not finite")
        self.solved, self._smoothed, self._multipliers = solved.x, None, solved.multipliers
        return solved.converged

    def finish(self, iterations: int, tolerance: float | None = None) -> bool:
        """Improve the states, as `iterate`, after the last frame: all accelerations have their usual weight."""
        self._early[:] = 1.0
        return self.iterate(iterations, tolerance)

    def covariance(self, first: int) -> Array:
        """Return marginal covariances (N - first, D, D) of frames from `first`, which exists, on; NaN for a singular
        Hessian.
        """
        self._window.condition(self.prior)
        solver = LevenbergMarquardt(self._window, self.limits)
        solver.linearise(self.solved, self._multipliers)
        D = self.space.size
        try:
            factor = self._window.factorise(_DAMPING)
        except SolverError:
            return np.full((self.frames - first, D, D), np.nan)
        left = [*self._left] if first < self.first else []
        if left:
            factor = Factor(np.concatenate([*(one.columns(len(factor.band)) for one in left), factor.band], axis=1))
        return factor.inverse_diagonal(D, LAGS, first - self.first + len(left))

    def weighted_first(self) -> dict[str, Array]:
        """Return the observations of the oldest frame with their weights: name -> (...)."""
        rows = self._errors.weighted({name: values[:1] for name, values in self.rows.items()})
        return {name: values[0] for name, values in rows.items()}

    def _share(self) -> float:
        """Weight of a new estimate of the landmarks' errors."""
        return max(_EVERY / (_MEMORY_S * self.rate_hz), 1 / max(self._appended, 1))

    def _data(self) -> FragmentData:
        """Observations of the window with the present weights."""
        first = self.first
        rows = self._errors.weighted({name: values[first:] for name, values in self.rows.items()})
        inside, a, w_a = self.inside[first:], self.a_world[first:], self.w_acceleration[first:]
        w = self._early * (inside[2:] & inside[1:-1] & inside[:-2])
        jerk = (np.convolve(inside, np.ones(LAGS), mode="valid") == LAGS).astype(float)
        return FragmentData(rows, self.constant, a[1:-1], w[:, None] * w_a[1:-1], jerk, self.rate_hz)

    def _first_terms(self) -> FragmentData:
        """Observations of the first four solved frames, with the weights of terms that contain the first one."""
        own = slice(self.first, self.first + LAGS)
        rows = self._errors.weighted({name: values[own].copy() for name, values in self.rows.items()})
        for name in self._weights:
            rows[name][1:] = 0.0
        w = self.w_acceleration[own][1:3].copy()
        w[1:] = 0.0
        inside, a = self.inside[own], self.a_world[own][1:3]
        jerk = np.array([float(inside.all())])
        return FragmentData(rows, self.constant, a, w * inside[:3].all(), jerk, self.rate_hz)


class _RunningErrors:
    """Size of the landmarks' errors and their autocorrelation, averaged over time; as in `Annealing`."""

    def __init__(self, data: Observations) -> None:
        self._settings, self._sizes = data.settings, data.points.sizes
        self._constant_errors = data.problem.energy.constant_errors
        self._size, self._factor = 0.0, 1.0
        self._estimated = False

    @property
    def sigma(self) -> float:
        """Standard deviation per axis, px, with the factor for autocorrelation."""
        given, bounds = self._settings.sigma_reprojection, self._settings.sigma_reprojection_range
        if given is not None:
            return given
        return float(np.clip(self._size * self._factor, *bounds)) if self._estimated else bounds[1]

    def estimate(self, residuals: Array, seen: Mask, share: float) -> None:
        """Average with residuals (N, L, 2), px, where seen (N, L)."""
        s = self._settings
        errors = CameraErrors(seen, self._sizes, s.sigma_reprojection_range[1], s.largest_correlation_factor)
        if s.sigma_reprojection is not None or not errors.enough:
            return
        size, factor = errors.estimated(residuals)
        share = share if self._estimated else 1.0
        self._size += share * (size - self._size)
        self._factor += share * (factor - self._factor)
        self._estimated = True

    def weighted(self, rows: Mapping[str, Array]) -> dict[str, Array]:
        """Return rows with the weights of landmarks, and of what is constant beside them."""
        out = dict(rows)
        out["w_visual"] = rows["w_visual"] / self.sigma**2
        out["knee_visual"] = np.full_like(rows["knee_visual"], self._settings.robust_reprojection / self._factor)
        share = self._factor / self._settings.largest_correlation_factor if self._estimated else 1.0
        for name in self._constant_errors:
            out[name] = share * rows[name]
        return out
