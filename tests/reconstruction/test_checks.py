"""Checks of what a recording declares: each planted mistake is named first, and a correct recording passes.

What is left open of positions in world is in their covariances, or it is named.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import planted
import pytest

from benchmarks.planted.gross import OF_CAMERA, OF_SENSORS
from benchmarks.scoring import bands
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import NAME as CLOCKS
from rtof_kin.calibration.camera_estimate import FOCAL, PITCH, displacements
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import Check, Verdict
from rtof_kin.core.errors import InvalidInputError, RtofError, SolverError, ViewError
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.inertial.outlier_rejection import FROZEN, GRAVITY
from rtof_kin.reconstruction import pipeline
from rtof_kin.reconstruction.camera_evidence import Scene, check_walk, standing_feet
from rtof_kin.reconstruction.checks import explained
from rtof_kin.reconstruction.checks.camera import check_bones, check_camera_alone
from rtof_kin.reconstruction.checks.image import ImageExcerpt, exchanged_sides
from rtof_kin.reconstruction.checks.sensors import SETUP
from rtof_kin.reconstruction.lift import shipped_lifter
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import with_camera
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import Grade, headline
from rtof_kin.simulation.simulate import SimulationSettings, simulate

Plant = Callable[[Recording], Recording]
OF_IMAGE = (
    "mirrored picture",
    "turned by 90 degrees",
    "names of left and right exchanged",
    "u and v exchanged",
    "upside down",
)
"""Faults that are found without sensors too, by the same checks; two of them are tried with sensors."""
BY_BENCHMARK = (
    "samples of left and right swapped",
    "samples of an arm and a thigh swapped",
    "forearms swapped",
    "upper arm and forearm swapped",
)
"""Faults found by the same code as others; the benchmark plants them."""


@cache
def demo(seconds: float = 6.0) -> Recording:
    """The beginning of the demo, at half the rate of its video."""
    whole = Recording.load(model_path("demo"))
    keypoints = whole.video[: round(60 * seconds) : 2]
    imus = whole.imus[: int(np.searchsorted(whole.imus.times, keypoints.times[-1], "right"))]
    return replace(whole, keypoints=keypoints, imus=imus, truth=None)


@cache
def right(mode: str) -> Reconstruction:
    return reconstruct(demo(), mode=mode)


def failed(result: Reconstruction) -> list[Check]:
    return [check for check in result.checks if check.failed]


def named(checks: tuple[Check, ...], name: str) -> Check:
    return next(check for check in checks if name in check.name)


def with_imus(recording: Recording, **changed: object) -> Recording:
    assert recording.imus is not None
    return replace(recording, imus=replace(recording.imus, **changed))


# --- mistakes that are recognised ------------------------------------------------------------------


@pytest.mark.parametrize(
    "mistake, mode",
    [
        *((name, "sf2") for name in OF_CAMERA if name not in OF_IMAGE[2:]),
        *((name, "lift") for name in OF_IMAGE),
        *((name, "lift") for name in OF_SENSORS if name not in BY_BENCHMARK),
    ],
)
def test_first_failed_check_names_the_mistake(mistake: str, mode: str) -> None:
    fault = (OF_CAMERA | OF_SENSORS)[mistake]
    given = replace(demo(), imus=None) if mistake in OF_IMAGE and mode == "lift" else demo()
    assert fault.named in failed(reconstruct(fault.plant(given), mode=mode))[0].cause


def test_correct_recording_passes_without_diagnosis_of_its_setup(caplog: pytest.LogCaptureFixture) -> None:
    checks = {check.name: check for check in right("sf2").checks}
    assert not failed(right("sf2"))
    assert not right("sf2").faults
    for name in (FROZEN, GRAVITY, CLOCKS, SETUP):
        assert checks[name].verdict is Verdict.PASSED
    assert checks[SETUP].value == 0  # no other setup was tried


def test_failed_check_is_logged_with_cause_and_measure(caplog: pytest.LogCaptureFixture) -> None:
    reconstruct(replace(demo(), floor_height=1.0, imus=None), mode="lift")
    (message,) = [record.getMessage() for record in caplog.records if "floor" in record.getMessage()]
    assert "ankle" in message
    assert "floor is probably wrong" in message


def test_checks_without_their_evidence_are_unknown_not_passed() -> None:
    alone = check_camera_alone(replace(demo(), imus=None), demo().skeleton)
    assert np.isnan(named(alone, "length of bones").value)
    assert np.isnan(named(alone, "perspective").value)
    motion = planted.human(SkeletonModel.default(), 40)
    recording = planted.recording(motion, sigma_px=3.0)
    unsure = check_camera_alone(recording, recording.skeleton, planted.PlantedLifter(motion))
    assert np.isnan(named(unsure, "exchanged sides").value)
    rotated = check_camera_alone(OF_CAMERA["upside down"].plant(demo()), demo().skeleton)
    assert np.isnan(named(rotated, "ankle").value)
    assert "upside down" in named(rotated, "ankle").advice


def test_image_in_which_the_lifter_sees_no_person_is_unknown() -> None:
    class Blind(planted.PlantedLifter):
        def predict(self, *_: object, **__: object) -> object:
            raise InvalidInputError("no person is visible")

    picture = ImageExcerpt.of(demo(), demo().skeleton, Blind(planted.human(SkeletonModel.default(), 40)))
    assert picture.lifted is None
    assert all(check.verdict is Verdict.NOT_POSSIBLE for check in picture.checks)


def test_wrong_samples_are_named_by_sensor_or_without_usual_cause_as_such() -> None:
    imus = demo().imus
    f = imus.f_sensor.copy()
    f[:, 2] *= -1
    one, unusual = (
        failed(reconstruct(with_imus(demo(), f_sensor=f), mode="lift"))[0] for f in (f, imus.f_sensor[..., [1, 2, 0]])
    )
    assert "sign flipped" in one.cause
    assert one.subject == imus.names[2]
    assert "do not belong together" in unusual.cause
    assert "axes" in unusual.advice


@pytest.mark.parametrize("seconds", [-2.0, -0.7, 1.3])
def test_clock_offset_beyond_the_range_of_calibration_is_estimated(seconds: float) -> None:
    imus = demo().imus
    clocks = named(reconstruct(with_imus(demo(), times=imus.times + seconds), mode="lift").checks, CLOCKS)
    assert clocks.value == pytest.approx(abs(seconds - 0.06), abs=0.05)  # the demo's video is late
    assert "start_s" in clocks.advice


def test_clock_offset_of_periodic_motion_is_unknown() -> None:
    k, imus = demo().video, demo().imus
    once = 45  # frames, repeated four times
    kept = np.searchsorted(imus.times, k.times[:once]).clip(0, len(imus) - 1)
    uv, confidence, R, f = (
        np.tile(v, (4, *[1] * (v.ndim - 1)))
        for v in (k.uv_px[:once], k.confidence[:once], imus.R_inertial_sensor[kept], imus.f_sensor[kept])
    )
    periodic = with_imus(demo(), times=k.times, R_inertial_sensor=R, f_sensor=f)
    periodic = replace(periodic, keypoints=replace(k, uv_px=uv, confidence=confidence))
    clocks = named(reconstruct(periodic, mode="lift").checks, CLOCKS)
    assert clocks.verdict is Verdict.NOT_POSSIBLE
    assert "repeats itself" in clocks.advice


# --- causes that are measured ----------------------------------------------------------------------


def references(axis: str, degrees: float, recording: Recording) -> Recording:
    """All references turned alike."""
    given = recording.calibration
    R = so3.about_axis(axis, np.radians(degrees)) @ given.R_world_inertial
    return replace(recording, calibration=replace(given, R_world_inertial=R))


def rolled(recording: Recording) -> Recording:
    """The camera turned by 10 deg about its line of sight."""
    camera = recording.video.camera
    R = so3.about_axis("z", np.radians(10.0)) @ camera.R_camera_world
    return with_camera(recording, replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world))


def frozen(recording: Recording) -> Recording:
    """The left shank's sensor repeats one sample with noise."""
    given, imus = recording.calibration, recording.imus
    s = imus.names.index(given.sensors[given.joints.index("LeftLeg")])
    R, f, noise = imus.R_inertial_sensor.copy(), imus.f_sensor.copy(), np.random.default_rng(0)
    R[:, s] = R[0, s] @ so3.exp(np.radians(0.5) * noise.standard_normal((len(imus), 3)))
    f[:, s] = f[0, s] + 0.05 * noise.standard_normal((len(imus), 3))
    return with_imus(recording, R_inertial_sensor=R, f_sensor=f)


