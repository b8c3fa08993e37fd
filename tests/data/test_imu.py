"""IMU samples: units, joining and resampling."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnitError
from rtof_kin.data.imu import STANDARD_GRAVITY, BoneImuSequence, ImuSequence

Array = NDArray[np.float64]


def at_rest(frames: int = 6, scale: float = 1.0) -> ImuSequence:
    """Two sensors; the specific force of the second is scaled."""
    f = np.tile([0.0, 0.0, STANDARD_GRAVITY], (frames, 2, 1))
    f[:, 1] *= scale
    R = so3.exp(np.random.default_rng(0).normal(size=(frames, 2, 3)))
    return ImuSequence(np.arange(frames) / 60, R, f, ("chest", "wrist"))


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (1 / STANDARD_GRAVITY, "1.00, which is one gravity in g; multiply"),
        (0.01, r"0.10 m/s\^2, so gravity was removed; give"),
        (1000 / STANDARD_GRAVITY, r"1e\+03, far above one gravity; give m/s\^2"),
    ],
)
def test_other_unit_or_missing_gravity_is_refused(scale: float, message: str) -> None:
    with pytest.raises(UnitError, match=f"IMU wrist: the median specific force is {message}"):
        at_rest(scale=scale)


def test_slow_movement_without_gravity_is_not_taken_for_a_sensor_in_g() -> None:
    f = 0.6 * np.random.default_rng(0).normal(size=(100, 1, 3))  # about 1 m/s^2, or 1 g
    R = np.tile(np.eye(3), (100, 1, 1, 1))
    with pytest.raises(UnitError, match="gravity was removed"):
        ImuSequence(np.arange(100) / 60, R, f, ("wrist",))


def test_frozen_and_empty_sensors_pass_the_unit_check() -> None:
    f, R = np.tile([0.0, 0.0, 3.5], (100, 1, 1)), np.tile(np.eye(3), (100, 1, 1, 1))
    for force in (f, np.full_like(f, np.nan)):
        assert len(ImuSequence(np.arange(100) / 60, R, force, ("wrist",))) == 100


def test_sensors_with_different_times_are_joined_at_even_ones() -> None:
    """One at 100 Hz, one at 60 Hz that starts later and pauses, with the same rotation about z."""

    def turning(times: Array, name: str) -> ImuSequence:
        R = so3.about_axis("z", 2.0 * times)[:, None]
        f = np.stack([0 * times, times, 0 * times + 9.81], axis=-1)[:, None]
        return ImuSequence(times, R, f, (name,))

    fast = turning(np.arange(101) / 100, "fast")
    late = 0.305 + np.arange(40) / 60
    slow = turning(late[(late < 0.5) | (late > 0.7)], "slow")
    both = ImuSequence.joined([slow, fast])
    assert both.names == ("slow", "fast")
    np.testing.assert_allclose(both.times, np.arange(101) / 100, atol=1e-12)
    given = np.isfinite(both.f_sensor[:, 0, 0])
    np.testing.assert_array_equal(given, np.isfinite(both.R_inertial_sensor[:, 0, 0, 0]))
    assert given[31:48].all()
    assert not given[:30].any()
    assert not given[52:69].any()
    for s, ok in ((0, given), (1, np.ones(101, dtype=bool))):
        expected = so3.about_axis("z", 2.0 * both.times[ok])
        np.testing.assert_allclose(both.R_inertial_sensor[ok, s], expected, atol=1e-9)
        np.testing.assert_allclose(both.f_sensor[ok, s, 1], both.times[ok], atol=1e-9)


def test_sensors_with_equal_times_are_joined_unchanged() -> None:
    base = at_rest()
    parts = [base.select([name]) for name in base.names]
    both = ImuSequence.joined(parts)
    for field in ("times", "R_inertial_sensor", "f_sensor"):
        np.testing.assert_array_equal(getattr(both, field), getattr(base, field))
    with pytest.raises(InvalidInputError, match="there are none"):
        ImuSequence.joined([])
    with pytest.raises(InvalidInputError, match="chest .*more than once"):
        ImuSequence.joined([parts[0], parts[0]])


def test_resampling_is_geodesic_for_orientation_and_averages_acceleration() -> None:
    fast = np.arange(200) / 240
    rate, ramp = 1.3, np.array([2.0, -1.0, 0.5])
    R = np.stack([so3.about_axis("x", rate * fast), so3.about_axis("z", -rate * fast)], axis=1)
    a = np.stack([fast[:, None] * ramp, -fast[:, None] * ramp], axis=1)
    a[::2] += 1.0  # a ripple at the fast rate averages to a half
    sequence = BoneImuSequence(fast, R, a, np.zeros((2, 3)), ("Hips", "Head"))
    video = np.arange(3, 40) / 60
    out = sequence.resample(video)
    np.testing.assert_allclose(out.R_world_bone[:, 0], so3.about_axis("x", rate * video), atol=1e-12)
    np.testing.assert_allclose(out.a_world[:, 0], video[:, None] * ramp + 0.5, atol=0.03)
    assert out.joints == sequence.joints
    np.testing.assert_array_equal(out.times, video)


def test_resampling_leaves_long_gaps() -> None:
    times, R = np.arange(60) / 60, np.tile(np.eye(3), (60, 1, 1, 1))
    a = np.random.default_rng(0).normal(size=(60, 1, 3))
    R[20:30], a[20:30] = np.nan, np.nan
    gap = BoneImuSequence(times, R, a, np.zeros((1, 3)), ("Hips",))
    out = gap.resample(times, max_gap=0.1)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out.R_world_bone[:, 0, 0, 0])), np.arange(20, 30))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out.a_world[:, 0, 0])), np.arange(19, 31))
    assert np.isfinite(gap.resample(times, max_gap=0.2).R_world_bone).all()
    assert np.isnan(gap.resample([0.5, 1.5]).R_world_bone[1]).all()
