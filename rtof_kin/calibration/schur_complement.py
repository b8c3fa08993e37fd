"""Blocks of a fragment's Hessian by states and unknowns, for the Schur complement of the states."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Final, TypeVar

import numpy as np

from rtof_kin.calibration.residuals import Changes, Residuals
from rtof_kin.core.array_types import Array

_FRAMES: Final = 13
"""Frames that are added in one slice."""
_Result = TypeVar("_Result")
Slices = Generator[None, None, _Result]
"""Work that is done piece by piece; the result comes with the end."""


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
        """Begin with zeros."""
        count = parts[-1].stop if parts else 0
        self.columns, self.corner = np.zeros((frames, size, count)), np.zeros((count, count))
        self.gradient = np.zeros(count)
        self._parts, self._changes = parts, changes

    def by_unknowns(self, name: str, like: Array, through: Array | None = None) -> Array:
        """Return derivatives (..., G) of a field of `Changes`, or of a function of it.

        Args:
            like: array (...) of the result's shape. through: (..., i, j) derivative of the function by the field.
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
