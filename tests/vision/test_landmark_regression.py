"""The adapter: near the joints, whatever is seen of a person, and honest about the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS, landmarks_px, points_px, walking, watching

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.vision.landmark_regression import LEAST_SHARE, LandmarkRegression, read_gaussian
from rtof_kin.vision.layouts import detector_table

ADAPTER = LandmarkRegression.default()


@pytest.fixture(scope="module")
def motion() -> MotionSequence:
    return walking()


@pytest.fixture(scope="module")
def camera(motion: MotionSequence) -> Camera:
    return watching(motion)


def sees(layout: str, motion: MotionSequence, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    uv = points_px(layout, motion, camera)
    return uv, np.full(uv.shape[:2], 0.8)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_joints_are_found_better_than_by_the_plain_mapping(
    layout: str, motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees(layout, motion, camera)
    found, plain = ADAPTER.apply(layout, uv, confidence), ADAPTER.naive(layout, uv, confidence)
    joints = motion.skeleton.names
    assert found.names[: len(joints)] == joints
    assert plain.names == joints
    truth = landmarks_px(joints, motion, camera)
    error = np.linalg.norm(found.uv_px[:, : len(joints)] - truth, axis=-1)
    plain_error = np.linalg.norm(plain.uv_px - truth, axis=-1)
    assert error.mean() < 4.0  # px; 1 cm is 3 px here
    assert error.mean() < 0.5 * plain_error.mean()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_landmarks_that_the_detector_shows_come_along(
    layout: str, motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees(layout, motion, camera)
    found = ADAPTER.apply(layout, uv, confidence)
    extra = found.names[21:]
    assert ("RightHeel" in extra) == (layout not in ("coco17", "human36m17"))
    assert ("Nose" in extra) == (layout != "human36m17")
    assert ("LeftHandEnd" in extra) == (layout == "mediapipe33")
    truth = landmarks_px(found.names, motion, camera)
    known = found.confidence > 0
    error = np.linalg.norm(found.uv_px - truth, axis=-1)
    assert error[known].mean() < 5.0
    assert set(found.names) <= set(motion.skeleton.landmarks)


@pytest.mark.parametrize("layout", ["joints", "landmarks"])
def test_the_skeletons_own_points_stay_as_they_are(
    layout: str, motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees(layout, motion, camera)
    found = ADAPTER.apply(layout, uv, confidence)
    np.testing.assert_array_equal(found.uv_px, uv)
    np.testing.assert_array_equal(found.confidence, confidence)
    assert found.names == tuple(motion.skeleton.landmarks)[: uv.shape[1]]


def test_hidden_points_cost_what_only_they_told(motion: MotionSequence, camera: Camera) -> None:
    uv, confidence = sees("halpe26", motion, camera)
    form = detector_table().layout("halpe26")
    for name in ("RightWrist", "LeftAnkle", "LeftHeel", "LeftBigToe", "LeftSmallToe"):
        confidence[:, form.points.index(name)] = 0.0
    found = ADAPTER.apply("halpe26", uv, confidence)
    seen = dict(zip(found.names, (found.confidence > 0).T, strict=True))
    for name in ("RightHand", "LeftFoot", "LeftHeel", "LeftToe"):
        assert not seen[name].any()
        assert np.isnan(found.uv_px[:, found.names.index(name)]).all()
        assert np.isnan(found.sigma_px[:, found.names.index(name)]).all()
    for name in ("LeftHand", "RightForeArm", "LeftLeg", "RightFoot", "Head", "Hips", "Spine2"):
        assert seen[name].all()
    known = found.confidence > 0
    error = np.linalg.norm(found.uv_px - landmarks_px(found.names, motion, camera), axis=-1)
    assert error[known].mean() < 5.0


def test_frames_with_too_few_points_are_unseen_and_the_others_unharmed(
    motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees("coco17", motion, camera)
    whole = ADAPTER.apply("coco17", uv, confidence)
    confidence[10:20, 3:] = 0.0
    uv[30] = np.nan
    found = ADAPTER.apply("coco17", uv, confidence)
    gone = np.r_[10:20, 30]
    assert not found.confidence[gone].any()
    assert np.isnan(found.uv_px[gone]).all()
    rest = np.setdiff1d(np.arange(len(uv)), gone)
    np.testing.assert_allclose(found.uv_px[rest], whole.uv_px[rest])


def test_guessed_joints_count_less_and_are_known_to_be_worse(motion: MotionSequence, camera: Camera) -> None:
    uv, confidence = sees("coco17", motion, camera)
    found = ADAPTER.apply("coco17", uv, confidence)
    at = {name: i for i, name in enumerate(found.names)}
    for spine in ("Spine", "Spine1", "Spine2"):
        for limb in ("RightLeg", "LeftFoot", "RightHand", "LeftForeArm"):
            assert found.confidence[0, at[spine]] < found.confidence[0, at[limb]]
        assert found.sigma_px[0, at[spine]] > found.sigma_px[0, at["RightLeg"]]
    assert np.all(found.confidence <= 0.8)
    assert np.all(found.confidence[found.confidence > 0] >= 0.8 * LEAST_SHARE)


def test_a_joint_inherits_the_confidence_of_the_points_that_tell_it(
    motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees("coco17", motion, camera)
    before = ADAPTER.apply("coco17", uv, confidence)
    wrist = detector_table().layout("coco17").points.index("LeftWrist")
    confidence[:, wrist] = 0.2
    after = ADAPTER.apply("coco17", uv, confidence)
    ratio = dict(zip(after.names, (after.confidence / before.confidence)[0], strict=True))
    assert ratio["LeftHand"] < 0.6
    assert ratio["RightFoot"] > 0.95


def test_a_person_twice_as_far_is_half_as_large_and_so_are_the_errors(
    motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees("body25", motion, camera)
    near = ADAPTER.apply("body25", uv, confidence)
    far = ADAPTER.apply("body25", uv / 2 + 300.0, confidence)
    np.testing.assert_allclose(far.uv_px, near.uv_px / 2 + 300.0, atol=1e-2)
    np.testing.assert_allclose(far.sigma_px, near.sigma_px / 2, rtol=1e-6)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_somebody_who_lies_or_hangs_is_found_as_well_as_standing(
    quarter: int, motion: MotionSequence, camera: Camera
) -> None:
    uv, confidence = sees("halpe26", motion, camera)
    c, s = [(0, 1), (-1, 0), (0, -1)][quarter - 1]
    turn = np.array([[c, -s], [s, c]])
    standing = ADAPTER.apply("halpe26", uv, confidence)
    turned = ADAPTER.apply("halpe26", uv @ turn.T, confidence)
    np.testing.assert_allclose(turned.uv_px, standing.uv_px @ turn.T, atol=1e-6)
    np.testing.assert_allclose(turned.sigma_px, standing.sigma_px, rtol=1e-9)


def test_leaning_far_over_costs_little(motion: MotionSequence, camera: Camera) -> None:
    uv, confidence = sees("halpe26", motion, camera)
    truth = landmarks_px(motion.skeleton.names, motion, camera)
    for angle in np.radians([20, 45, 70, 110]):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        found = ADAPTER.apply("halpe26", uv @ turn.T, confidence)
        error = np.linalg.norm(found.uv_px[:, :21] - truth @ turn.T, axis=-1)
        assert error.mean() < 5.0


def test_what_is_no_persons_points_is_refused(motion: MotionSequence, camera: Camera) -> None:
    uv, confidence = sees("coco17", motion, camera)
    with pytest.raises(UnknownNameError, match="layout of keypoints 'coco'.*coco17"):
        ADAPTER.apply("coco", uv, confidence)
    with pytest.raises(ShapeError, match=r"layout body25: expected shape \(T, 25, 2\)"):
        ADAPTER.apply("body25", uv, confidence)
    with pytest.raises(
        ShapeError, match="no point is seen in any of the 50 frames.*highest confidence is 0,"
    ):
        ADAPTER.apply("coco17", uv, 0 * confidence)
    with pytest.raises(ShapeError, match="no point is seen"):
        ADAPTER.naive("coco17", np.full_like(uv, np.nan), confidence)
    confidence[:, 2:] = 0.0
    with pytest.raises(ShapeError, match="in no frame are enough points seen.*at least 4 of its 17"):
        ADAPTER.apply("coco17", uv, confidence)


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"mean": None}, "no array mean; build it again"),
        ({"offsets": np.zeros((3, 3))}, "points that lie elsewhere than in .*detectors.toml"),
        ({"offsets": 1.0}, "points that lie elsewhere"),
        ({"covariance": np.eye(4)}, "covariance of points: expected shape .*build it again"),
    ],
)  # fmt: skip
def test_a_fit_to_other_points_is_refused(changed: dict[str, object], message: str, tmp_path: Path) -> None:
    arrays = {**read_npz(model_path("detectors.npz")), **changed}
    kept = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    path = tmp_path / "detectors.npz"
    np.savez(path, **kept)  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=message):
        read_gaussian(path, detector_table())
