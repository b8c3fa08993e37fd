"""Clocks and channels: what is uneven, lost, missing, stuck, saturated or near iron is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensor_support import moved

from rtof_kin.core.plausibility import Check, Verdict
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.sampling import check_sampling

PLAIN = Declaration()


def found(stream: SensorStream, declared: Declaration = PLAIN) -> dict[str, Check]:
    return {check.name: check for check in check_sampling(stream, declared)}


def failed(stream: SensorStream, declared: Declaration = PLAIN) -> list[str]:
    return [name for name, check in found(stream, declared).items() if check.failed]


def kept(stream: SensorStream, keep: np.ndarray) -> SensorStream:
    return SensorStream(
        stream.name, stream.times[keep], stream.f_sensor[keep], stream.R_inertial_sensor[keep],
        stream.w_sensor[keep],
    )  # fmt: skip


def test_a_good_stream_passes_everything_that_can_be_told() -> None:
    checks = found(moved())
    assert not failed(moved())
    assert {name for name, check in checks.items() if check.verdict is Verdict.NOT_POSSIBLE} == {
        "rate against the declared one"
    }
    assert checks["rate against the declared one"].advice == "none is declared; it is 60 Hz"


def test_a_declared_rate_that_the_stamps_do_not_have_is_named() -> None:
    check = found(moved(), Declaration(rate_hz=100.0))["rate against the declared one"]
    assert check.failed
    assert check.value == pytest.approx(40.0, abs=0.01)
    assert dict(check.likely) == {"rate_hz": 60.0}
    assert not failed(moved(), Declaration(rate_hz=60.2))


def test_stamps_in_whole_milliseconds_are_no_jitter_and_have_the_right_rate() -> None:
    stream = moved()
    rounded = replace(stream, times=np.round(stream.times, 3))
    assert not failed(rounded, Declaration(rate_hz=60.0))


def test_times_of_arrival_are_jitter() -> None:
    rng = np.random.default_rng(0)
    stream = moved()
    late = np.sort(stream.times + rng.exponential(0.02, len(stream)))
    assert "jitter of time stamps" in failed(replace(stream, times=late))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
def test_lost_packets_are_counted_even_if_they_are_many(share: float) -> None:
    rng = np.random.default_rng(1)
    keep = rng.random(len(moved())) > share
    checks = found(kept(moved(), keep))
    assert checks["samples lost"].value == pytest.approx(100 * np.mean(~keep), abs=0.5)
    assert checks["samples lost"].failed
    assert checks["jitter of time stamps"].passed


def test_the_longest_gap_is_told() -> None:
    keep = np.ones(len(moved()), dtype=bool)
    keep[300:420] = False
    check = found(kept(moved(), keep))["samples lost"]
    assert check.advice.startswith("120 of ")
    assert "the longest gap is 2.02 s" in check.advice


def test_missing_samples_are_a_share() -> None:
    f = np.array(moved().f_sensor)
    f[::10, 1] = np.nan
    check = found(replace(moved(), f_sensor=f))["missing samples of acceleration"]
    assert check.failed
    assert check.value == pytest.approx(10, abs=0.1)


def test_a_sensor_that_stands_still_to_the_last_digit_is_stuck() -> None:
    w = np.array(moved().w_sensor)
    w[200:260] = w[200]
    checks = found(replace(moved(), w_sensor=w))
    assert checks["stuck values of gyroscope"].value == pytest.approx(59 / 60)
    assert "stays the same to the last digit from 13.3" in checks["stuck values of gyroscope"].advice
    assert checks["stuck values of acceleration"].passed


def test_one_dead_axis_is_named() -> None:
    w = np.array(moved().w_sensor)
    w[:, 2] = 0.0
    check = found(replace(moved(), w_sensor=w))["stuck values of gyroscope"]
    assert check.failed
    assert check.advice == "Component z never changes"


@pytest.mark.parametrize("declared", [PLAIN, Declaration("g"), Declaration(gravity="removed")])
def test_saturation_is_found_in_the_axes_of_the_file(declared: Declaration) -> None:
    stream = moved()
    a = declared.filed_acceleration(stream.f_sensor, stream.R_inertial_sensor)
    limit = np.percentile(np.abs(a), 99)
    clipped = declared.specific_force(np.clip(a, -limit, limit), stream.R_inertial_sensor)
    check = found(replace(stream, f_sensor=clipped), declared)["saturated samples of acceleration"]
    assert check.failed


def test_saturation_is_the_share_of_samples_at_the_ends_of_the_range() -> None:
    beyond = np.abs(moved().w_sensor).max(axis=1) > 5.0
    w = np.clip(moved().w_sensor, -5.0, 5.0)
    check = found(replace(moved(), w_sensor=w))["saturated samples of gyroscope"]
    assert check.failed
    assert check.value == pytest.approx(100 * np.mean(beyond), abs=1)


def test_iron_disturbs_the_field_and_turning_does_not() -> None:
    stream = moved()
    m = np.einsum("tji,j->ti", stream.R_inertial_sensor, [0.4, 0.0, -0.7])
    assert "disturbed magnetic field" not in failed(replace(stream, m_sensor=m))
    near = np.array(m)
    near[:300] *= 1.5
    assert "disturbed magnetic field" in failed(replace(stream, m_sensor=near))
    absent = found(replace(stream, m_sensor=np.full_like(m, np.nan)))["disturbed magnetic field"]
    assert absent.verdict is Verdict.NOT_POSSIBLE


def test_one_sample_has_no_clock() -> None:
    one = SensorStream("one", np.array([0.0]), np.array([[0.0, 0.0, 9.81]]))
    checks = found(one)
    assert checks["samples lost"].advice == "there are 1 samples"
    assert not failed(one)
