"""Planted exchanges of sides and jumps to another person are found and corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.imu_stream import FaultKind
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras
from rtof_kin.vision.outlier_rejection import reject_keypoint_outliers

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
SEEN = planted.keypoints(planted.human(BODY, 180).poses, sigma_px=3.0)
LEGS = ("UpLeg", "Leg", "Foot")


def exchanged(seen: KeypointSequence, frames: slice, parts: tuple[str, ...] | None = None) -> KeypointSequence:
    """Left and right of some parts, or of all, exchanged in some frames."""
    source = list(range(len(seen.names)))
    for i, name in enumerate(seen.names):
        part = name.removeprefix("Left").removeprefix("Right")
        if part != name and (parts is None or part in parts):
            side = "Right" if name.startswith("Left") else "Left"
            source[i] = seen.names.index(side + part)
    uv, confidence = seen.uv_px.copy(), seen.confidence.copy()
    uv[frames], confidence[frames] = uv[frames][:, source], confidence[frames][:, source]
    return replace(seen, uv_px=uv, confidence=confidence)


def jumped(seen: KeypointSequence, frames: slice, px: float = 500.0) -> KeypointSequence:
    """Somebody to the side, three quarters as large, in some frames."""
    uv = seen.uv_px.copy()
    uv[frames] = uv[frames].mean(axis=1, keepdims=True) * [0.25, 0.25] + 0.75 * uv[frames] + [px, 0]
    return replace(seen, uv_px=uv)


def test_correct_keypoints_are_returned_unchanged() -> None:
    for seen in (SEEN, SEEN[::2], planted.keypoints(planted.moving(BODY, 60).poses)):
        again, faults = reject_keypoint_outliers(seen)
        assert again is seen
        assert faults == ()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sigma_px", [0.0, 5.0])
def test_no_faults_in_varied_motion(seed: int, sigma_px: float) -> None:
    seen = planted.keypoints(planted.human(BODY, 240, seed=10 * seed).poses, sigma_px, seed)
    assert reject_keypoint_outliers(seen) == (seen, ())


def test_no_faults_in_gaps_single_outliers_and_few_frames() -> None:
    rng = np.random.default_rng(0)
    outliers = 80 * rng.standard_normal(SEEN.uv_px.shape) * (rng.random((180, 21, 1)) < 0.1)
    away = SEEN.uv_px.copy()
    away[60:120] = np.nan
    away[120:] += [300.0, 0.0]
    few = [SEEN[:n] for n in (1, 2, 5)]
    cases = [replace(SEEN, uv_px=SEEN.uv_px + outliers), replace(SEEN, uv_px=away), *few]
    for seen in (*cases, *(planted.unseen(one, slice(None)) for one in few)):
        assert reject_keypoint_outliers(seen)[1] == ()


@pytest.mark.parametrize("frames", [slice(60, 90), slice(70, 71)])
def test_exchanged_sides_are_corrected(frames: slice) -> None:
    mended, faults = reject_keypoint_outliers(exchanged(SEEN, frames))
    np.testing.assert_array_equal(mended.uv_px, SEEN.uv_px)
    np.testing.assert_array_equal(mended.confidence, SEEN.confidence)
    assert {f.what for f in faults} == {"keypoints of legs", "keypoints of arms and head"}
    for fault in faults:
        assert fault.kind is FaultKind.SIDES
        assert fault.start == SEEN.times[frames.start]
        assert fault.stop == SEEN.times[frames.stop - 1]


@pytest.mark.parametrize("every", [1, 2])
def test_exchanged_legs_are_corrected_with_their_confidence(every: int) -> None:
    own = replace(SEEN, confidence=np.linspace(0.5, 1.0, len(SEEN.names)) * np.ones((180, 1)))[::every]
    mended, faults = reject_keypoint_outliers(exchanged(own, slice(60 // every, 90 // every), LEGS))
    np.testing.assert_array_equal(mended.uv_px, own.uv_px)
    np.testing.assert_array_equal(mended.confidence, own.confidence)
    assert [f.what for f in faults] == ["keypoints of legs"]


def test_undetected_points_do_not_prevent_a_correction() -> None:
    seen = planted.unseen(SEEN, slice(None), BODY.index("LeftHand", "RightFoot"))
    seen = planted.unseen(seen, slice(0, None, 3), BODY.index("LeftForeArm"))
    mended, faults = reject_keypoint_outliers(exchanged(seen, slice(61, 91)))
    np.testing.assert_array_equal(mended.uv_px, seen.uv_px)
    assert {f.kind for f in faults} == {FaultKind.SIDES}
    assert len(faults) == 2


@pytest.mark.parametrize("frames", [slice(100, None), slice(60, 100)])
def test_long_or_open_exchanges_are_reported_only(frames: slice) -> None:
    wrong = exchanged(SEEN, frames)
    mended, faults = reject_keypoint_outliers(wrong)
    np.testing.assert_array_equal(mended.uv_px, wrong.uv_px)
    assert faults
    assert all(f.kind is FaultKind.SIDES_IN_DOUBT for f in faults)
    assert faults[0].start == SEEN.times[frames.start]


def test_open_exchanges_end_at_a_gap() -> None:
    seen = planted.unseen(SEEN, slice(90, 120))
    mended, faults = reject_keypoint_outliers(exchanged(seen, slice(80, 90)))
    assert {f.kind for f in faults} == {FaultKind.SIDES_IN_DOUBT}
    np.testing.assert_array_equal(mended.uv_px[120:], SEEN.uv_px[120:])


def test_another_persons_keypoints_are_removed() -> None:
    mended, (fault,) = reject_keypoint_outliers(jumped(SEEN, slice(60, 90)))
    assert fault.kind is FaultKind.SOMEBODY_ELSE
    assert (fault.start, fault.stop) == (SEEN.times[60], SEEN.times[89])
    assert np.isnan(mended.uv_px[60:90]).all()
    assert not mended.seen[60:90].any()
    np.testing.assert_array_equal(mended.uv_px[:60], SEEN.uv_px[:60])
    np.testing.assert_array_equal(mended.uv_px[90:], SEEN.uv_px[90:])


def test_jumps_without_return_are_reported_only() -> None:
    wrong = jumped(SEEN, slice(90, None))
    mended, (fault,) = reject_keypoint_outliers(wrong)
    assert fault.kind is FaultKind.JUMP
    assert fault.start == SEEN.times[90]
    np.testing.assert_array_equal(mended.uv_px, wrong.uv_px)


def test_sides_may_be_named_by_a_letter() -> None:
    names = ("Hip", "LHip", "RHip", "LKnee", "RKnee", "LFoot", "RFoot", "Head", "Neck")
    legs = tuple(side + part for part in LEGS for side in ("Left", "Right"))
    seen = SEEN.select(("Hips", *legs, "Head", "Neck"))
    mended, faults = reject_keypoint_outliers(replace(exchanged(seen, slice(60, 90)), names=names))
    np.testing.assert_array_equal(mended.uv_px, seen.uv_px)
    assert [f.what for f in faults] == ["keypoints of legs"]


def test_nine_in_ten_corrections_of_simulated_detections_are_right() -> None:
    better = []
    for seed in range(1, 5):
        poses = planted.human(BODY, 600, seed=seed).poses
        wrong, right = (
            simulate(
                poses,
                BODY.joint_offsets,
                camera=standard_cameras(poses, seed)[seed % 4],
                seed=seed,
                settings=SimulationSettings(DetectorErrors(exchanges=factor), sensors=()),
            ).video
            for factor in (2.0, 0.0)
        )
        mended, faults = reject_keypoint_outliers(wrong, person=False)
        before, after = (np.nansum(np.abs(seen.uv_px - right.uv_px), axis=(1, 2)) for seen in (wrong, mended))
        for fault in faults:
            if fault.kind is FaultKind.SIDES:
                during = (wrong.times >= fault.start) & (wrong.times <= fault.stop)
                better.append(after[during].sum() <= before[during].sum())
    assert len(better) > 10
    assert np.mean(better) >= 0.9


def test_a_detectors_own_points_are_treated_as_the_landmarks() -> None:
    own = tuple(f"coco17:{side}{part}" for side in ("Left", "Right") for part in ("Ear", "Hip", "Knee"))
    like = ["LeftShoulder", "LeftUpLeg", "LeftLeg", "RightShoulder", "RightUpLeg", "RightLeg"]
    columns = [*range(len(SEEN.names)), *(SEEN.names.index(name) for name in like)]
    uv, confidence = SEEN.uv_px[:, columns], SEEN.confidence[:, columns]
    seen = replace(SEEN, uv_px=uv, confidence=confidence, names=SEEN.names + own)
    swapped = exchanged(SEEN, slice(60, 70), LEGS)
    wrong = seen.uv_px.copy()
    wrong[:, : len(SEEN.names)] = swapped.uv_px
    wrong[60:70, -6:] = seen.uv_px[60:70][:, [-6, -2, -1, -3, -5, -4]]
    again, faults = reject_keypoint_outliers(replace(seen, uv_px=wrong))
    assert [fault.kind for fault in faults] == [FaultKind.SIDES]
    np.testing.assert_allclose(again.uv_px, seen.uv_px)
    gone, _ = reject_keypoint_outliers(jumped(seen, slice(60, 70)))
    assert not gone.seen[60:70].any()
    assert gone.seen[:60].all()
