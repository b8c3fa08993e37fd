"""Motions of sensors at common times, from orientations or raw samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from assignment_support import walking_log

from rtof_kin.calibration.sensor_motion import joined, sensor_motions
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream


def swinging(offset: float = 0.0) -> SensorLog:
    """A sensor 0.5 m from a fixed vertical axis that swings by 0.6 sin(4 t) about it."""
    t = np.arange(0, 6, 0.01)
    angle, rate, change = 0.6 * np.sin(4 * t), 2.4 * np.cos(4 * t), -9.6 * np.sin(4 * t)
    R = so3.about_axis("z", angle)
    a = 0.5 * np.stack([-(rate**2), change, 0 * t], axis=-1)
    f = a - GRAVITY_WORLD
    w = np.stack([0 * t, 0 * t, rate], axis=-1)
    stream = SensorStream("one", t + offset, f, R, w)
    return SensorLog(Path("swing"), "planted", (stream,), Declaration())


def test_rates_and_accelerations_are_those_planted() -> None:
    motions = sensor_motions(swinging())
    middle = (motions.times > 1) & (motions.times < 5)
    rate = 2.4 * np.cos(4 * motions.times[middle])
    np.testing.assert_allclose(motions.w[middle, 0, 2], rate, atol=0.02)
    own = np.einsum("tji,tj->ti", motions.R[middle, 0], motions.a[middle, 0])
    np.testing.assert_allclose(own[:, 0], -0.5 * rate**2, atol=0.05)


def test_the_second_derivative_of_the_orientation_accelerates_points_of_the_body() -> None:
    motions = sensor_motions(swinging())
    middle = (motions.times > 1) & (motions.times < 5)
    axis = motions.a[middle, 0] + motions.D[middle, 0] @ np.array([-0.5, 0.0, 0.0])
    assert np.abs(axis).max() < 0.03 * np.abs(motions.a[middle]).max()


def test_raw_samples_and_an_orientation_that_contradicts_gravity_are_filtered() -> None:
    log = swinging()
    (stream,) = log.streams
    wrong = np.tile(so3.about_axis("x", np.pi / 2), (len(stream), 1, 1)) @ stream.R_inertial_sensor
    for R in (None, wrong):
        motions = sensor_motions(replace(log, streams=(replace(stream, R_inertial_sensor=R),)))
        up = np.einsum("tij,j->ti", motions.R[:, 0], [0.0, 0.0, 1.0])
        assert np.degrees(np.arccos(up[100:, 2])).max() < 5


def test_sensors_of_different_times_are_an_error() -> None:
    late = replace(swinging(100.0).streams[0], name="late")
    log = replace(swinging(), streams=(*swinging().streams, late))
    with pytest.raises(InvalidInputError, match=r"0\.0 s in common"):
        sensor_motions(log)
    with pytest.raises(InvalidInputError, match="no sensor"):
        sensor_motions(replace(swinging(), streams=()))


def test_pieces_are_joined_in_time() -> None:
    motions = sensor_motions(walking_log(("Pelvis", "L_Foot")))
    halves = [motions.select(np.arange(50)), motions.select(np.arange(50, len(motions)))]
    np.testing.assert_array_equal(joined(halves).D, motions.D)
