"""Causes that are measured: the first line names the mistake planted in the demo, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.reconstruction.checks.camera import check_bones
from rtof_kin.reconstruction.checks.image import exchanged_sides
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import headline

SECONDS = 8.0


def demo() -> Recording:
    whole = Recording.load(model_path("demo"))
    assert whole.imus is not None
    keypoints = whole.video[: round(60 * SECONDS)]
    imus = whole.imus[: int(np.searchsorted(whole.imus.times, keypoints.times[-1]))]
    return replace(whole, keypoints=keypoints, imus=imus, truth=None)


def references(axis: str, degrees: float, recording: Recording) -> Recording:
    """All references turned alike."""
    given = recording.calibration
    assert given is not None
    R = so3.about_axis(axis, np.radians(degrees)) @ given.R_world_inertial
    return replace(recording, calibration=replace(given, R_world_inertial=R))


def rolled(recording: Recording) -> Recording:
    """The camera turned by 10 deg about its line of sight."""
    camera = recording.video.camera
    R = so3.about_axis("z", np.radians(10.0)) @ camera.R_camera_world
    turned = replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world)
    return replace(recording, keypoints=replace(recording.video, camera=turned))


def frozen(recording: Recording) -> Recording:
    """The left shank's sensor repeats one sample with noise."""
    given, imus = recording.calibration, recording.imus
    assert given is not None
    assert imus is not None
    s = imus.names.index(given.sensors[given.joints.index("LeftLeg")])
    R, f, noise = imus.R_inertial_sensor.copy(), imus.f_sensor.copy(), np.random.default_rng(0)
    R[:, s] = R[0, s] @ so3.exp(np.radians(0.5) * noise.standard_normal((len(imus), 3)))
    f[:, s] = f[0, s] + 0.05 * noise.standard_normal((len(imus), 3))
    return replace(recording, imus=replace(imus, R_inertial_sensor=R, f_sensor=f))


def twisted(recording: Recording) -> Recording:
    """The left shank's sensor turned by 60 deg about the bone."""
    given, skeleton = recording.calibration, recording.skeleton
    assert given is not None
    R, s = given.R_sensor_bone.copy(), given.joints.index("LeftLeg")
    bone = so3.unit(skeleton.joint_offsets[skeleton.names.index("LeftFoot")])
    R[s] = R[s] @ so3.exp(np.radians(60.0) * bone)
    return replace(recording, calibration=replace(given, R_sensor_bone=R))


def faster(recording: Recording) -> Recording:
    """A video of half the frame rate that is declared."""
    video = recording.video
    times = video.times[0] + (video.times - video.times[0]) / 2
    return replace(recording, keypoints=replace(video, times=times))


def unseen(recording: Recording) -> Recording:
    """Nobody seen from 2 to 7 s."""
    video = recording.video
    gone = (video.times > video.times[0] + 2.0) & (video.times < video.times[0] + 7.0)
    uv = np.where(gone[:, None, None], np.nan, video.uv_px)
    confidence = np.where(gone[:, None], 0.0, video.confidence)
    return replace(recording, keypoints=replace(video, uv_px=uv, confidence=confidence))


def exchanged_legs(recording: Recording) -> Recording:
    return replace(recording, keypoints=exchanged_sides(recording.video, only="legs"))


def ending(recording: Recording) -> Recording:
    assert recording.imus is not None
    return replace(recording, imus=recording.imus[: len(recording.imus) // 2])


@pytest.mark.parametrize(
    ("plant", "named"),
    [
        (partial(references, "x", 10.0), "the references of all sensors are tilted by about 10 deg"),
        (partial(references, "z", 30.0), "all sensors' headings are off by about"),
        (rolled, "the camera is probably turned by about 10 deg about its line of sight"),
        (frozen, "the sensor on LeftLeg is frozen"),
        (twisted, "the sensor on LeftLeg is turned by about"),
        (faster, "the video runs 2 times too fast"),
        (exchanged_legs, "left and right of the legs' keypoints are exchanged"),
        (unseen, "the person, 2."),
        (ending, "all sensors, 4."),
    ],
)
def test_first_line_names_the_cause(plant: Callable[[Recording], Recording], named: str) -> None:
    settings = ReconstructionSettings(confidence=False)
    found = reconstruct(plant(demo()), calibrate=False, settings=settings)
    assert headline(audit(found)).text.startswith(named)


def test_right_recording_fails_no_check_and_has_no_gap() -> None:
    found = reconstruct(demo(), calibrate=False, settings=ReconstructionSettings(confidence=False))
    assert not [check for check in found.checks if check.failed]
    assert not found.faults


def test_noise_of_orientations_does_not_make_bones_too_long() -> None:
    """Regression on noisy orientations is attenuated as by bones that are shorter than declared."""
    recording = demo()
    assert recording.imus is not None
    assert recording.calibration is not None
    rng, T = np.random.default_rng(0), len(recording.imus)
    shake = np.cumsum(rng.standard_normal((T, len(recording.imus.names), 3)), axis=0)
    shake = np.radians(8.0) * (shake - shake.mean(axis=0)) / 6
    R = recording.imus.R_inertial_sensor @ so3.exp(shake)
    bone_imus = recording.calibration.apply(replace(recording.imus, R_inertial_sensor=R))
    check = check_bones(bone_imus, recording.skeleton)
    assert not check.failed
