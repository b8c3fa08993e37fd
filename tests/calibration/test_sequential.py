"""Calibration from windows that follow each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion
from rtof_kin.calibration import sequential
from rtof_kin.calibration.estimate import even_noise
from rtof_kin.calibration.fragment_profile import finished
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.result import (
    SelfCalibration,
    Verdict,
    read_self_calibration_toml,
    write_self_calibration_toml,
)
from rtof_kin.calibration.sequential import (
    TURN_SPEED,
    DelayPosterior,
    LateSensors,
    Sensors,
    SequentialCalibration,
    WindowObservations,
)
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.joint_space.observations import Observations, low_passed, sensor_data

Array = NDArray[np.float64]
SETTINGS = replace(cs.SETTINGS, floor_height=None)
N = 24
HEADINGS = np.radians([12.0, -8.0, 6.0, 10.0, -10.0, 7.0, -12.0, 9.0])


def observations(recording: Recording, motion: Motion) -> Observations:
    guess = cs.guessed(recording, motion.poses)
    imus = recording.bone_imus(times=motion.poses.times)
    return Observations(recording.skeleton, N, SETTINGS, guess, recording.video, imus)


def window(data: Observations, recording: Recording, motion: Motion, first: int) -> WindowObservations:
    """N frames with the true states."""
    part = slice(first, first + N)
    times = recording.video.times
    rows = {name: values[part] for name, values in data.rows.items()}
    rows["w_visual"] = data.confidence[part] / 2.0**2
    given = CalibrationObservations(times[part], rows, data.constant, data.a_world[part], data.w_acceleration[part])
    poses = motion.poses
    x = data.space.from_poses(poses.p_world_joint[part, 0], poses.R_world_bone[part])
    slow = low_passed(even_noise(recording.bone_imus()), SETTINGS)
    return WindowObservations(given, x, lambda t: sensor_data(t, slow, data.sensors, SETTINGS)[:4])


def passed(
    recording: Recording, motion: Motion, found: SequentialCalibration | CalibrationPriors
) -> SequentialCalibration:
    """All windows of a recording, one after the other."""
    data = observations(recording, motion)
    if isinstance(found, CalibrationPriors):
        found = SequentialCalibration(data.problem, SETTINGS, found)
    for first in range(12, len(motion.poses) - N - 12, N):
        finished(found.update(window(data, recording, motion, first)))
    return found


def off(found: SelfCalibration, recording: Recording) -> float:
    """Largest error of a planted heading, rad."""
    truth = dict(zip(recording.calibration.joints, HEADINGS, strict=True))
    return max(abs(value[0] - truth[joint]) for joint, value in found.of_kind("heading").items())


def test_planted_headings_and_delay_are_found() -> None:
    motion = cs.motion(150)
    recording = cs.late(cs.misaligned(planted.recording(motion, sigma_px=2.0), heading=HEADINGS), 0.025)
    found = passed(recording, motion, cs.only("heading", sigma_delay=0.05, sigma_heading=0.2))
    calibration = found.as_self_calibration()
    assert len(calibration.of_kind("heading")) == 8
    assert off(calibration, recording) < np.radians(4.0)
    assert calibration["delay", "video"].value[0] == pytest.approx(0.025, abs=0.006)
    assert calibration["delay", "video"].verdict is Verdict.OBSERVED


def test_what_is_applied_moves_with_limited_speed_and_then_stays() -> None:
    motion = cs.motion(100)
    recording = cs.misaligned(planted.recording(motion, sigma_px=2.0), heading=HEADINGS)
    found = passed(recording, motion, cs.only("heading", sigma_heading=0.2))
    before = found.corrections(0.0).heading
    after = found.corrections(0.5).heading
    most = 0.5 * TURN_SPEED
    assert set(before.values()) == {0.0}
    assert np.abs(list(after.values())).max() == pytest.approx(most)
    wanted = found.as_self_calibration().of_kind("heading")
    last = found.corrections(100.0).heading
    assert last == {joint: pytest.approx(value[0]) for joint, value in wanted.items()}
    assert found.corrections(0.0).R_mounting == {}


def test_corrections_undo_planted_headings() -> None:
    motion = cs.motion(60)
    recording = cs.misaligned(planted.recording(motion), heading=HEADINGS)
    heading = passed(recording, motion, cs.only("heading", sigma_heading=0.2)).corrections(100.0).heading
    before = recording.bone_imus()
    turns = so3.about_axis("z", np.array([heading[joint] for joint in before.joints]))
    truth = motion.poses.R_world_bone[:, cs.BODY.index(*before.joints)]
    remains, askew = (so3.angle_between(R, truth).mean() for R in (turns @ before.R_world_bone, before.R_world_bone))
    assert remains < 0.5 * askew


def test_a_person_who_stands_still_tells_nothing() -> None:
    motion = planted.standing(cs.BODY, 60)
    recording = cs.misaligned(planted.recording(motion), heading=HEADINGS)
    found = passed(recording, motion, cs.only("heading", "delay"))
    assert found.windows == 0
    assert all(q.verdict is Verdict.PRIOR for q in found.as_self_calibration().quantities)
    assert found.corrections(10.0).delay == 0.0


def test_information_of_many_windows_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    motion = cs.motion(60)
    recording = planted.recording(motion, sigma_px=2.0)
    data = observations(recording, motion)
    monkeypatch.setattr(sequential, "EFFECTIVE_SECONDS", 1.0)
    priors = cs.only("heading")
    found = SequentialCalibration(data.problem, SETTINGS, priors)
    part, sigmas = window(data, recording, motion, 12), []
    for _ in range(6):
        finished(found.update(part))
        sigmas.append(found.as_self_calibration().quantities[0].sigma[0])
    assert sigmas[1] < sigmas[0]
    np.testing.assert_allclose(sigmas[3:], sigmas[2], rtol=0.05)


def test_a_saved_calibration_is_applied_at_once_and_goes_on(tmp_path: Path) -> None:
    motion = cs.motion(100)
    recording = cs.late(cs.misaligned(planted.recording(motion, sigma_px=2.0), heading=HEADINGS), 0.025)
    priors = cs.only("heading", sigma_delay=0.05, sigma_heading=0.2)
    first = passed(recording, motion, priors).as_self_calibration()
    write_self_calibration_toml(tmp_path / "found.toml", first)
    data = observations(recording, motion)
    found = SequentialCalibration(data.problem, SETTINGS, priors, read_self_calibration_toml(tmp_path / "found.toml"))
    begun = found.corrections(0.0)
    assert begun.delay == pytest.approx(first["delay", "video"].value[0])
    assert begun.heading == {j: pytest.approx(v[0]) for j, v in first.of_kind("heading").items()}
    again = passed(recording, motion, found).as_self_calibration()
    assert off(again, recording) < np.radians(4.0)


def test_slices_change_nothing_until_the_last() -> None:
    motion = cs.motion(60)
    recording = cs.misaligned(planted.recording(motion), heading=HEADINGS)
    data = observations(recording, motion)
    found = SequentialCalibration(data.problem, SETTINGS, cs.only("heading", "mounting"))
    slices = found.update(window(data, recording, motion, 12))
    for _ in range(10):
        next(slices)
    assert found.windows == 0
    assert not found.y.any()
    finished(slices)
    assert found.windows == 1
    assert found.y.any()


def test_by_default_the_delay_alone_is_open() -> None:
    motion = cs.motion(30)
    found = SequentialCalibration(observations(planted.recording(motion), motion).problem, SETTINGS)
    assert [(q.kind, q.item) for q in found.as_self_calibration().quantities] == [("delay", "video")]


def test_nothing_open_is_refused() -> None:
    motion = cs.motion(30)
    data = observations(planted.recording(motion), motion)
    with pytest.raises(CalibrationError, match="open"):
        SequentialCalibration(data.problem, SETTINGS, cs.only())


TIMES = 5.0 + np.arange(40) / 60
USUAL = 0.05


def clock(times: Array) -> Sensors:
    """Sensors that measure the time."""
    return times[:, None], np.ones((len(times), 1)), times[:, None], np.ones((len(times), 1))


def told(posterior: DelayPosterior, energy: Callable[[Array], Array], rate_hz: float = 60.0) -> LateSensors:
    """Tell the posterior the energy of every delay."""
    late = posterior.around(TIMES, rate_hz, clock)
    delays = np.array([TIMES[0] - late.sensors(k)[0][0, 0] for k in late.steps])
    posterior.add(posterior.interpolated(late, energy(delays)), 1.0)
    posterior.estimate(1.0)
    return late


@pytest.mark.parametrize("delay", [0.0, 0.04, -0.06])
def test_sensors_are_those_at_the_stamps_less_the_delay(delay: float) -> None:
    late = DelayPosterior(USUAL, delay, USUAL).around(TIMES, 60.0, clock)
    np.testing.assert_allclose(late.sensors(0)[0][:, 0], TIMES - delay)
    np.testing.assert_allclose(late.sensors(1)[0][:, 0], TIMES - delay - late.step)
    tried = delay + late.step * late.steps
    assert tried[0] < delay - 2 * USUAL < delay + 2 * USUAL < tried[-1]
    assert len(late.sensors(int(late.steps[0]))[1]) == len(late.sensors(int(late.steps[-1]))[1]) == 40


def test_slow_videos_are_searched_between_frames() -> None:
    times = 5.0 + np.arange(10) / 10
    late = DelayPosterior(USUAL, 0.0, USUAL).around(times, 10.0, clock)
    assert late.step <= USUAL / 3
    np.testing.assert_allclose(late.sensors(3)[0][:, 0], times - 3 * late.step)


def test_moments_are_those_of_a_parabola() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: 0.5 * ((d - 0.03) / 0.01) ** 2)
    precision = 1 / 0.01**2 + 1 / USUAL**2
    assert posterior.delay == pytest.approx(0.03 / 0.01**2 / precision, abs=2e-4)
    assert posterior.sigma == pytest.approx(precision**-0.5, rel=0.03)
    assert posterior.quantity.verdict is Verdict.OBSERVED


def test_two_likely_delays_are_no_known_delay() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: 2e4 * np.abs(np.abs(d) - 0.05))
    assert posterior.sigma > 0.04
    assert posterior.quantity.verdict is Verdict.PRIOR


def test_a_delay_beyond_the_search_is_in_doubt() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: -1e4 * d)
    assert posterior.quantity.verdict is Verdict.DOUBTFUL


def test_a_saved_delay_that_is_wrong_is_forgotten() -> None:
    posterior = DelayPosterior(USUAL, -0.05, USUAL / 2)
    for _ in range(2):
        told(posterior, lambda d: 0.5 * ((d - 0.04) / 0.005) ** 2)
    assert posterior.delay == pytest.approx(0.04, abs=2e-3)
    assert posterior.quantity.verdict is Verdict.OBSERVED


def test_every_delay_counts_the_same_samples() -> None:
    """A gap that only some delays see would favour these."""

    def until(times: Array) -> Sensors:
        q, w, a, _ = clock(times)
        known = (times < TIMES[-5])[:, None].astype(float)
        return q, known * w, a, known * w

    late = DelayPosterior(USUAL, 0.0, USUAL).around(TIMES, 60.0, until)
    first, last = (late.sensors(int(k)) for k in late.steps[[0, -1]])
    np.testing.assert_array_equal(first[1], last[1])
    np.testing.assert_array_equal(first[3], last[3])
    assert 0 < first[1].sum() < len(TIMES) - 4
