"""Energy of one fragment as a function of the unknowns alone, to second order.

The fragment's states x are eliminated by the Schur complement of their Gauss-Newton Hessian::

    Hessian     H - C^T A^-1 C          A banded by x, C by x and y, H by y
    gradient    h - C^T A^-1 g

with C^T A^-1 C = (L^-1 C)^T (L^-1 C) by the factor of A = L L^T.

The work comes in slices, so that a caller with little time per frame makes one slice in each.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np

from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes, Residuals
from rtof_kin.calibration.unknowns import Unknown
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.banded import Factor
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.joint_space.observations import Attached
from rtof_kin.solve.joint_space.state import Limits
from rtof_kin.solve.settings import JointSpaceSettings

_FRAMES = 13  # Frames that are added in one slice
_Result = TypeVar("_Result")
Slices = Generator[None, None, _Result]  # Work that is done piece by piece; the result comes with the end


def finished(slices: Slices[_Result]) -> _Result:
    """Do all slices at once and return the result."""
    while True:
        try:
            next(slices)
        except StopIteration as last:
            result: _Result = last.value
            return result


class UnknownsHessian:
    """Sums over the residuals of N frames.

    Attributes:
        columns: (N, D, G) Hessian by states and unknowns. corner: (G, G) by unknowns.
        gradient: (G,) by unknowns at fixed states.
    """

    def __init__(self, frames: int, size: int, parts: Sequence[slice], changes: Sequence[Changes]) -> None:
        count = parts[-1].stop if parts else 0
        self.columns, self.corner = np.zeros((frames, size, count)), np.zeros((count, count))
        self.gradient = np.zeros(count)
        self._parts, self._changes = parts, changes

    def by_unknowns(self, name: str, like: Array, through: Array | None = None) -> Array:
        """Return derivatives (..., G) of a field of `Changes`, or of a function of it; `like`: array (...) of the
        result's shape; `through`: (..., i, j) derivative of the function by the field.
        """
        out = np.zeros((*like.shape, len(self.gradient)))
        for part, change in zip(self._parts, self._changes, strict=True):
            own = getattr(change, name)
            if own is not None:
                out[..., part] = own if through is None else through @ own
        return out

    def add_in_parts(self, residuals: Residuals, by_unknowns: Array) -> Slices[None]:
        """Add residuals of single frames, some frames in each slice; arguments are those of `add`."""
        for first in range(0, len(by_unknowns), _FRAMES):
            part = slice(first, first + _FRAMES)
            own = Residuals(residuals.value[part], residuals.by_state[part], residuals.weight[part])
            self.add(own, by_unknowns[part], first=first)
            yield

    def add(
        self, residuals: Residuals, by_unknowns: Array, order: int = 0, rate_hz: float = 1.0, first: int = 0
    ) -> None:
        """Add residuals (n - order, R, i) of differences over time, of n frames.

        Args:
            residuals: with `by_state` (n, R, i, D) of the differenced quantity.
            by_unknowns: (n - order, R, i, G) their derivatives. order: 0 for single frames. rate_hz: 1/s.
            first: frame of the fragment that they begin with.
        """
        flat = by_unknowns.reshape(-1, len(self.gradient))
        active = np.flatnonzero(flat.any(axis=0))
        if not len(active):
            return
        by_active = flat[:, active]
        weight = np.broadcast_to(residuals.weight[..., None], residuals.value.shape)
        weighted = weight.reshape(-1, 1) * by_active
        self.corner[np.ix_(active, active)] += weighted.T @ by_active
        self.gradient[active] += weighted.T @ residuals.value.ravel()
        n, size = len(residuals.by_state), self.columns.shape[1]
        frames = weighted.reshape(n - order, -1, len(active))
        spread = np.zeros((n, *frames.shape[1:]))
        for k, factor in enumerate(np.diff(np.eye(order + 1), n=order, axis=0)[0]):
            spread[k : k + len(frames)] += factor * rate_hz**order * frames
        left = np.swapaxes(residuals.by_state.reshape(n, -1, size), 1, 2)
        self.columns[first : first + n, :, active] += left @ spread


_DAMPING: Final = 1e-6
_BLOCK = 24  # Right-hand sides that are solved in one slice


@dataclass(frozen=True)
class ProfiledFragment:
    """A fragment's observations and states, and the problem to evaluate them with."""

    problem: FragmentEnergy  # With the observations bound to it
    limits: Limits | None
    settings: JointSpaceSettings
    observations: CalibrationObservations  # Corrected by the unknowns y
    first: int  # Frame of the observations with which the fragment begins
    x: Array  # (N, 3 + 4A) states
    multipliers: Array | None = None  # (N, M) of the limits

    def linearise(self) -> Array:
        """Return the energy's gradient (N, D) by the states; the problem stores the Hessian."""
        names = self.limits.names if self.limits else ()
        m = np.zeros((len(self.x), len(names))) if self.multipliers is None else self.multipliers
        return LevenbergMarquardt(self.problem, self.limits).linearise(self.x, m)

    def profile(self, unknowns: Sequence[Unknown], columns: Sequence[slice], y: Array) -> Slices[tuple[Array, Array]]:
        """Return Hessian (G, G) and gradient (G,) of the energy at y (G,) as a function of the unknowns alone."""
        slope = self.linearise()
        yield
        factor = self.problem.factorise(_DAMPING)
        yield
        own = yield from self.unknowns_hessian(unknowns, columns, y)
        return (yield from _eliminated(own, slope, factor))

    def unknowns_hessian(
        self, unknowns: Sequence[Unknown], columns: Sequence[slice], y: Array
    ) -> Slices[UnknownsHessian]:
        """Return the blocks of the Hessian by unknowns; arguments are those of `profile`."""
        problem, given, N = self.problem, self.observations, len(self.x)
        energy, s, rate = problem.energy, self.settings, given.rate_hz
        at = CalibrationResiduals(problem.space, Attached.of(energy), given, self.first, self.x)
        changes = [u.changes(at, y[c]) for u, c in zip(unknowns, columns, strict=True)]
        out = UnknownsHessian(N, problem.space.size, columns, changes)
        by, values = out.by_unknowns, given.fragment(self.first, N)
        weights = values.observation
        yield

        def changed(*names: str) -> bool:
            return any(getattr(change, name) is not None for change in changes for name in names)

        if changed("points", "image"):
            pixels = at.pixels(weights["w_visual"], weights["knee_visual"])
            yield
            image = by("points", pixels.value, at.image_by_point[1]) - by("image", pixels.value)
            yield from out.add_in_parts(pixels, image)
        if changed("turns"):
            turns, by_turn = at.turns(weights["w_sensor"], energy["orientation"].robust)
            yield
            yield from out.add_in_parts(turns, by("turns", turns.value, by_turn))
        if changed("feet") and energy["floor"].feet and weights["w_floor"].any():
            feet = at.feet(weights["w_floor"], energy["floor"].cutoff)
            out.add(feet, by("feet", feet.value))
            yield
        if changed("sensors", "accelerations"):
            moves = at.accelerations(values.w_acceleration, s.robust_acceleration)
            moved = np.diff(by("sensors", at.sensors), n=2, axis=0) * rate**2
            yield
            out.add(moves, moved - by("accelerations", moves.value), 2, rate)
            yield
        if changed("jerk"):
            jerk = at.jerk(values.w_jerk, problem.sigma_jerk[:3] * given.length_scale)
            out.add(jerk, by("jerk", jerk.value), 3, rate)
            yield
        return out


def _eliminated(own: UnknownsHessian, slope: Array, factor: Factor) -> Slices[tuple[Array, Array]]:
    G = len(own.gradient)
    right = np.column_stack([own.columns.reshape(-1, G), slope.ravel()])
    half = np.empty_like(right)  # L^-1 of it, where A = L L^T
    coupled = np.zeros((G + 1, G + 1))
    for first in range(0, G + 1, _BLOCK):
        block, done = slice(first, first + _BLOCK), slice(first + _BLOCK)
        half[:, block] = factor.forward_columns(right[:, block])
        coupled[done, block] = half[:, done].T @ half[:, block]
        yield
    coupled = np.triu(coupled) + np.triu(coupled, 1).T
    return own.corner - coupled[:G, :G], own.gradient - coupled[:G, G]
