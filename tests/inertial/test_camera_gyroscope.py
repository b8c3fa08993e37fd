"""The turning of a camera from the phone that films."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.orientation import HELD, held_of_gravity, match_to_image, motion_of_gyroscope, with_gravity

RATE = 200.0
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
    times = np.arange(round(seconds * RATE)) / RATE
    R_world_camera = turning(times)
    R = R_world_camera @ HELD[held]
    w = np.zeros((len(times), 3))
    step = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * RATE
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
