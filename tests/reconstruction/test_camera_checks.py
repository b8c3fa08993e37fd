"""Checks of camera, image and body: each planted mistake is named, and a correct recording passes."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import planted
import pytest

from benchmarks.planted.gross import OF_CAMERA as FAULTS
from benchmarks.planted.gross import camera
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import Check, Verdict
from rtof_kin.core.errors import InvalidInputError, ViewError
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.reconstruction.camera_evidence import Scene, check_walk, standing_feet
from rtof_kin.reconstruction.checks import explained
from rtof_kin.reconstruction.checks.camera import check_camera_alone
from rtof_kin.reconstruction.checks.image import look_at_picture
from rtof_kin.reconstruction.lift import shipped_lifter
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import SimulationSettings, simulate

OF_IMAGE = (
    "names of left and right exchanged",
    "mirrored picture",
    "u and v exchanged",
    "upside down",
    "turned by 90 degrees",
)


@cache
def demo() -> Recording:
    """The first five seconds of the demo."""
    whole = Recording.load(model_path("demo"))
    return replace(whole, keypoints=whole.video[:300], truth=None)


def found(checks: tuple[Check, ...], name: str) -> Check:
    return next(check for check in checks if name in check.name)


def test_correct_recording_passes() -> None:
    assert not [c for c in reconstruct(demo(), mode="sf2", calibrate=False).checks if c.failed]


@pytest.mark.parametrize(
    "mistake, with_sensors", [*((name, True) for name in FAULTS), *((name, False) for name in OF_IMAGE)]
)
def test_first_failed_check_names_the_mistake(mistake: str, with_sensors: bool) -> None:
    wrong = FAULTS[mistake].plant(demo() if with_sensors else replace(demo(), imus=None))
    mode = "sf2" if with_sensors else "lift"
    failed = [check for check in reconstruct(wrong, mode=mode, calibrate=False).checks if check.failed]
    assert FAULTS[mistake].named in failed[0].cause


def test_failed_check_is_logged_with_cause_and_measure(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "rtof_kin"):
        reconstruct(replace(demo(), floor_height=1.0, imus=None), mode="lift")
    (message,) = [record.getMessage() for record in caplog.records if "floor" in record.getMessage()]
    assert "ankle" in message
    assert "floor is probably wrong" in message


def test_checks_without_their_evidence_are_unknown_not_passed() -> None:
    alone = check_camera_alone(replace(demo(), imus=None), demo().skeleton)
    assert np.isnan(found(alone, "length of bones").value)
    assert np.isnan(found(alone, "perspective").value)
    motion = planted.human(SkeletonModel.default(), 40)
    recording = planted.recording(motion, sigma_px=3.0)
    unsure = check_camera_alone(recording, recording.skeleton, planted.PlantedLifter(motion))
    assert np.isnan(found(unsure, "exchanged sides").value)
    rotated = check_camera_alone(FAULTS["upside down"].plant(demo()), demo().skeleton)
    assert np.isnan(found(rotated, "ankle").value)
    assert "upside down" in found(rotated, "ankle").advice


def test_image_in_which_the_lifter_sees_no_person_is_unknown() -> None:
    class Blind(planted.PlantedLifter):
        def predict(self, *_: object, **__: object) -> object:
            raise InvalidInputError("no person is visible")

    lifter = Blind(planted.human(SkeletonModel.default(), 40))
    picture = look_at_picture(demo(), demo().skeleton, lifter)
    assert picture.lifted is None
    assert all(check.verdict is Verdict.NOT_POSSIBLE for check in picture.checks)


def test_view_error_names_its_likely_cause() -> None:
    wrong = FAULTS["camera's translation in mm"].plant(demo())
    found = explained(ViewError("behind the camera"), wrong, wrong.skeleton, shipped_lifter())
    assert isinstance(found, ViewError)
    assert re.search("millimetres.*: behind the camera", str(found))
    assert explained(ViewError("behind the camera"), demo(), demo().skeleton, shipped_lifter()) is None


@pytest.mark.parametrize("factor", [1.0, 1.3])
def test_walk_towards_the_camera_checks_the_focal_length(factor: float) -> None:
    """A longer focal length moves the body away and keeps its pose."""
    motion, _ = planted.walking(SkeletonModel.default(), 6.0)
    view = Camera.looking_at([10.0, 0.5, 1.5], [0.0, 0.0, 1.0], 1250.0)
    recording = simulate(
        motion.poses, motion.skeleton.joint_offsets, camera=view, settings=SimulationSettings.noiseless(), seed=0
    )
    at = view.to_camera(motion.poses.p_world_joint)
    away = (factor - 1) * at[:, :1] * [0.0, 0.0, 1.0]
    p = (at + away - view.t_camera_world) @ view.R_camera_world
    imus = recording.bone_imus(times=motion.poses.times)
    scene = Scene(motion.skeleton, 0.0, standing_feet(recording.video, motion.poses, motion.skeleton), imus)
    check = check_walk(scene, view, replace(motion.poses, p_world_joint=p))
    assert check.failed is (factor > 1)
    assert check.passed or "too long" in check.cause


def test_assumed_camera_parameters_are_kept_in_the_file(tmp_path: Path) -> None:
    assumed = ("focal length", "pose")
    camera(assumed=lambda _: assumed)(demo()).save(tmp_path / "demo")
    assert Recording.load(tmp_path / "demo").video.camera.assumed == assumed
