"""From a detector's points to the skeleton's landmarks: any layout, any subset of its points.

A joint centre is estimated from all points that are seen (`PoseGaussian`), with the uncertainty that the
motion it was fitted to shows; of people who lie or hang, in an image turned by quarters until they stand.
Joints are those of the shipped skeleton: the best that can be done for a body whose skeleton has them
elsewhere, as motion capture's have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, ShapeError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import DetectorTable, Layout, detector_table, own
from rtof_kin.vision.pose_gaussian import FEWEST_POINTS, QUARTERS, PoseGaussian
from rtof_kin.vision.views import point_names

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LEAST_CONFIDENCE = 0.1
"""A detector's point below this confidence counts as unseen."""
LEAST_SHARE = 0.1
"""A joint counts as unseen where less than this share of its expected square error is the detector's own:
it would be a guess, three times further off than detections are."""


@dataclass(frozen=True)
class RegressedLandmarks:
    """Landmarks of the skeleton in an image."""

    names: tuple[str, ...]
    """L landmarks: all joints, then those that the detector has a point for."""
    uv_px: Array
    """(T, L, 2); NaN where too little was seen."""
    confidence: Array
    """(T, L) the detector's own, of the points that tell most about the landmark, times the share of the
    expected square error that is the detector's own; 0 where too little was seen."""
    sigma_px: Array
    """(T, L) expected error per axis, px; NaN where too little was seen."""


class LandmarkRegression:
    """The fitted mapping of every layout.

    Attributes:
        table: the layouts. gaussian: how their points and the skeleton's landmarks lie to each other.
    """

    def __init__(self, table: DetectorTable, gaussian: PoseGaussian):
        """Check that the two belong to each other."""
        self.table, self.gaussian = table, gaussian
        self._skeleton = SkeletonModel.default()
        if gaussian.names != point_names(table, self._skeleton):
            raise ShapeError("adapter: fitted to other points than those of its table")

    @classmethod
    def default(cls) -> LandmarkRegression:
        """The one that ships."""
        return _shipped()

    def landmarks(self, layout: str) -> tuple[str, ...]:
        """The landmarks that a layout gives: all joints, then those it has a point for."""
        points = set(self.table.layout(layout).points)
        extra = [name for name, seen_by in self.table.seen_by.items() if points & set(seen_by)]
        order = list(self._skeleton.landmarks)
        return (*self._skeleton.names, *sorted(extra, key=order.index))

    def apply(self, layout: str, uv_px: Array, confidence: Array) -> RegressedLandmarks:
        """Landmarks from detections of one person.

        Args:
            layout: name of the layout; the skeleton's own, 'joints' and 'landmarks', stay as they are.
            uv_px: (T, K, 2) pixels, NaN where unseen. confidence: (T, K) in [0, 1], 0 where unseen.

        Raises:
            UnknownNameError: no such layout.
            ShapeError: another number of points than the layout has, or nothing was ever seen.
        """
        form = self.table.layout(layout)
        uv, confidence, seen = checked_points(form, uv_px, confidence)
        if layout in ("joints", "landmarks"):
            sigma = np.where(seen, 0.0, np.nan)
            return RegressedLandmarks(form.names, uv, np.where(seen, confidence, 0.0), sigma)
        names = self.landmarks(layout)
        out = np.full((len(uv), len(names), 2), np.nan)
        sigma, out_confidence = np.full(out.shape[:2], np.nan), np.zeros(out.shape[:2])
        for pattern, frames in patterns(seen):
            out[frames], out_confidence[frames], sigma[frames] = self._frames(
                form, names, pattern, uv[frames][:, pattern], confidence[frames][:, pattern]
            )
        if not np.any(out_confidence > 0):
            raise ShapeError(
                f"keypoints in layout {layout}: in no frame are enough points seen to tell a joint; at "
                f"least {FEWEST_POINTS} of its {len(form)} points with a confidence of "
                f"{LEAST_CONFIDENCE:g} are needed"
            )
        return RegressedLandmarks(names, out, out_confidence, sigma)

    def _frames(
        self, form: Layout, names: Sequence[str], pattern: Mask, uv: Array, confidence: Array
    ) -> tuple[Array, Array, Array]:
        """Landmarks, their confidence and error in frames in which the same points are seen."""
        seen = [point for point, is_seen in zip(form.points, pattern, strict=True) if is_seen]
        wanted = [own(name) for name in names]
        given = self.gaussian.given(seen)
        regression = given.regression(wanted)
        turn, fit = given.turned_upright(uv)
        scale, R_turned_image = fit.scale, np.array(QUARTERS)[turn]
        turned = uv @ np.swapaxes(R_turned_image, -1, -2)
        points = given.estimate(regression, turned, scale) @ R_turned_image
        share = self.gaussian.noise**2 / (self.gaussian.noise**2 + regression.model_variance)
        shown = [name in self._skeleton.names or bool(set(self.table.seen_by[name]) & set(seen))
                 for name in names]  # fmt: skip
        share = np.where(np.array(shown) & (share >= LEAST_SHARE), share, 0.0)
        error = np.sqrt(regression.model_variance + regression.noise_variance)
        sigma = np.where(share > 0, error / scale[:, None], np.nan)
        points[:, share == 0] = np.nan
        return points, confidence @ regression.weight.T * share, sigma

    def naive(self, layout: str, uv_px: Array, confidence: Array) -> RegressedLandmarks:
        """The plain mapping, for comparison: each joint at the nearest point, or between two."""
        form = self.table.layout(layout)
        uv, confidence, seen = checked_points(form, uv_px, confidence)
        uv = np.where(seen[..., None], uv, np.nan)
        at: dict[str, tuple[Array, Array]] = {}
        for joint, lists in self.table.naive.items():
            nearest = next((p for p in lists if set(p) <= set(form.points)), None)
            if nearest is not None:
                index = [form.points.index(p) for p in nearest]
                at[joint] = uv[:, index].mean(axis=1), confidence[:, index].min(axis=1)
        for joint, (start, stop, share) in self.table.naive_between.items():
            if start in at and stop in at:
                middle = (1 - share) * at[start][0] + share * at[stop][0]
                at[joint] = middle, np.minimum(at[start][1], at[stop][1])
        names = tuple(name for name in self._skeleton.names if name in at)
        points = np.stack([at[name][0] for name in names], axis=1)
        known = np.isfinite(points).all(axis=-1)
        own_confidence = np.where(known, np.stack([at[name][1] for name in names], axis=1), 0.0)
        return RegressedLandmarks(names, points, own_confidence, np.full(known.shape, np.nan))


