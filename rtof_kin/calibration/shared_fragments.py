"""Fragments that share unknowns: what is wrong all through a recording, from all of it at once.

The recording is cut into fragments that do not overlap. Each has states x_f of its own, all share the
unknowns y. For y as it is, every fragment's states are solved by the solver that reconstruction uses;
then one Gauss-Newton step is taken on what is left, the energy as a function of y alone:

::

    profile(y)  = sum_f min_x E_f(x; y) + 1/2 y^T P y
    Hessian     = sum_f (H_f - C_f^T A_f^-1 C_f) + P        A_f banded, C_f its border, H_f the corner
    gradient    = sum_f (h_f - C_f^T A_f^-1 g_f) + P y

(variable projection; Golub & Pereyra 2003). The Hessian at the end is the inverse covariance of y, as
far as residuals are worth what their weights say. Errors that last are worth less than one by one a
frame: `Worth` says how much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from rtof_kin.calibration.learned_prior import learned_precision
from rtof_kin.calibration.residuals import Evidence, Situation
from rtof_kin.calibration.schur_complement import Border
from rtof_kin.calibration.unknowns import Unknown
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.observations import Observations

Array = NDArray[np.float64]
_DAMPING = 1e-6
_INNER = 8
"""Iterations of a fragment's states after the first round."""
_LIVELY = 8
"""Fragments that a delay is looked for in."""
_AS_GOOD = 0.01
"""Share of the energy within which another value of what is searched for is as good as the best one."""
_ENOUGH = 1e-3
"""Share of the energy by which a step must lower it for another one; the states are solved to less."""


@dataclass(frozen=True)
class Worth:
    """What residuals count in a calibration, as shares of what they count in a reconstruction."""

    vision: float = 1.0
    sensors: float = 1.0
    """Their orientations."""
    motion: float = 1.0
    """Accelerations and jerk. Both are smaller of who keeps the arms bent, so they must not count for
    more than the rest."""
    prior: float = 1.0
    """That of poses, and the start's torso."""


@dataclass(frozen=True)
class Shared:
    """What a recording says about its unknowns."""

    y: Array
    """(G,) the estimate."""
    hessian: Array
    """(G, G) of the energy as a function of the unknowns alone, their prior included."""
    sigma_px: float
    """Size that the landmarks' errors were taken to have, px."""
    residuals: Array
    """(T, L, 2) of reprojection with everything corrected, px; NaN in fragments that were left out."""
    energies: tuple[float, ...]
    """After every step that was taken, none first."""
    converged: bool
    """Whether the last step changed the energy by next to nothing."""
    doubts: dict[int, str]
    """Column of what was searched for -> why the search may have missed it; empty where it did not."""


