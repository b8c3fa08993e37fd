"""Statistical parametric mapping (SPM) of a comparison: Student's t along the cycle, with clusters.

The t of B - A at each phase over the strides or repetitions of both, paired or Welch's of two samples, against the
threshold of random field theory (Friston et al., Human Brain Mapping 1, 1994; Pataky, Journal of Biomechanics 43,
2010), computed by the package ``spm1d``. The level of each angle is that of the comparison over the number of angles
(Bonferroni), so that the chance of even one cluster anywhere is at most `LEVEL` if A and B do not differ.

The test knows the spread between repeats alone. Errors that last through a recording shift all of its repeats
and make clusters; `SpmCluster.beyond_bands` says where the difference exceeds the 95 % band of B - A.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy

from rtof_kin.clinical.comparison import AngleComparison, Comparison
from rtof_kin.clinical.comparison_change import LEVEL
from rtof_kin.clinical.comparison_samples import Pair
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.packages import optional
from rtof_kin.data.confidence import BAND_95

FEWEST: Final = 3  #: Repeats of each motion that a test needs
_NO_SPREAD: Final = 1e-9  # [rad] standard deviation that is rounding


@dataclass(frozen=True)
class SpmCluster:
    """Consecutive phases in which |t| exceeds the threshold."""

    start: float  #: Share of the cycle
    stop: float
    p: float  #: Chance of a cluster as wide or wider without a difference, of this angle alone
    sign: int  #: 1 where B is larger, -1 where A is
    beyond_bands: bool | None  #: Whether the difference exceeds the band of B - A somewhere inside; None without bands


@dataclass(frozen=True)
class AngleSpm:
    """SPM{t} of one angle."""

    name: str
    t: Array  #: (P,) at the phases
    dof: float
    threshold: float  #: |t| beyond which a cluster begins, at the level of this angle
    paired: bool
    repeats: tuple[int, int]
    clusters: tuple[SpmCluster, ...]


@dataclass(frozen=True)
class ComparisonSpm:
    """SPM of all angles of a comparison."""

    angles: tuple[AngleSpm, ...]
    not_tested: dict[str, str]  #: Angle -> why it has no test
    level: float  #: Of each angle
    phases: Array  #: (P,) share of the cycle


def compare_spm(found: Comparison) -> ComparisonSpm:
    """Return the SPM of a comparison by cycle or repetition. `InvalidInputError`: its axis has no repeats;
    `MissingPackageError`: spm1d is not installed.
    """
    if found.by not in ("cycle", "repetition") or found.axis is None:
        raise InvalidInputError(
            f"compare --spm: needs strides or repetitions, and this comparison is by {found.by}; give --by "
            "cycle or --by repetition"
        )
    left_out = {one.name: reason for one in found.angles if (reason := _untestable(one))}
    tested = [one for one in found.angles if one.name not in left_out]
    level = LEVEL / max(1, len(tested))
    return ComparisonSpm(tuple(_tested(one, level) for one in tested), left_out, level, found.axis)


def _untestable(one: AngleComparison) -> str:
    """Why an angle has no test; '' if it has."""
    if min(one.repeats) < FEWEST:
        return f"{one.repeats[0]} and {one.repeats[1]} repeats; {FEWEST} of each are needed"
    pair = one.pair()
    a, b = pair.a.values, pair.b.values
    spreads = (b - a,) if pair.paired else (a, b)
    if min(float(own.std(axis=0, ddof=1).min()) for own in spreads) < _NO_SPREAD:
        return "all repeats have the same value"
    return ""


def _tested(one: AngleComparison, level: float) -> AngleSpm:
    spm1d = optional("spm1d", "clinical", "statistical parametric mapping")
    pair = one.pair()
    a, b = pair.a.values, pair.b.values
    field = spm1d.stats.ttest_paired(b, a) if pair.paired else _welch(spm1d, a, b)
    inference = field.inference(alpha=level, two_tailed=True, interp=True)
    last = a.shape[1] - 1
    clusters = []
    for cluster in inference.clusters:
        start, stop = (float(end) / last for end in cluster.endpoints)
        beyond = _beyond(pair, start, stop)
        clusters.append(SpmCluster(start, stop, float(cluster.P), int(cluster.csign), beyond))
    return AngleSpm(
        one.name,
        np.asarray(field.z, dtype=float),
        float(field.df[1]),
        float(inference.zstar),
        pair.paired,
        one.repeats,
        tuple(clusters),
    )


def _welch(spm1d: Any, a: Array, b: Array) -> Any:
    """Field of Welch's t, with the median of its degrees of freedom.

    The statistic of spm1d pools the variances whatever its option: of 20 strides and 8 with three times the
    spread, a quarter had a false cluster.
    """
    field = spm1d.stats.ttest2(b, a, equal_var=True)
    found = scipy.stats.ttest_ind(b, a, axis=0, equal_var=False)
    field.z, field.df = np.asarray(found.statistic), (1, float(np.median(found.df)))
    return field


def _beyond(pair: Pair, start: float, stop: float) -> bool | None:
    """Whether B - A exceeds its band of lasting errors between two phases; None without bands."""
    bands = [own.sigma.mean(axis=0) ** 2 for own in (pair.a, pair.b) if own.sigma is not None]
    if not bands:
        return None
    a, b = pair.a.curve, pair.b.curve
    phases = np.linspace(0, 1, len(a))
    inside = (phases >= start - 1e-9) & (phases <= stop + 1e-9)
    if not inside.any():  # between two phases
        inside = np.isin(np.arange(len(a)), [np.abs(phases - (start + stop) / 2).argmin()])
    return bool(np.any(np.abs(b - a)[inside] > BAND_95 * np.sqrt(np.sum(bands, axis=0))[inside]))
