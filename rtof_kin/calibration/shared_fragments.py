"""Fragments of one recording that share unknowns.

A recording is given as one slice or several, of which fragments that do not overlap are chosen by what their sensors
and landmarks show: what a calibration costs goes with the length of this excerpt, not with that of the recording. Each
fragment has states x_f, all share the unknowns y. For given y, every fragment's states are solved by the solver of the
reconstruction; then a Gauss-Newton step is taken on the energy as a function of y alone:

::

    profile(y)  = sum_f min_x E_f(x; y) + 1/2 y^T P y
    Hessian     = sum_f (H_f - C_f^T A_f^-1 C_f) + P        A_f banded, C_f by states and y, H_f by y
    gradient    = sum_f (h_f - C_f^T A_f^-1 g_f) + P y

(variable projection; Golub & Pereyra 2003). The Hessian at the end is the inverse covariance of y, as far
as the weights are right; autocorrelated errors weigh less than in single frames (`priors`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Self

import numpy as np
import scipy
from scipy.linalg import block_diag, cho_factor, cho_solve

from rtof_kin.calibration.fragment_profile import ProfiledFragment, UnknownsHessian, finished
from rtof_kin.calibration.priors import OVERCOUNT, WEIGHT_POSES
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.straight_legs import StraightLeg
from rtof_kin.calibration.unknowns import Unknown, columns_of, corrected
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.inertial.outlier_rejection import find_disagreements, merge_faults
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings

_MISALIGNED_FRACTION = 0.8  # Minimum fraction of the excerpt over which a sensor must disagree to count as misaligned


@dataclass(frozen=True)
class Slice:
    """A recording, or the part of it between two times, made ready for calibration."""

    recording: Recording  # With evenly spaced keypoints, and an approximate calibration of its IMUs
    guess: InitialGuess  # At the keypoints' times, from poses after SF2
    bone_imus: BoneImuSequence | None  # Sensors at those times; None without


@dataclass(frozen=True)
class Excerpt:
    """Fragments of one recording, joined; times jump between them."""

    slices: tuple[Slice, ...]
    data: tuple[Observations, ...]  # Of each slice; all have the same states and sensors
    fragments: tuple[tuple[int, int], ...]  # Slice and first frame there of every fragment, in the order of time

    left_out: tuple[StreamFault, ...] = ()  # Intervals of sensors that are not used, by segment

    @classmethod
    def chosen(cls, slices: Sequence[Slice], frames: int, settings: JointSpaceSettings, most_seconds: float) -> Self:
        """Choose fragments of slices: the liveliest of each of so many equal parts.

        Args:
            slices: of one recording, in the order of time; those in which other sensors have data than in the one
                with most of them are left out.
            most_seconds: length of all fragments, s.
        """
        data = [_observed(part, frames, settings) for part in slices]
        sensed = max(data, key=lambda own: len(own.space.names) - len(own.fixed))
        alike = [
            i
            for i, own in enumerate(data)  # the same joints turn, with the same sensors
            if (own.space.names, own.fixed) == (sensed.space.names, sensed.fixed)
            and np.array_equal(own.problem.sigma_jerk, sensed.problem.sigma_jerk)
        ]
        data = [data[i] for i in alike]
        whole = [
            (i, first) for i, own in enumerate(data) for first in range(0, len(own.start) - frames + 1, frames)
        ] or [(0, 0)]
        count = max(int(min(float(len(whole)), most_seconds * data[0].rate_hz / frames)), 1)
        motion = np.empty(len(whole))  # accelerations of the sensors times the share of landmarks seen
        for k, (i, first) in enumerate(whole):
            shown = np.mean(data[i].confidence[first : first + frames] > 0)
            motion[k] = np.std(data[i].a_world[first : first + frames], axis=0).sum() * shown
        best = [part[np.argmax(motion[part])] for part in np.array_split(np.arange(len(whole)), count)]
        return cls(tuple(slices[i] for i in alike), tuple(data), tuple(whole[k] for k in best))

    @property
    def frames(self) -> int:
        """N of a fragment."""
        return self.data[0].frames

    @property
    def firsts(self) -> range:
        """First frame of every fragment in the excerpt."""
        return range(0, len(self.fragments) * self.frames, self.frames)

    def joined(self, values: Sequence[Array]) -> Array:
        """Return the excerpt's frames (T', ...) of values (T, ...) of every slice."""
        return np.concatenate([values[i][first : first + self.frames] for i, first in self.fragments])

    @property
    def times(self) -> Array:
        """(T',) stamps of the video, s."""
        return self.joined([part.guess.poses.times for part in self.slices])

    @property
    def observations(self) -> CalibrationObservations:
        """Of the T' frames."""
        given = self.data[0]
        rows = {name: self.joined([own.rows[name] for own in self.data]) for name in given.rows}
        w_acceleration = self.joined([own.w_acceleration for own in self.data])
        for fault in self.left_out:
            during = (self.times >= fault.start) & (self.times <= fault.stop)
            s = given.sensors.index(fault.what)
            rows["w_sensor"][during, s], w_acceleration[during, s] = 0.0, 0.0
        a_world = self.joined([own.a_world for own in self.data])
        return CalibrationObservations(self.times, rows, given.constant, a_world, w_acceleration)

    def by_slice(self, values: Array) -> list[tuple[int, Array]]:
        """Return slices and their part of values (T', ...) of the excerpt's frames."""
        counts = np.bincount([i for i, _ in self.fragments]) * min(self.frames, len(values))
        parts = np.split(values, np.cumsum(counts)[:-1])
        return [(i, part) for i, part in enumerate(parts) if len(part)]

    def slipped(self, states: Sequence[Array]) -> tuple[StreamFault, ...]:
        """Intervals in which a sensor contradicts the motion solved with all of them, but for sensors that do so nearly
        always, which a constant mounting error explains; `states`: (N, 3 + 4A) of every fragment.
        """
        faults, seconds = list[StreamFault](), 0.0
        for (i, first), x in zip(self.fragments, states, strict=True):
            own = slice(first, min(first + self.frames, len(self.data[i].start)))
            start, sensed = self.slices[i].guess.poses, self.slices[i].bone_imus
            if sensed is None:
                continue
            poses = start.with_poses(own, *(v[: own.stop - first] for v in self.data[i].space.poses(x)))
            seconds += float(poses.times[-1] - poses.times[0])
            faults += find_disagreements(poses, sensed[own], self.data[i].skeleton)
        lasting = {
            name
            for name in {fault.what for fault in faults}
            if sum(f.stop - f.start for f in faults if f.what == name) >= _MISALIGNED_FRACTION * seconds
        }
        return merge_faults(fault for fault in faults if fault.what not in lasting)


def _observed(part: Slice, frames: int, settings: JointSpaceSettings) -> Observations:
    recording = part.recording
    return Observations(
        recording.skeleton,
        frames,
        settings,
        part.guess,
        recording.keypoints,
        part.bone_imus,
        places=() if part.bone_imus is None else part.bone_imus.joints,
    )


_INNER = 8  # Iterations of a fragment's states after the first round
_LIVELY = 6  # Fragments used by the search for a delay
_AS_GOOD = 0.01  # Relative energy within which another value of a search is as good as the best one
_ENOUGH = 1e-3  # Relative decrease of the energy below which steps end; the states are solved more accurately


@dataclass(frozen=True)
class Shared:
    """Estimate of the unknowns."""

    y: Array  # (G,) the estimate
    hessian: Array  # (G, G) of the energy as a function of the unknowns alone, with their prior
    energies: tuple[float, ...]  # Before the first and after every accepted step
    converged: bool
    doubts: dict[int, str]  # Column of a searched unknown -> reason why the search may have failed


class SharedFragments:
    """The fragments of one recording and the unknowns that they share.

    Attributes:
        excerpt: the fragments. columns: of each unknown in y. prior: (G, G) its precision.
        data: what all fragments have in common: states, problem, limits, settings.
        confidence: (T', L) relative weights of the landmarks, 0 where unobserved.
        sigma_px: of the landmarks.
    """

    def __init__(
        self, excerpt: Excerpt, unknowns: Sequence[Unknown], weight: float, legs: Sequence[StraightLeg] = ()
    ) -> None:
        """Take the fragments.

        Args:
            unknowns: in the order in which they correct the observations; a delay is the first.
            weight: of residuals relative to a reconstruction; of postures `WEIGHT_POSES` times as much.
            legs: evidence of the mountings.
        """
        self.excerpt, self.unknowns, self._weight, self.legs = excerpt, tuple(unknowns), weight, tuple(legs)
        self.data = excerpt.data[0]
        self._given = excerpt.observations
        self._start = excerpt.joined([own.start for own in excerpt.data])
        self.confidence = excerpt.joined([own.confidence for own in excerpt.data])
        self.columns = columns_of(self.unknowns)
        self.prior = _precision(self.unknowns)
        self._solver = LevenbergMarquardt(self.data.problem, self.data.limits)
        self._firsts = list(excerpt.firsts)
        self.sigma_px = np.nan
        self._states: dict[int, tuple[Array, Array | None]] = {}
        self._doubts: dict[int, str] = {}

    def estimate(
        self, rounds: int, progress: Callable[[int, int], None] | None = None, start: Array | None = None
    ) -> Shared:
        """Estimate the unknowns, and the prior of those kinds that shrink. `SolverError`: a fragment cannot be solved,
        or the unknowns' Hessian is not positive definite.

        Args:
            progress: called with (steps done, steps in all).
            start: (G,) initial values; by default zero, and a searched delay.
        """
        report = progress or (lambda done, total: None)
        if not self._states:
            self.begin()
        report(1, rounds + 1)
        y, energies, converged = self._searched() if start is None else start, [], False
        best, step, given = (np.inf, y), np.zeros_like(y), self.prior
        shrinking = [c for u, c in zip(self.unknowns, self.columns, strict=True) if u.shrinks]
        for done in range(rounds + 1):
            given_y = self.corrected(y)
            of_data = self.settle(given_y)
            energy, before = of_data + self._unlikely(y), best[0] + self._unlikely(best[1])
            report(done + 1, rounds + 1)
            if energy > before * (1 + _ENOUGH):  # too far
                step = step / 4
                y = best[1] + step
                continue
            energies.append(energy)
            converged = before - energy < _ENOUGH * energy
            best = of_data, y
            if converged:  # the Hessian is that of the step before
                break
            information, slope = self.profile(given_y, y)
            r, J = self.straightness(y)
            information, slope = information + J.T @ J, slope + J.T @ r
            self.prior = learned_precision(given, information, slope, y, shrinking)
            hessian = information + self.prior
            step = -cho_solve(cho_factor(hessian), slope + self.prior @ y)
            y = y + step
        y = best[1]
        report(rounds + 1, rounds + 1)
        return Shared(y, hessian, tuple(energies), converged, self._doubts)

    def _unlikely(self, y: Array) -> float:
        return 0.5 * float(y @ self.prior @ y + np.sum(self.straightness(y)[0] ** 2))

    def straightness(self, y: Array) -> tuple[Array, Array]:
        """Return residuals (m,) of straight legs and their derivatives (m, G) at y (G,): as much overstated as the
        information of images and sensors is.
        """
        own = next((c for u, c in zip(self.unknowns, self.columns, strict=True) if u.name == "mounting"), None)
        if own is None or not self.legs:
            return np.zeros(0), np.zeros((0, len(y)))
        found = [leg.residuals(y[own].reshape(-1, 3)) for leg in self.legs]
        r, by_mounting = (np.concatenate(values) for values in zip(*found, strict=True))
        J = np.zeros((len(r), len(y)))
        J[:, own] = by_mounting
        return np.sqrt(OVERCOUNT) * r, np.sqrt(OVERCOUNT) * J

    def _searched(self) -> Array:
        """(G,) with the searched unknowns at the smallest energy, all others at zero.

        The energy of fast motion is not quadratic in a delay, so it is searched by energies alone, on
        fragments with much motion.
        """
        y = np.zeros(len(self.prior))
        deviations = np.sqrt(np.diag(np.linalg.inv(self.prior)))
        columns = zip(self.unknowns, self.columns, strict=True)
        for i in [part.start for unknown, part in columns if unknown.searched]:
            sigma, energy = float(deviations[i]), partial(self._energy_at, y, i)
            grid = sigma * np.arange(-2.0, 3.0)
            energies = np.array([energy(value) for value in grid])
            best = float(grid[int(np.argmin(energies))])
            found = scipy.optimize.minimize_scalar(
                energy,
                bounds=(best - sigma, best + sigma),
                method="bounded",
                options={"xatol": 0.05 * sigma, "maxiter": 6},
            )
            y[i] = found.x
            self._doubts |= _doubt(i, float(found.x), float(found.fun), grid, energies, sigma)
        return y

    def _energy_at(self, y: Array, i: int, value: float) -> float:
        """Energy of the liveliest fragments at another value of one unknown, with full weights."""
        y = np.where(np.arange(len(y)) == i, value, y)
        corrected, a, N = self.corrected(y, full=True), self._given.a_world, self.data.frames
        lively = {first: float(np.std(a[first : first + N], axis=0).sum()) for first in self._firsts}
        chosen = sorted(sorted(lively, key=lambda first: -lively[first])[:_LIVELY])
        return self.settle(corrected, chosen) + self._unlikely(y)

    def corrected(self, y: Array, full: bool = False) -> CalibrationObservations:
        """Return the observations corrected by y (G,), weighted, or with the full weights of a reconstruction."""
        given, s = corrected(self._given, self.unknowns, y), self.data.settings
        weight, prior = (1.0, 1.0) if full else (self._weight, self._weight * WEIGHT_POSES)
        knee = s.robust_reprojection / s.largest_correlation_factor * np.sqrt(weight)
        return replace(given, weight_of_motion=weight).changed(
            w_visual=weight * self.confidence / self.sigma_px**2,
            knee_visual=np.full(len(given.times), knee),
            w_sensor=weight * given.rows["w_sensor"],
            w_prior=prior * given.rows["w_prior"],
            w_torso=prior * given.rows["w_torso"],
        )

    def begin(self, sigma_px: float | None = None) -> None:
        """Solve the fragments as reconstruction does; set `sigma_px` to that of the residuals, unless it is given, and
        limit the priors of biases.
        """
        s, data, sizes, constant = self.data.settings, self.data, list[float](), list[float]()
        for first in self._firsts:
            values = self._given.fragment(first, data.frames)
            data.problem.bind(values)
            index = np.clip(np.arange(first, first + data.frames), 0, len(self._start) - 1)
            annealing = Annealing(s, data.problem, self.confidence[index], data.points.sizes, values.observation)
            solved = self._solver.solve(
                self._start[index], s.annealing + s.max_iterations, s.tolerance, None, annealing
            )
            self._states[first] = solved.x, solved.multipliers
            rows = *(values.observation[name] for name in ("w_visual", "w_sensor")), values.w_acceleration
            if any(row.any() for row in rows):
                sizes.append(annealing.sigma)
                constant.append(annealing.constant_px)
        self.sigma_px = float(np.median(sizes)) if sigma_px is None else sigma_px
        self.unknowns = tuple(u.limited(float(np.median(constant))) for u in self.unknowns)
        self.prior = _precision(self.unknowns)

    def slipped(self) -> tuple[StreamFault, ...]:
        """Intervals in which a sensor contradicts the present states; see `Excerpt.slipped`."""
        return self.excerpt.slipped([self._states[first][0] for first in self._firsts])

    def settle(self, corrected: CalibrationObservations, firsts: Sequence[int] | None = None) -> float:
        """Optimise the states of all fragments, or of those with first frames `firsts`; return the energy."""
        total, s = 0.0, self.data.settings
        for first in self._firsts if firsts is None else firsts:
            problem = self.bound(corrected, first)
            x, multipliers = self._states[first]
            solved = self._solver.solve(x, _INNER, s.tolerance, multipliers)
            self._states[first] = solved.x, solved.multipliers
            total += problem.total(solved.x)
        return total

    def states(self, first: int) -> Array:
        """Return the current states (N, 3 + 4A) of the fragment with a first frame."""
        return self._states[first][0]

    def bound(self, corrected: CalibrationObservations, first: int) -> FragmentEnergy:
        """Return the energy with a fragment's observations bound to it."""
        problem = self.data.problem
        problem.bind(corrected.fragment(first, self.data.frames))
        return problem

    def profile(self, corrected: CalibrationObservations, y: Array) -> tuple[Array, Array]:
        """Return Hessian (G, G) and gradient (G,) of the data's energy at y (G,) by the unknowns alone."""
        hessian, gradient = np.zeros_like(self.prior), np.zeros(len(y))
        for first in self._firsts:
            fragment = self._profiled(corrected, first, *self._states[first])
            information, slope = finished(fragment.profile(self.unknowns, self.columns, y))
            hessian, gradient = hessian + information, gradient + slope
        return hessian, gradient

    def unknowns_hessian(self, corrected: CalibrationObservations, first: int, x: Array, y: Array) -> UnknownsHessian:
        """Return the blocks of a fragment's Hessian by unknowns at states x (N, 3 + 4A) and y (G,)."""
        fragment = self._profiled(corrected, first, x)
        return finished(fragment.unknowns_hessian(self.unknowns, self.columns, y))

    def _profiled(
        self, corrected: CalibrationObservations, first: int, x: Array, multipliers: Array | None = None
    ) -> ProfiledFragment:
        problem, data = self.bound(corrected, first), self.data
        return ProfiledFragment(problem, data.limits, data.settings, corrected, first, x, multipliers)


def _doubt(column: int, found: float, least: float, grid: Array, energies: Array, sigma: float) -> dict[int, str]:
    """Column and reason why a search over ``grid +- sigma`` may have failed; empty where it did not."""
    border = float(grid[-1]) + sigma
    if abs(found) > border - sigma / 2:
        return {column: f"the search ends at its border of {border:.3g} s, and the delay may lie beyond"}
    others = (np.abs(grid - found) > 0.99 * sigma) & (energies < least * (1 + _AS_GOOD))
    if others.any():
        rival = float(grid[others][np.argmin(energies[others])])
        return {column: f"{rival:.3g} s explains the recording as well"}
    return {}


def _precision(unknowns: Sequence[Unknown]) -> Array:
    """(G, G) of all kinds' priors."""
    return np.asarray(np.linalg.inv(block_diag(*(u.covariance for u in unknowns))))


_LEARNING_ROUNDS: Final = 30
_STEADY: Final = 1e-3
_LEAST_SHARE = 0.05  # Smallest share of a prior's variance
_TINY = 1e-9  # Added to sums of squares, so that unobserved estimates have a ratio of 1


def learned_precision(given: Array, information: Array, slope: Array, y: Array, shrinking: Sequence[slice]) -> Array:
    """Return the precision (G, G) of the prior that matches the size of the estimates.

    With information D and precision P the estimate is A times the truth plus noise, A = (P + D)^-1 D; as
    autocorrelated errors make D k times too large (`OVERCOUNT`), its covariance is A P^-1 A^T + k A (P + D)^-1. The
    prior's variance of each kind is multiplied, by 0.05 to 1, until its estimates are of that size (empirical Bayes by
    moments; Morris 1983).

    With small errors all estimates are smaller than their prior makes likely. A smaller prior also limits estimates of
    combinations that nothing observes: a radial bias in the image looks like a nearer person.

    Args:
        given: (G, G) precision before. information: (G, G) the data's Hessian at y.
        slope: (G,) gradient of the data's energy at y (G,). shrinking: columns of the kinds that may shrink.
    """
    shares, precision = np.ones(len(shrinking)), given
    for _ in range(_LEARNING_ROUNDS if shrinking else 0):
        inverse = np.linalg.inv(information + precision)
        estimate = y - inverse @ (slope + precision @ y)
        A = inverse @ information
        expected = np.diag(A @ np.linalg.inv(precision) @ A.T + OVERCOUNT * A @ inverse)
        before = shares
        ratios = [_size(given, estimate**2, own) / _size(given, expected, own) for own in shrinking]
        shares = (before * ratios).clip(_LEAST_SHARE, 1.0)
        precision = given.copy()
        for share, own in zip(shares, shrinking, strict=True):
            precision[own, own] /= share
        if np.all(np.abs(shares - before) < _STEADY):
            break
    return precision


def _size(given: Array, squares: Array, own: slice) -> float:
    """Sum of squares of one kind, in variances of its prior."""
    return float(np.diag(given)[own] @ squares[own]) + _TINY