class SharedFragments:
    """The fragments of one recording and the unknowns that they share."""

    def __init__(
        self, data: Observations, times: Array, unknowns: Sequence[Unknown], worth: Worth,
        most_seconds: float = np.inf,
    ) -> None:  # fmt: skip
        """Collect; nothing is solved yet.

        Args:
            times: (T,) stamps of the frames, s.
            unknowns: in the order in which they correct the evidence: a delay comes first.
            most_seconds: of fragments; of a longer recording they are chosen evenly.
        """
        self.data, self.times, self.unknowns, self.worth = data, times, tuple(unknowns), worth
        self._given = Evidence.of(data, times)
        stops = np.cumsum([len(u.covariance) for u in unknowns]).tolist()
        starts = [0, *stops[:-1]]
        self.columns = tuple(slice(a, b) for a, b in zip(starts, stops, strict=True))
        self.prior = _precision(self.unknowns)
        self._solver = LevenbergMarquardt(data.problem, data.limits)
        firsts = np.arange(0, len(times), data.frames)
        most = min(float(len(firsts)), most_seconds * self._given.rate_hz / data.frames)
        chosen = np.linspace(0, len(firsts) - 1, max(int(most), 1)).round().astype(int)
        self._firsts: list[int] = firsts[chosen].tolist()
        self._sigma_px = np.nan
        self._states: dict[int, tuple[Array, Array | None]] = {}
        self._doubts: dict[int, str] = {}

    def estimate(
        self, rounds: int, progress: Callable[[int, int], None] | None = None, overcount: float = 1.0,
        start: Array | None = None,
    ) -> Shared:  # fmt: skip
        """Solve, and learn on the way how large the errors are of those kinds that shrink.

        Args:
            rounds: Gauss-Newton steps at most.
            progress: told how far it is.
            overcount: by how much errors that last make the data count too much.
            start: (G,) values to begin with; zero where not given, a delay searched for.

        Raises:
            SolverError: a fragment cannot be solved, or the unknowns' Hessian is not positive definite.
        """
        tell = progress or (lambda done, total: None)
        self.begin()
        tell(1, rounds + 1)
        y, energies, converged = self._searched() if start is None else start, [], False
        best, step, given = (np.inf, y), np.zeros_like(y), self.prior
        for done in range(rounds + 1):
            evidence = self.corrected(y)
            of_data = self.settle(evidence)
            energy, before = of_data + self._unlikely(y), best[0] + self._unlikely(best[1])
            tell(done + 1, rounds + 1)
            if energy > before * (1 + _ENOUGH):  # too far
                step = step / 4
                y = best[1] + step
                continue
            energies.append(energy)
            converged = before - energy < _ENOUGH * energy
            best = of_data, y
            information, slope = self.profile(evidence, y)
            self.prior = learned_precision(given, information, slope, y, self._shrinking, overcount)
            hessian = information + self.prior
            if converged:
                break
            step = -cho_solve(cho_factor(hessian), slope + self.prior @ y)
            y = y + step
        y = best[1]
        tell(rounds + 1, rounds + 1)
        residuals = self._residuals(self.corrected(y))
        return Shared(y, hessian, self._sigma_px, residuals, tuple(energies), converged, self._doubts)

    @property
    def _shrinking(self) -> list[slice]:
        """Columns of the kinds whose prior is learned."""
        return [c for u, c in zip(self.unknowns, self.columns, strict=True) if u.shrinks]

    def _unlikely(self, y: Array) -> float:
        """The prior's energy."""
        return 0.5 * float(y @ self.prior @ y)

    # --- a delay ---------------------------------------------------------------------------------

    @property
    def _search_columns(self) -> NDArray[np.bool_]:
        """(G,) whether an unknown is found by search: the first of each kind that asks for it."""
        chosen = np.zeros(len(self.prior), dtype=bool)
        for unknown, part in zip(self.unknowns, self.columns, strict=True):
            chosen[part.start] = unknown.searched
        return chosen

    def _searched(self) -> Array:
        """(G,) with what is searched where the energy is least, all others at zero.

        Fast motion makes the energy anything but a parabola in a delay, so Gauss-Newton steps fall short:
        it is looked for by energies alone, on fragments with much motion.
        """
        y = np.zeros(len(self.prior))
        deviations = np.sqrt(np.diag(np.linalg.inv(self.prior)))
        for i in np.flatnonzero(self._search_columns).tolist():
            sigma, energy = float(deviations[i]), partial(self._energy_at, y, i)
            grid = sigma * np.arange(-2.0, 3.0)
            energies = np.array([energy(value) for value in grid])
            best = float(grid[int(np.argmin(energies))])
            found = minimize_scalar(
                energy, bounds=(best - sigma, best + sigma), method="bounded",
                options={"xatol": 0.02 * sigma, "maxiter": 8},
            )  # fmt: skip
            y[i] = found.x
            self._doubts |= _doubt(i, float(found.x), float(found.fun), grid, energies, sigma)
        return y

    def _energy_at(self, y: Array, i: int, value: float) -> float:
        """Of the liveliest fragments with another value of one unknown, weighed as always."""
        y = np.where(np.arange(len(y)) == i, value, y)
        evidence, chosen = self.corrected(y, Worth()), self._liveliest()
        self.settle(evidence, chosen)
        return self.settle(evidence, chosen) + self._unlikely(y)

    def _liveliest(self) -> list[int]:
        """First frames of the fragments in which accelerations differ most."""
        a, N = self._given.a_world, self.data.frames
        lively = {first: float(np.std(a[first : first + N], axis=0).sum()) for first in self._firsts}
        return sorted(sorted(lively, key=lambda first: -lively[first])[:_LIVELY])

    # --- states ----------------------------------------------------------------------------------

    def corrected(self, y: Array, worth: Worth | None = None) -> Evidence:
        """The evidence without what the unknowns say is wrong, weighed."""
        evidence, worth = self._given, worth or self.worth
        for unknown, part in zip(self.unknowns, self.columns, strict=True):
            evidence = unknown.correct(evidence, y[part])
        rows, s = evidence.rows, self.data.settings
        knee = s.robust_reprojection / s.largest_correlation_factor * np.sqrt(worth.vision)
        evidence = replace(evidence, worth_of_motion=worth.motion)
        return evidence.changed(
            w_visual=worth.vision * self.data.confidence / self._sigma_px**2,
            knee_visual=np.full(len(evidence.times), knee),
            w_sensor=worth.sensors * rows["w_sensor"],
            w_prior=worth.prior * rows["w_prior"],
            w_torso=worth.prior * rows["w_torso"],
        )

    def begin(self) -> None:
        """Solve the fragments as reconstruction does, which tells how large landmarks' errors are, and so
        how large those can be that stay.
        """
        s, data, sizes, lasting = self.data.settings, self.data, list[float](), list[float]()
        for first in self._firsts:
            index, inside, values = data.fragment(first)
            data.problem.bind(values)
            annealing = Annealing(s, data.problem, data.confidence[index], values.observation)
            solved = self._solver.solve(
                data.start[index], s.annealing + s.max_iterations, s.tolerance, None, annealing
            )
            self._states[first] = solved.x, solved.multipliers
            if data.anything_seen(first, inside):
                sizes.append(annealing.sigma)
                lasting.append(annealing.lasting_px)
        self._sigma_px = float(np.median(sizes))
        self.unknowns = tuple(u.limited(float(np.median(lasting))) for u in self.unknowns)
        self.prior = _precision(self.unknowns)

    def settle(self, evidence: Evidence, firsts: Sequence[int] | None = None) -> float:
        """Bring the states of all fragments, or some, to their optimum; the energy there."""
        total, s = 0.0, self.data.settings
        for first in self._firsts if firsts is None else firsts:
            problem = self.bound(evidence, first)
            x, multipliers = self._states[first]
            solved = self._solver.solve(x, _INNER, s.tolerance, multipliers)
            self._states[first] = solved.x, solved.multipliers
            total += problem.total(solved.x)
        return total

    def states(self, first: int) -> Array:
        """(N, 3 + 4A) of the fragment from a frame, as they are by now."""
        return self._states[first][0]

    def bound(self, evidence: Evidence, first: int) -> FragmentEnergy:
        """The problem with a fragment's evidence."""
        problem = self.data.problem
        problem.bind(evidence.fragment(first, self.data.frames))
        return problem

    def _residuals(self, evidence: Evidence) -> Array:
        """(T, L, 2) px."""
        out = np.full((len(evidence.times), len(self.data.names), 2), np.nan)
        for first in self._firsts:
            own = out[first : first + self.data.frames]
            own[:] = self.bound(evidence, first).value(self._states[first][0])[1][: len(own)]
        return out

    # --- unknowns --------------------------------------------------------------------------------

    def profile(self, evidence: Evidence, y: Array) -> tuple[Array, Array]:
        """Hessian (G, G) and gradient (G,) of the data's energy as a function of the unknowns alone."""
        hessian, gradient = np.zeros_like(self.prior), np.zeros(len(y))
        for first in self._firsts:
            problem = self.bound(evidence, first)
            x, multipliers = self._states[first]
            names = self.data.limits.names if self.data.limits else ()
            m = np.zeros((len(x), len(names))) if multipliers is None else multipliers
            slope = self._solver.linearise(x, m)
            border = self.border(evidence, first, x, y)
            C = border.columns.reshape(-1, len(y))
            solved = problem.factorise(_DAMPING).solve_columns(np.column_stack([C, slope.ravel()]))
            hessian += border.corner - C.T @ solved[:, :-1]
            gradient += border.gradient - C.T @ solved[:, -1]
        return (hessian + hessian.T) / 2, gradient

    def border(self, evidence: Evidence, first: int, x: Array, y: Array) -> Border:
        """Of a fragment's Hessian at states x (N, 3 + 4A)."""
        at = Situation(self.data.space, self.data.attached, evidence, first, x)
        changes = [u.changes(at, y[c]) for u, c in zip(self.unknowns, self.columns, strict=True)]
        border = Border(len(x), self.data.space.size, self.columns, changes)
        by, values = border.by_unknowns, evidence.fragment(first, len(x))
        weights, shape, s = values.observation, self.data.problem.energy.shape, self.data.settings
        pixels = at.pixels(weights["w_visual"], weights["knee_visual"])
        image = by("points", pixels.value, at.image_by_point[1]) - by("image", pixels.value)
        border.add(pixels, image)
        turns, by_turn = at.turns(weights["w_sensor"], shape.robust_orientation)
        border.add(turns, by("turns", turns.value, by_turn))
        if shape.feet and weights["w_floor"].any():
            feet = at.feet(weights["w_floor"], shape.floor_cutoff)
            border.add(feet, by("feet", feet.value))
        moves = at.accelerations(values.w_acceleration, s.robust_acceleration)
        rate = evidence.rate_hz
        moved = np.diff(by("sensors", at.sensors), n=2, axis=0) * rate**2
        border.add_differences(moves, moved - by("accelerations", moves.value), 2, rate)
        jerk = at.jerk(values.w_jerk, self.data.problem.sigma_jerk[:3] * evidence.length_scale)
        border.add_differences(jerk, by("jerk", jerk.value), 3, rate)
        return border


def _doubt(
    column: int, found: float, least: float, grid: Array, energies: Array, sigma: float
) -> dict[int, str]:
    """Why a search over ``grid +- sigma`` may have missed what it looked for; empty where it did not."""
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
