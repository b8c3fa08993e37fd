"""Gait Variable Scores (GVS), Movement Analysis Profile (MAP), Gait Profile Score (GPS) and Gait Deviation Index (GDI).

Baker et al., Gait & Posture 30 (2009) and 35 (2012); Schwartz and Rozumalski, Gait & Posture 28 (2008), with features
and scale of the reference's own people. docs/gait_scores.md has the mathematics, `tests/clinical/test_gait_scores.py`
checks it. With the difference d of a person's mean curve from the mean of the reference, at P = 51 instants of the
cycle of a side::

    GVS_v = sqrt(mean over the cycle of d_v^2)        GPS = sqrt(mean over variables of GVS_v^2)

Errors e of standard deviation s add mean(s^2) to a squared score (`Score.noise`), whatever their correlation, and
change a score by at most 1.96 sqrt(mean of s^2) in at least 95 of 100 cases (Szekely and Bakirov, Probability Theory
and Related Fields 126, 2003), those of the GDI's distance by 1.96 sqrt(sum of s^2). The mean over n strides has its own
variance v / n, which is added to s^2: to the bias as it is, to the band times the ratio of Student's to the normal
quantile squared.

The GDI is 100 - 10 (ln D - mean of ln D_r) / (standard deviation of ln D_r), with the distance D from the reference's
mean along its gait features, and D_r of its person r that from mean and features of the *others*. A person of the
reference counts once, with the mean over the strides of a side in all recordings; right and left are pooled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_variables import GaitCycles
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.gait_reference import NAMES, GaitReference

PELVIS: Final = 3  #: Variables of the pelvis, the first of `VARIABLES`


@dataclass(frozen=True)
class Score:
    """A root mean square difference from the reference, rad; NaN where it is not computed."""

    value: float
    pose_sigma: float
    """Root of the mean variance of the curves by the covariances of the poses; NaN if these are unknown."""
    stride_sigma: float  #: The same by the number of strides and their spread; NaN for one stride
    stride_bound: float  #: The same widened by Student's quantile, as the spread is estimated
    spread: float  #: Standard deviation of the score between strides; NaN for fewer than two
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

    mean: Array  #: (9, 51) rad; NaN for a variable without a complete stride
    pose_variance: Array  #: (9, 51) rad^2, by the covariances; NaN if unknown
    stride_variance: Array  #: (9, 51) rad^2, of a mean over these strides; NaN for a single one
    stride_bound: Array  #: (9, 51) rad^2, the same times the ratio of Student's to the normal quantile squared
    strides: Array  #: (n, 9, 51) rad, of the single strides


@dataclass(frozen=True)
class GaitScores:
    """All scores of a motion."""

    profile: Mapping[str, tuple[Score, ...]]
    """Side -> nine scores in the order of `VARIABLES`: the Movement Analysis Profile."""
    sides: Mapping[str, Score]  #: Side -> Gait Profile Score
    overall: Score
    missing: Mapping[str, Mapping[str, str]]  #: Side -> variables without a score -> what they need
    curves: Mapping[str, SideCurves]
    has_bands: bool  #: Whether the motion has covariances


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
            bound[v] = (scipy.stats.t.ppf(0.975, n - 1) / BAND_95) ** 2 * strides[v]
    return SideCurves(mean, pose, strides, bound, own)


def _score(curves: SideCurves, reference: Array, variables: Sequence[int]) -> Score:
    """Root mean square over some variables of one side."""
    index = list(variables)
    value, *strides = (_root((own[index] - reference[index]) ** 2) for own in (curves.mean, *curves.strides))
    if np.isnan(value):
        return NOT_COMPUTED
    single = [one for one in strides if np.isfinite(one)]
    spread = float(np.std(single, ddof=1)) if len(single) > 1 else _NAN
    variances = (curves.pose_variance, curves.stride_variance, curves.stride_bound)
    pose, stride, bound = (_root(one[index]) for one in variances)
    return Score(value, pose, stride, bound, spread, len(single))


def _overall(curves: Mapping[str, SideCurves], reference: Array) -> Score:
    """Over the nine variables of the left side and the six of the right that are not of the pelvis."""

    def stacked(field: str) -> Array:
        return np.concatenate([getattr(curves["left"], field), getattr(curves["right"], field)[PELVIS:]])

    value = _root((stacked("mean") - np.concatenate([reference, reference[PELVIS:]])) ** 2)
    if np.isnan(value):
        return NOT_COMPUTED
    names = ("pose_variance", "stride_variance", "stride_bound")
    pose, stride, bound = (_root(stacked(name)) for name in names)
    return Score(value, pose, stride, bound, _NAN, sum(len(own.strides) for own in curves.values()))


def _root(squares: Array) -> float:
    """Root of a mean square; NaN where any is unknown."""
    return float(np.sqrt(np.mean(squares)))


def people_scores(reference: GaitReference) -> Array | None:
    """Return scores (N, 2, 10), rad, of the reference's own people, each against the mean of the others: nine variable
    scores and the profile score, right and left; None without curves.
    """
    if reference.curves is None or len(reference.curves) < 2:
        return None
    own, count = reference.curves, len(reference.curves)
    others = (own.sum(axis=0) - own).mean(axis=1, keepdims=True) / (count - 1)
    squares = np.mean((own - others) ** 2, axis=-1)
    return np.asarray(np.sqrt(np.concatenate([squares, squares.mean(axis=-1, keepdims=True)], axis=-1)))


VARIANCE: Final = 0.98  #: Share of the reference's variance that the features have
FEWEST: Final = 5  #: People without whose curves there is no index


@dataclass(frozen=True)
class GaitFeatures:
    """Features of a reference, and the scale of its distances."""

    mean: Array  #: (459,) rad
    basis: Array  #: (459, m), orthonormal columns
    log_mean: float  #: Mean of the logarithms of the people's distances
    log_sd: float
    distances: Array  #: (N, 2) rad, of people, right and left, each from mean and features of the others

    def index(self, distance: Array | float) -> Array:
        """Return the index of a distance (...), rad, from the mean along the features."""
        with np.errstate(divide="ignore"):
            return np.asarray(100 - 10 * (np.log(distance) - self.log_mean) / self.log_sd)


@dataclass(frozen=True)
class DeviationIndex:
    """The index of one side."""

    value: float
    low: float  #: Lower end of the 95 % band
    high: float  #: Upper end; infinite if the curves may be the mean itself
    explained: float  #: Share of the squared deviation from the mean that the features have


def gait_features(reference: GaitReference) -> GaitFeatures:
    """Return the features of a reference. `InvalidInputError`: it has only means, or too few people, or people without
    differences.

    Args:
        reference: with the curves of at least `FEWEST` people.
    """
    if reference.curves is None:
        raise InvalidInputError(
            "the reference has means and standard deviations only, and the GDI needs the curves of its people"
        )
    if len(reference.curves) < FEWEST:
        raise InvalidInputError(
            f"the reference has the curves of {len(reference.curves)} people, and the GDI needs {FEWEST}"
        )
    vectors = reference.curves.reshape(len(reference.curves), len(SIDES), -1)
    distances = np.empty(vectors.shape[:2])
    for person, own in enumerate(vectors):
        mean, basis = _basis(np.delete(vectors, person, axis=0))
        distances[person] = np.linalg.norm((own - mean) @ basis, axis=1)
    if not np.all(distances > 0) or np.ptp(distances) == 0:
        raise InvalidInputError("people of the reference have the same curves, so there is no scale of a GDI")
    logs = np.log(distances)
    mean, basis = _basis(vectors)
    return GaitFeatures(mean, basis, float(logs.mean()), float(logs.std(ddof=1)), distances)


def _basis(vectors: Array) -> tuple[Array, Array]:
    """Mean (459,) and features (459, m) of vectors (N, 2, 459)."""
    flat = vectors.reshape(-1, vectors.shape[-1])
    mean = flat.mean(axis=0)
    _, sizes, rows = np.linalg.svd(flat - mean, full_matrices=False)
    share = np.cumsum(sizes**2) / max(float(np.sum(sizes**2)), 1e-300)
    return mean, rows[: int(np.searchsorted(share, VARIANCE)) + 1].T


def deviation_index(curves: SideCurves, features: GaitFeatures) -> DeviationIndex:
    """Return the index of one side; NaN if a variable is missing."""
    difference = curves.mean.ravel() - features.mean
    if np.isnan(difference).any():
        return DeviationIndex(*[float("nan")] * 4)
    along = difference @ features.basis
    distance, total = float(np.linalg.norm(along)), float(np.linalg.norm(difference))
    sums = [float(np.sum(v)) for v in (curves.pose_variance, curves.stride_bound)]
    half = BAND_95 * float(np.sqrt(np.nansum(sums)))
    ends = np.array([distance, distance + half, max(distance - half, 0.0)])
    value, low, high = features.index(ends).tolist()
    return DeviationIndex(value, low, high, (distance / total) ** 2 if total > 0 else 1.0)


FEW: Final = 10  #: People below whose number scores are said to be relative to few
LEAST_STRIDES: Final = 3  #: Strides of each side that a person needs


def build_reference(
    people: Mapping[str, GaitCycles], *, least_strides: int = LEAST_STRIDES, **about: Any
) -> tuple[GaitReference, dict[str, str]]:
    """Return a reference, and the people that are left out with the reasons. `InvalidInputError`: fewer than two people
    are left, or a licence or source is missing.

    Args:
        least_strides: see `LEAST_STRIDES`. about: fields of `GaitReference`: licence, source, system, zero, notes.
    """
    kept, left_out = {}, {}
    for code, cycles in people.items():
        if reason := unsuitable(cycles, least_strides):
            left_out[code] = reason
        else:
            kept[code] = cycles
    if len(kept) < 2:
        why = "; ".join(f"{code}: {reason}" for code, reason in list(left_out.items())[:3])
        raise InvalidInputError(
            f"gait reference: {len(kept)} of {len(people)} people can be used, and two are needed ({why})"
        )
    curves = np.array([[side_curves(own, side).mean for side in SIDES] for own in kept.values()])
    pooled = curves.mean(axis=1)
    speeds = tuple(own.speed for own in kept.values())
    known = [speed for speed in speeds if np.isfinite(speed)]
    return GaitReference(
        pooled.mean(axis=0),
        curves.std(axis=(0, 1), ddof=1),
        len(kept),
        curves=curves,
        names=tuple(kept),
        strides=tuple((own.sides.count("right"), own.sides.count("left")) for own in kept.values()),
        speeds=speeds,
        speed_range=(min(known), max(known)) if known else None,
        **about,
    ), left_out


def unsuitable(cycles: GaitCycles, least_strides: int) -> str:
    """Return why a person cannot be part of a reference, '' for one with as many strides of each side."""
    if cycles.why_not:
        return cycles.why_not
    for side in SIDES:
        if missing := cycles.missing(side):
            needs = "; ".join(f"{name} needs {what}" for name, what in missing.items())
            return f"{side} cycle: {needs}"
        few = cycles.complete(side).sum(axis=0)
        if few.min() < least_strides:
            return f"{few.min()} {side} strides with {NAMES[int(few.argmin())]}; {least_strides} are needed"
    return ""
