"""A camera that is not calibrated: found from the recording, stated, and part of the covariances."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rtof_kin.calibration.camera_estimate import FOCAL, corrected
from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.confidence import WORLD
from rtof_kin.reconstruction.pipeline import calibrate_camera, reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import excerpt, with_camera
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.provenance import input_provenance
from rtof_kin.reporting.statistics import ReconstructionStatistics
from rtof_kin.solve.uncertainty import disagreement

PLANTED = np.array([0.0, np.radians(-5.0), np.radians(5.0), 0.0, 0.0])
UNSURE = CameraUncertainty(focal=0.1, tilt=np.radians(5.0), height=0.02)


@cache
def demo() -> Recording:
    """Four seconds of the demo, at a quarter of its rate."""
    whole = Recording.load(model_path("demo"))
    return replace(whole, keypoints=whole.video[800:1040:4], truth=None, floor_height=0.0)


@cache
def known() -> Camera:
    """The true camera, declared exact."""
    return replace(demo().video.camera, accuracy=CameraUncertainty())


@cache
def results(mode: str) -> tuple[Reconstruction, Reconstruction]:
    """With the true camera, and with a wrong one that is declared uncertain."""
    recording = demo() if mode == "rtof" else replace(demo(), imus=None)
    wrong = replace(corrected(demo().video.camera, PLANTED), uncertainty=UNSURE)
    return reconstruct(with_camera(recording, known()), mode=mode), reconstruct(
        with_camera(recording, wrong), mode=mode
    )


@pytest.mark.parametrize("mode", ["rtof", "rto"])
def test_a_planted_tilt_is_found_within_what_is_stated(mode: str) -> None:
    _, found = results(mode)
    off = found.camera.value + PLANTED
    assert (np.abs(off)[:4] < 3 * found.camera.sigma[:4]).all()
    assert (np.abs(off)[1:3] < np.radians(4.0)).all()
    assert (found.camera.sigma[1:3] < 0.75 * UNSURE.tilt).all()


@pytest.mark.parametrize("mode", ["rtof", "rto"])
def test_joint_angles_are_those_of_the_known_camera(mode: str) -> None:
    true, found = results(mode)
    assert np.degrees(np.median(np.abs(found.motion.q[:, 7:] - true.motion.q[:, 7:]))) < 1.0


@pytest.mark.parametrize("mode", ["rtof", "rto"])
def test_what_remains_is_in_the_covariances(mode: str) -> None:
    """Of the distance: the share of the focal length; and the true one lies inside."""
    true, found = results(mode)
    stated = found.motion.confidence
    known = true.motion.confidence
    camera = found.camera.found
    ray = found.motion.poses.p_world_joint[:, 0] - camera.center_world
    distance = np.linalg.norm(ray, axis=-1)
    ray = ray / distance[:, None]
    both = np.stack([stated.position_covariance[:, 0], known.position_covariance[:, 0]])
    variance = np.einsum("ti,ctij,tj->ct", ray, both, ray)
    share = np.sqrt(np.median(variance[0] - variance[1])) / np.median(distance)
    assert share == pytest.approx(found.camera.sigma[FOCAL], rel=0.4)
    sigma = np.sqrt(variance[0])
    away = true.motion.poses.p_world_joint[:, 0] - true.recording.video.camera.center_world
    assert (np.abs(np.linalg.norm(away, axis=-1) - distance) < 3 * sigma).all()
    assert (stated.position_sigma > known.position_sigma).mean() > 0.9


def test_it_is_told_what_was_assumed_found_and_remains() -> None:
    _, found = results("rtof")
    assert any("the camera is not calibrated (focal length" in text for text in found.warnings)
    table = input_provenance(ReconstructionStatistics(found))["camera_estimate"]
    assert [row[0] for row in table["rows"]][:3] == ["focal length", "pitch", "roll"]
    assert all(len(row) == len(table["columns"]) for row in table["rows"])
    assert found.recording.video.camera.uncertainty.tilt < UNSURE.tilt
    assert not [check.message for check in found.checks if check.failed]


def test_the_camera_alone_is_what_a_lift_finds() -> None:
    wrong = replace(corrected(demo().video.camera, PLANTED), uncertainty=UNSURE)
    recording = with_camera(demo(), wrong)
    alone, lifted = calibrate_camera(recording), reconstruct(recording, mode="lift").camera
    np.testing.assert_array_equal(alone.value, lifted.value)
    np.testing.assert_array_equal(alone.covariance, lifted.covariance)


def test_a_known_camera_is_not_touched() -> None:
    true, _ = results("rtof")
    assert true.camera is None
    assert true.recording.video.camera is known()
    assert input_provenance(ReconstructionStatistics(true))["camera_estimate"] is None


def test_covariances_are_those_of_solutions_with_other_cameras() -> None:
    """A rigid shift and turn, whose squares are known."""
    true, _ = results("rtof")
    motion = true.motion
    before = motion.confidence
    shifted = replace(motion.poses, p_world_joint=motion.poses.p_world_joint + np.array([0.3, 0, 0]))
    apart = disagreement(motion.poses, shifted, before)
    after = before.plus(apart).plus(apart)
    added = after.position_covariance - before.position_covariance
    np.testing.assert_allclose(added[:, 3], np.broadcast_to(np.diag([0.18, 0, 0]), added[:, 3].shape), atol=1e-9)
    np.testing.assert_allclose(after.relative_covariance, before.relative_covariance, atol=1e-9)
    np.testing.assert_allclose(after.turn(WORLD, "Hips"), before.turn(WORLD, "Hips"), atol=1e-9)


def test_of_a_long_video_the_part_in_which_the_person_comes_and_goes_is_used() -> None:
    video = demo().video
    times = np.arange(20 * 60) / 15.0
    uv = np.tile(video.uv_px, (20, 1, 1))
    near = (times > 30) & (times < 45)
    uv[near] = (uv[near] - uv[near].mean()) * 1.8 + uv[near].mean()
    long = replace(video, times=times, uv_px=uv, confidence=np.tile(video.confidence, (20, 1)))
    part = excerpt(long)
    assert part.times[0] < 45
    assert part.times[-1] > 30
    assert part.times[-1] - part.times[0] <= 41
    assert len(excerpt(replace(video, times=video.times / 2))) == 60


def test_the_audit_lists_the_unknowns_of_the_camera() -> None:
    true, found = results("rtof")
    listed = [r for r in audit(found) if r.subject == "camera" and "assumed, " in r.note]
    assert [r.name.split(",")[0] for r in listed] == [row[0] for row in found.camera.table()]
    assert all(0 <= r.value < 3 for r in listed)
    assert not [r for r in audit(true) if "assumed, " in r.note]


def test_further_cameras_move_rigidly_with_the_first() -> None:
    video = demo().video
    second = replace(video.camera, R_camera_world=so3.about_axis("y", 1.0) @ video.camera.R_camera_world)
    recording = replace(demo(), views=(replace(video, camera=second),))
    moved = with_camera(recording, corrected(video.camera, np.array([0.1, 0.05, -0.02, 0.3, 0.0])))

    def between(one: Recording) -> np.ndarray:
        points = np.random.default_rng(0).normal(size=(5, 3))
        first, other = one.video.camera, one.views[0].camera
        return other.to_camera((points - first.t_camera_world) @ first.R_camera_world)

    np.testing.assert_allclose(between(moved), between(recording), atol=1e-12)
