"""Linear regression of the skeleton's landmarks from a detector's points, for any subset of the points.

A joint centre is estimated from all detected points by the conditional mean of a normal distribution
(`PoseGaussian`), with the expected error. Points of people who lie or hang are rotated upright first, by
quarter turns. Joints are those of the shipped skeleton.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import OWN_LAYOUTS, DetectorTable, Layout, detector_table, own, point_names
from rtof_kin.vision.pose_gaussian import FEWEST_POINTS, QUARTERS, PoseGaussian

LEAST_CONFIDENCE: Final = 0.1  # [-] of a detected point
LEAST_SHARE: Final = 0.1  # [-] of an observed landmark's expected square error that is detector noise


@dataclass(frozen=True)
class RegressedLandmarks:
    """Landmarks of the skeleton in an image."""

    names: tuple[str, ...]
    """L landmarks: all joints, then those that the layout shows."""
    uv_px: Array
    """(T, L, 2); NaN where unobserved."""
    confidence: Array
    """(T, L) weighted mean confidence of the points times the detector's fraction of the expected square
    error; 0 where unobserved."""
    sigma_px: Array
    """(T, L) expected error per axis, px; NaN where unobserved."""


class LandmarkRegression:
    """The regressions of all layouts.

    Args:
        gaussian: distribution of their points and the skeleton's landmarks.

    Raises:
        InvalidInputError: the distribution is of other points.
    """

    def __init__(self, table: DetectorTable, gaussian: PoseGaussian):
        self.table, self.gaussian = table, gaussian
        self._skeleton = SkeletonModel.default()
        if gaussian.names != point_names(table, self._skeleton):
            raise InvalidInputError("landmark regression: fitted to other points than those of its table")

    @staticmethod
    def default() -> LandmarkRegression:
        """Return the shipped one, of the shipped layouts and those that were added."""
        return _default(detector_table())

    def apply(self, layout: str, uv_px: Array, confidence: Array) -> RegressedLandmarks:
        """Estimate the landmarks of one person.

        Args:
            layout: name of the layout; points of 'joints' and 'landmarks' are returned unchanged.
            uv_px: (T, K, 2) px, NaN where not detected. confidence: (T, K) in [0, 1], 0 where not detected.

        Raises:
            UnknownNameError: unknown layout.
            InvalidInputError: wrong number of points, or too few detected in every frame.
        """
        form = self.table.layout(layout)
        uv, confidence, seen = _checked(form, uv_px, confidence)
        if layout in OWN_LAYOUTS:
            sigma = np.where(seen, 0.0, np.nan)
            return RegressedLandmarks(form.names, uv, np.where(seen, confidence, 0.0), sigma)
        names = self.landmarks(form)
        out = np.full((len(uv), len(names), 2), np.nan)
        sigma, out_confidence = np.full(out.shape[:2], np.nan), np.zeros(out.shape[:2])
        for pattern, frames in _patterns(seen):
            out[frames], out_confidence[frames], sigma[frames] = self._frames(
                form, names, pattern, uv[frames][:, pattern], confidence[frames][:, pattern]
            )
        if not np.any(out_confidence > 0):
            raise InvalidInputError(
                f"keypoints in layout {layout}: in no frame are enough points detected for a joint; at "
                f"least {FEWEST_POINTS} of its {len(form)} points with a confidence of "
                f"{LEAST_CONFIDENCE:g} are needed"
            )
        return RegressedLandmarks(names, out, out_confidence, sigma)

    def landmarks(self, form: Layout) -> tuple[str, ...]:
        """Return the landmarks that `apply` estimates: all joints, then those that a layout shows."""
        if form.name in OWN_LAYOUTS:
            return form.names
        shown = {name for name, points in self.table.seen_by.items() if set(points) & set(form.points)}
        return (*self._skeleton.names, *(name for name in self._skeleton.landmarks if name in shown))

    def _frames(
        self, form: Layout, names: Sequence[str], pattern: Mask, uv: Array, confidence: Array
    ) -> tuple[Array, Array, Array]:
        """Return landmarks, confidence and error of frames in which the same points are detected."""
        seen = [point for point, is_seen in zip(form.points, pattern, strict=True) if is_seen]
        conditioned = self.gaussian.given(seen)
        regression = conditioned.regression([own(name) for name in names])
        turn, fit = conditioned.turned_upright(uv)
        R_turned_image = np.array(QUARTERS)[turn]
        turned = uv @ np.swapaxes(R_turned_image, -1, -2)
        points = conditioned.estimate(regression, turned, fit.scale) @ R_turned_image
        share = self.gaussian.noise**2 / (self.gaussian.noise**2 + regression.model_variance)
        joints, seen_by = self._skeleton.names, self.table.seen_by
        shown = [name in joints or not set(seen_by[name]).isdisjoint(seen) for name in names]
        share = np.where(np.array(shown) & (share >= LEAST_SHARE), share, 0.0)
        error = np.sqrt(regression.model_variance + regression.noise_variance)
        sigma = np.where(share > 0, error / fit.scale[:, None], np.nan)
        points[:, share == 0] = np.nan
        return points, confidence @ regression.weight.T * share, sigma


@lru_cache(maxsize=4)
def _default(table: DetectorTable) -> LandmarkRegression:
    return LandmarkRegression(table, read_gaussian(model_path("detectors.npz"), table))


def _checked(form: Layout, uv_px: Array, confidence: Array) -> tuple[Array, Array, Mask]:
    """Return points, confidence and the mask of detected points, with shapes checked."""
    uv: Array = readonly(f"keypoints in layout {form.name}", uv_px, ("T", len(form), 2))
    confidence = readonly(f"confidence in layout {form.name}", confidence, uv.shape[:2])
    seen = np.isfinite(uv).all(axis=-1) & (confidence >= LEAST_CONFIDENCE)
    if not seen.any():
        highest = float(np.nanmax(confidence, initial=0.0))
        raise InvalidInputError(
            f"keypoints in layout {form.name}: no point is detected in any of the {len(uv)} frames (the "
            f"highest confidence is {highest:g}, {LEAST_CONFIDENCE:g} is needed); check the detector's output"
        )
    return uv, confidence, seen


def _patterns(seen: Mask) -> Iterator[tuple[Mask, NDArray[np.int64]]]:
    """Generate each set of detected points with its frames; sets with too few points are skipped."""
    rows, index = np.unique(seen, axis=0, return_inverse=True)
    for k, row in enumerate(rows):
        if row.sum() >= FEWEST_POINTS:
            yield row, np.flatnonzero(index.ravel() == k)


def read_gaussian(path: str | Path, table: DetectorTable) -> PoseGaussian:
    """Read the distribution that ``models/build_adapters.py`` fitted to a table's points.

    Raises:
        FileFormatError: no such file, damaged, or fitted to other points.
    """
    arrays = read_npz(Path(path))
    lacking = {"mean", "covariance", "noise", "offsets"} - set(arrays)
    if lacking:
        raise FileFormatError(path, f"no array {', '.join(sorted(lacking))}; build it again")
    offsets = np.array([point.offset for point in table.points])
    fitted = arrays["offsets"]
    if fitted.shape != offsets.shape or not np.allclose(fitted, offsets, atol=1e-9):
        raise FileFormatError(path, f"fitted to points that differ from those in {table.path}; build it again")
    names = point_names(table, SkeletonModel.default())
    try:
        return PoseGaussian(names, arrays["mean"], arrays["covariance"], float(arrays["noise"]))
    except InvalidInputError as error:
        raise FileFormatError(path, f"{error}; build it again") from error
