"""Samples of sensors at the times of frames: as a recording has them, in any order, with gaps."""

from __future__ import annotations

import numpy as np
import pytest
from live_support import demo
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.live.sensor_buffer import SensorBuffer

Array = NDArray[np.float64]
CUTOFF_HZ = 12.0


def imus() -> ImuSequence:
    found = demo().imus
    assert found is not None
    return found


def calibrated() -> ImuCalibration:
    found = demo().calibration
    assert found is not None
    return found


def joints() -> tuple[str, ...]:
    return calibrated().joints


def buffer(order: Array | None = None, count: int = 240) -> SensorBuffer:
    """With the first samples of the demo, in an order."""
    out = SensorBuffer(calibrated(), joints(), 60.0, CUTOFF_HZ)
    for i in range(count) if order is None else order.tolist():
        for s, name in enumerate(imus().names):
            out.add(name, float(imus().times[i]), imus().R_inertial_sensor[i, s], imus().f_sensor[i, s])
    return out


def test_within_the_samples_the_values_are_those_of_a_recording() -> None:
    times = imus().times[40:200] + 0.3 / 60
    expected = calibrated().apply(imus()).low_passed(CUTOFF_HZ).resample(times)
    q, known, a, moved = buffer().at(times)
    own = [joints().index(joint) for joint in expected.joints]
    assert known.all()
    assert moved.all()
    turns = so3.angle_between(so3.from_quat_wxyz(q[:, own]), expected.R_world_bone)
    assert np.degrees(turns.max()) < 0.05
    off = np.linalg.norm(a[:, own] - expected.a_world, axis=-1)
    assert np.median(off) < 0.05 * np.median(np.linalg.norm(expected.a_world, axis=-1)) + 0.1


def test_the_order_of_arrival_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    times = imus().times[30:200] + 0.001
    ordered = buffer().at(times)
    shuffled = buffer(np.argsort(np.arange(240) + rng.uniform(0, 6, 240))).at(times)
    turns = (so3.from_quat_wxyz(values[0]) for values in (ordered, shuffled))  # quaternions have two signs
    np.testing.assert_allclose(*turns, atol=1e-12)
    for one, other in zip(ordered[1:], shuffled[1:], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_gaps_and_times_beyond_the_samples_are_unknown() -> None:
    lacking = np.array([i for i in range(240) if not 100 <= i < 112])
    sensors, times = buffer(lacking), imus().times
    known = sensors.at(times[[90, 105, 120, 239]])[1]
    assert known.all(axis=1).tolist() == [True, False, True, True]
    soon, late = times[239] + 0.015, times[239] + 0.05
    assert sensors.at(np.array([soon, late]))[1].all(axis=1).tolist() == [True, False]
    assert not buffer(np.array([0])).at(times[:1])[1].any()


def test_old_samples_are_forgotten() -> None:
    sensors = SensorBuffer(calibrated(), joints(), 60.0, CUTOFF_HZ)
    name, R, f = imus().names[0], imus().R_inertial_sensor[0, 0], imus().f_sensor[0, 0]
    for i in range(5000):
        sensors.add(name, i / 100, R, f)
    s = joints().index(joints()[calibrated().sensors.index(name)])
    known = sensors.at(np.array([1.0, 49.5]))[1][:, s]
    assert known.tolist() == [False, True]


def test_corrections_rotate_what_is_returned() -> None:
    sensors, times = buffer(), imus().times[50:60]
    before = sensors.at(times)
    joint = joints()[2]
    turn = so3.exp(np.array([0.1, -0.2, 0.05]))
    sensors.correct({joint: 0.3}, {joint: turn})
    after, raw = sensors.at(times), sensors.at(times, corrected=False)
    R_before, R_after = (so3.from_quat_wxyz(values[0][:, 2]) for values in (before, after))
    np.testing.assert_allclose(R_after, so3.about_axis("z", 0.3) @ R_before @ turn, atol=1e-9)
    np.testing.assert_allclose(after[2][:, 2], before[2][:, 2] @ so3.about_axis("z", 0.3).T, atol=1e-9)
    np.testing.assert_allclose(after[0][:, 1], before[0][:, 1], atol=1e-12)
    np.testing.assert_allclose(raw[0], before[0])


def test_an_unknown_sensor_is_named() -> None:
    with pytest.raises(UnknownNameError, match="nobody"):
        buffer(count=1).add("nobody", 0.0, np.eye(3), np.zeros(3))


def test_samples_without_an_orientation_are_left_out() -> None:
    sensors = buffer(count=1)
    newest = sensors.newest.copy()
    sensors.add(imus().names[0], 9.0, np.full((3, 3), np.nan), np.zeros(3))
    np.testing.assert_array_equal(sensors.newest, newest)
