"""Orientation by VQF: against planted motion with gyroscope bias, and against the maker's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.orientation import (
    HELD,
    OrientationSettings,
    held_of_gravity,
    log_with_orientation,
    match_to_image,
    motion_of_gyroscope,
    with_gravity,
    with_orientation,
)

REAL = Path(__file__).parents[1] / "fixtures" / "inertial"
FIELD = np.array([0.0, 0.4, -0.9])
BIAS = np.array([0.004, -0.006, 0.005])
RATE = 100.0


def moving(seconds: float = 30) -> tuple[SensorStream, Array]:
    """A limb that swings and rests, measured with noise and a gyroscope's bias; its true orientation."""
    rng = np.random.default_rng(8)
    t = np.arange(int(seconds * RATE)) / RATE
    swing = np.clip(np.sin(0.4 * t), 0, None) * np.sin(2 * np.pi * 0.7 * t)
    R = Rotation.from_euler("zyx", np.stack([1.2 * swing, 0.8 * swing, 0.5 * swing], axis=1))
    R = Rotation.from_euler("zyx", [0.5, -0.4, 0.3]) * R
    middle = (R[:-1].inv() * R[1:]).as_rotvec() * RATE
    w = np.concatenate([middle[:1], (middle[1:] + middle[:-1]) / 2, middle[-1:]])
    p = 0.3 * R.apply([0, 0, -1.0])
    a = np.gradient(np.gradient(p, 1 / RATE, axis=0), 1 / RATE, axis=0)
    f = R.inv().apply(a + np.array([0, 0, 9.81])) + rng.normal(0, 0.03, (len(t), 3))
    m = R.inv().apply(FIELD) + rng.normal(0, 0.005, (len(t), 3))
    w = w + BIAS + rng.normal(0, 0.003, w.shape)
    return SensorStream("shank", t + 5, f, None, w, m), R.as_matrix()


def inclination_deg(R: Array, true: Array) -> Array:
    """Angle between the verticals, seen by the sensor: (T,) degrees."""
    cos = np.sum(R[:, 2] * true[:, 2], axis=1)
    return np.rad2deg(np.arccos(np.clip(cos, -1, 1)))


def oriented(stream: SensorStream, settings: OrientationSettings | None = None) -> Array:
    R = with_orientation(stream, settings or OrientationSettings()).R_inertial_sensor
    assert R is not None
    return R


@pytest.mark.parametrize("causal", [False, True])
def test_inclination_is_estimated_despite_gyroscope_bias(causal: bool) -> None:
    stream, true = moving()
    stream = replace(stream, notes=("counter wrapped",))
    got = with_orientation(stream, OrientationSettings(magnetometer=False, causal=causal))
    assert got.R_inertial_sensor is not None
    error = inclination_deg(got.R_inertial_sensor, true)[500:]
    assert np.median(error) < 0.5
    assert error.max() < 3
    assert got.notes[0] == "counter wrapped"
    assert ("causal" if causal else "offline") in got.notes[1]
    assert "heading is arbitrary" in got.notes[1]
    jitter = np.random.default_rng(4).uniform(-0.0005, 0.0005, len(stream))
    uneven = oriented(replace(stream, times=stream.times + jitter))
    assert np.median(inclination_deg(uneven, true)) < 0.5


def test_the_magnetometer_gives_the_heading() -> None:
    stream, true = moving()
    R = oriented(stream)
    drift = np.unwrap(so3.heading(R @ np.swapaxes(true, 1, 2)))
    assert np.abs(np.rad2deg(drift))[500:].max() < 3  # x east: the field lies towards +y, so truth's axes
    alone = oriented(replace(stream, m_sensor=None))
    drift_alone = np.unwrap(so3.heading(alone @ np.swapaxes(true, 1, 2)))
    assert np.ptp(drift_alone) != pytest.approx(np.ptp(drift))


