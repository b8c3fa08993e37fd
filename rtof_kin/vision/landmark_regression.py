"""Linear regression of the skeleton's landmarks from a detector's points, for any subset of the points.

A joint centre is estimated from all detected points by the conditional mean of a normal distribution
(`PoseGaussian`), with the expected error. Points of people who lie or hang are rotated upright first, by
quarter turns. Joints are those of the shipped skeleton.

Normal distribution of the points of a person in an image, and its conditionals. A person is z = s (u - t): pixels u
shifted and scaled so that the 21 joints are centred and have an RMS radius of 1. Mean and covariance of z were fitted
to free motion seen from many directions. The place t has a flat prior; the scale s is the maximum-likelihood estimate
from the detected points. Any subset of points then gives a regression of all others (Rasmussen and Williams 2006, A.2).

Recognition of a detector's layout, by the names of its points or by geometry. Several layouts have the same number of
points (BODY_25 and BODY_25B; COCO and Human3.6M; MediaPipe and the skeleton's own landmarks). Without names, the layout
is the one under which the points are most likely to be a person's, by the distribution of
`PoseGaussian`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import OWN_LAYOUTS, DetectorTable, Layout, detector_table, own, point_names

ANYWHERE: Final = 1e4  # [RMS radii squared] variance of a person's place; practically flat
_UPRIGHT_BONUS = 0.5  # log-likelihood per point by which a turned person must fit better
QUARTERS: Final = tuple(np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
FEWEST_POINTS: Final = 4  # detected, for a regression


class Regression(NamedTuple):
    """Best linear estimate of M points from K detected ones; lengths in RMS radii."""

    mean: Array  # (M, 2) about the centre of the K points' means
    gain: Array  # (2M, 2K) derivative of the estimates
    model_variance: Array  # (M,) mean square error per axis for exact detections
    noise_variance: Array  # (M,) mean square error per axis from detector noise
    weight: Array  # (M, K) relative influence of each detected point; rows sum to 1


class Likelihood(NamedTuple):
    """Goodness of fit of T persons."""

    scale: Array  # (T,) RMS radii per px
    per_point: Array  # (T,) log-likelihood of the pixels per point
    misfit: Array  # (T,) squared Mahalanobis distance per degree of freedom; its expectation is 1


@dataclass(frozen=True)
class PoseGaussian:
    """Mean and covariance of N points, and the noise of a detector."""

    names: tuple[str, ...]  #: N points
    mean: Array  #: (N, 2) RMS radii, right and down
    covariance: Array  #: (2N, 2N), x and y of each point in turn
    noise: float  #: Standard deviation of a detector's error per axis, RMS radii

    def __post_init__(self) -> None:
        N = len(self.names)
        object.__setattr__(self, "mean", readonly("mean of points", self.mean, (N, 2)))
        covariance = readonly("covariance of points", self.covariance, (2 * N, 2 * N))
        object.__setattr__(self, "covariance", covariance)

    def given(self, seen: Sequence[str]) -> _ConditionedPose:
        """Return the distribution conditioned on detected points."""
        return _ConditionedPose(self, seen)

    def between(self, a: Sequence[str], b: Sequence[str]) -> Array:
        """Return the covariance (2A, 2B) of points of a person anywhere in the image."""
        rows, columns = (
            (2 * np.array(indices_of("point", p, self.names))[:, None] + np.arange(2)).ravel() for p in (a, b)
        )
        anywhere = ANYWHERE * np.tile(np.eye(2), (len(a), len(b)))
        return np.asarray(self.covariance[np.ix_(rows, columns)] + anywhere)


class _ConditionedPose:
    """Distribution of persons with K detected points; factorised once."""

    def __init__(self, gaussian: PoseGaussian, seen: Sequence[str]):
        self.seen = tuple(seen)
        self._gaussian = gaussian
        self._covariance = gaussian.between(seen, seen)
        with_noise = self._covariance + gaussian.noise**2 * np.eye(2 * len(seen))
        self._precision = np.linalg.inv(with_noise)
        self._log_det = float(np.linalg.slogdet(with_noise)[1])
        mean = gaussian.mean[indices_of("point", seen, gaussian.names)]
        self._centre = mean.mean(axis=0)
        self._mean = (mean - self._centre).ravel()

    def regression(self, wanted: Sequence[str]) -> Regression:
        """Return the regression of M points on the detected ones."""
        gaussian, M = self._gaussian, len(wanted)
        cross = gaussian.between(wanted, self.seen)
        gain = cross @ self._precision
        own = np.diag(gaussian.between(wanted, wanted))
        error = own + ((gain @ self._covariance - 2 * cross) * gain).sum(axis=1)
        per_point = np.maximum(error.reshape(M, 2).mean(axis=1), 0)
        size = np.linalg.norm(gain.reshape(M, 2, len(self.seen), 2), axis=(1, 3))
        noise = gaussian.noise**2 * (gain**2).sum(axis=1).reshape(M, 2).mean(axis=1)
        mean = gaussian.mean[indices_of("point", wanted, gaussian.names)] - self._centre
        return Regression(mean, gain, per_point, noise, size / size.sum(axis=1, keepdims=True))

    def likelihood(self, uv_px: Array) -> Likelihood:
        """Estimate scale and likelihood of persons from pixels (T, K, 2) of the detected points. With a = x' P x, b =
        x' P m and n degrees of freedom, log p(x | s) = n log s - (s^2 a - 2 s b) / 2 + constant has its maximum at the
        positive root of a s^2 - b s - n = 0.
        """
        x, m = _centred(uv_px), self._mean
        P, n = self._precision, 2 * len(self.seen) - 2
        whitened = x @ P
        a, b = np.maximum((whitened * x).sum(axis=1), 1e-300), whitened @ m
        scale = (b + np.sqrt(b * b + 4 * a * n)) / (2 * a)
        square = scale**2 * a - 2 * scale * b + m @ P @ m
        log_p = n * np.log(scale) - (square + self._log_det) / 2
        return Likelihood(scale, log_p / len(self.seen), square / n)

    def turned_upright(self, uv_px: Array) -> tuple[NDArray[np.int64], Likelihood]:
        """Return the quarter turn (T,) that brings persons (T, K, 2) upright, and their likelihood then."""
        T = len(uv_px)
        every = self.likelihood(np.concatenate([uv_px @ turn.T for turn in QUARTERS]))
        per_point = every.per_point.reshape(len(QUARTERS), T)
        best = np.argmax(per_point + np.eye(len(QUARTERS))[:, :1] * _UPRIGHT_BONUS, axis=0)
        row = best * T + np.arange(T)
        return best, Likelihood(every.scale[row], every.per_point[row], every.misfit[row])

    def estimate(self, regression: Regression, uv_px: Array, scale: Array) -> Array:
        """Return points (T, M, 2), px, from the detected ones (T, K, 2) of persons of scale (T,)."""
        centre = uv_px.mean(axis=1, keepdims=True)
        z = scale[:, None] * _centred(uv_px) - self._mean
        estimate = (regression.mean.ravel() + z @ regression.gain.T) / scale[:, None]
        return np.asarray(estimate.reshape(len(uv_px), -1, 2) + centre)


def _centred(uv_px: Array) -> Array:
    """Return (T, 2K) pixels about their mean, as the flat prior on the place allows."""
    return np.asarray((uv_px - uv_px.mean(axis=1, keepdims=True)).reshape(len(uv_px), -1))


LEAST_CONFIDENCE: Final = 0.1  # [-] of a detected point
LEAST_SHARE: Final = 0.1  # [-] of an observed landmark's expected square error that is detector noise


@dataclass(frozen=True)
class RegressedLandmarks:
    """Landmarks of the skeleton in an image."""

    names: tuple[str, ...]  #: L landmarks: all joints, then those that the layout shows
    uv_px: Array  #: (T, L, 2); NaN where unobserved
    confidence: Array
    """(T, L) weighted mean confidence of the points times the detector's fraction of the expected square
    error; 0 where unobserved."""
    sigma_px: Array  #: (T, L) expected error per axis, px; NaN where unobserved


class LandmarkRegression:
    """The regressions of all layouts; `gaussian` is the distribution of their points and the skeleton's landmarks."""

    def __init__(self, table: DetectorTable, gaussian: PoseGaussian):
        self.table, self.gaussian = table, gaussian
        self._skeleton = SkeletonModel.default()

    @staticmethod
    def default() -> LandmarkRegression:
        """Return the shipped one, of the shipped layouts and those that were added."""
        return _default(detector_table())

    def apply(self, layout: str, uv_px: Array, confidence: Array) -> RegressedLandmarks:
        """Estimate the landmarks of one person. `UnknownNameError`: unknown layout; `InvalidInputError`: wrong number
        of points, or too few detected in every frame.

        Args:
            layout: name of the layout; points of 'joints' and 'landmarks' are returned unchanged.
            uv_px: (T, K, 2) px, NaN where not detected. confidence: (T, K) in [0, 1], 0 where not detected.
        """
        form = self.table.layout(layout)
        uv, confidence, seen = _checked(form, uv_px, confidence)
        if layout in OWN_LAYOUTS:
            sigma = np.where(seen, 0.0, np.nan)
            return RegressedLandmarks(form.names, uv, np.where(seen, confidence, 0.0), sigma)
        names = self.landmarks(form)
        out = np.full((len(uv), len(names), 2), np.nan)
        sigma, out_confidence = np.full(out.shape[:2], np.nan), np.zeros(out.shape[:2])
        patterns, which = np.unique(seen, axis=0, return_inverse=True)
        for k in np.flatnonzero(patterns.sum(axis=1) >= FEWEST_POINTS):
            pattern, frames = patterns[k], np.flatnonzero(which.ravel() == k)
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


