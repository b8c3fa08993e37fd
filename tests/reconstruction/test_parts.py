"""Long recordings: parts give the motion of the whole, and a part that is lost does not stop the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.jobs import is_shared, work_shared
from rtof_kin.core.resources import model_path
from rtof_kin.formats.measurements_file import read_measurements
from rtof_kin.reconstruction import parts, self_calibration
from rtof_kin.reconstruction.parts import is_long, parts_of, reconstruct_in_parts
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Choices, Reconstruction
from rtof_kin.reconstruction.self_calibration import ClockOffset, SetupEstimate
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.export import export
from rtof_kin.reporting.statistics import ReconstructionStatistics

SECONDS = 2.0


@pytest.fixture(scope="module")
def demo() -> Recording:
    return Recording.load(model_path("demo")).between(0.0, 10.0)


def joined(parts: list[Reconstruction], field: str) -> np.ndarray:
    return np.concatenate([getattr(part.motion.poses, field) for part in parts])


def statistics_of(parts: list[Reconstruction]) -> ReconstructionStatistics:
    out = ReconstructionStatistics(parts[0])
    for part in parts[1:]:
        out.add(part)
    return out


@pytest.mark.parametrize("frames, seconds", [(216_000, 60.0), (1000, 60.0), (5000, 60.0), (3700, 10.0)])
def test_parts_cover_all_frames_once(frames: int, seconds: float) -> None:
    found = parts_of(frames, 60.0, 25, seconds)
    kept = np.concatenate([np.arange(part.start, part.stop) for part in found])
    np.testing.assert_array_equal(kept, np.arange(frames))
    for part in found:
        assert part.first % 25 == 0
        assert 0 <= part.first <= part.start
        assert part.stop <= part.last <= frames
        assert part.start == 0 or part.start - part.first >= 120
    assert len(found) == 1 or found[-1].stop - found[-1].start >= 0.5 * seconds * 60


@pytest.mark.parametrize("mode", ["rtof", "imu"])
def test_parts_give_the_motion_of_the_whole(demo: Recording, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "find_offset", lambda *_: ClockOffset())  # of other excerpts, 2 ms apart
    demo = demo.between(0.0, 6.5)
    whole = reconstruct(demo, mode=mode)
    parts = list(reconstruct_in_parts(demo, mode=mode, seconds=SECONDS))
    assert len(parts) > 2
    count = sum(len(part.motion.times) for part in parts)
    np.testing.assert_allclose(joined(parts, "times"), whole.motion.times[:count])
    p, expected = joined(parts, "p_world_joint"), whole.motion.poses.p_world_joint[:count]
    if mode == "imu":  # the path of the root drifts, the posture does not
        p, expected = p - p[:, :1], expected - expected[:, :1]
    assert np.abs(p - expected).max() < (1e-5 if mode == "rtof" else 2e-2)
    q = np.concatenate([part.motion.q for part in parts])
    ends = np.cumsum([len(part.motion.times) for part in parts])[:-1] - 1
    assert np.abs(np.diff(q, axis=0)[ends]).max() < 0.2  # no jump between parts
    fragments = [f.first_frame for part in parts for f in part.solution.fragments]
    assert fragments == sorted(fragments)
    if mode == "rtof":
        assert fragments == [f.first_frame for f in whole.solution.fragments]
        found, once = statistics_of(parts), ReconstructionStatistics(whole)
        for name in ("mpjpe_rr_mm", "flexion_deg"):
            assert found.metrics[name] == pytest.approx(once.metrics[name], rel=1e-3)
        image = {r.subject: r.value for r in audit(whole) if r.section == "image"}
        for result in audit(found):
            if result.section == "image":
                assert result.value == pytest.approx(image[result.subject], rel=1e-3, abs=1e-3)


def test_parts_that_are_solved_side_by_side_are_the_same_to_the_bit(demo: Recording) -> None:
    unseen = demo.video.times < 2.5
    confidence = np.where(unseen[:, None], 0.0, demo.video.confidence)
    recording = replace(demo, keypoints=replace(demo.video, confidence=confidence)).between(0.0, 6.0)
    one = list(reconstruct_in_parts(recording, mode="lift", seconds=2.0))
    with work_shared(2):
        assert is_shared()
        two = list(reconstruct_in_parts(recording, mode="lift", seconds=2.0))
    assert len(one) == len(two) == 3
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.motion.q, b.motion.q)
        np.testing.assert_array_equal(a.motion.poses.R_world_bone, b.motion.poses.R_world_bone)
        assert a.warnings == b.warnings


def test_where_no_part_can_be_reconstructed_the_error_is_raised(demo: Recording) -> None:
    nobody = replace(demo.video, confidence=np.zeros_like(demo.video.confidence))
    with pytest.raises(InvalidInputError, match="no person was seen"):
        list(reconstruct_in_parts(replace(demo, keypoints=nobody), mode="rtof", seconds=SECONDS))


def test_where_the_sensors_stop_the_camera_goes_on(demo: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "find_offset", lambda *_: ClockOffset())
    demo = demo.between(0.0, 6.0)
    rows = int(np.searchsorted(demo.imus.times, 1.0))
    places = ReconstructionSettings(sensor_joints=demo.calibration.joints)  # of the usual energy
    ended = replace(demo, imus=demo.imus[:rows])
    parts = list(reconstruct_in_parts(ended, mode="rtof", settings=places, seconds=SECONDS))
    last = parts[-1]
    assert last.motion.poses.valid.all()
    assert not np.isfinite(last.bone_imus.R_world_bone).any()
    assert any("no sensor has samples" in text for text in statistics_of(parts).warnings)


def test_a_part_in_which_nobody_is_seen_is_marked_and_written_like_the_others(
    demo: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def quantity(kind: str, item: str, value: list[float]) -> Quantity:
        return Quantity(kind, item, np.array(value), np.full(len(value), 0.01), np.full(len(value), 0.1), 0.99)

    found = SelfCalibration((quantity("delay", "video", [0.02]), quantity("mounting", "LeftLeg", [0.05, 0.0, 0.0])))
    once = SetupEstimate(found, choices=Choices("yes"))
    monkeypatch.setattr(parts, "estimate_setup", lambda *_: once)
    demo = demo.between(0.0, 8.0)
    seen = demo.video
    absent = seen.times < 4.5
    uv = np.where(absent[:, None, None], np.nan, seen.uv_px)
    confidence = np.where(absent[:, None], 0.0, seen.confidence)
    away = replace(demo, keypoints=replace(seen, uv_px=uv, confidence=confidence))
    results = list(reconstruct_in_parts(away, mode="rtof", seconds=SECONDS))
    lost, last = results[0].motion, results[-1].motion
    assert not lost.poses.valid.any()
    assert np.isnan(lost.q).all()
    assert last.poses.valid.all()

    statistics = export(results, tmp_path / "out")
    assert any("not reconstructed" in text and "no person was seen" in text for text in statistics.warnings)
    assert statistics["invalid"].mean_of_all > 0.2
    assert any("not reconstructed" in result.note for result in audit(statistics))
    measured = read_measurements(tmp_path / "out" / "measurements.h5")
    times = Motion.load(tmp_path / "out" / "motion.h5").poses.times
    np.testing.assert_allclose(times, seen.times - 0.02, atol=1e-9)
    np.testing.assert_allclose(measured.views[0].video_times, seen.times, atol=1e-9)
    np.testing.assert_array_equal(measured.views[0].seen.any(axis=1), ~absent)


@pytest.mark.parametrize(
    ("seconds", "drift", "expected"), [(119.0, 0.0, False), (121.0, 0.0, True), (121.0, 1e-3, False)]
)
def test_long_recordings_are_in_parts_but_for_a_camera_whose_heading_drifts(
    demo: Recording, seconds: float, drift: float, expected: bool
) -> None:
    video = demo.video
    times = video.times * (seconds / (video.times[-1] - video.times[0]))
    keypoints = replace(video, times=times, camera=replace(video.camera, heading_drift=drift))
    assert is_long(replace(demo, keypoints=keypoints, imus=None, calibration=None, truth=None)) == expected
