"""Self-calibration that goes on while a person moves, window after window.

Every window of N frames whose states were estimated adds to what is known of the unknowns y. Its
information I and gradient s at the current y are those of `fragment_profile`, the same as in batch::

    c <- (1 - d/m) c + d              d seconds of the window, m of memory
    S <- (1 - d/m) S + I
    b <- (1 - d/m) b + I (y - y_0) - s
    y  = y_0 + (P + r S)^-1 r b       r = min(1, effective seconds / c)

P and y_0 are those of the prior, or of a saved calibration. Errors of vision are autocorrelated: the
windows count together as `EFFECTIVE_SECONDS` at most, and those of m seconds ago less.

The delay of the video has a posterior of its own (`DelayPosterior`), as energies are not quadratic in it.

An update takes some 50 ms and comes in slices of about a ms. What is applied to new samples moves
towards the estimate with a limited speed, so that poses do not jump.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag, cho_factor, cho_solve

from rtof_kin.calibration.estimate import quantities_of
from rtof_kin.calibration.fragment_profile import ProfiledFragment, Slices
from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.calibration.priors import EFFECTIVE_SECONDS, OVERCOUNT, WEIGHT_POSES, CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.result import Quantity, SelfCalibration, Verdict
from rtof_kin.calibration.unknowns import Delay, Sampled, Unknown, columns_of, corrected, items_of, open_sensors
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError
from rtof_kin.core.numerics.banded import Factor
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.joint_space.state import Limits
from rtof_kin.solve.settings import JointSpaceSettings

Sensors = tuple[Array, Array, Array, Array]  # What `Sampled` returns
_REACH = 2.0  # Delays that are tried reach so many standard deviations of the prior to both sides
_COARSEST = 1 / 3  # [sigma] Largest step between them; one frame where that is smaller
_FINE = np.linspace(-_REACH, _REACH, 401)  # [sigma] Delays of the posterior, between which energies are interpolated
_SHARPEST = 0.02  # [sigma] Smallest deviation: samples are interpolated


@dataclass(frozen=True)
class LateSensors:
    """Sensors at evenly spaced instants, of which every delay of a grid takes some."""

    at: Sensors
    steps: Index  # (n,) delays of the grid from the present one, in steps
    step: float  # [s]
    count: int  # Instants from the first to the last frame
    parts: int  # Steps from frame to frame

    def sensors(self, k: int) -> Sensors:
        """Return the sensors at the frames for a delay k steps longer than the present one."""
        first = int(self.steps[-1]) - k
        frames = slice(first, first + self.count, self.parts)
        q, _, a, _ = (values[frames] for values in self.at)
        return q, self._known[0], a, self._known[1]

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        """Weights (N, S) of orientations and accelerations that all delays have, for energies of the same residuals."""
        first = int(self.steps[-1])
        frames = [slice(first - k, first - k + self.count, self.parts) for k in self.steps.tolist()]
        orientations, accelerations = (
            np.minimum.reduce([weights[own] for own in frames]) for weights in (self.at[1], self.at[3])
        )
        return orientations, accelerations


class DelayPosterior:
    """Delay that windows of a motion tell.

    Energies are added up on a grid of delays between `_REACH` standard deviations of the prior on either side. Delay
    and deviation are the moments of the posterior, which is wide while two delays explain the motion.

    Attributes:
        delay: s. sigma: its standard deviation, s. doubt: why it may be wrong; empty for no reason.
    """

    def __init__(self, usual: float, mean: float, sigma: float) -> None:
        """Begin with a prior.

        Args:
            usual: standard deviation of the delay of any video, s.
            mean, sigma: of this one, from a saved calibration, s; zero and the usual one where unknown.
        """
        self._usual = usual
        self._begin(mean, sigma)

    def _begin(self, mean: float, sigma: float) -> None:
        self._prior, self._energies = (mean, sigma), np.zeros_like(_FINE)
        self.delay, self.sigma, self.doubt = mean, sigma, ""

    def around(self, times: Array, rate_hz: float, sampled: Sampled) -> LateSensors:
        """Return the sensors at the frames of a window, for the present delay and for all others; `times`: (N,) stamps
        of the video, evenly spaced, s; `sampled`: the sensors at any times.
        """
        mean, sigma = self._prior
        parts = int(np.ceil(1 / (_COARSEST * sigma * rate_hz)))
        step = 1 / (parts * rate_hz)
        present = (self.delay - mean) / step
        ends = np.round(np.array([-1, 1]) * _REACH * sigma / step - present).astype(int)
        lowest, highest = min(int(ends[0]) - 1, 0), max(int(ends[1]) + 1, 0)
        count = parts * (len(times) - 1) + 1
        instants = times[0] - self.delay + step * np.arange(-highest, count - lowest)
        return LateSensors(sampled(instants), np.arange(lowest, highest + 1), step, count, parts)

    def interpolated(self, late: LateSensors, energies: Array) -> Array:
        """Return energies (n,) of a window at the delays of `late` on the grid of the posterior."""
        mean, sigma = self._prior
        delays = (self.delay + late.step * late.steps - mean) / sigma
        return np.asarray(CubicSpline(delays, energies - energies.min())(_FINE))

    def add(self, interpolated: Array, kept: float) -> None:
        """Add the energies of a window."""
        self._energies = kept * self._energies + interpolated

    def estimate(self, weight: float) -> None:
        """Set delay, deviation and doubt; a saved delay that the search leads away from is forgotten."""
        mean, sigma = self._prior
        at, spread = OffsetScan(_FINE, -(weight * self._energies + _FINE**2 / 2)).moments()
        self.sigma = max(spread, _SHARPEST) * sigma
        self.delay, self.doubt = mean + sigma * at, ""
        if abs(at) > _REACH - _COARSEST:
            if sigma < self._usual:
                self._begin(0.0, self._usual)
            else:
                self.doubt = f"the search ends at {self.delay:.3g} s, and the delay may lie beyond"

    @property
    def quantity(self) -> Quantity:
        """The delay with its verdict."""
        known = float(np.clip(1 - (self.sigma / self._usual) ** 2, 0.0, 1.0))
        delay, sigma, usual = (np.array([v]) for v in (self.delay, self.sigma, self._usual))
        return Quantity("delay", "video", delay, sigma, usual, known, self.doubt)


DELAY_ALONE: Final = CalibrationPriors(sigma_swing=None, sigma_image_bias=None, sigma_ankle_height=None)
"""Priors that leave nothing open but the delay. Where sensors are calibrated well, headings and mountings
take over errors of the detector; open them where they are known to be wrong."""
_DAMPING: Final = 1e-3
_STEPS = 2  # Gauss-Newton steps of a window's states at the current estimate
_STILL: Final = np.radians(3.0)
"""[rad] Turning in a window, in the mean of the sensors, below which it is not used: its errors are those of
the window before."""
_KEPT = 0.25  # Least deviation of a saved value, in those of the prior: sensors move a little between recordings
_KEPT_DELAY = 0.5  # The same of a delay: clocks are started again


@dataclass(frozen=True)
class WindowObservations:
    """A window of N frames, as measured: nothing of the calibration is applied."""

    given: CalibrationObservations
    """Of the N frames, evenly spaced: landmarks with the weights that the estimator gave them, sensors at the
    frames' stamps with those of `Observations`."""
    x: Array  # (N, 3 + 4A) estimated states
    sampled: Sampled
    """The sensors at any times near the window. Accelerations are smoothed over one sample, or delays
    of half a sample seem likelier than others."""
    multipliers: Array | None = None  # (N, M) of the limits