_PER_METRE: Final = 2.55  #: [RMS radii] of the joints in 1 m across the line of sight, of the shipped skeleton
_RIDGE: Final = 0.02
"""[m] Extent of a segment's points in a direction from which on they tell a further point's place along it."""


@lru_cache(maxsize=4)
def _default(table: DetectorTable) -> LandmarkRegression:
    """The regression of the distribution that ``models/build_adapters.py`` fitted to the points without a spread of
    their own; the others are placed beside them.
    """
    arrays, skeleton = read_npz(model_path("detectors.npz")), SkeletonModel.default()
    names = point_names(table.fitted, skeleton)
    gaussian = PoseGaussian(names, arrays["mean"], arrays["covariance"], float(arrays["noise"]))
    return LandmarkRegression(table, _placed(gaussian, table, skeleton))


def _placed(known: PoseGaussian, table: DetectorTable, skeleton: SkeletonModel) -> PoseGaussian:
    """Return the distribution of known points with those that are fixed in a segment.

    A point is an affine combination of the known points of its segment, as far as these extend, plus the rest r in the
    segment's frame. Segments are seen from everywhere, so rests have mean 0 and the covariance r_i . r_j / 3 per axis
    within a segment, to which the spread between persons is added.
    """
    own_points = [Landmark(own(name), *place) for name, place in skeleton.landmarks.items()]
    offsets = dict(zip(skeleton.names, skeleton.joint_offsets, strict=True))
    parents = {joint.name: joint.parent for joint in skeleton.table.joints}
    ends = [Landmark(own(name), parent, offsets[name]) for name, parent in parents.items() if parent is not None]
    points = [*own_points, *ends, *table.fitted.points]
    further = [one for one in table.points if one.name in table.places]
    N, M = len(known.names), len(further)
    weights, rests = np.zeros((M, N)), np.zeros((M, len(skeleton.names), 3))
    for row, point in enumerate(further):
        near = [one for one in points if one.joint == point.joint]
        q = np.array([one.offset for one in near])
        centred = q - q.mean(axis=0)
        gram = centred.T @ centred + _RIDGE**2 * np.eye(3)
        w = 1 / len(near) + centred @ np.linalg.solve(gram, point.offset - q.mean(axis=0))
        np.add.at(weights[row], [known.names.index(one.name) for one in near], w)
        rests[row, skeleton.names.index(point.joint)] = point.offset - w @ q
    flat = rests.reshape(M, -1)
    spread = [np.mean(np.square(table.places[one.name].spread)) for one in further]
    rest = _PER_METRE**2 * (flat @ flat.T / 3 + np.diag(spread))
    both = np.kron(np.concatenate([np.eye(N), weights]), np.eye(2))
    covariance = both @ known.covariance @ both.T
    covariance[2 * N :, 2 * N :] += np.kron(rest, np.eye(2))
    names = (*known.names, *(one.name for one in further))
    return PoseGaussian(names, np.concatenate([known.mean, weights @ known.mean]), covariance, known.noise)


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


