"""Wrong cameras, pictures and bodies are named; right ones pass."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import ViewError
from rtof_kin.core.plausibility import Check, Verdict
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.camera_checks import UNVERIFIED, check_camera_alone, explained
from rtof_kin.reconstruction.image_checks import exchanged_axes, exchanged_sides, mirrored, upside_down
from rtof_kin.reconstruction.lift import shipped_lifter
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.scale_checks import check_walk
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import SimulationSettings, simulate

Plant = Callable[[Recording], Recording]


@cache
def demo() -> Recording:
    """The first five seconds of the demo."""
    whole = Recording.load(model_path("demo"))
    return replace(whole, keypoints=whole.video[:300], truth=None)


def seen(change: Callable[[KeypointSequence], KeypointSequence]) -> Plant:
    return lambda r: replace(r, keypoints=change(r.video))


def camera(**changes: Any) -> Plant:
    return seen(lambda k: replace(k, camera=replace(k.camera, **{
        name: change(getattr(k.camera, name)) for name, change in changes.items()
    })))  # fmt: skip


def focal(factor: float) -> Plant:
    return camera(K=lambda K: K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def turned(k: KeypointSequence) -> KeypointSequence:
    return replace(k, uv_px=np.stack([k.camera.height_px - k.uv_px[..., 1], k.uv_px[..., 0]], axis=-1))


def frozen(k: KeypointSequence) -> KeypointSequence:
    uv = k.uv_px.copy()
    uv[100:160] = uv[100]
    return replace(k, uv_px=uv)


def first_cause(recording: Recording) -> str:
    mode = "lift" if recording.imus is None else "sf2"
    failed = [check for check in reconstruct(recording, mode=mode, calibrate=False).checks if check.failed]
    return failed[0].cause if failed else ""


PLANTED: dict[str, tuple[Plant, str]] = {
    "a translation in mm": (camera(t_camera_world=lambda t: 1000 * t), "millimetres"),
    "a short focal length": (focal(0.5), "focal length is probably too short"),
    "a long focal length": (focal(1.2), "focal length"),
    "long bones": (lambda r: replace(r, joint_offsets=1.2 * r.joint_offsets), "bones"),
    "a floor too high": (lambda r: replace(r, floor_height=1.0), "floor"),
    "a floor too low": (lambda r: replace(r, floor_height=-1.0), "floor"),
    "half the picture": (seen(lambda k: replace(k, uv_px=k.uv_px / 2)), "picture 2 times smaller"),
    "exchanged names": (seen(exchanged_sides), "left and right of the keypoints are exchanged"),
    "a mirrored picture": (seen(mirrored), "the picture is mirrored"),
    "exchanged axes": (seen(exchanged_axes), "u and v"),
    "a world with y up": (
        camera(R_camera_world=lambda R: R @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]), "+y points up"
    ),
    "an upside-down video": (seen(upside_down), "upside down"),
    "a turned video": (seen(turned), "90 degrees clockwise"),
    "a frozen detector": (seen(frozen), "frozen"),
    "an assumed pose": (camera(assumed=lambda _: ("focal length", "pose")), UNVERIFIED),
}  # fmt: skip


def test_nothing_is_said_against_a_right_recording() -> None:
    assert first_cause(demo()) == ""


def test_how_well_the_feet_tell_the_focal_length_is_said_where_nothing_else_does() -> None:
    checks = reconstruct(demo(), mode="sf2", calibrate=False).checks
    (focal,) = [check for check in checks if check.name.startswith("focal length to better than")]
    assert focal.verdict is Verdict.NOT_POSSIBLE
    assert 10 < float(focal.name.split()[-2]) < 40
    assert "absolute positions" in focal.advice


@pytest.mark.parametrize("mistake", PLANTED)
def test_the_first_check_that_fails_names(mistake: str) -> None:
    plant, named = PLANTED[mistake]
    assert named in first_cause(plant(demo()))


@pytest.mark.parametrize("mistake", [
    "exchanged names", "a mirrored picture", "exchanged axes", "an upside-down video", "a turned video",
])  # fmt: skip
def test_the_picture_alone_names(mistake: str) -> None:
    plant, named = PLANTED[mistake]
    assert named in first_cause(plant(replace(demo(), imus=None)))


def test_a_failed_check_is_a_warning_with_its_cause_and_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "rtof_kin"):
        reconstruct(replace(demo(), floor_height=1.0, imus=None), mode="lift")
    (message,) = [record.getMessage() for record in caplog.records if "floor" in record.getMessage()]
    assert "ankle" in message
    assert "floor is probably wrong" in message


def found(checks: tuple[Check, ...], name: str) -> Check:
    return next(check for check in checks if name in check.name)


def test_what_the_data_cannot_tell_is_not_passed() -> None:
    alone = check_camera_alone(replace(demo(), imus=None), demo().skeleton)
    assert np.isnan(found(alone, "length of bones").value)
    assert np.isnan(found(alone, "perspective").value)
    planted_lifter = planted.PlantedLifter(planted.human(SkeletonModel.default(), 40))
    recording = planted.recording(planted.human(SkeletonModel.default(), 40), sigma_px=3.0)
    unsure = check_camera_alone(recording, recording.skeleton, planted_lifter)
    assert np.isnan(found(unsure, "exchanged sides").value)


def test_what_a_turned_picture_makes_of_the_floor_is_not_told() -> None:
    checks = check_camera_alone(seen(upside_down)(demo()), demo().skeleton)
    ankle = found(checks, "ankle")
    assert np.isnan(ankle.value)
    assert "upside down" in ankle.advice


def test_an_error_in_the_middle_names_its_likely_cause() -> None:
    wrong = PLANTED["a translation in mm"][0](demo())
    with (
        pytest.raises(ViewError, match=r"millimetres.*behind the camera"),
        explained(wrong, wrong.skeleton, shipped_lifter()),
    ):
        raise ViewError("pose is behind the camera")
    with (
        pytest.raises(ViewError, match=r"^pose is behind the camera"),
        explained(demo(), demo().skeleton, shipped_lifter()),
    ):
        raise ViewError("pose is behind the camera")


def test_who_walks_towards_a_camera_tells_its_focal_length() -> None:
    motion, _ = planted.walking(SkeletonModel.default(), 3.0)
    view = Camera.looking_at([7.0, 0.5, 1.5], [0.0, 0.0, 1.0], 1250.0)
    recording = simulate(
        motion.poses, motion.skeleton.joint_offsets, camera=view,
        settings=SimulationSettings.noiseless(), seed=0,
    )  # fmt: skip
    at = view.to_camera(motion.poses.p_world_joint)
    imus = recording.bone_imus(times=motion.poses.times)
    for factor, failed in ((1.0, False), (1.3, True)):
        # A longer focal length moves the body away, and leaves its pose.
        away = (factor - 1) * at[:, :1] * [0.0, 0.0, 1.0]
        p = (at + away - view.t_camera_world) @ view.R_camera_world
        poses = replace(motion.poses, p_world_joint=p)
        check = check_walk(poses, imus, recording.video, motion.skeleton)
        assert check.failed is failed
    assert "focal length is probably too long" in check.cause


@pytest.mark.parametrize("assumed", [(), ("focal length", "pose")])
def test_what_is_assumed_of_a_camera_is_kept_in_its_file(tmp_path: Path, assumed: tuple[str, ...]) -> None:
    camera(assumed=lambda _: assumed)(demo()).save(tmp_path / "demo")
    assert Recording.load(tmp_path / "demo").video.camera.assumed == assumed