_MEMORY_S = 60.0  # [s] of windows after which one counts 1/e
_DELAY_SPEED = 0.005  # [s/s] Largest speed of the applied delay
TURN_SPEED: Final = np.radians(1.0)  # [rad/s] The same of headings and mountings
_SIGNIFICANT = 2.0
"""[1] Least deviation of a heading or mounting from where it began, in standard deviations, that is corrected: a
smaller one may be the detector's."""


@dataclass(frozen=True)
class Corrections:
    """What is applied to new samples."""

    delay: float  # [s] to subtract from the stamps of the video
    heading: Mapping[str, float]
    """Segment -> rotation about world's z to apply to its measured orientation and acceleration, rad."""
    R_mounting: Mapping[str, Array]  # Segment -> (3, 3) to multiply its measured orientation by, from the right


class SequentialCalibration:
    """Estimate of delay, headings and mountings from windows of a motion.

    Attributes:
        unknowns: kinds but the delay, in the order of y. columns: of each in y.
        y: (G,) estimate. delay: posterior of the delay, or None. windows: how many were used.
    """

    def __init__(
        self,
        problem: FragmentEnergy,
        settings: JointSpaceSettings,
        priors: CalibrationPriors | None = None,
        start: SelfCalibration | None = None,
    ) -> None:
        """Begin with the priors, or with a saved calibration. `CalibrationError`: nothing is open.

        Args:
            problem: energy of a window, of which no other solver binds data.
            priors: `sigma_delay`, `sigma_heading` and `sigma_swing` say what is open; by default `DELAY_ALONE`.
        """
        priors = priors or DELAY_ALONE
        self._problem, self._settings = problem, settings
        self._limits = Limits(problem.space) if settings.limits else None
        skeleton = problem.space.skeleton
        sensors = tuple(skeleton.names[j] for j in problem.energy["orientation"].sensors)
        self.unknowns = tuple(open_sensors(priors, skeleton, sensors)) if sensors else ()
        if not self.unknowns and priors.sigma_delay is None:
            raise CalibrationError("nothing is left open: give at least one standard deviation")
        self.columns = columns_of(self.unknowns)
        covariance = block_diag(*(u.covariance for u in self.unknowns))[: sum(len(u.covariance) for u in self.unknowns)]
        self._usual = np.array(np.diag(covariance))
        saved = {(q.kind, q.item): q for q in (start.quantities if start else ()) if q.observed}
        self._mean = _started(self.unknowns, covariance, saved)
        self._prior = np.asarray(np.linalg.inv(covariance) if self.unknowns else covariance)
        self.y, self.windows, self._seconds = self._mean.copy(), 0, 0.0
        self._information, self._vector = np.zeros_like(self._prior), np.zeros_like(self._mean)
        self.delay, usual, late = None, priors.sigma_delay, saved.get(("delay", "video"))
        if usual is not None:
            sigma = usual if late is None else min(usual, float(np.hypot(late.sigma[0], _KEPT_DELAY * usual)))
            self.delay = DelayPosterior(usual, 0.0 if late is None else float(late.value[0]), sigma)
        self._begun = self.delay.delay if self.delay else 0.0
        self._applied, self._applied_delay = self._mean.copy(), self._begun
        self._quantities = self._listed()

    def update(self, window: WindowObservations) -> Slices[None]:
        """Take a window into account, in slices of one or two ms; one without motion is left out. `SolverError`: the
        window's Hessian is not positive definite; nothing has changed then.

        Args:
            window: of as many frames as the problem has; later than those before.
        """
        if _turning(window.given) < _STILL:
            return
        given, N = window.given, len(window.x)
        late = self.delay.around(given.times, given.rate_hz, window.sampled) if self.delay else None
        yield
        now = self._by(self.y, given, late.sensors(0) if late else None)
        yield
        fragment = ProfiledFragment(self._problem, self._limits, self._settings, now, 0, window.x, window.multipliers)
        self._problem.bind(now.fragment(0, N))
        yield
        fragment, factor = yield from self._settled(fragment)
        energies = (yield from self._searched(given, late, fragment.x, factor)) if late else np.zeros(1)
        information, force = np.zeros_like(self._prior), np.zeros_like(self.y)
        if self.unknowns:
            weighted = {name: WEIGHT_POSES * now.rows[name] for name in ("w_prior", "w_torso")}
            fragment = replace(fragment, observations=now.changed(**weighted))
            self._problem.bind(fragment.observations.fragment(0, N))
            yield
            information, force = yield from fragment.profile(self.unknowns, self.columns, self.y)
        self._account(N / now.rate_hz, information, force, energies)
        yield
        self._quantities = self._listed()

    def corrections(self, seconds: float) -> Corrections:
        """Return what to apply to new samples, changed as much as the seconds since the last call allow."""
        wanted, delay = self._wanted()
        most, step = TURN_SPEED * seconds, _DELAY_SPEED * seconds
        self._applied += np.clip(wanted - self._applied, -most, most)
        self._applied_delay += float(np.clip(delay - self._applied_delay, -step, step))
        own = [(kind, item, self._applied[part]) for kind, item, part in items_of(self.unknowns)]
        return Corrections(
            self._applied_delay,
            {item: float(value[0]) for kind, item, value in own if kind == "heading"},
            {item: so3.exp(value) for kind, item, value in own if kind == "mounting"},
        )

    def applied(self, given: CalibrationObservations, sampled: Sampled) -> CalibrationObservations:
        """Return observations, as of `WindowObservations`, corrected by what `corrections` returned last."""
        late = sampled(given.times - self._applied_delay) if self.delay else None
        return self._by(self._applied, given, late)

    def as_self_calibration(self) -> SelfCalibration:
        """Return the present estimate, as `calibrate` would."""
        return SelfCalibration(self._quantities, converged=self.windows > 0)

    def _by(self, y: Array, given: CalibrationObservations, sampled: Sensors | None) -> CalibrationObservations:
        """Observations corrected by y (G,), with the sensors sampled anew where there is a delay."""
        if sampled is not None:
            given = Delay(1.0, lambda _: sampled).correct(given, np.zeros(1))
        return corrected(given, self.unknowns, y)

    def _settled(self, fragment: ProfiledFragment) -> Slices[tuple[ProfiledFragment, Factor]]:
        problem = self._problem
        energy = problem.total(fragment.x)
        for _ in range(_STEPS):
            slope = fragment.linearise()
            yield
            factor = problem.factorise(_DAMPING)
            yield
            x = problem.retract(fragment.x, factor.solve(-slope))
            after = problem.total(x)
            if not after < energy:
                break
            energy, fragment = after, replace(fragment, x=x)
            yield
        return fragment, factor

    def _searched(self, given: CalibrationObservations, late: LateSensors, x: Array, factor: Factor) -> Slices[Array]:
        assert self.delay is not None
        problem, energies = self._problem, np.zeros(len(late.steps))
        for i, k in enumerate(late.steps.tolist()):
            problem.bind(self._by(self.y, given, late.sensors(k)).fragment(0, len(x)))
            yield
            energies[i] = problem.total(problem.retract(x, factor.solve(-problem.gradient(x))))
            yield
        return self.delay.interpolated(late, energies)

    def _account(self, seconds: float, information: Array, force: Array, energies: Array) -> None:
        if not all(np.isfinite(values).all() for values in (information, force, energies)):
            return
        kept = max(0.0, 1 - seconds / _MEMORY_S)
        self._seconds = kept * self._seconds + seconds
        self._information = kept * self._information + information
        self._vector = kept * self._vector + information @ (self.y - self._mean) - force
        self.windows += 1
        if self.delay:
            self.delay.add(energies, kept)
            self.delay.estimate(self._share / OVERCOUNT)
        if self.unknowns:
            hessian = self._prior + self._share * self._information
            self.y = self._mean + cho_solve(cho_factor(hessian), self._share * self._vector)

    @property
    def _share(self) -> float:
        """Weight of all windows: together they count as the effective seconds at most."""
        return min(1.0, EFFECTIVE_SECONDS / max(self._seconds, 1e-9))

    def _listed(self) -> tuple[Quantity, ...]:
        found = [self.delay.quantity] if self.delay else []
        if self.unknowns:
            hessian = self._prior + self._share * self._information
            moved = quantities_of(self.unknowns, self.y - self._mean, hessian, self._prior, self._usual, _SIGNIFICANT)
            parts = zip(moved, items_of(self.unknowns), strict=True)
            found += [replace(q, value=q.value + self._mean[own]) for q, (_, _, own) in parts]
        return tuple(found)

    def _wanted(self) -> tuple[Array, float]:
        """What is to be applied: known estimates and an observed delay, else what it began with."""
        wanted, delay, quantities = self._mean.copy(), self._begun, list(self._quantities)
        if self.delay:
            late, *quantities = quantities
            delay = float(late.value[0]) if late.verdict is Verdict.OBSERVED else delay
        for q, (_, _, own) in zip(quantities, items_of(self.unknowns), strict=True):
            if q.observed:
                wanted[own] = q.value
        return wanted, delay


def _turning(given: CalibrationObservations) -> float:
    """Largest angle of the sensors from their first orientation, in the mean of those with data, rad."""
    known = given.rows["w_sensor"] > 0
    used = known.all(axis=0)
    if not used.any():
        return np.inf
    q = given.rows["quat_sensor"][:, used]
    cosine = np.abs(np.sum(q * q[:1], axis=-1)).min(axis=0)
    return float(np.mean(2 * np.arccos(np.minimum(cosine, 1.0))))


def _started(unknowns: Sequence[Unknown], covariance: Array, saved: Mapping[tuple[str, str], Quantity]) -> Array:
    """Means (G,) of the prior; narrows its covariance (G, G) of items that are saved."""
    mean = np.zeros(len(covariance))
    for kind, item, own in items_of(unknowns):
        known, width = saved.get((kind, item)), own.stop - own.start
        if known is not None:
            usual = np.sqrt(np.diag(covariance)[own])
            share = np.minimum(1.0, np.hypot(known.sigma[:width] / usual, _KEPT))
            mean[own] = known.value[:width]
            covariance[own, own] *= np.outer(share, share)
    return mean
