"""Tests of `rtof_kin.reconstruction.self_calibration`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.calibration.straight_legs import NEVER_STILL
from rtof_kin.core.jobs import work_shared
from rtof_kin.reconstruction import self_calibration
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.reconstruction.self_calibration import CLOCK_DOUBT, DAYS_APART, ClockOffset, find_offset
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import headline

DEMO = Path(__file__).parents[2] / "models" / "demo"


@pytest.fixture(scope="module", autouse=True)
def by_velocities_alone() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(self_calibration, "_UNSHARP", np.inf)
        yield


@pytest.fixture(scope="module")
def demo() -> Recording:
    return Recording.load(DEMO)


def late(recording: Recording, seconds: float, drift: float = 0.0) -> Recording:
    times = recording.imus.times
    moved = times + seconds + drift * (times - times.mean())
    return replace(recording, imus=replace(recording.imus, times=moved))


def found(recording: Recording) -> ClockOffset:
    return find_offset([Job.of(recording, None, None, None, None)])


@pytest.fixture(scope="module")
def right(demo: Recording) -> ClockOffset:
    return found(demo.between(5.0, 13.0))


def test_right_clocks_are_not_named_and_a_detectors_delay_leaves_the_sensors(right: ClockOffset) -> None:
    assert right.warnings == ()
    assert not right.foreign
    assert right.applied.sensors_late == 0.0


@pytest.mark.parametrize("seconds", [-0.1, 0.4])
def test_sensors_on_a_wrong_clock_are_corrected_and_named(demo: Recording, right: ClockOffset, seconds: float) -> None:
    wrong = found(late(demo.between(5.0, 13.0), seconds))
    assert wrong.delay.value[0] == pytest.approx(right.delay.value[0] - seconds, abs=0.015)
    assert wrong.applied.sensors_late == pytest.approx(seconds, abs=0.04)  # the detector's delay
    assert ("late" if seconds > 0 else "early") in wrong.warnings[0]
    assert "corrected" in wrong.warnings[0]


def test_a_drift_of_one_percent_is_corrected_and_named(demo: Recording) -> None:
    wrong = late(demo.between(0.0, 24.0), 0.0, 0.01)
    clocks = found(wrong)
    assert "clock runs" in clocks.warnings[0]
    assert "fast" in clocks.warnings[0]
    moved, before = clocks.applied.apply(wrong).imus, demo.between(0.0, 24.0).imus
    assert np.ptp(moved.times) == pytest.approx(np.ptp(before.times), rel=0.003)


def test_sensors_of_another_take_are_left_out_and_lead_the_first_line(demo: Recording) -> None:
    video, other = demo.between(1.0, 8.0), demo.between(14.0, 21.0)
    times = other.imus.times - other.imus.times[0] + video.imus.times[0]
    wrong = replace(video, imus=replace(other.imus, times=times))
    result = reconstruct(wrong, mode="sf2")
    assert not np.isfinite(result.bone_imus.R_world_bone).any()
    assert "the sensors do not belong to this video" in headline(audit(result)).text


def test_where_velocities_are_unsharp_the_energy_decides(
    demo: Recording, right: ClockOffset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibrated(jobs: list[Job], priors: CalibrationPriors, known: None) -> SelfCalibration:
        assert (len(jobs), known, priors.sigma_swing) == (1, None, None)
        return SelfCalibration((Quantity("delay", "video", *np.array([[0.003], [0.004], [0.02]]), 0.96),))

    monkeypatch.setattr(self_calibration, "_UNSHARP", 0.0)
    monkeypatch.setattr(self_calibration, "calibrated", calibrated)
    after = found(demo.between(5.0, 13.0)).delay
    assert after.value[0] == pytest.approx(right.delay.value[0] + 0.003)
    assert after.sigma[0] == pytest.approx(0.004)


def test_what_the_setup_noted_is_said_again(demo: Recording) -> None:
    noted = tuple(f"{note}: 3 of them" for note in (DAYS_APART, CLOCK_DOUBT, NEVER_STILL))
    lines = "\n".join(["found: x", *(f"doubtful: {note}" for note in noted)])
    assert found(replace(demo.between(5.0, 9.0), notes=lines)).warnings[:3] == noted


def test_the_uncertainty_of_the_clocks_widens_what_moves(demo: Recording, right: ClockOffset) -> None:
    poses = demo.truth
    (apart,) = right.apart(poses[300:400])
    moved = np.linalg.norm(apart.p_world_joint[:90] - poses.p_world_joint[300:390], axis=-1)
    speed = np.linalg.norm(np.gradient(poses.p_world_joint[300:400], poses.times[300:400], axis=0), axis=-1)
    expected = speed[:90] * right.delay.sigma[0]
    assert np.median(moved) == pytest.approx(np.median(expected), rel=0.3)


def test_a_recording_without_sensors_has_no_clocks_to_compare(demo: Recording) -> None:
    assert found(replace(demo.between(5.0, 8.0), imus=None, calibration=None)) == ClockOffset()
    assert find_offset([]) == ClockOffset()


def test_excerpts_lifted_side_by_side_and_one_by_one_give_the_same_clocks(demo: Recording) -> None:
    jobs = [Job.of(demo.between(begin, begin + 3.0)) for begin in (1.0, 6.0, 12.0)]
    one_by_one = find_offset(jobs)
    with work_shared(2):
        assert find_offset(jobs) == one_by_one


def test_sensors_that_began_seconds_off_are_left_out_and_the_first_line_says_when(demo: Recording) -> None:
    wrong = find_offset([Job.of(late(demo.between(1.0, 8.0), 1.5), None, None, None, None)])
    (check,) = wrong.checks
    assert wrong.foreign
    assert "or they began 1.5 s earlier than declared" in check.cause
    assert "start_s" in check.advice


def test_sensors_that_explain_little_and_fit_the_image_are_kept(
    demo: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(self_calibration, "_EXPLAINED", (0.99, 0.99))
    monkeypatch.setattr(self_calibration, "_SUSPECT", 1.0)
    right = found(demo.between(5.0, 9.0))
    (check,) = right.checks
    assert not right.foreign
    assert np.isnan(check.value)
    assert right.warnings == ()


def test_bands_are_as_wide_as_strides_differ_where_the_stride_is_in_doubt() -> None:
    motion, _ = planted.walking(SkeletonModel.default(), 6.0)
    poses = motion.poses
    delay = Quantity("delay", "video", *np.array([[0.0], [0.01], [0.29]]), 0.96)
    same, other = (ClockOffset(delay, repeats=s).apart(poses)[-1] for s in (1.2, 0.9))
    assert np.abs(same.p_world_joint - poses.p_world_joint).max() < 0.01  # all strides are alike
    assert np.abs(other.p_world_joint - poses.p_world_joint).max() > 0.2
    assert np.isfinite(other.p_world_joint).all()