_FRAMES = 60  # persons, spread over the recording, that are tested
_LEAST_MARGIN = 1.0  # log-likelihood per point over the next layout; wrong ones are 4 to 8 worse
_LARGEST_MISFIT = 3.0  # median squared distance per degree of freedom; persons 0.6 to 2.7, wrong order 3 to 5
_LARGEST_MISFIT_NAMED = 3.4  # for a layout that was named: postures may be unusual


@dataclass(frozen=True)
class Recognition:
    """A layout and the evidence for it."""

    layout: Layout
    reason: str
    order: tuple[int, ...]  #: (K,) index of each of its points among those of the file


class _Fit(NamedTuple):
    layout: Layout
    log_likelihood: float
    misfit: float


def recognise(
    uv_px: Array,
    confidence: Array,
    names: Sequence[str] | None = None,
    layout: str | None = None,
    regression: LandmarkRegression | None = None,
) -> Recognition:
    """Recognise or verify the layout of the points of one or more people. `UnknownNameError`: unknown `layout`;
    `InvalidInputError`: number or names of the points do not match, the geometry is not a person's, or two layouts are
    equally likely.

    Args:
        uv_px: (..., K, 2) px, NaN where not detected. confidence: (..., K), 0 where not detected.
        names: K names of the points in the file, if it has them.
        layout: name of the layout to verify; None to recognise it.
        regression: layouts and geometry; the shipped ones if None.
    """
    regression = regression or LandmarkRegression.default()
    table, K = regression.table, uv_px.shape[-2]
    wanted = [table.layout(layout)] if layout is not None else list(table.layouts.values())
    if names is not None:
        named = [(form, order) for form in wanted if (order := form.order(names)) is not None]
        if named:
            form, order = max(named, key=lambda pair: len(pair[0]))
            return Recognition(form, f"{form.title}: its {len(form)} points are named", tuple(order))
        if layout is not None or not all(name.strip().isdigit() for name in names):
            lacking = [name for name in wanted[0].names if name not in names][:5]
            why = f"no layout; known: {', '.join(form.name for form in wanted)}"
            why = why if layout is None else f"not layout {layout}: there is no {', '.join(lacking)}"
            raise InvalidInputError(f"the points are named {', '.join(names[:5])}, ..., which is {why}")
    same = [form for form in table.layouts.values() if len(form) == K]
    if layout is not None and len(wanted[0]) != K:
        others = ", ".join(form.name for form in same) or "none of those known"
        raise InvalidInputError(f"layout {layout} has {len(wanted[0])} points, but there are {K} here, as in: {others}")
    if not same:
        known = ", ".join(f"{form.name} ({len(form)})" for form in table.layouts.values())
        raise InvalidInputError(f"no layout has {K} points; known: {known}; or name each point in landmarks")
    return _decided(_fits(regression, same, uv_px, confidence), layout)


