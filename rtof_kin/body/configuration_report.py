"""Singular postures and limit violations of a skeleton's configurations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.core.array_types import Array, Mask


@dataclass(frozen=True)
class ConfigurationReport:
    """Singular postures and limit violations of configurations, which are never clipped."""

    singular: Mask
    """(T, J) True if a ball joint is within 5 degrees of a singular posture."""
    limit_excess: Array
    """(T, D) excess of each revolute beyond its limits, rad; 0 inside."""
    dof_names: tuple[str, ...]
    """Names of the D revolutes."""

    @property
    def violations(self) -> dict[str, float]:
        """Largest excess, rad, of each revolute that violates its limits."""
        worst = np.nanmax(self.limit_excess, axis=0, initial=0)
        return {n: float(w) for n, w in zip(self.dof_names, worst, strict=True) if w > 0}