def twisted(recording: Recording) -> Recording:
    """The left shank's sensor turned by 60 deg about the bone."""
    given, skeleton = recording.calibration, recording.skeleton
    s, R = given.joints.index("LeftLeg"), given.R_sensor_bone.copy()
    bone = so3.unit(skeleton.joint_offsets[skeleton.names.index("LeftFoot")])
    R[s] = R[s] @ so3.exp(np.radians(60.0) * bone)
    return replace(recording, calibration=replace(given, R_sensor_bone=R))


def faster(recording: Recording) -> Recording:
    """A video of half the frame rate that is declared."""
    video = recording.video
    return replace(recording, keypoints=replace(video, times=(video.times + video.times[0]) / 2))


def unseen(recording: Recording) -> Recording:
    """Nobody seen from 2 to 7 s."""
    video = recording.video
    gone = (video.times > video.times[0] + 2.0) & (video.times < video.times[0] + 7.0)
    uv = np.where(gone[:, None, None], np.nan, video.uv_px)
    return replace(
        recording, keypoints=replace(video, uv_px=uv, confidence=np.where(gone[:, None], 0.0, video.confidence))
    )


def ending(recording: Recording) -> Recording:
    return replace(recording, imus=recording.imus[: len(recording.imus) // 2])


@pytest.mark.parametrize(
    ("plant", "first"),
    [
        (partial(references, "x", 10.0), "the references of all sensors are tilted by about 10 deg"),
        (partial(references, "z", 30.0), "all sensors' headings are off by about"),
        (rolled, "the camera is probably turned by about 10 deg about its line of sight"),
        (frozen, "the sensor on LeftLeg is frozen"),
        (twisted, "the sensor on LeftLeg is turned by about"),
        (faster, "the video runs 2 times too fast"),
        (
            lambda r: replace(r, keypoints=exchanged_sides(r.video, only="legs")),
            "left and right of the legs' keypoints are exchanged",
        ),
        (unseen, "the person, 2."),
        (ending, "all sensors, 4."),
    ],
)
def test_first_line_names_the_cause(plant: Plant, first: str) -> None:
    mode = "rtof" if plant is twisted else "sf2"
    assert headline(audit(reconstruct(plant(demo(8.0)), mode=mode))).text.startswith(first)


def test_a_quarter_turn_of_the_sensors_world_is_the_only_finding() -> None:
    (check,) = failed(reconstruct(references("z", 90.0, demo(4.0)), mode="rtof"))
    assert check.cause.startswith("all sensors' headings are off by about 9")


def test_noise_of_orientations_does_not_make_bones_too_long() -> None:
    """Regression on noisy orientations is attenuated as by bones that are shorter than declared."""
    recording = demo(8.0)
    rng, T = np.random.default_rng(0), len(recording.imus)
    shake = np.cumsum(rng.standard_normal((T, len(recording.imus.names), 3)), axis=0)
    shake = np.radians(8.0) * (shake - shake.mean(axis=0)) / 6
    R = recording.imus.R_inertial_sensor @ so3.exp(shake)
    bone_imus = recording.calibration.apply(replace(recording.imus, R_inertial_sensor=R))
    assert not check_bones(bone_imus, recording.skeleton).failed


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


# --- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error, plant, message",
    [
        (ViewError, OF_CAMERA["camera's translation in mm"].plant, "millimetres.*: it diverged"),
        (SolverError, OF_SENSORS["accelerations negated"].plant, "sign flipped.*therefore it diverged"),
        (InvalidInputError, OF_SENSORS["accelerations negated"].plant, "sign flipped.*therefore it diverged"),
    ],
)
def test_errors_name_their_likely_cause_first(error: type[RtofError], plant: Plant, message: str) -> None:
    wrong = plant(demo())
    found = explained(error("it diverged"), wrong, wrong.skeleton, shipped_lifter())
    assert isinstance(found, error)
    assert re.search(message, str(found))
    assert explained(error("it diverged"), demo(), demo().skeleton, shipped_lifter()) is None


def test_errors_of_mode_imu_name_wrong_samples_first(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(*_: object) -> None:
        raise SolverError("it diverged")

    monkeypatch.setattr(pipeline, "reconstruct_from_sensors", diverge)
    with pytest.raises(SolverError, match="^all sensors are frozen.*it diverged"):
        reconstruct(replace(OF_SENSORS["all sensors frozen"].plant(demo(1.3)), keypoints=None), mode="imu")


# --- positions in world ----------------------------------------------------------------------------


@cache
def coarse() -> Recording:
    """Six seconds of the demo, at a third of its rate."""
    whole = Recording.load(model_path("demo"))
    return replace(whole, keypoints=whole.video[:360:3])


def focal(factor: float) -> Plant:
    """Plant a focal length that is wrong by a factor."""

    def plant(recording: Recording) -> Recording:
        camera = recording.video.camera
        return with_camera(
            recording, replace(camera, K=camera.K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])
        )

    return plant


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
def test_a_wrong_scale_that_nothing_shows_lies_inside_the_bands_in_world(plant: Plant) -> None:
    found = reconstruct(plant(coarse()))
    line = headline(audit(found)).line
    assert found.recording.truth is not None
    assert not line.startswith("pass:")
    assert bands(found.motion, found.recording.truth)["inside_world"] >= 0.9 or "fails" in line


def test_what_is_unverified_does_not_widen_positions_relative_to_the_root() -> None:
    known = replace(coarse().video.camera, accuracy=CameraUncertainty())
    sure, unsure = reconstruct(with_camera(coarse(), known)), reconstruct(coarse())
    relative, world = (
        [getattr(r.motion.confidence, f"{kind}_covariance") for r in (sure, unsure)]
        for kind in ("relative", "position")
    )
    np.testing.assert_array_equal(*relative)
    assert np.trace(world[0], axis1=2, axis2=3).max() < np.trace(world[1], axis1=2, axis2=3).min()
    verdict = headline(audit(unsure))
    assert verdict.room is Grade.WEAK
    assert "the focal length" in verdict.text


def test_displacements_are_those_of_another_camera() -> None:
    camera = Camera.looking_at([5.0, 1.0, 2.0], [0.0, 0.0, 0.9], 1200.0)
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (6, 3))
    d, step = displacements(camera, points), 1e-5
    depth = camera.to_camera(points) * [1.0, 1.0, 1.0 + step]
    longer = (depth - camera.t_camera_world) @ camera.R_camera_world
    np.testing.assert_allclose((points - longer) / step, d[..., FOCAL], atol=1e-4)
    R = so3.exp(np.array([step, 0.0, 0.0])) @ camera.R_camera_world  # the true one
    true = camera.to_camera(points) @ R + camera.center_world
    np.testing.assert_allclose((points - true) / step, d[..., PITCH], atol=1e-4)
