"""Angular velocity from orientations, and the interval in which a calibration pose is held."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.inertial.likelihood import orientation_rate
from rtof_kin.inertial.pose_calibration import calibrate_by_pose

Array = NDArray[np.float64]
SEGMENTS = ("LeftLeg", "Hips")


def stream(still: tuple[float, float], rate: float = 100.0, gyroscope: bool = True, first: float = 0.0) -> SensorStream:
    """A sensor that rotates by 1 rad/s about its z axis except in one interval."""
    times = first + np.arange(0, 10, 1 / rate)
    speed = np.where((times >= still[0]) & (times < still[1]), 0.0, 1.0)
    R = so3.about_axis("z", np.cumsum(speed) / rate)
    return SensorStream("s", times, None, R, speed[:, None] * [0, 0, 1] if gyroscope else None)


def held(*streams: SensorStream) -> tuple[float, float]:
    """Interval in which the pose is held."""
    named = tuple(
        SensorStream(name, s.times, None, s.R_inertial_sensor, s.w_sensor)
        for name, s in zip("ab", streams, strict=False)
    )
    log = SensorLog(Path("log"), "planted", named, Declaration())
    joints = dict(zip("ab", SEGMENTS[: len(streams)], strict=False))
    return calibrate_by_pose(log, joints, "N", SkeletonModel.default(), facing=0.0).still


def test_the_rate_of_an_orientation_is_its_angular_velocity() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.015, 500))
    w = np.array([0.4, -1.1, 2.0])
    R = so3.exp(rng.standard_normal(3)) @ so3.exp(times[:, None] * w)
    np.testing.assert_allclose(orientation_rate(times, R), np.tile(w, (500, 1)), atol=1e-9)
    R[4] = np.nan
    known = np.isfinite(orientation_rate(times, R)).all(axis=1)
    assert np.flatnonzero(~known).tolist() == [3, 5]


@pytest.mark.parametrize("gyroscope", [True, False])
def test_the_first_second_in_which_all_are_still_is_found(gyroscope: bool) -> None:
    start, stop = held(stream((2.0, 6.0), gyroscope=gyroscope), stream((3.0, 8.0), 61.0, gyroscope))
    assert start == pytest.approx(3.3, abs=0.1)
    assert stop == pytest.approx(5.7, abs=0.1)
    start, stop = held(stream((4.0, 5.1), gyroscope=gyroscope))
    assert (start, stop) == (pytest.approx(4.05, abs=0.06), pytest.approx(5.05, abs=0.06))


def test_gaps_short_pauses_and_separate_sensors_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"even around 4\.\d\d s sensors turn at .* deg/s, a most"):
        held(stream((4.0, 4.6)), stream((0.0, 10.0)))
    with pytest.raises(CalibrationError, match="have 0 s in common"):
        held(stream((0.0, 10.0)), stream((100.0, 110.0), first=100.0))
    whole = stream((20.0, 30.0), gyroscope=False)
    keep = (whole.times < 4) | (whole.times > 7)
    assert whole.R_inertial_sensor is not None
    with pytest.raises(CalibrationError, match="without rotation"):
        held(SensorStream("a", whole.times[keep], None, whole.R_inertial_sensor[keep]))
