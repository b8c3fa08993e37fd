"""Tests of `rtof_kin.calibration.clock_scan`."""

from __future__ import annotations

import numpy as np
import planted
from clocks_support import filmed, skeleton, worn

from rtof_kin.calibration.clock_scan import STEP, velocities_in_image, velocities_of_sensors
from rtof_kin.core import rotations as so3


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


def test_frames_that_do_not_show_the_person_are_missing() -> None:
    motion = planted.moving(skeleton(), 600)
    poses, keypoints = filmed(motion, 0.0, 10.0)
    seen = velocities_in_image(poses, planted.unseen(keypoints, slice(240, 360)), skeleton())
    assert not seen.known[round(4.2 / STEP) : round(5.8 / STEP)].any()
    assert seen.known[: round(3.9 / STEP)].all()


def test_fast_turns_are_limited() -> None:
    motion = planted.moving(skeleton(), 300)
    poses, keypoints = filmed(motion, 0.0, 5.0)
    R = poses.R_world_bone.copy()
    R[150] = so3.about_axis("z", np.pi) @ R[150]
    seen = velocities_in_image(poses.with_poses(slice(None), poses.p_world_joint, R), keypoints, skeleton())
    assert np.nanmax(np.linalg.norm(seen.w_world, axis=-1)) < 7.0
