"""The Gait Deviation Index (GDI) of a side, relative to a reference with the curves of single people.

Schwartz and Rozumalski, Gait & Posture 28 (2008). The nine curves of one side are a vector g of 459 numbers.
Gait features are its coordinates along the right singular vectors F of the reference, about its mean m, as
many as have 98 % of the variance. With the distance D = |F^T (g - m)|::

    GDI = 100 - 10 (ln D - mean of ln D_r) / (standard deviation of ln D_r)

over the people r of the reference, right and left. Two differences from the publication, whose features are
those of 6,702 strides of patients and whose scale is that of 166 healthy children:

- The features are those of the reference's own people. What differs in no way in which healthy people differ
  is outside of them, and not in the index; `DeviationIndex.explained` is the share that is inside.
- D_r of a person is that from mean and features of the *others*. Features fitted to a person contain all of
  that person's deviation and less of another's, so with few people every other healthy person would have an
  index above 100. So scaled, the people of the reference have mean 100 and standard deviation 10 exactly.

The band is that of D by the same bound as for the scores (`gait_scores`): D differs from its true value by at
most 1.96 sqrt(sum of s^2) in at least 95 of 100 cases, and the index falls monotonically with D.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_scores import SideCurves
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.gait_reference import GaitReference

VARIANCE: Final = 0.98
"""Share of the reference's variance that the features have."""
FEWEST: Final = 5
"""People without whose curves there is no index."""


@dataclass(frozen=True)
class GaitFeatures:
    """Features of a reference, and the scale of its distances."""

    mean: Array
    """(459,) rad."""
    basis: Array
    """(459, m), orthonormal columns."""
    log_mean: float
    """Mean of the logarithms of the people's distances."""
    log_sd: float
    distances: Array
    """(N, 2) rad, of people, right and left, each from mean and features of the others."""

    def index(self, distance: Array | float) -> Array:
        """Return the index of a distance.

        Args:
            distance: (...) rad, from the mean along the features.
        """
        with np.errstate(divide="ignore"):
            return np.asarray(100 - 10 * (np.log(distance) - self.log_mean) / self.log_sd)


@dataclass(frozen=True)
class DeviationIndex:
    """The index of one side."""

    value: float
    low: float
    """Lower end of the 95 % band."""
    high: float
    """Upper end; infinite if the curves may be the mean itself."""
    explained: float
    """Share of the squared deviation from the mean that the features have."""


def gait_features(reference: GaitReference) -> GaitFeatures:
    """Return the features of a reference.

    Args:
        reference: with the curves of at least `FEWEST` people.

    Raises:
        InvalidInputError: it has only means, or too few people, or people without differences.
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
