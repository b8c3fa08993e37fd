"""Motions of sensors at common times, from orientations or raw samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from assignment_support import places, turned, walk, walking_log, walking_poses

from rtof_kin.calibration.motion_score import MotionScore, image_scores, pair_features, sensor_motions, single_features
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
    axis = motions.a[middle, 0] + motions.D[middle, 0] @ np.array([-0.5, 0.0, 0.0])  # a point of the body
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


SEGMENTS = tuple(places().values())


def test_a_limb_agrees_best_with_its_own_segment() -> None:
    scores = image_scores(sensor_motions(walking_log()), walking_poses(), walk().skeleton, SEGMENTS)
    limbs = [s for s, joint in enumerate(SEGMENTS) if "Left" in joint or "Right" in joint]
    assert [int(scores[s].argmax()) for s in limbs] == limbs


def test_scores_are_the_same_for_any_mounting_and_heading() -> None:
    scores = [
        image_scores(sensor_motions(log), walking_poses(), walk().skeleton, SEGMENTS)
        for log in (walking_log(), turned(walking_log(), 4))
    ]
    np.testing.assert_allclose(scores[0], scores[1], atol=3.0)
    assert np.ptp(scores[0]) > 50


GAIN = 6
"""Index of how much a common joint explains, among the features of pairs."""


def test_features_are_the_same_for_any_mounting_and_heading() -> None:
    logs = walking_log(), turned(walking_log(), 6)
    single, pair = ([features(sensor_motions(log)) for log in logs] for features in (single_features, pair_features))
    np.testing.assert_allclose(single[0], single[1], atol=1e-6)
    off = np.abs(pair[0] - pair[1])[~np.eye(13, dtype=bool)]
    assert np.quantile(off, 0.95) < 0.2  # headings are tried on a grid


def test_neighbouring_segments_have_the_most_of_a_common_joint() -> None:
    joints = list(places().values())
    gain = pair_features(sensor_motions(walking_log()))[..., GAIN]
    np.fill_diagonal(gain, 0)
    for side in ("Left", "Right"):
        leg, arm = joints.index(f"{side}Leg"), joints.index(f"{side}ForeArm")
        assert joints[int(gain[leg].argmin())] in (f"{side}UpLeg", f"{side}Foot")
        assert joints[int(gain[arm].argmin())] == f"{side}Arm"


def test_scores_of_fewer_segments_are_those_of_all() -> None:
    motions, score = sensor_motions(walking_log(("Pelvis", "L_Foot", "R_Foot"))), MotionScore.load()
    single, pair = score.tables(motions, score.segments)
    keep = [2, 0]
    some = score.tables(motions, [score.segments[k] for k in keep])
    np.testing.assert_array_equal(some[0], single[:, keep])
    np.testing.assert_array_equal(some[1], pair[:, :, keep][..., keep])
    np.testing.assert_allclose(pair, pair.transpose(1, 0, 3, 2), atol=1e-12)
