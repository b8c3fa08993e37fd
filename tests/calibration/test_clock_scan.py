"""Tests of `rtof_kin.calibration.clock_scan`."""

from __future__ import annotations

import numpy as np
import planted
import pytest
from clocks_support import filmed, skeleton, worn

from rtof_kin.calibration.clock_scan import (
    STEP,
    AngularVelocities,
    ClockScan,
    velocities_in_image,
    velocities_of_sensors,
)
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError


def turning(seed: int, samples: int, columns: int = 3) -> AngularVelocities:
    return AngularVelocities(0.0, planted.smooth_noise(seed, (samples, columns, 3), 8, 1.0))


def test_the_gain_is_that_of_the_regression_on_the_best_heading() -> None:
    seen, sensed = turning(0, 400, 1), turning(1, 300, 1)
    scan = ClockScan.of(seen, sensed, 0.0, 100.0)
    for k in (0, 123, len(scan.scan.offsets) - 1):
        lag = -round(scan.scan.offsets[k] / STEP)
        rows = np.arange(max(0, -lag), min(400, 300 - lag))
        v, s = seen.w_world[rows, 0], sensed.w_world[rows + lag, 0]
        best = max(np.sum(v * (s @ so3.about_axis("z", h).T)) for h in np.linspace(0, 2 * np.pi, 2000))
        own, whole = np.sum(s**2), np.sum(seen.w_world**2) + 3 * 0.15**2 * 400
        g = np.clip(best / own, 0, 1.3)
        wanted = -1.5 * 400 * STEP / 0.25 * np.log1p(-max(2 * g * best - g**2 * own, 0) / whole)
        assert scan.scan.gains[k] == pytest.approx(wanted, rel=1e-3, abs=1e-3)


def test_headings_of_the_sensors_do_not_matter() -> None:
    seen, sensed = turning(0, 400), turning(0, 900)
    turns = so3.about_axis("z", np.array([0.3, -2.0, 3.0]))
    turned = AngularVelocities(0.0, np.einsum("sij,tsj->tsi", turns, sensed.w_world))
    np.testing.assert_allclose(
        ClockScan.of(seen, turned, 0.0, 60.0).scan.gains,
        ClockScan.of(seen, sensed, 0.0, 60.0).scan.gains,
        rtol=1e-3,
        atol=1e-3,
    )


def test_unknown_sensors_take_the_segments_that_move_alike_each_once() -> None:
    sensed = turning(3, 1500, 4)
    order = [2, 0, 3]
    seen = AngularVelocities(0.0, sensed.w_world[600:1100][:, order])
    scan = ClockScan.of(seen, sensed, 0.0, 60.0, known=False)
    assert scan.scan.best == pytest.approx(-600 * STEP, abs=2 * STEP)
    assert scan.segments.tolist() == [1, -1, 0, 2]


def test_the_vertex_lies_between_samples() -> None:
    sensed = turning(5, 1500, 2)
    wide = np.arange(1500) * STEP
    at = wide[300:800] + 0.007
    w = np.stack([np.interp(at, wide, sensed.w_world[:, s, i]) for s in range(2) for i in range(3)], axis=1)
    scan = ClockScan.of(AngularVelocities(0.0, w.reshape(-1, 2, 3)), sensed, 0.0, 30.0)
    assert scan.scan.best == pytest.approx(-300 * STEP - 0.007, abs=0.002)
    assert scan.sigma < 0.01


def test_too_little_overlap_is_an_error() -> None:
    with pytest.raises(CalibrationError, match="in common"):
        ClockScan.of(turning(0, 300), turning(1, 300), 100.0, 10.0)


def test_a_sensor_turns_like_its_segment_but_for_the_heading() -> None:
    motion = planted.moving(skeleton(), 600)
    log, calibration = worn(motion)
    seen = velocities_in_image(*filmed(motion, 0.0, 10.0, radians=0.0), skeleton())
    sensed = velocities_of_sensors(log)
    T = min(len(seen.w_world), len(sensed.w_world))
    for s, joint in enumerate(calibration.joints):
        w = sensed.w_world[:T, s] @ calibration.R_world_inertial[s].T
        wanted = seen.of(skeleton().index(joint)).w_world[:T, 0]
        np.testing.assert_allclose(w, wanted, atol=0.03)


def test_frames_without_the_person_are_missing_and_fast_turns_limited() -> None:
    motion = planted.moving(skeleton(), 600)
    poses, keypoints = filmed(motion, 0.0, 10.0)
    R = poses.R_world_bone.copy()
    R[150] = so3.about_axis("z", np.pi) @ R[150]  # exchanged limbs, whose turn is shortened
    poses = poses.with_poses(slice(None), poses.p_world_joint, R)
    seen = velocities_in_image(poses, planted.unseen(keypoints, slice(240, 360)), skeleton())
    assert np.nanmax(np.linalg.norm(seen.w_world, axis=-1)) < 7.0
    assert not seen.known[round(4.2 / STEP) : round(5.8 / STEP)].any()
    assert seen.known[: round(3.9 / STEP)].all()
