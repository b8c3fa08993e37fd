"""Positions in the room: what nothing verifies is in their covariances, or it is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.scoring import bands
from rtof_kin.calibration.camera_unknowns import FOCAL, PITCH, displacements
from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import with_camera
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import Grade, headline

CAMERA = Camera.looking_at([5.0, 1.0, 2.0], [0.0, 0.0, 0.9], 1200.0)
POINTS = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (6, 3))


@cache
def demo() -> Recording:
    """Six seconds of the demo, at a third of its rate."""
    whole = Recording.load(model_path("demo"))
    return replace(whole, keypoints=whole.video[:360:3])


def focal(factor: float) -> Callable[[Recording], Recording]:
    """Plant a focal length that is wrong by a factor."""

    def plant(recording: Recording) -> Recording:
        camera = recording.video.camera
        K = camera.K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]]
        return with_camera(recording, replace(camera, K=K))

    return plant


@cache
def right() -> Reconstruction:
    return reconstruct(demo())


@pytest.mark.parametrize(
    "plant",
    [
        focal(0.8),
        focal(1.1),
        lambda r: replace(focal(1.2)(r), floor_height=0.0),
        lambda r: replace(r, joint_offsets=0.9 * r.joint_offsets),
        lambda r: replace(r, joint_offsets=1.1 * r.joint_offsets),
        lambda r: replace(r, floor_height=0.1),
    ],
)
def test_a_wrong_scale_that_nothing_shows_lies_inside_the_bands_in_world(
    plant: Callable[[Recording], Recording],
) -> None:
    found = reconstruct(plant(demo()))
    line = headline(audit(found)).line
    assert found.recording.truth is not None
    assert not line.startswith("pass:")
    assert bands(found.motion, found.recording.truth)["inside_world"] >= 0.9 or "fails" in line


def test_what_is_unverified_does_not_widen_positions_relative_to_the_root() -> None:
    known = replace(demo().video.camera, accuracy=CameraUncertainty())
    sure, unsure = reconstruct(with_camera(demo(), known)), right()
    relative, world = (
        [getattr(r.motion.confidence, f"{kind}_covariance") for r in (sure, unsure)]
        for kind in ("relative", "position")
    )
    np.testing.assert_array_equal(*relative)
    assert np.trace(world[0], axis1=2, axis2=3).max() < np.trace(world[1], axis1=2, axis2=3).min()
    verdict = headline(audit(unsure))
    assert verdict.room is Grade.WEAK
    assert "the focal length" in verdict.text


def test_a_camera_turned_against_the_sensors_is_named_in_the_first_line() -> None:
    camera = demo().video.camera
    R = camera.R_camera_world @ so3.about_axis("z", np.radians(20.0))
    turned = replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world)
    found = headline(audit(reconstruct(with_camera(demo(), turned))))
    assert found.line.startswith("fail: all sensors' headings are off by about 20 deg against the camera")


def test_displacements_are_those_of_another_camera() -> None:
    d, step = displacements(CAMERA, POINTS), 1e-5
    depth = CAMERA.to_camera(POINTS) * [1.0, 1.0, 1.0 + step]
    longer = (depth - CAMERA.t_camera_world) @ CAMERA.R_camera_world
    np.testing.assert_allclose((POINTS - longer) / step, d[..., FOCAL], atol=1e-4)
    R = so3.exp(np.array([step, 0.0, 0.0])) @ CAMERA.R_camera_world  # the true one
    true = CAMERA.to_camera(POINTS) @ R + CAMERA.center_world
    np.testing.assert_allclose((POINTS - true) / step, d[..., PITCH], atol=1e-4)