def cut(stream: SensorStream, rows: Array) -> SensorStream:
    arrays = {n: getattr(stream, n)[rows] for n in ("times", "f_sensor", "w_sensor", "m_sensor")}
    return replace(stream, **arrays)


@pytest.mark.parametrize(
    "gaps, note",
    [
        ([1000, 1001, 1500, *range(2000, 2007)], "3 gaps of up to 0.080 s"),
        (range(1000, 1300), "restarted 1 time, at 18.00 s; headings before and after are not related"),
    ],
)
def test_short_gaps_are_interpolated_and_long_ones_restart_the_filter(gaps: Sequence[int], note: str) -> None:
    stream, true = moving()
    rows = np.delete(np.arange(len(stream)), gaps)
    got = with_orientation(cut(stream, rows), OrientationSettings(magnetometer=False))
    assert got.R_inertial_sensor is not None
    assert np.median(inclination_deg(got.R_inertial_sensor, true[rows])) < 0.5
    assert note in got.notes[-1]


def test_missing_samples_stay_missing() -> None:
    stream, true = moving()
    f, w, m = (np.array(x) for x in (stream.f_sensor, stream.w_sensor, stream.m_sensor))
    f[700:703, 1] = np.nan
    w[1200:1250] = np.nan
    m[100:400] = np.nan
    f[:3] = np.nan
    w[-2:] = np.inf
    R = oriented(replace(stream, f_sensor=f, w_sensor=w, m_sensor=m))
    missing = np.isnan(R).any(axis=(1, 2))
    assert np.flatnonzero(missing).tolist() == [0, 1, 2, *range(1200, 1250), 2998, 2999]
    assert np.median(inclination_deg(R[~missing], true[~missing])) < 0.5


def test_short_pieces_stay_missing_and_missing_channels_are_refused() -> None:
    stream, _ = moving()
    R = oriented(cut(stream, np.concatenate([np.arange(50), np.arange(500, 1500)])))
    assert np.isnan(R[:50]).all()
    assert np.isfinite(R[50:]).all()
    for lacking, word in (("f_sensor", "accelerometer"), ("w_sensor", "gyroscope")):
        with pytest.raises(InvalidInputError, match=f"shank has no {word}"):
            with_orientation(replace(stream, **{lacking: None}))
    no_field = replace(stream, m_sensor=None)
    assert len(oriented(no_field)) == len(stream)
    with pytest.raises(InvalidInputError, match="shank has no magnetometer"):
        with_orientation(no_field, OrientationSettings(magnetometer=True))
    with pytest.raises(InvalidInputError, match="nowhere 1 s of samples"):
        with_orientation(cut(stream, np.arange(50)))
    with pytest.raises(InvalidInputError, match="set rate_hz"):
        with_orientation(stream, OrientationSettings(rate_hz=1e8))


def test_a_log_gets_orientation_where_missing() -> None:
    stream, true = moving(5)
    other = replace(stream, name="foot", R_inertial_sensor=true)
    log = SensorLog(Path("walk"), "made here", (stream, other), Declaration())
    got = log_with_orientation(log)
    assert got.streams[0].R_inertial_sensor is not None
    assert got.streams[1] is other
    assert [note.split(":")[0] for note in got.notes] == ["shank"]


def test_inclination_agrees_with_the_manufacturers() -> None:
    log = read_sensor_log(REAL / "hipose_mtw17")
    for theirs in log.streams:
        ours = with_orientation(theirs)
        assert theirs.R_inertial_sensor is not None
        assert ours.R_inertial_sensor is not None
        error = inclination_deg(ours.R_inertial_sensor, theirs.R_inertial_sensor)
        assert np.median(error) < 2
        assert error.max() < 8


PHONE_RATE = 200.0
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1, 0]])  # R_camera_world: looks along y
TILT = so3.exp(np.radians([-8.0, 0.0, 3.0]))


