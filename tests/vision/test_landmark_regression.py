"""Landmark regression: small errors for any detected points, and correct expected errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from detector_support import LAYOUTS, landmarks_px, points_px, walking, watching
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.vision.landmark_regression import ANYWHERE, LEAST_SHARE, LandmarkRegression, PoseGaussian, recognise
from rtof_kin.vision.layouts import detector_table, own

Array = NDArray[np.float64]
REGRESSION = LandmarkRegression.default()
MOTION = walking()
CAMERA = watching(MOTION)


def detected(layout: str) -> tuple[Array, Array]:
    uv = points_px(layout, MOTION, CAMERA)
    return uv, np.full(uv.shape[:2], 0.8)


def errors(found: Any, turn: Array | None = None) -> Array:
    """(T, L) px."""
    truth = landmarks_px(found.names, MOTION, CAMERA) @ (np.eye(2) if turn is None else turn.T)
    return np.asarray(np.linalg.norm(found.uv_px - truth, axis=-1))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_joints_and_shown_landmarks_have_small_errors(layout: str) -> None:
    found = REGRESSION.apply(layout, *detected(layout))
    assert found.names[:21] == MOTION.skeleton.names
    assert errors(found)[:, :21].mean() < 4.0  # px; 1 cm is 3 px here
    assert errors(found)[found.confidence > 0].mean() < 5.0
    extra = found.names[21:]
    assert ("RightHeel" in extra) == (layout not in ("coco17", "human36m17"))
    assert ("Nose" in extra) == (layout != "human36m17")
    assert ("LeftHandEnd" in extra) == (layout == "mediapipe33")
    assert set(found.names) <= set(MOTION.skeleton.landmarks)


@pytest.mark.parametrize("layout", ["joints", "landmarks"])
def test_the_skeletons_own_points_are_unchanged(layout: str) -> None:
    uv, confidence = detected(layout)
    found = REGRESSION.apply(layout, uv, confidence)
    np.testing.assert_array_equal(found.uv_px, uv)
    np.testing.assert_array_equal(found.confidence, confidence)
    assert found.names == tuple(MOTION.skeleton.landmarks)[: uv.shape[1]]


def test_landmarks_without_their_points_are_unobserved() -> None:
    uv, confidence = detected("halpe26")
    points = detector_table().layout("halpe26").points
    for name in ("RightWrist", "LeftAnkle", "LeftHeel", "LeftBigToe", "LeftSmallToe"):
        confidence[:, points.index(name)] = 0.0
    found = REGRESSION.apply("halpe26", uv, confidence)
    seen = dict(zip(found.names, (found.confidence > 0).T, strict=True))
    for name in ("RightHand", "LeftFoot", "LeftHeel", "LeftToe"):
        assert not seen[name].any()
        assert np.isnan(found.uv_px[:, found.names.index(name)]).all()
        assert np.isnan(found.sigma_px[:, found.names.index(name)]).all()
    for name in ("LeftHand", "RightForeArm", "LeftLeg", "RightFoot", "Head", "Hips", "Spine2"):
        assert seen[name].all()
    assert errors(found)[found.confidence > 0].mean() < 5.0


def test_frames_with_too_few_points_are_unobserved_and_others_unchanged() -> None:
    uv, confidence = detected("coco17")
    whole = REGRESSION.apply("coco17", uv, confidence)
    confidence[10:20, 3:] = 0.0
    uv[30] = np.nan
    found = REGRESSION.apply("coco17", uv, confidence)
    gone = np.r_[10:20, 30]
    assert not found.confidence[gone].any()
    assert np.isnan(found.uv_px[gone]).all()
    rest = np.setdiff1d(np.arange(len(uv)), gone)
    np.testing.assert_allclose(found.uv_px[rest], whole.uv_px[rest])


def test_joints_without_near_points_have_less_confidence_and_larger_errors() -> None:
    found = REGRESSION.apply("coco17", *detected("coco17"))
    at = {name: i for i, name in enumerate(found.names)}
    for spine in ("Spine", "Spine1", "Spine2"):
        for limb in ("RightLeg", "LeftFoot", "RightHand", "LeftForeArm"):
            assert found.confidence[0, at[spine]] < found.confidence[0, at[limb]]
        assert found.sigma_px[0, at[spine]] > found.sigma_px[0, at["RightLeg"]]
    assert np.all(found.confidence <= 0.8)
    assert np.all(found.confidence[found.confidence > 0] >= 0.8 * LEAST_SHARE)


def test_a_joint_inherits_the_confidence_of_near_points() -> None:
    uv, confidence = detected("coco17")
    before = REGRESSION.apply("coco17", uv, confidence)
    confidence[:, detector_table().layout("coco17").points.index("LeftWrist")] = 0.2
    after = REGRESSION.apply("coco17", uv, confidence)
    ratio = dict(zip(after.names, (after.confidence / before.confidence)[0], strict=True))
    assert ratio["LeftHand"] < 0.6
    assert ratio["RightFoot"] > 0.95


def test_results_scale_with_the_person() -> None:
    uv, confidence = detected("body25")
    near = REGRESSION.apply("body25", uv, confidence)
    far = REGRESSION.apply("body25", uv / 2 + 300.0, confidence)
    np.testing.assert_allclose(far.uv_px, near.uv_px / 2 + 300.0, atol=1e-2)
    np.testing.assert_allclose(far.sigma_px, near.sigma_px / 2, rtol=1e-6)


@pytest.mark.parametrize("degrees", [20, 45, 70, 90, 110, 180, 270])
def test_results_rotate_with_the_person(degrees: int) -> None:
    uv, confidence = detected("halpe26")
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    turned = REGRESSION.apply("halpe26", uv @ turn.T, confidence)
    assert errors(turned, turn)[:, :21].mean() < 5.0
    if degrees % 90 == 0:
        standing = REGRESSION.apply("halpe26", uv, confidence)
        np.testing.assert_allclose(turned.uv_px, standing.uv_px @ turn.T, atol=1e-6)
        np.testing.assert_allclose(turned.sigma_px, standing.sigma_px, rtol=1e-9)


def test_too_few_points_and_unknown_layouts_are_refused() -> None:
    uv, confidence = detected("coco17")
    with pytest.raises(UnknownNameError, match=r"'coco'.*coco17"):
        REGRESSION.apply("coco", uv, confidence)
    with pytest.raises(InvalidInputError, match=r"layout body25: expected shape \(T, 25, 2\)"):
        REGRESSION.apply("body25", uv, confidence)
    with pytest.raises(InvalidInputError, match="highest confidence is 0,"):
        REGRESSION.apply("coco17", uv, 0 * confidence)
    confidence[:, 2:] = 0.0
    with pytest.raises(InvalidInputError, match="at least 4 of its 17"):
        REGRESSION.apply("coco17", uv, confidence)


def test_the_shipped_distribution_was_fitted_to_the_points_of_the_table() -> None:
    offsets = [point.offset for point in detector_table().fitted.points]
    np.testing.assert_allclose(read_npz(model_path("detectors.npz"))["offsets"], offsets, atol=1e-9)


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


EVERY = (*LAYOUTS, "joints", "landmarks")


@pytest.fixture(scope="module")
def seen() -> dict[str, tuple[Array, Array]]:
    """Noisy points, an eighth of them undetected, in every layout."""
    motion, rng = walking(), np.random.default_rng(0)
    out = {}
    for layout in EVERY:
        uv = points_px(layout, motion, watching(motion))
        confidence = np.where(rng.random(uv.shape[:2]) < 0.125, 0.0, 0.7)
        out[layout] = uv + 5 * rng.normal(size=uv.shape), confidence
    return out


@pytest.mark.parametrize("layout", EVERY)
@pytest.mark.parametrize("frames", [slice(0, 1), slice(None)])
def test_a_layout_is_recognised_by_geometry(layout: str, frames: slice, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = (array[frames] for array in seen[layout])
    found = recognise(uv, confidence)
    assert found.layout.name == layout
    assert "confirmed by geometry (misfit" in found.reason
    assert found.order == tuple(range(uv.shape[1]))
    assert recognise(uv, confidence, layout=layout).layout.name == layout


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_turned_videos_are_recognised(quarter: int, seen: dict[str, tuple[Array, Array]]) -> None:
    c, s = [(0, 1), (-1, 0), (0, -1)][quarter - 1]
    for layout in ("coco17", "human36m17", "body25b"):
        uv, confidence = seen[layout]
        assert recognise(uv @ np.array([[c, -s], [s, c]]), confidence).layout.name == layout


@pytest.mark.parametrize(
    "named, is_",
    [
        ("body25", "body25b"),
        ("coco17", "human36m17"),
        ("mediapipe33", "landmarks"),
        ("body25b", "body25"),
        ("human36m17", "coco17"),
    ],
)
def test_another_layout_with_as_many_points_is_refused(
    named: str, is_: str, seen: dict[str, tuple[Array, Array]]
) -> None:
    with pytest.raises(InvalidInputError, match=f"layout {named}: .* as those of {is_}"):
        recognise(*seen[is_], layout=named)


def test_a_wrong_number_of_points_is_refused(seen: dict[str, tuple[Array, Array]]) -> None:
    with pytest.raises(InvalidInputError, match=r"halpe26 has 26 points.* 25 .*body25, body25b"):
        recognise(*seen["body25"], layout="halpe26")
    uv, confidence = seen["halpe26"]
    with pytest.raises(InvalidInputError, match=r"no layout has 24 points; known: body25 \(25\)"):
        recognise(uv[:, :24], confidence[:, :24])
    with pytest.raises(UnknownNameError, match="'openpose'"):
        recognise(uv, confidence, layout="openpose")


@pytest.mark.parametrize("layout", ["body25", "coco17", "halpe26", "joints"])
@pytest.mark.parametrize("named", [False, True])
def test_a_wrong_order_of_points_is_refused(layout: str, named: bool, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = seen[layout]
    order = np.random.default_rng(1).permutation(uv.shape[1])
    with pytest.raises(InvalidInputError, match="check their order"):
        recognise(uv[:, order], confidence[:, order], layout=layout if named else None)
    with pytest.raises(InvalidInputError, match="check their order"):
        recognise(np.random.default_rng(0).uniform(0, 1000, uv.shape), np.ones(uv.shape[:2]))


def test_names_determine_layout_and_order(seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = seen["halpe26"]
    names = detector_table().layout("halpe26").names  # the first 17 are COCO's
    order = np.random.default_rng(1).permutation(26)
    found = recognise(uv[:, order], confidence[:, order], [names[i] for i in order])
    assert found.layout.name == "halpe26"
    assert "26 points are named" in found.reason
    np.testing.assert_array_equal(order[list(found.order)], np.arange(26))
    found = recognise(uv, confidence, names, layout="coco17")
    assert found.layout.name == "coco17"
    assert found.order == tuple(range(17))


def test_names_of_another_layout_are_refused(seen: dict[str, tuple[Array, Array]]) -> None:
    names = detector_table().layout("body25").names
    with pytest.raises(InvalidInputError, match=r"named Nose, Neck.*not layout body25b.*no UpperNeck"):
        recognise(*seen["body25b"], names, layout="body25b")
    with pytest.raises(InvalidInputError, match=r"named a, b, c,.* known: body25,"):
        recognise(np.zeros((1, 3, 2)), np.ones((1, 3)), ["a", "b", "c"])


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_detected_points_are_refused(count: int, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, _ = seen["coco17"]
    confidence = np.where(np.arange(17) < count, 0.9, 0.0) * np.ones(uv.shape[:2])
    with pytest.raises(InvalidInputError, match=f"more than {count} of 17 points"):
        recognise(uv, confidence)


def test_placed_points_are_predicted_as_well_as_stated() -> None:
    """From all of the fitted points of a walk, seen exactly."""
    known = REGRESSION.gaussian
    table = detector_table()
    layout = table.layout("anatomical52")
    placed = [name for name in layout.points if name in table.places]
    fitted = [name for name in detector_table().layout("halpe26").points]
    given = known.given(fitted)
    uv = points_px("halpe26", MOTION, CAMERA)
    turn, fit = given.turned_upright(uv)
    assert not turn.any()
    regression = given.regression(placed)
    found = given.estimate(regression, uv, fit.scale)
    exact = points_px("anatomical52", MOTION, CAMERA)[:, [layout.points.index(name) for name in placed]]
    scale = fit.scale[:, None, None]
    error = scale * (found - exact)
    spread = np.array([np.sqrt(np.mean(np.square(table.places[name].spread))) for name in placed])
    stated = np.sqrt(regression.model_variance + regression.noise_variance)
    assert np.all(stated >= 2.55 * spread * 0.99)
    assert np.sqrt((error**2).mean()) < np.sqrt(np.mean(stated**2))  # the places are exact here
    assert np.abs(error.mean(axis=(0, 2)) / stated).max() < 1.5


def test_two_sides_of_a_knee_give_its_middle() -> None:
    given = REGRESSION.gaussian.given(["LeftKneeLateral", "LeftKneeMedial", "LeftHip", "LeftAnkle"])
    one = REGRESSION.gaussian.given(["LeftKneeLateral", "LeftHip", "LeftAnkle"])
    knee = [own("LeftLeg")]
    assert given.regression(knee).model_variance < 0.6 * one.regression(knee).model_variance


def test_joints_follow_from_anatomical_points() -> None:
    confidence = np.full((50, 52), 0.8)
    found = REGRESSION.apply("anatomical52", points_px("anatomical52", MOTION, CAMERA), confidence)
    before = REGRESSION.apply("coco17", *detected("coco17"))
    trunk = [found.names.index(name) for name in ("Hips", "Spine", "Spine1", "Spine2", "Spine3")]
    assert errors(found)[:, trunk].mean() < errors(before)[:, trunk].mean()
    assert np.all(found.sigma_px[:, trunk] < before.sigma_px[:, trunk])
    assert {"LeftHeel", "RightToeBase"} <= set(found.names)
