"""Preparation of a recording: even keypoints, one lift, one resampling of the sensors, SF2."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from reconstruction_support import BODY, QUICK_PRIORS, SETTINGS, TURN, Case

from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES, Mode
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import FaultKind
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.solve.fragment_solver import SolverStatus
from rtof_kin.solve.initial_guess import InertialGuidedIK
from rtof_kin.solve.settings import CartesianSettings

Array = NDArray[np.float64]


@pytest.mark.parametrize("mode", CAMERA_MODES)
@pytest.mark.parametrize("with_sensors", [True, False])
def test_video_is_lifted_for_the_clocks_and_once_with_the_sensors_of_the_mode(
    case: Case, mode: Mode, with_sensors: bool
) -> None:
    lifter, used = case.lifter(), mode in ("sf2", "rtof")
    settings = replace(SETTINGS, lift_with_sensors=with_sensors)
    result = case.run(mode, lifter=lifter, settings=settings)
    assert (result.bone_imus is not None) == used
    of_clocks = [None] if used else []
    assert lifter.sensors == [*of_clocks, result.bone_imus if used and with_sensors else None]


def test_video_is_lifted_once_more_with_calibration(case: Case) -> None:
    lifter = case.lifter()
    assert case.run(lifter=lifter, calibrate=True, priors=QUICK_PRIORS).calibration is not None
    assert len(lifter.asked) == 3


def test_rejected_sensor_runs_sf2_again_on_the_same_lift(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """The diagnosis of the setup, which a rejected sensor causes, lifts once more, without sensors."""
    refined: list[Any] = []
    refine = InertialGuidedIK.refine

    def counted(self: InertialGuidedIK, lifted: Any, *sensors: Any) -> Any:
        refined.append(lifted)
        return refine(self, lifted, *sensors)

    monkeypatch.setattr(InertialGuidedIK, "refine", counted)
    calibration, lifter = case.recording.calibration, case.lifter()
    R = np.array(calibration.R_sensor_bone)
    R[0] = R[0] @ so3.about_axis("x", np.radians(60))
    result = case.changed(calibration=replace(calibration, R_sensor_bone=R)).run(lifter=lifter)
    (fault,) = result.faults
    assert fault.kind is FaultKind.DISAGREES
    assert fault.what == planted.LIMBS[0]
    assert np.isnan(result.bone_imus.R_world_bone[:, 0]).all()
    assert len(refined) == 2
    assert refined[0] is refined[1] is result.stages["lift"]
    assert [sensors is not None for sensors in lifter.sensors] == [False, True, False]


@pytest.mark.parametrize("mode", ["sf2", "rtof"])
def test_sensors_are_resampled_to_the_frames_once(case: Case, monkeypatch: pytest.MonkeyPatch, mode: Mode) -> None:
    imus, video = case.recording.imus, case.recording.video
    calls: list[bool] = []
    resample = BoneImuSequence.resample

    def counted(self: BoneImuSequence, times: ArrayLike, max_gap: float = 0.1) -> BoneImuSequence:
        calls.append(not np.array_equal(self.times, times) and np.array_equal(times, video.times))
        return resample(self, times, max_gap)

    monkeypatch.setattr(BoneImuSequence, "resample", counted)
    late = case.changed(imus=replace(imus, times=imus.times + 1e-3), keypoints=planted.unseen(video, slice(5, 10)))
    assert late.prepare(mode).guess.poses is not None
    assert sum(calls) == 1
    late.run(mode)
    assert sum(calls) == 2


@pytest.mark.parametrize("mode", ["sf2", "rto", "rtof"])
@pytest.mark.parametrize("turned", [None, TURN], ids=["positions", "orientations"])
def test_solver_starts_from_the_lift_corrected_by_sf2(case: Case, mode: Mode, turned: Array | None) -> None:
    """With the lifter's orientations where it has them."""
    lifter, idle = case.lifter(turned=turned), CartesianSettings(max_iterations=0, refit_root=False)
    found = case.prepare(mode, lifter)
    lifted = found.stages["lift"]
    R = None if turned is None else lifted.R_world_bone
    refined = InertialGuidedIK(BODY).refine(lifted, found.bone_imus, R)
    np.testing.assert_allclose(found.start.p_world_joint, refined.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(found.start.R_world_bone, refined.R_world_bone, atol=1e-9)
    solution = case.run(mode, lifter=lifter, settings=replace(SETTINGS, fragment=idle)).solution
    if solution is not None:
        np.testing.assert_allclose(solution.poses.p_world_joint, refined.p_world_joint, atol=1e-9)


@pytest.mark.parametrize(
    "change, remedy",
    [
        (lambda k: replace(k, times=1000 * k.times), "seconds"),
        (lambda k: replace(k, uv_px=k.uv_px / 1920), "multiply x by its width"),
    ],
)
def test_keypoints_in_another_unit_are_refused(case: Case, change: Any, remedy: str) -> None:
    with pytest.raises(InvalidInputError, match=remedy):
        case.changed(keypoints=change(case.recording.video), imus=None).prepare("rto")


@pytest.mark.parametrize("mode", ["sf2", "rtof"])
@pytest.mark.parametrize(
    "missing, error, named",
    [
        (("imus", "calibration"), InvalidInputError, "needs IMUs .*'rto'"),
        (("calibration",), CalibrationError, "have no calibration"),
    ],
)
def test_mode_with_sensors_needs_calibrated_sensors(
    case: Case, mode: Mode, missing: tuple[str, ...], error: type[Exception], named: str
) -> None:
    lifter, without = case.lifter(), case.changed(**dict.fromkeys(missing))
    with pytest.raises(error, match=named):
        without.run(mode, lifter=lifter)
    assert not lifter.asked
    assert without.run("lift").metrics is not None


def keypoints_at(times: Array) -> KeypointSequence:
    """One landmark on a straight line: 100 px/s to the right, 40 px/s down."""
    uv = 500 + np.asarray(times)[:, None, None] * np.array([100.0, 40.0])
    return KeypointSequence(planted.camera(), times, uv, np.full((len(times), 1), 0.8), ("Head",))


@pytest.mark.parametrize(
    "times",
    [
        np.arange(5) / 30,
        np.array([0.0, 1.0]),
        np.array([3.0]),
        np.arange(500) / 60 + np.random.default_rng(0).uniform(-4e-3, 4e-3, 500) / 60,
    ],
    ids=["even", "two", "one", "jitter below 1 %"],
)
def test_even_times_are_kept(times: Array) -> None:
    keypoints = keypoints_at(times)
    assert evenly_spaced(keypoints) is keypoints


@settings(max_examples=60, deadline=None)
@given(jitter=st.floats(0.02, 0.4), frames=st.integers(3, 400), rate=st.floats(5, 120), seed=st.integers(0, 1000))
def test_jittering_times_become_even_and_positions_are_interpolated(
    jitter: float, frames: int, rate: float, seed: int
) -> None:
    times = (np.arange(frames) + np.random.default_rng(seed).uniform(-jitter, jitter, frames)) / rate
    keypoints = keypoints_at(times)
    even = evenly_spaced(keypoints)
    if even is not keypoints:
        np.testing.assert_allclose(np.diff(even.times), np.diff(even.times).mean(), rtol=1e-9)
    assert even.times[[0, -1]].tolist() == times[[0, -1]].tolist()
    assert evenly_spaced(even) is even
    seen = even.seen[:, 0]
    expected = 500 + even.times[seen, None] * np.array([100.0, 40.0])
    # Next to a sample, up to 1 % of a frame, the sample itself is taken.
    np.testing.assert_allclose(even.uv_px[seen, 0], expected, atol=1.1 / rate + 1e-6)
    np.testing.assert_allclose(even.confidence[seen], 0.8)


@pytest.mark.parametrize("milliseconds", [[33, 33, 34], [14, 19], [16, 17, 17]])
def test_times_rounded_to_milliseconds_have_the_mean_rate(milliseconds: list[int]) -> None:
    times = np.cumsum([0, *milliseconds * 40]) / 1000
    even = evenly_spaced(keypoints_at(times))
    assert len(even) == len(times)
    assert np.diff(even.times).mean() == pytest.approx(np.mean(milliseconds) / 1000)
    assert even.seen.all()


@pytest.mark.parametrize("start", [0.0, 12.3, 1.7e9])
@pytest.mark.parametrize("rate", [25.0, 29.97, 100.0])
def test_dropped_frames_are_missing_and_all_others_kept(
    start: float, rate: float, caplog: pytest.LogCaptureFixture
) -> None:
    dropped = [10, 11, 12, 25]
    with caplog.at_level(logging.WARNING):
        even = evenly_spaced(keypoints_at(start + np.delete(np.arange(40), dropped) / rate))
    np.testing.assert_allclose(even.times, start + np.arange(40) / rate, atol=1e-6)
    assert np.flatnonzero(~even.seen[:, 0]).tolist() == dropped
    assert np.isnan(even.uv_px[dropped]).all()
    for figure in ("36 samples", "40 even frames", f"{1000 / rate:.1f} ms"):
        assert figure in caplog.text


def test_missing_landmark_is_not_interpolated() -> None:
    keypoints = keypoints_at(np.arange(30) / 60 + np.where(np.arange(30) % 2, 0.002, 0.0))
    missing = np.flatnonzero(~evenly_spaced(planted.unseen(keypoints, 14)).seen[:-1, 0])
    assert 1 <= len(missing) <= 2
    assert set(missing) <= {13, 14, 15}


def test_video_with_jitter_and_dropped_frames_is_reconstructed() -> None:
    truth = planted.human(BODY, 120)
    times = truth.times + np.random.default_rng(1).uniform(-1.5e-3, 1.5e-3, 120)
    k, kept = planted.keypoints(truth.poses), np.delete(np.arange(10, 100, 2), [20, 21])
    video = replace(k, times=times[kept], uv_px=k.uv_px[kept], confidence=k.confidence[kept])
    result = Case(truth, replace(planted.recording(truth), keypoints=video)).run()
    assert len(result.motion.times) == 45
    assert np.ptp(np.diff(result.motion.times)) < 1e-9
    assert result.stage_metrics["rtof"]["mpjpe_rr_mm"] < 30
    assert result.solution.status is SolverStatus.CONVERGED


def test_further_views_are_cleaned_resampled_lifted_and_fused(case: Case) -> None:
    video = case.recording.video
    half = video.times[::2] + 0.001
    late = replace(video, times=half, uv_px=video.uv_px[::2], confidence=video.confidence[::2])
    lifter = case.lifter()
    two = case.changed(views=(late,)).prepare("rto", lifter)
    assert len(lifter.asked) == 2
    (view,) = two.recording.views
    np.testing.assert_array_equal(view.times, two.recording.video.times)
    assert view.seen[1:-1].all()
    # Both lifts are alike, so their mean is each of them.
    one = case.prepare("rto")
    p, expected = two.stages["lift"].p_world_joint, one.stages["lift"].p_world_joint
    np.testing.assert_allclose(p, expected, atol=1e-9)


def test_another_person_in_a_view_is_left_out_and_named(case: Case) -> None:
    video = case.recording.video
    uv = video.uv_px.copy()
    uv[15:20] += 400.0
    two = case.changed(views=(replace(video, uv_px=uv),)).prepare("rto")
    assert ["keypoints of view 1" in fault.what for fault in two.outliers] == [True]
    assert not two.recording.views[0].seen[15:20].any()
    assert two.recording.video.seen.all()
