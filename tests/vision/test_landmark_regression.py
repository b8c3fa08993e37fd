"""Landmark regression: small errors for any detected points, and correct expected errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import LAYOUTS, landmarks_px, points_px, walking, watching
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.vision.landmark_regression import LEAST_SHARE, LandmarkRegression, read_gaussian
from rtof_kin.vision.layouts import detector_table

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


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"mean": None}, "no array mean"),
        ({"offsets": np.zeros((3, 3))}, r"differ from those in .*detectors.toml"),
        ({"offsets": 1.0}, "build it again"),
        ({"covariance": np.eye(4)}, "covariance of points: expected shape"),
    ],
)
def test_a_fit_to_other_points_is_refused(changed: dict[str, object], message: str, tmp_path: Path) -> None:
    arrays = {**read_npz(model_path("detectors.npz")), **changed}
    kept = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    path = tmp_path / "detectors.npz"
    np.savez(path, **kept)  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=message):
        read_gaussian(path, detector_table())
