"""Agreement of estimates with references, and reliability of repeated measures, as validation studies report them.

CMC: coefficient of multiple correlation of curves measured together (Ferrari et al., Gait & Posture 31, 2010). Limits
of agreement: bias -+ 1.96 s, s^2 the variance within people plus that between them (Bland and Altman, J Biopharm Stat
17, 2007). ICC(2,1), absolute agreement, and ICC(3,1), consistency (Shrout and Fleiss, Psychol Bull 86, 1979). SEM: root
of the error mean square (Weir, J Strength Cond Res 19, 2005).
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


def agreement_of(curves: Sequence[tuple[str, Array, Array]]) -> Agreement:
    """Return the agreement of curves, pooled; that without values for none.

    Args:
        curves: person, '' where people are not known; reference (n,) and difference (n,), estimate - reference, rad.
    """
    if not curves:
        return NO_AGREEMENT
    ranges = np.array([(np.ptp(reference), np.ptp(reference + difference)) for _, reference, difference in curves])
    rmse = np.array([np.sqrt(np.mean(difference**2)) for _, _, difference in curves])
    errors = ranges[:, 1] - ranges[:, 0]
    groups = list(dict.fromkeys(group for group, _, _ in curves))
    own = [[k for k, one in enumerate(curves) if one[0] == group] for group in groups]
    limits = [
        limits_of_agreement([np.concatenate([curves[k][2] for k in index]) for index in own]),
        limits_of_agreement([errors[index] for index in own]),
    ]
    if len(groups) == 1 and groups[0]:  # the variance between people is not known
        limits = [(bias, _NAN, _NAN) for bias, _, _ in limits]
    return Agreement(
        float(np.mean(rmse / ranges[:, 0])) if ranges[:, 0].min() > _STILL else _NAN,
        multiple_correlation((reference, reference + difference) for _, reference, difference in curves),
        float(np.mean(np.abs(errors))),
        *limits[0],
        *limits[1],
    )


def multiple_correlation(pairs: Iterable[tuple[Array, Array]]) -> float:
    """Return the coefficient of pairs of curves (F,), in one unit; NaN where it is imaginary."""
    count, frames, within, total = 0, 0, 0.0, 0.0
    for both in map(np.stack, pairs):
        count, frames = count + 1, frames + both.shape[1]
        within += float(np.sum((both - both.mean(axis=0)) ** 2))
        total += float(np.sum((both - both.mean()) ** 2))
    within, total = within / frames, total / (2 * frames - count)
    return float(np.sqrt(1 - within / total)) if total > 0 and within <= total else _NAN


def limits_of_agreement(own: Sequence[Array]) -> tuple[float, float, float]:
    """Return bias, lower and upper limit of differences (n,) by group, n > 0; of one group, by its own spread alone."""
    d = np.concatenate(own) if len(own) > 1 else own[0]
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
    `MissingPackageError`: pingouin is not installed.
    """
    known = values[np.isfinite(values).all(axis=1)]
    people, repeats = known.shape
    if repeats < 2 or people < FEWEST:
        why = f"{people} people with all {repeats}; {FEWEST} are needed" if repeats > 1 else "no second one"
        return Reliability(people, why_not=f"{kind}: {why}")
    if np.ptp(known) < _STILL:
        return Reliability(people, why_not=f"{kind}: everyone has the same value")
    pingouin, pandas = (optional(name, "clinical", "an intraclass correlation") for name in ("pingouin", "pandas"))
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
