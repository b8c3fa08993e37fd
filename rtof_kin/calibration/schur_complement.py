"""What borders a fragment's Hessian: residuals' derivatives by states against those by unknowns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtof_kin.calibration.residuals import Changes, Residuals

Array = NDArray[np.float64]


class Border:
    """Sums over the residuals of N frames.

    Attributes:
        columns: (N, D, G) of the Hessian, by states and unknowns. corner: (G, G) of the unknowns.
        gradient: (G,) by the unknowns at fixed states.
    """

    def __init__(self, frames: int, size: int, parts: Sequence[slice], changes: Sequence[Changes]) -> None:
        """Nothing yet.

        Args:
            size: D. parts, changes: columns of every kind of unknown, and what it changes.
        """
        count = parts[-1].stop if parts else 0
        self.columns, self.corner = np.zeros((frames, size, count)), np.zeros((count, count))
        self.gradient = np.zeros(count)
        self._parts, self._changes = parts, changes

    def by_unknowns(self, name: str, like: Array, through: Array | None = None) -> Array:
        """(..., G) derivatives of what a field of `Changes` names, of the shape of `like` (...).

        Args:
            through: (..., i, j) derivative by it of what is asked for, where that is something else.
        """
        out = np.zeros((*like.shape, len(self.gradient)))
        for part, change in zip(self._parts, self._changes, strict=True):
            own = getattr(change, name)
            if own is not None:
                out[..., part] = own if through is None else through @ own
        return out

    def add(self, residuals: Residuals, by_unknowns: Array) -> None:
        """Residuals of single frames, with their derivatives (N, R, i, G)."""
        weighted = residuals.weight[..., None, None] * by_unknowns
        self._count(residuals.value, weighted, by_unknowns)
        self._spread(residuals.by_state, weighted)

    def add_differences(self, residuals: Residuals, by_unknowns: Array, order: int, rate_hz: float) -> None:
        """Residuals (N - order, R, i) of differences over time: `by_state` (N, R, i, D) is that of what
        they are taken of.
        """
        weighted = residuals.weight[..., None, None] * by_unknowns
        self._count(residuals.value, weighted, by_unknowns)
        spread = np.zeros((len(weighted) + order, *weighted.shape[1:]))
        for k, factor in enumerate(np.diff(np.eye(order + 1), n=order, axis=0)[0]):
            spread[k : k + len(weighted)] += factor * rate_hz**order * weighted
        self._spread(residuals.by_state, spread)

    def _count(self, value: Array, weighted: Array, by_unknowns: Array) -> None:
        flat = weighted.reshape(-1, len(self.gradient))
        self.corner += flat.T @ by_unknowns.reshape(flat.shape)
        self.gradient += flat.T @ value.ravel()

    def _spread(self, by_state: Array, weighted: Array) -> None:
        N, size, count = self.columns.shape
        left = np.swapaxes(by_state.reshape(N, -1, size), 1, 2)
        self.columns += left @ weighted.reshape(N, -1, count)
