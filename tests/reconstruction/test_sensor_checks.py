"""Checks of sensors and clocks: the first warning of `reconstruct` names the fault planted in the demo."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.planted.gross import OF_CAMERA
from benchmarks.planted.gross import OF_SENSORS as FAULTS
from rtof_kin.calibration.bone_images import NAME as CLOCKS
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import Verdict
from rtof_kin.core.errors import InvalidInputError, RtofError, SolverError
from rtof_kin.core.resources import model_path
from rtof_kin.inertial.outlier_rejection import FROZEN, GRAVITY
from rtof_kin.reconstruction import pipeline
from rtof_kin.reconstruction.checks import explained
from rtof_kin.reconstruction.checks.sensors import SETUP
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

BY_BENCHMARK = (
    "samples of left and right swapped",
    "samples of an arm and a thigh swapped",
    "forearms swapped",
    "upper arm and forearm swapped",
)
"""Faults found by the same code as others; the benchmark plants them."""


@cache
def demo(seconds: float = 6.0) -> Recording:
    """The beginning of the demo."""
    whole = Recording.load(model_path("demo"))
    assert whole.imus is not None
    keypoints = whole.video[: round(60 * seconds)]
    kept = whole.imus.times <= keypoints.times[-1]
    names = ("times", "R_inertial_sensor", "f_sensor")
    imus = replace(whole.imus, **{name: getattr(whole.imus, name)[kept] for name in names})
    return replace(whole, keypoints=keypoints, imus=imus, truth=None)


def lifted(recording: Recording) -> Reconstruction:
    return reconstruct(recording, mode="lift")


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == pipeline.WARNINGS_LOGGER]


ROTATED = ("mirrored picture", "upside down", "turned by -90 degrees")
"""Faults of the image, which sensors must not be blamed for."""
PLANTED = {name: fault for name, fault in FAULTS.items() if name not in BY_BENCHMARK} | {
    name: OF_CAMERA[name] for name in ROTATED
}


@pytest.mark.parametrize("name", PLANTED)
def test_first_warning_names_the_fault(name: str, caplog: pytest.LogCaptureFixture) -> None:
    lifted(PLANTED[name].plant(demo()))
    assert PLANTED[name].named in messages(caplog)[0]


def test_correct_recording_passes_without_diagnosis_of_its_setup(caplog: pytest.LogCaptureFixture) -> None:
    found = lifted(demo())
    assert not messages(caplog)
    checks = {check.name: check for check in found.checks}
    for name in (FROZEN, GRAVITY, CLOCKS, SETUP):
        assert checks[name].verdict is Verdict.PASSED
    assert checks[SETUP].value == 0  # no other setup was tried


def test_rotated_world_of_the_sensors_is_named() -> None:
    recording = demo(4.0)
    assert recording.calibration is not None
    R = so3.about_axis("z", np.pi / 2) @ recording.calibration.R_world_inertial
    turned = replace(recording, calibration=replace(recording.calibration, R_world_inertial=R))
    found = reconstruct(turned, calibrate=False, settings=ReconstructionSettings(confidence=False))
    (cause,) = [check.cause for check in found.checks if check.failed]
    assert cause.startswith("all sensors' headings are off by about 9")


def test_wrong_samples_are_named_by_sensor_or_without_usual_cause_as_such() -> None:
    imus = demo().imus
    assert imus is not None
    f = imus.f_sensor.copy()
    f[:, 2] *= -1
    one, unusual = (
        next(check for check in lifted(replace(demo(), imus=replace(imus, f_sensor=f))).checks if check.failed)
        for f in (f, imus.f_sensor[..., [1, 2, 0]])
    )
    assert "sign flipped" in one.cause
    assert one.subject == imus.names[2]
    assert "do not belong together" in unusual.cause
    assert "axes" in unusual.advice


def test_errors_of_mode_imu_name_wrong_samples_first(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(*_: object) -> None:
        raise SolverError("it diverged")

    monkeypatch.setattr(pipeline, "reconstruct_from_sensors", diverge)
    frozen = replace(FAULTS["all sensors frozen"].plant(demo(1.3)), keypoints=None)
    with pytest.raises(SolverError, match="^all sensors are frozen.*it diverged"):
        reconstruct(frozen, mode="imu")


@pytest.mark.parametrize("error", [SolverError, InvalidInputError])
def test_errors_name_wrong_samples_first(error: type[RtofError]) -> None:
    wrong = FAULTS["accelerations negated"].plant(demo())
    found = explained(error("it diverged"), wrong, wrong.skeleton, None)
    assert isinstance(found, error)
    assert re.search("sign flipped.*therefore it diverged", str(found))
    assert explained(error("it diverged"), demo(), demo().skeleton, None) is None


@pytest.mark.parametrize("seconds", [-2.0, -0.7, 1.3])
def test_clock_offset_beyond_the_range_of_calibration_is_estimated(seconds: float) -> None:
    imus = demo().imus
    assert imus is not None
    found = lifted(replace(demo(), imus=replace(imus, times=imus.times + seconds)))
    (clocks,) = [check for check in found.checks if check.name == CLOCKS]
    assert clocks.value == pytest.approx(abs(seconds - 0.06), abs=0.05)  # the demo's video is late
    assert "start_s" in clocks.advice


def test_clock_offset_of_periodic_motion_is_unknown() -> None:
    k, imus = demo().video, demo().imus
    assert imus is not None
    once = 90  # frames, repeated four times
    kept = np.searchsorted(imus.times, k.times[:once]).clip(0, len(imus) - 1)
    uv, confidence, R, f = (
        np.tile(v, (4, *[1] * (v.ndim - 1)))
        for v in (k.uv_px[:once], k.confidence[:once], imus.R_inertial_sensor[kept], imus.f_sensor[kept])
    )
    periodic = replace(
        demo(),
        keypoints=replace(k, uv_px=uv, confidence=confidence),
        imus=replace(imus, times=k.times, R_inertial_sensor=R, f_sensor=f),
    )
    (clocks,) = [check for check in lifted(periodic).checks if check.name == CLOCKS]
    assert clocks.verdict is Verdict.NOT_POSSIBLE
    assert "repeats itself" in clocks.advice
