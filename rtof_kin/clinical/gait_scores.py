"""Gait Variable Scores (GVS), Movement Analysis Profile (MAP) and Gait Profile Score (GPS), with bands.

Baker et al., Gait & Posture 30 (2009) and 35 (2012). With the difference d of a person's mean curve from the
mean of the reference, at P = 51 instants of the gait cycle of one side::

    GVS_v = sqrt(mean over the cycle of d_v^2)        GPS = sqrt(mean over variables of GVS_v^2)

over the nine variables of a side; the overall GPS over fifteen, the nine of the left side and the six of the
right that are not of the pelvis, which is one for both.

**Noise bias.** With errors e of mean 0 and standard deviation s, whatever their correlation,

    E[GVS_observed^2] = GVS^2 + mean of s^2

so a score of noisy curves is too large. `Score.noise` is the root of that second term, and `Score.corrected`
the root of the difference. The value itself is not corrected: it is what the definition says.

**Band.** All of d are one vector, and by the triangle inequality observed and true score differ by at most
the root mean square of e. Of all Gaussian e with the same mean of s^2, one that lasts (of rank one) most often exceeds
a limit beyond 1.24 of its root (Szekely and Bakirov, Probability Theory and Related Fields 126, 2003). So

    |score_observed - score| <= 1.96 sqrt(mean of s^2)

in at least 95 of 100 cases, for errors that are independent from frame to frame as for those that last
through the whole recording, are shared by several angles, or anything between. Strides do not average errors
out. The mean over n strides has its own variance v / n, which is added to s^2: to the bias as it is, to the
band times the ratio of Student's to the normal quantile squared, as v is estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_variables import GaitCycles
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.gait_reference import NAMES, GaitReference

PELVIS: Final = 3
"""Variables of the pelvis, the first of `VARIABLES`."""


@dataclass(frozen=True)
class Score:
    """A root mean square difference from the reference, rad; NaN where it is not computed."""

    value: float
    pose_sigma: float
    """Root of the mean variance of the curves by the covariances of the poses; NaN if these are unknown."""
    stride_sigma: float
    """The same by the number of strides and their spread; NaN for one stride."""
    stride_bound: float
    """The same widened by Student's quantile, as the spread is estimated."""
    spread: float
    """Standard deviation of the score between strides; NaN for fewer than two."""
    strides: int

    @property
    def noise(self) -> float:
        """Root of the expected excess of the squared score."""
        return float(np.sqrt(np.nansum([self.pose_sigma**2, self.stride_sigma**2])))

    @property
    def half_width(self) -> float:
        """Half width of the 95 % band, from what is known of the errors."""
        return BAND_95 * float(np.sqrt(np.nansum([self.pose_sigma**2, self.stride_bound**2])))

    @property
    def low(self) -> float:
        """Lower end of the 95 % band."""
        return max(0.0, self.value - self.half_width) if np.isfinite(self.value) else float("nan")

    @property
    def high(self) -> float:
        """Upper end of the 95 % band."""
        return self.value + self.half_width

    @property
    def corrected(self) -> float:
        """Value without the noise that is expected in it."""
        return float(np.sqrt(max(0.0, self.value**2 - self.noise**2)))


_NAN: Final = float("nan")
NOT_COMPUTED: Final = Score(_NAN, _NAN, _NAN, _NAN, _NAN, 0)


@dataclass(frozen=True)
class SideCurves:
    """Mean curves of one side, and their uncertainty."""

    mean: Array
    """(9, 51) rad; NaN for a variable without a complete stride."""
    pose_variance: Array
    """(9, 51) rad^2, by the covariances; NaN if unknown."""
    stride_variance: Array
    """(9, 51) rad^2, of a mean over these strides; NaN for a single one."""
    stride_bound: Array
    """(9, 51) rad^2, the same times the ratio of Student's to the normal quantile squared."""
    strides: Array
    """(n, 9, 51) rad, of the single strides."""


@dataclass(frozen=True)
class GaitScores:
    """All scores of a motion."""

    profile: Mapping[str, tuple[Score, ...]]
    """Side -> nine scores in the order of `VARIABLES`: the Movement Analysis Profile."""
    sides: Mapping[str, Score]
    """Side -> Gait Profile Score."""
    overall: Score
    missing: Mapping[str, Mapping[str, str]]
    """Side -> variables without a score -> what they need."""
    curves: Mapping[str, SideCurves]
    has_bands: bool
    """Whether the motion has covariances."""


