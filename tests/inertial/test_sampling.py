"""Uneven, lost, missing, stuck, saturated and magnetically disturbed samples are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_support import moved

from rtof_kin.core.checks import Check, Verdict
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.inertial.physics import LAWS, check_log

PLAIN, STREAM = Declaration(), moved()
RATE, LOST, JITTER = "rate against the declared one", "samples lost", "jitter of time stamps"
FIELD = "disturbed magnetic field"
OTHERS = {*LAWS, "jump of the orientation", "delay of the gyroscope", "norm of quaternions, less 1"}


def found(stream: SensorStream, declared: Declaration = PLAIN) -> dict[str, Check]:
    log = SensorLog(Path("log"), "planted", (stream,), declared)
    return {check.name: check for check in check_log(log) if check.name not in OTHERS}


def failed(stream: SensorStream, declared: Declaration = PLAIN) -> list[str]:
    return [name for name, check in found(stream, declared).items() if check.failed]


def kept(keep: NDArray[np.bool_]) -> SensorStream:
    s = STREAM
    return SensorStream(s.name, s.times[keep], s.f_sensor[keep], s.R_inertial_sensor[keep], s.w_sensor[keep])


def test_a_correct_stream_passes() -> None:
    checks = found(STREAM)
    assert not failed(STREAM)
    assert [name for name, check in checks.items() if check.verdict is Verdict.NOT_POSSIBLE] == [RATE]
    assert "60 Hz" in checks[RATE].advice
    rounded = replace(STREAM, times=np.round(STREAM.times, 3))
    assert not failed(rounded, Declaration(rate_hz=60.0))
    assert not failed(STREAM, Declaration(rate_hz=60.2))


def test_a_wrong_declared_rate_is_found() -> None:
    check = found(STREAM, Declaration(rate_hz=100.0))[RATE]
    assert check.failed
    assert check.value == pytest.approx(40.0, abs=0.01)
    assert dict(check.likely) == {"rate_hz": 60.0}


def test_times_of_arrival_are_jitter() -> None:
    late = np.sort(STREAM.times + np.random.default_rng(0).exponential(0.02, len(STREAM)))
    assert JITTER in failed(replace(STREAM, times=late))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
def test_lost_packets_are_counted(share: float) -> None:
    keep = np.random.default_rng(1).random(len(STREAM)) > share
    checks = found(kept(keep))
    assert checks[LOST].value == pytest.approx(100 * np.mean(~keep), abs=0.5)
    assert checks[LOST].failed
    assert checks[JITTER].passed


def test_the_longest_gap_is_named() -> None:
    keep = np.ones(len(STREAM), dtype=bool)
    keep[300:420] = False
    advice = found(kept(keep))[LOST].advice
    assert advice.startswith("120 of ")
    assert "the longest gap is 2.02 s" in advice


def test_missing_stuck_and_constant_channels_are_found() -> None:
    f, w = np.array(STREAM.f_sensor), np.array(STREAM.w_sensor)
    f[::10, 1] = np.nan
    w[200:260] = w[200]
    checks = found(replace(STREAM, f_sensor=f, w_sensor=w))
    assert checks["missing samples of acceleration"].value == pytest.approx(10, abs=0.1)
    assert checks["missing samples of acceleration"].failed
    assert checks["stuck values of gyroscope"].value == pytest.approx(59 / 60)
    assert "from 13.3" in checks["stuck values of gyroscope"].advice
    assert checks["stuck values of acceleration"].passed
    w[:, 2] = 0.0
    check = found(replace(STREAM, w_sensor=w))["stuck values of gyroscope"]
    assert check.failed
    assert check.advice == "Component z never changes"


@pytest.mark.parametrize("declared", [PLAIN, Declaration("g"), Declaration(gravity="removed")])
def test_saturation_is_found_in_the_axes_of_the_file(declared: Declaration) -> None:
    a = declared.filed_acceleration(STREAM.f_sensor, STREAM.R_inertial_sensor)
    limit = np.percentile(np.abs(a), 99)
    clipped = declared.specific_force(np.clip(a, -limit, limit), STREAM.R_inertial_sensor)
    assert "saturated samples of acceleration" in failed(replace(STREAM, f_sensor=clipped), declared)


def test_saturation_is_the_share_of_samples_at_the_ends_of_the_range() -> None:
    w = np.clip(STREAM.w_sensor, -5.0, 5.0)
    check = found(replace(STREAM, w_sensor=w))["saturated samples of gyroscope"]
    assert check.failed
    beyond = np.abs(STREAM.w_sensor).max(axis=1) > 5.0
    assert check.value == pytest.approx(100 * np.mean(beyond), abs=1)


def test_iron_disturbs_the_field_and_rotation_does_not() -> None:
    m = np.einsum("tji,j->ti", STREAM.R_inertial_sensor, [0.4, 0.0, -0.7])
    assert FIELD not in failed(replace(STREAM, m_sensor=m))
    near = np.array(m)
    near[:300] *= 1.5
    assert FIELD in failed(replace(STREAM, m_sensor=near))
    absent = found(replace(STREAM, m_sensor=np.full_like(m, np.nan)))[FIELD]
    assert absent.verdict is Verdict.NOT_POSSIBLE


def test_one_sample_has_no_rate() -> None:
    one = SensorStream("one", np.array([0.0]), np.array([[0.0, 0.0, 9.81]]))
    assert found(one)[LOST].verdict is Verdict.NOT_POSSIBLE
    assert not failed(one)