def turning(times: Array, seed: int = 0) -> Array:
    """R_world_camera (T, 3, 3) of a camera that is tilted, pans and shakes."""
    rng = np.random.default_rng(seed)
    v = np.radians(15.0) * np.sin(2 * np.pi * times / 7)[:, None] * [0, 1.0, 0]
    for hz in rng.uniform(0.7, 3, 4):
        v += np.radians(1.5) * rng.normal(size=3) * np.sin(2 * np.pi * hz * times + rng.uniform(0, 6))[:, None]
    return (TILT @ LEVEL).T @ so3.exp(v)


def phone(held: str, seconds: float = 20.0) -> tuple[SensorStream, CameraMotion]:
    """A phone's stream, and the true turning of its camera."""
    times = np.arange(round(seconds * PHONE_RATE)) / PHONE_RATE
    R_world_camera = turning(times)
    R = R_world_camera @ HELD[held]
    w = np.zeros((len(times), 3))
    step = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * PHONE_RATE
    w[1:-1] = (step[1:] + step[:-1]) / 2
    rng = np.random.default_rng(1)
    w += 0.005 * rng.normal(size=w.shape)
    f = np.einsum("tji,j->ti", R, [0, 0, 9.81]) + 0.1 * rng.normal(size=w.shape)
    stream = SensorStream("phone", times, f_sensor=f, w_sensor=w)
    return stream, CameraMotion(times, R_world_camera[0].T @ R_world_camera, up_first=R_world_camera[0].T[:, 2])


@pytest.mark.parametrize("held", HELD)
def test_turning_tilt_and_the_way_of_holding_are_recovered(held: str) -> None:
    stream, true = phone(held)
    assert held_of_gravity(stream) == held
    found = motion_of_gyroscope(stream, HELD[held])
    assert np.degrees(so3.angle_between(found.R_first_camera, true.R_first_camera)).max() < 0.7
    assert found.up_first @ true.up_first > np.cos(np.radians(0.7))


def test_gyroscope_alone_is_summed() -> None:
    stream, true = phone("portrait", 5.0)
    found = motion_of_gyroscope(replace(stream, f_sensor=None), HELD["portrait"])
    assert np.degrees(so3.angle_between(found.R_first_camera, true.R_first_camera)).max() < 0.3
    assert found.up_first is None


@pytest.mark.parametrize("held, offset", [("portrait", 3.217), ("landscape right", -41.93)])
def test_time_offset_and_the_way_of_holding_follow_from_the_image(held: str, offset: float) -> None:
    stream, true = phone(held, 30.0)
    rows = slice(1000, 3000, 7)  # 10 s of video
    noise = so3.exp(np.radians(0.03) * np.random.default_rng(2).normal(size=(len(true.times[rows]), 3)))
    image = CameraMotion(true.times[rows] + offset, true.R_first_camera[rows] @ noise)
    match = match_to_image(replace(stream, f_sensor=None), image)
    assert match.held == held
    assert match.offset == pytest.approx(offset, abs=0.01)
    assert match.correlation > 0.9
    assert not match.doubt
    up = with_gravity(image, stream, match).up_first
    assert up is not None
    assert up @ true.up_first > np.cos(np.radians(1.0))


def test_file_of_another_video_is_doubted() -> None:
    stream, _ = phone("portrait")
    times = np.arange(300) / 30
    match = match_to_image(stream, CameraMotion(times, turning(times * 1.37, seed=9)))
    assert "is it the file of this video" in match.doubt


def test_lack_of_a_gyroscope_or_of_time_is_said() -> None:
    stream, true = phone("portrait", 4.0)
    with pytest.raises(InvalidInputError, match="has no gyroscope"):
        motion_of_gyroscope(replace(stream, w_sensor=None), HELD["portrait"])
    with pytest.raises(InvalidInputError, match="has no gyroscope"):
        match_to_image(replace(stream, w_sensor=None), true)
    with pytest.raises(InvalidInputError, match="need 2 s at least"):
        match_to_image(stream, CameraMotion(true.times[:200], true.R_first_camera[:200]))
