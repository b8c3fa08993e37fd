"""Error whose variance is partly known and partly estimated from few repeats.

The error of a difference is e ~ N(0, K + v). K is known (stated bands); v is estimated by s^2 with nu
degrees of freedom, nu s^2 / v ~ chi^2_nu (repeats). The two-sided p-value of a difference d averages the
normal one over what s^2 leaves open of v:

::

    p(d) = E[2 Phi(-|d| / sqrt(K + nu s^2 / x))],   x ~ chi^2_nu

This is Student's t for K = 0 and the normal for s = 0; between them it is the distribution of Behrens and
Fisher (Fisher, Annals of Eugenics 6, 1935) with one of the variances known. Its false positives never
exceed the level (tests/clinical/test_mixed_error.py). Degrees of freedom by Satterthwaite do not keep small
levels, at which multiple tests are decided: with nu = 2 and K = 0.1 v there are 16 times too many at 0.1 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy import optimize, special, stats

from rtof_kin.core.array_types import Array

_NODES: Final = 150  # of the average, evenly spaced in log x
_TAIL: Final = 1e-13  # probability left out at either end


@dataclass(frozen=True)
class MixedError:
    """Normal error with mean 0."""

    known: float = 0.0
    """Known variance, unit^2."""
    estimated: float = 0.0
    """Estimated variance, unit^2."""
    dof: float = np.inf
    """Degrees of freedom of `estimated`."""

    @property
    def sigma(self) -> float:
        """Standard deviation, estimated."""
        return float(np.sqrt(self.known + self.estimated))

    @property
    def effective_dof(self) -> float:
        """Degrees of freedom of the whole variance by Satterthwaite; infinite if nothing is estimated."""
        return self.dof * ((self.known + self.estimated) / self.estimated) ** 2 if self.estimated else np.inf

    def p(self, difference: float) -> float:
        """Return the two-sided p-value of a difference.

        Args:
            difference: in the unit of the error.
        """
        if not np.isfinite(self.dof) or not self.estimated:
            return float(special.erfc(abs(difference) / self.sigma / np.sqrt(2)))
        chi2, weights = _average(self.dof)
        sigmas = np.sqrt(self.known + self.estimated * self.dof / chi2)
        return float(weights @ special.erfc(abs(difference) / sigmas / np.sqrt(2)))

    def half_width(self, level: float) -> float:
        """Return the difference whose p-value is a level; NaN if the error is unknown.

        Args:
            level: two-sided, e.g. 0.05 for half of a 95 % interval.
        """
        return _half_width(self, level)


@lru_cache(maxsize=4096)
def _half_width(error: MixedError, level: float) -> float:
    if not error.sigma > 0:
        return float("nan")
    z = stats.norm.isf(level / 2)
    if not np.isfinite(error.dof) or not error.estimated:
        return float(z * error.sigma)
    most = z * np.sqrt(error.known) + stats.t.isf(level / 2, error.dof) * np.sqrt(error.estimated)
    return float(optimize.brentq(lambda h: error.p(h) - level, 0.0, 1.01 * most, rtol=1e-8))


@lru_cache(maxsize=256)
def _average(dof: float) -> tuple[Array, Array]:
    """Nodes and weights of the mean over chi^2."""
    chi2 = np.geomspace(float(stats.chi2.ppf(_TAIL, dof)), float(stats.chi2.isf(_TAIL, dof)), _NODES)
    weights = stats.chi2.pdf(chi2, dof) * chi2
    return chi2, weights / weights.sum()
