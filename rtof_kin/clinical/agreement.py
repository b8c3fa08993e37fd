"""Agreement of estimates with references, and reliability of repeated measures, as validation studies report them.

==============  ===============================================================================================
nrmse           RMSE of a curve over the range of its reference, mean over curves
cmc             coefficient of multiple correlation of waveforms measured at the same time (Ferrari et al., Gait &
                Posture 31, 2010): two systems, pooled over curves; offsets count; not a number where the systems
                differ more than the curves move
range error     difference of the ranges of motion of a curve
limits          limits of agreement, bias -+ 1.96 s, s^2 the variance within people plus that between them (Bland and
                Altman, Journal of Biopharmaceutical Statistics 17, 2007); none of a single known person
ICC(2,1), (3,1)  intraclass correlations of single measures: two-way random, absolute agreement, and two-way mixed,
                consistency (Shrout and Fleiss, Psychological Bulletin 86, 1979), by the package ``pingouin``
SEM, MDC        root of the error mean square of the same analysis; 1.96 sqrt(2) SEM (Weir, Journal of Strength and
                Conditioning Research 19, 2005)
==============  ===============================================================================================
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.packages import optional
from rtof_kin.data.confidence import BAND_95

FEWEST: Final = 5  #: People without whom there is no intraclass correlation
_NAN: Final = float("nan")
_STILL: Final = 1e-9  # [rad] range of a curve that does not move


class Curve(NamedTuple):
    """Common samples of one angle in one trial, known throughout."""

    group: str  #: Person; '' where people are not known
    reference: Array  #: (n,) rad
    difference: Array  #: (n,) rad, estimate - reference


class Agreement(NamedTuple):
    """Agreement of curves, rad; NaN where a value cannot be computed."""

    nrmse: float = _NAN  #: Share of the range of the reference
    cmc: float = _NAN
    range_error: float = _NAN  #: Mean size of the difference of ranges of motion
    bias: float = _NAN  #: Of the angle, with limits over samples
    limit_low: float = _NAN
    limit_high: float = _NAN
    range_bias: float = _NAN  #: Of the range of motion, with limits over curves
    range_limit_low: float = _NAN
    range_limit_high: float = _NAN

    @property
    def figures(self) -> dict[str, float]:
        """Values by names with units, angles in degrees."""
        angles = list(self._asdict().items())[2:]
        return {"nrmse_share": self.nrmse, "cmc": self.cmc} | {f"{k}_deg": float(np.degrees(v)) for k, v in angles}


NO_AGREEMENT: Final = Agreement()


def agreement_of(curves: Sequence[Curve]) -> Agreement:
    """Return the agreement of curves, pooled; that without values for none."""
    if not curves:
        return NO_AGREEMENT
    ranges = np.array([[np.ptp(one.reference), np.ptp(one.reference + one.difference)] for one in curves])
    rmse = np.array([np.sqrt(np.mean(one.difference**2)) for one in curves])
    errors = ranges[:, 1] - ranges[:, 0]
    groups = list(dict.fromkeys(one.group for one in curves))
    own = [[k for k, one in enumerate(curves) if one.group == group] for group in groups]
    parts = [[np.concatenate([curves[k].difference for k in index]) for index in own], [errors[index] for index in own]]
    limits = [limits_of_agreement(part) for part in parts]
    if len(groups) == 1 and groups[0]:  # the variance between people is not known
        limits = [(bias, _NAN, _NAN) for bias, _, _ in limits]
    return Agreement(
        float(np.mean(rmse / ranges[:, 0])) if ranges[:, 0].min() > _STILL else _NAN,
        multiple_correlation([(one.reference, one.reference + one.difference) for one in curves]),
        float(np.mean(np.abs(errors))),
        *limits[0],
        *limits[1],
    )


def multiple_correlation(pairs: Iterable[tuple[Array, Array]]) -> float:
    """Return the coefficient of pairs of curves (F,), in one unit; NaN where it is imaginary."""
    within = total = frames = curves = 0.0
    for a, b in pairs:
        both = np.stack([a, b])
        within += float(np.sum((both - both.mean(axis=0)) ** 2))
        total += float(np.sum((both - both.mean()) ** 2))
        frames, curves = frames + len(a), curves + 1
    if not total > 0:
        return _NAN
    share = 1 - (within / frames) / (total / (2 * frames - curves))
    return float(np.sqrt(share)) if share >= 0 else _NAN


def limits_of_agreement(groups: Iterable[Array]) -> tuple[float, float, float]:
    """Return bias, lower and upper limit of differences (n,) by group; of one group, by its own spread alone."""
    own = [one for one in groups if len(one)]
    d = np.concatenate(own)
    n, bias = len(d), float(np.mean(d))
    if n < 2:
        return bias, _NAN, _NAN
    variance = float(np.var(d, ddof=1))
    if 1 < len(own) < n:
        sizes = np.array([len(one) for one in own])
        means = np.array([one.mean() for one in own])
        within = sum(float(np.sum((one - one.mean()) ** 2)) for one in own) / (n - len(own))
        between = float(np.sum(sizes * (means - bias) ** 2)) / (len(own) - 1)
        repeats = (n - float(np.sum(sizes**2)) / n) / (len(own) - 1)
        variance = within + max(0.0, between - within) / repeats
    half = BAND_95 * float(np.sqrt(variance))
    return bias, bias - half, bias + half


class Reliability(NamedTuple):
    """Reliability of a measure of people between raters or sessions; NaN where it is not computed."""

    people: int  #: With all repeats
    icc: float = _NAN
    low: float = _NAN  #: Lower end of the 95 % interval
    high: float = _NAN
    sem: float = _NAN  #: In the unit of the measure
    why_not: str = ""  #: Phrase on why there is no value


def reliability(values: Array, kind: Literal["ICC(2,1)", "ICC(3,1)"]) -> Reliability:
    """Return the reliability of a measure (N, k) of N people, k times; people with a NaN do not count.

    Raises:
        MissingPackageError: pingouin is not installed.
    """
    known = values[np.isfinite(values).all(axis=1)]
    people, repeats = known.shape
    if repeats < 2 or people < FEWEST:
        why = f"{people} people with all {repeats}; {FEWEST} are needed" if repeats > 1 else "one alone"
        return Reliability(people, why_not=why)
    if np.ptp(known) < _STILL:
        return Reliability(people, why_not="everyone has the same value")
    pingouin = optional("pingouin", "clinical", "an intraclass correlation")
    pandas = optional("pandas", "clinical", "an intraclass correlation")
    person, repeat = np.indices(known.shape)
    table = pandas.DataFrame({"person": person.ravel(), "repeat": repeat.ravel(), "value": known.ravel()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pandas, about calls of pingouin
        found = pingouin.intraclass_corr(table, targets="person", raters="repeat", ratings="value")
    row = found.iloc[int(kind[4]) - 1]  # whose names differ between versions; their order does not
    low, high = np.asarray(row.filter(like="CI95").iloc[0], dtype=float)
    rest = known - known.mean(axis=1, keepdims=True) - known.mean(axis=0) + known.mean()
    sem = float(np.sqrt(np.sum(rest**2) / ((people - 1) * (repeats - 1))))
    return Reliability(people, float(row["ICC"]), float(low), float(high), sem)