def gait_scores(cycles: GaitCycles, reference: GaitReference) -> GaitScores:
    """Return the scores of a motion against a reference."""
    curves = {side: side_curves(cycles, side) for side in SIDES}
    profile, missing = {}, {}
    for side in SIDES:
        profile[side] = tuple(_score(curves[side], reference.mean, [v]) for v in range(len(NAMES)))
        absent = dict.fromkeys(reference.missing, "to be in the reference")
        missing[side] = cycles.missing(side) | absent
    every = range(len(NAMES))
    sides = {side: _score(curves[side], reference.mean, every) for side in SIDES}
    overall = _overall(curves, reference.mean)
    return GaitScores(profile, sides, overall, missing, curves, cycles.sigma is not None)


def side_curves(cycles: GaitCycles, side: str) -> SideCurves:
    """Return the mean curves of one side with their variances."""
    known = cycles.complete(side)
    own = np.where(known[..., None], cycles.curves, np.nan)[known.any(axis=1)]
    mean, pose, strides, bound = (np.full(cycles.curves.shape[1:], np.nan) for _ in range(4))
    for v in range(len(NAMES)):
        rows = cycles.curves[known[:, v], v]
        if not (n := len(rows)):
            continue
        mean[v] = rows.mean(axis=0)
        if cycles.sigma is not None:  # errors last: strides do not make them smaller
            pose[v] = cycles.sigma[known[:, v], v].mean(axis=0) ** 2
        if n > 1:
            strides[v] = rows.var(axis=0, ddof=1) / n
            bound[v] = (stats.t.ppf(0.975, n - 1) / BAND_95) ** 2 * strides[v]
    return SideCurves(mean, pose, strides, bound, own)


def _score(curves: SideCurves, reference: Array, variables: Sequence[int]) -> Score:
    """Root mean square over some variables of one side."""
    index = list(variables)
    value = _rms(curves.mean[index] - reference[index])
    if np.isnan(value):
        return NOT_COMPUTED
    single = [_rms(own[index] - reference[index]) for own in curves.strides]
    single = [one for one in single if np.isfinite(one)]
    spread = float(np.std(single, ddof=1)) if len(single) > 1 else float("nan")
    variances = (curves.pose_variance, curves.stride_variance, curves.stride_bound)
    pose, stride, bound = (_root(one[index]) for one in variances)
    return Score(value, pose, stride, bound, spread, len(single))


def _overall(curves: Mapping[str, SideCurves], reference: Array) -> Score:
    """Over the nine variables of the left side and the six of the right that are not of the pelvis."""

    def stacked(field: str) -> Array:
        return np.concatenate([getattr(curves["left"], field), getattr(curves["right"], field)[PELVIS:]])

    value = _rms(stacked("mean") - np.concatenate([reference, reference[PELVIS:]]))
    if np.isnan(value):
        return NOT_COMPUTED
    strides = sum(len(own.strides) for own in curves.values())
    names = ("pose_variance", "stride_variance", "stride_bound")
    pose, stride, bound = (_root(stacked(name)) for name in names)
    return Score(value, pose, stride, bound, float("nan"), strides)


def _rms(differences: Array) -> float:
    return float(np.sqrt(np.mean(differences**2)))


def _root(variance: Array) -> float:
    """Root of the mean variance; NaN where any is unknown."""
    return float(np.sqrt(np.mean(variance)))


def people_scores(reference: GaitReference) -> tuple[Array, Array] | None:
    """Return scores of the reference's own people, each against the mean of the others; None without curves.

    Returns:
        Variable scores (N, 2, 9) and profile scores (N, 2), rad, right and left.
    """
    if reference.curves is None or len(reference.curves) < 2:
        return None
    own, count = reference.curves, len(reference.curves)
    others = (own.sum(axis=0) - own).mean(axis=1, keepdims=True) / (count - 1)
    squares = np.mean((own - others) ** 2, axis=-1)
    return np.sqrt(squares), np.sqrt(squares.mean(axis=-1))
