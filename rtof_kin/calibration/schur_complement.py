"""Blocks of a fragment's Hessian by states and unknowns, for the Schur complement of the states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtof_kin.calibration.residuals import Changes, Residuals
from rtof_kin.core.array_types import Array


class UnknownsHessian:
    """Sums over the residuals of N frames.

    Attributes:
        columns: (N, D, G) Hessian by states and unknowns. corner: (G, G) by unknowns.
        gradient: (G,) by unknowns at fixed states.
    """

    def __init__(self, frames: int, size: int, parts: Sequence[slice], changes: Sequence[Changes]) -> None:
        """Begin with zeros.

        Args:
            frames: N. size: D. parts, changes: columns and derivatives of every kind of unknown.
        """
        count = parts[-1].stop if parts else 0
        self.columns, self.corner = np.zeros((frames, size, count)), np.zeros((count, count))
        self.gradient = np.zeros(count)
        self._parts, self._changes = parts, changes

    def by_unknowns(self, name: str, like: Array, through: Array | None = None) -> Array:
        """Return derivatives (..., G) of a field of `Changes`, or of a function of it.

        Args:
            name: of the field. like: array (...) of the result's shape.
            through: (..., i, j) derivative of the function by the field.
        """
        out = np.zeros((*like.shape, len(self.gradient)))
        for part, change in zip(self._parts, self._changes, strict=True):
            own = getattr(change, name)
            if own is not None:
                out[..., part] = own if through is None else through @ own
        return out

    def add(self, residuals: Residuals, by_unknowns: Array, order: int = 0, rate_hz: float = 1.0) -> None:
        """Add residuals (N - order, R, i) of differences over time.

        Args:
            residuals: with `by_state` (N, R, i, D) of the differenced quantity.
            by_unknowns: (N - order, R, i, G) their derivatives. order: 0 for single frames. rate_hz: 1/s.
        """
        weighted = residuals.weight[..., None, None] * by_unknowns
        flat = weighted.reshape(-1, len(self.gradient))
        self.corner += flat.T @ by_unknowns.reshape(flat.shape)
        self.gradient += flat.T @ residuals.value.ravel()
        N, size, count = self.columns.shape
        spread = np.zeros((N, *weighted.shape[1:]))
        for k, factor in enumerate(np.diff(np.eye(order + 1), n=order, axis=0)[0]):
            spread[k : k + len(weighted)] += factor * rate_hz**order * weighted
        left = np.swapaxes(residuals.by_state.reshape(N, -1, size), 1, 2)
        self.columns += left @ spread.reshape(N, -1, count)