def _fits(regression: LandmarkRegression, forms: Sequence[Layout], uv_px: Array, confidence: Array) -> list[_Fit]:
    """Return the fit of each layout, the best first."""
    K = len(forms[0])
    uv, confidence = uv_px.reshape(-1, K, 2), confidence.reshape(-1, K)
    seen = np.isfinite(uv).all(axis=-1) & (confidence >= LEAST_CONFIDENCE)
    count = seen.sum(axis=1)
    most = count.max(initial=0)
    if most < min(2 * FEWEST_POINTS, K):
        raise InvalidInputError(
            f"nowhere are more than {most} of {K} points detected (confidence of at least "
            f"{LEAST_CONFIDENCE:g}), too few to recognise the layout; check the detector's output"
        )
    # Persons with most points detected, spread over the recording.
    good = np.flatnonzero(count >= 0.8 * most)
    rows = good[np.unique(np.linspace(0, len(good) - 1, _FRAMES).astype(int))]
    fits = []
    for form in forms:
        log_p, misfit = [], []
        for row in rows:
            points = [p for p, is_seen in zip(form.points, seen[row], strict=True) if is_seen]
            _, one = regression.gaussian.given(points).turned_upright(uv[row][seen[row]][None])
            log_p.append(one.per_point[0])
            misfit.append(one.misfit[0])
        fits.append(_Fit(form, float(np.median(log_p)), float(np.median(misfit))))
    return sorted(fits, key=lambda fit: -fit.log_likelihood)


def _decided(fits: Sequence[_Fit], layout: str | None) -> Recognition:
    best = fits[0]
    named = next((fit for fit in fits if fit.layout.name == layout), best)
    largest = _LARGEST_MISFIT if layout is None else _LARGEST_MISFIT_NAMED
    if best.misfit > largest:
        tried = " or ".join(fit.layout.name for fit in fits)
        raise InvalidInputError(
            f"{len(best.layout)} points are not arranged as a person's in layout {tried} (misfit "
            f"{best.misfit:.1f}, {largest:g} at most); check their order, and that y points down"
        )
    if best.log_likelihood - named.log_likelihood > _LEAST_MARGIN:
        raise InvalidInputError(
            f"layout {layout}: the points are arranged as those of {best.layout.name} (misfit "
            f"{best.misfit:.1f} instead of {named.misfit:.1f}); name that layout"
        )
    if layout is None and len(fits) > 1 and best.log_likelihood - fits[1].log_likelihood < _LEAST_MARGIN:
        either = f"{best.layout.name} or {fits[1].layout.name}"
        raise InvalidInputError(f"the points may be in layout {either}; name the layout")
    form = named.layout
    others = ", ".join(f"{fit.misfit:.1f} as {fit.layout.name}" for fit in fits if fit is not named)
    how = f"misfit {named.misfit:.1f}" + (f" against {others}" if others else "")
    return Recognition(form, f"{form.title}: confirmed by geometry ({how})", tuple(range(len(form))))