def checked_points(form: Layout, uv_px: Array, confidence: Array) -> tuple[Array, Array, Mask]:
    """Points, their confidence, and which of them count as seen.

    Raises:
        ShapeError: the shapes do not fit the layout, or no point is ever seen.
    """
    uv: Array = readonly(f"keypoints in layout {form.name}", uv_px, ("T", len(form), 2))
    confidence = readonly(f"confidence in layout {form.name}", confidence, uv.shape[:2])
    seen = np.isfinite(uv).all(axis=-1) & (confidence >= LEAST_CONFIDENCE)
    if not seen.any():
        highest = float(np.nanmax(confidence, initial=0.0))
        raise ShapeError(
            f"keypoints in layout {form.name}: no point is seen in any of the {len(uv)} frames (the "
            f"highest confidence is {highest:g}, {LEAST_CONFIDENCE:g} is needed); look at the detector's "
            "own output first"
        )
    return uv, confidence, seen


def patterns(seen: Mask) -> Iterator[tuple[Mask, NDArray[np.int64]]]:
    """Which points are seen together, and in which frames; those with too few are left out."""
    rows, index = np.unique(seen, axis=0, return_inverse=True)
    for k, row in enumerate(rows):
        if row.sum() >= FEWEST_POINTS:
            yield row, np.flatnonzero(index.ravel() == k)


def read_gaussian(path: str | Path, table: DetectorTable) -> PoseGaussian:
    """The normal distribution that ``models/build_adapters.py`` fitted to a table's points.

    Raises:
        FileFormatError: no such file, damaged, or fitted to points that lie elsewhere.
    """
    arrays = read_npz(Path(path))
    lacking = {"mean", "covariance", "noise", "offsets"} - set(arrays)
    if lacking:
        raise FileFormatError(path, f"no array {', '.join(sorted(lacking))}; build it again")
    offsets = np.array([point.offset for point in table.points])
    fitted = arrays["offsets"]
    if fitted.shape != offsets.shape or not np.allclose(fitted, offsets, atol=1e-9):
        raise FileFormatError(
            path, f"fitted to points that lie elsewhere than in {table.path}; build it again"
        )
    names = point_names(table, SkeletonModel.default())
    try:
        return PoseGaussian(names, arrays["mean"], arrays["covariance"], float(arrays["noise"]))
    except ShapeError as error:
        raise FileFormatError(path, f"{error}; build it again") from error


@cache
def _shipped() -> LandmarkRegression:
    table = detector_table()
    return LandmarkRegression(table, read_gaussian(model_path("detectors.npz"), table))
