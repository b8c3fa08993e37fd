"""One constant shift between the clocks of two motions, from the agreement of their angular velocities.

The agreement at a shift is the correlation of the velocities of all common angles together

::

    r(shift) = sum v_A(t) v_B(t - shift) / sqrt(sum v_A(t)^2  sum v_B(t - shift)^2)

over the instants and angles that both have, low-passed. It is 1 for equal movements, whatever the offsets of
the angles, and around 0 for unrelated ones. The standard deviation of the best shift is that of a jackknife
over the angles (Efron and Stein, Annals of Statistics 9, 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import fftconvolve

from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.comparison_samples import usable
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError

GRID_HZ: Final = 50.0
"""Sampling rate of the velocities that are compared."""
CUTOFF_HZ: Final = 4.0
"""Low-pass of the velocities."""
POOR: Final = 0.5
"""Agreement below which two motions hardly agree."""
AMBIGUOUS: Final = 0.9
"""Agreement of the second best shift, as a share of the best, from which on the shift is ambiguous."""
_LEAST_OVERLAP: Final = 1.0  # [s] of a shift that is considered
_LEAST_SHARE: Final = 0.3  # of the shorter motion that overlaps at such a shift
_SHORTEST: Final = 8  # samples of a stretch that is differentiated


@dataclass(frozen=True)
class Alignment:
    """Shift of motion B onto the clock of A."""

    shift: float
    """[s] added to the times of B."""
    sigma: float
    """[s] standard deviation, by a jackknife over the angles; NaN for fewer than three angles."""
    agreement: float
    """r at the shift."""
    rival: float
    """[s] second best shift; NaN if there is none."""
    rival_agreement: float
    """r at that; NaN if there is none."""
    unshifted: float
    """r without a shift; NaN if the time spans hardly overlap."""

    @property
    def poor(self) -> bool:
        """Whether the motions hardly agree even so, e.g. because they are different movements."""
        return not self.agreement >= POOR

    @property
    def ambiguous(self) -> bool:
        """Whether another shift is nearly as good, as in periodic movement."""
        return bool(self.rival_agreement >= AMBIGUOUS * self.agreement)


def align(a: ClinicalAngles, b: ClinicalAngles, names: Sequence[str], reach: float = float("inf")) -> Alignment:
    """Estimate the shift with the best agreement, to a fraction of a frame.

    Args:
        reach: s, largest shift that is considered.

    Raises:
        InvalidInputError: there is no common angle, or too few samples to compare velocities.
    """
    start_a, first = _velocities(a, names)
    start_b, second = _velocities(b, names)
    products, energies_a, energies_b = _correlations(first, second)
    lags = np.arange(-(len(second) - 1), len(first))
    shifts = lags / GRID_HZ + (start_a - start_b)
    overlap = np.minimum(len(first), lags + len(second)) - np.maximum(lags, 0)
    shorter = min(len(first), len(second))
    least = min(max(_LEAST_OVERLAP * GRID_HZ, _LEAST_SHARE * shorter), shorter)
    allowed = (overlap >= least) & (np.abs(shifts) <= reach)

    def agreement(chosen: Array) -> Array:
        """R of all shifts from some of the angles."""
        size = np.sqrt(np.maximum(chosen @ energies_a, 0) * np.maximum(chosen @ energies_b, 0))
        r = np.divide(chosen @ products, size, out=np.zeros(len(lags)), where=size > 1e-9)
        return np.where(allowed, r, -np.inf)

    every = np.ones(len(names))
    r = agreement(every)
    if not r.max() > 0:
        raise InvalidInputError("align: the motions have no common angle that moves; name others (--angles)")
    scan = OffsetScan(shifts, r, apart=0.0)
    here = int(np.abs(shifts).argmin())
    zero = float(r[here]) if allowed[here] and abs(shifts[here]) <= 1 / GRID_HZ else float("nan")
    without = [agreement(every - one) for one in np.eye(len(names))]
    (rival, rival_agreement), known = scan.rival, scan.rival[1] > 0
    return Alignment(
        scan.best,
        _jackknife(shifts, without, scan.peak),
        scan.gain,
        rival if known else float("nan"),
        rival_agreement if known else float("nan"),
        zero,
    )


def _velocities(angles: ClinicalAngles, names: Sequence[str]) -> tuple[float, Array]:
    """Time of the first sample, s, and velocities (T, A) rad/s at `GRID_HZ`; 0 where unknown."""
    values = usable(angles.select(names))[0]
    count = int((angles.times[-1] - angles.times[0]) * GRID_HZ) + 1
    times = angles.times[0] + np.arange(count) / GRID_HZ
    grid = signals.interpolate(angles.times, values, times, 1.5 / angles.rate_hz)
    out = np.zeros_like(grid)
    for column in range(grid.shape[1]):
        for start, stop in signals.runs(np.isfinite(grid[:, column])):
            if stop - start >= _SHORTEST:
                smooth = signals.low_pass(grid[start:stop, column], GRID_HZ, CUTOFF_HZ)
                out[start:stop, column] = np.gradient(smooth) * GRID_HZ
    return float(times[0]), out


def _correlations(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Sums (A, L) over the overlap at every lag: v_A v_B, v_A^2 and v_B^2 where the other is known."""
    reverse = b[::-1]

    def total(x: Array, y: Array) -> Array:
        return np.asarray(fftconvolve(x, y, axes=0).T)

    known_a, known_b = (a != 0).astype(float), (reverse != 0).astype(float)
    return total(a, reverse), total(a**2, known_b), total(known_a, reverse**2)


def _jackknife(shifts: Array, agreements: Sequence[Array], best: int) -> float:
    """Standard deviation, s, of the peak near the best one, over the angles left out one by one."""
    if len(agreements) < 3:
        return float("nan")
    near = slice(max(0, best - int(GRID_HZ / 4)), best + int(GRID_HZ / 4) + 1)
    peaks = [OffsetScan(shifts[near], r[near]).best for r in agreements]
    n = len(peaks)
    return float(np.sqrt((n - 1) / n * np.sum((np.array(peaks) - np.mean(peaks)) ** 2)))
