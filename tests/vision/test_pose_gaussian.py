"""The normal distribution of a person's points: conditionals, size, place, errors."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.vision.landmark_regression import ANYWHERE, PoseGaussian

Array = NDArray[np.float64]
NAMES = tuple("abcdefgh")
SEEN, WANTED = tuple("bcdfg"), tuple("ah")


@pytest.fixture(scope="module")
def gaussian() -> PoseGaussian:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(16, 16)) * 0.1
    return PoseGaussian(NAMES, rng.normal(size=(8, 2)), root @ root.T, noise=0.03)


def drawn(gaussian: PoseGaussian, count: int, seed: int = 1) -> Array:
    """(count, 8, 2) persons, as they are."""
    rng = np.random.default_rng(seed)
    z = rng.multivariate_normal(gaussian.mean.ravel(), gaussian.covariance, count)
    return z.reshape(count, 8, 2)


def observed(points: Array, names: tuple[str, ...]) -> Array:
    return points[:, [NAMES.index(name) for name in names]]


def test_the_estimate_is_the_textbook_conditional_mean(gaussian: PoseGaussian) -> None:
    x = observed(drawn(gaussian, 3), SEEN)
    i = np.array([2 * NAMES.index(n) + k for n in SEEN for k in (0, 1)])
    j = np.array([2 * NAMES.index(n) + k for n in WANTED for k in (0, 1)])
    anywhere = ANYWHERE * np.tile(np.eye(2), (8, 8))
    C = gaussian.covariance + anywhere
    A = C[np.ix_(i, i)] + gaussian.noise**2 * np.eye(len(i))
    m = gaussian.mean.ravel()
    want = m[j] + (x.reshape(3, -1) - m[i]) @ np.linalg.solve(A, C[np.ix_(i, j)])
    got = gaussian.given(SEEN).estimate(gaussian.given(SEEN).regression(WANTED), x, np.ones(3))
    np.testing.assert_allclose(got.reshape(3, -1), want, atol=2e-5)  # the prior on place is nearly flat


def test_the_scale_maximises_the_likelihood(gaussian: PoseGaussian) -> None:
    x = observed(drawn(gaussian, 1), SEEN) * 50.0
    i = np.array([2 * NAMES.index(n) + k for n in SEEN for k in (0, 1)])
    C = gaussian.covariance[np.ix_(i, i)] + ANYWHERE * np.tile(np.eye(2), (5, 5))
    C += gaussian.noise**2 * np.eye(10)
    centred = (x[0] - x[0].mean(axis=0)).ravel()
    mean = observed(gaussian.mean[None], SEEN)[0]
    mean = (mean - mean.mean(axis=0)).ravel()

    def minus_log_p(log_s: float) -> float:
        s = np.exp(log_s)
        # 8 of the 10 coordinates are left once the person may stand anywhere.
        return float(-8 * log_s - multivariate_normal(mean, C).logpdf(s * centred))

    best = minimize_scalar(minus_log_p, bounds=(-8, 2), method="bounded", options={"xatol": 1e-10})
    found = gaussian.given(SEEN).likelihood(x).scale[0]
    assert np.log(found) == pytest.approx(best.x, abs=1e-5)


def test_expected_errors_equal_actual_errors(gaussian: PoseGaussian) -> None:
    regression = gaussian.given(SEEN).regression(WANTED)
    points = drawn(gaussian, 20000)
    noisy = points + gaussian.noise * np.random.default_rng(2).normal(size=points.shape)
    for seen, promised in (
        (points, regression.model_variance),
        (noisy, regression.model_variance + regression.noise_variance),
    ):
        got = gaussian.given(SEEN).estimate(regression, observed(seen, SEEN), np.ones(20000))
        made = ((got - observed(points, WANTED)) ** 2).mean(axis=(0, 2))
        np.testing.assert_allclose(made, promised, rtol=0.05)


def test_the_misfit_of_its_own_samples_is_one(gaussian: PoseGaussian) -> None:
    points = drawn(gaussian, 2000)
    points = points + gaussian.noise * np.random.default_rng(3).normal(size=points.shape)
    right = gaussian.given(SEEN).likelihood(observed(points, SEEN))
    assert right.misfit.mean() == pytest.approx(1.0, abs=0.2)
    wrong = gaussian.given(SEEN).likelihood(observed(points, tuple("gfdcb")))
    assert np.median(wrong.misfit) > 3 * np.median(right.misfit)
    assert np.mean(right.per_point > wrong.per_point) > 0.99


def test_more_points_never_increase_the_error(gaussian: PoseGaussian) -> None:
    regressions = [gaussian.given(SEEN[:k]).regression(WANTED) for k in range(1, 6)]
    errors = np.array([r.model_variance + r.noise_variance for r in regressions])
    assert np.all(np.diff(errors, axis=0) <= 1e-9)
    weight = gaussian.given(SEEN).regression(("b", "d")).weight
    np.testing.assert_allclose(weight.sum(axis=1), 1.0)
    assert np.argmax(weight, axis=1).tolist() == [SEEN.index("b"), SEEN.index("d")]


def test_wrong_shapes_and_names_are_refused(gaussian: PoseGaussian) -> None:
    with pytest.raises(InvalidInputError, match="covariance of points"):
        PoseGaussian(NAMES, gaussian.mean, gaussian.covariance[:4, :4], 0.03)
    with pytest.raises(UnknownNameError, match="point 'z'"):
        gaussian.given(("z",))
