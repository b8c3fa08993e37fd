"""When nobody turns, and how fast sensors do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.stillness import angular_velocity, find_still, orientation_rate, streams_of

Array = NDArray[np.float64]


def stream(name: str, still: tuple[float, float], seconds: float = 10.0, rate: float = 100.0) -> SensorStream:
    """A sensor that turns by 1 rad/s about its z axis but for one period."""
    times = np.arange(0, seconds, 1 / rate)
    speed = np.where((times >= still[0]) & (times < still[1]), 0.0, 1.0)
    w = np.stack([0 * times, 0 * times, speed], axis=-1)
    return SensorStream(name, times, w_sensor=w)


def test_the_rate_of_an_orientation_is_the_angular_velocity_that_made_it() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.015, 500))
    w = np.array([0.4, -1.1, 2.0])
    R = so3.exp(rng.standard_normal(3)) @ so3.exp(times[:, None] * w)
    np.testing.assert_allclose(orientation_rate(times, R), np.tile(w, (500, 1)), atol=1e-9)


def test_a_missing_orientation_makes_its_neighbours_rates_missing_and_no_more() -> None:
    times = np.arange(9) / 60
    R = so3.exp(times[:, None] * np.array([0.0, 0.0, 3.0]))
    R[4] = np.nan
    known = np.isfinite(orientation_rate(times, R)).all(axis=1)
    assert known.tolist() == [True] * 3 + [False, True, False] + [True] * 3


def test_the_first_second_in_which_all_are_still_is_found() -> None:
    streams = [stream("a", (2.0, 6.0)), stream("b", (3.0, 8.0), rate=61.0)]
    start, stop = find_still(streams)
    assert start == pytest.approx(3.3, abs=0.1)
    assert stop == pytest.approx(5.7, abs=0.1)


def test_shorter_pauses_are_ignored() -> None:
    with pytest.raises(CalibrationError, match=r"even around 4\.\d\d s sensors turn at .* deg/s, a most"):
        find_still([stream("a", (4.0, 4.6)), stream("b", (0.0, 10.0))])


def test_sensors_that_share_too_little_time_are_refused() -> None:
    late = SensorStream("late", np.arange(100, 110, 0.01), w_sensor=np.zeros((1000, 3)))
    with pytest.raises(CalibrationError, match="have 0 s in common"):
        find_still([stream("a", (0.0, 10.0)), late])


def test_the_stillest_second_of_a_short_pose_is_taken() -> None:
    start, stop = find_still([stream("a", (4.0, 5.1))])
    assert (start, stop) == (pytest.approx(4.05, abs=0.06), pytest.approx(5.05, abs=0.06))


def test_gaps_are_not_still() -> None:
    whole = stream("a", (20.0, 30.0))
    keep = (whole.times < 4) | (whole.times > 7)
    holed = SensorStream("a", whole.times[keep], w_sensor=whole.w_sensor[keep])  # type: ignore[index]
    with pytest.raises(CalibrationError, match="nobody stands still"):
        find_still([holed])


def test_the_gyroscope_takes_precedence_over_the_orientation() -> None:
    R, f, w = np.tile(np.eye(3), (5, 2, 1, 1)), np.zeros((5, 2, 3)), np.ones((5, 3))
    _, second = streams_of(ImuSequence(np.arange(5.0), R, f, ("a", "b")))
    np.testing.assert_array_equal(angular_velocity(second), 0.0)
    np.testing.assert_array_equal(angular_velocity(replace(second, w_sensor=w)), w)
    with pytest.raises(InvalidInputError, match="sensor a"):
        angular_velocity(SensorStream("a", np.arange(5.0)))
