"""One fault is planted in the demo at a time, and the first message of `reconstruct` names it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks import input_checks
from benchmarks.sensor_checks import FAULTS
from rtof_kin.calibration import clock_check as clock_evidence
from rtof_kin.core.errors import SolverError
from rtof_kin.core.plausibility import Verdict as Found
from rtof_kin.core.resources import model_path
from rtof_kin.inertial.recorded_form import FROZEN, GRAVITY
from rtof_kin.reconstruction import pipeline
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.sensor_checks import SETUP, naming_wrong_samples
from rtof_kin.recording.recording import Recording


@cache
def demo(seconds: float = 6.0) -> Recording:
    """The beginning of the demo."""
    whole = Recording.load(model_path("demo"))
    assert whole.imus is not None
    keypoints = whole.video[: round(60 * seconds)]
    kept = whole.imus.times <= keypoints.times[-1]
    imus = replace(
        whole.imus, times=whole.imus.times[kept], f_sensor=whole.imus.f_sensor[kept],
        R_inertial_sensor=whole.imus.R_inertial_sensor[kept],
    )  # fmt: skip
    return replace(whole, keypoints=keypoints, imus=imus, truth=None)


@contextmanager
def messages() -> Iterator[list[str]]:
    """What the pipeline warns of."""
    told: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            told.append(record.getMessage())

    listener = Listener()
    logging.getLogger(pipeline.DOUBTS).addHandler(listener)
    try:
        yield told
    finally:
        logging.getLogger(pipeline.DOUBTS).removeHandler(listener)


LIKE_ANOTHER = (
    "samples of left and right swapped", "samples of an arm and a thigh swapped", "forearms swapped",
    "upper arm and forearm swapped",
)  # fmt: skip
"""Left to the benchmark: what finds them is what finds others."""


def lifted(recording: Recording) -> Reconstruction:
    return reconstruct(recording, mode="lift")


@pytest.mark.parametrize("name", [name for name in FAULTS if name not in LIKE_ANOTHER])
def test_the_first_message_names_what_was_planted(name: str) -> None:
    with messages() as told:
        lifted(FAULTS[name].plant(demo()))
    assert FAULTS[name].named in told[0]


def test_nothing_is_wrong_with_the_demo_and_little_is_spent_to_tell() -> None:
    with messages() as told:
        found = lifted(demo())
    assert not told
    checks = {check.name: check for check in found.checks}
    for name in (FROZEN, GRAVITY, clock_evidence.NAME, SETUP):
        assert checks[name].verdict is Found.PASSED
    assert checks[SETUP].value == 0  # other setups were not even tried


@pytest.mark.parametrize("name", ["mirrored picture", "upside down", "turned by -90 degrees"])
def test_a_picture_that_is_turned_is_not_blamed_on_the_sensors(name: str) -> None:
    fault = input_checks.FAULTS[name]
    with messages() as told:
        lifted(fault.plant(demo()))
    assert fault.named in told[0]


def test_one_wrong_sensor_of_many_is_named() -> None:
    imus = demo().imus
    assert imus is not None
    f = imus.f_sensor.copy()
    f[:, 2] *= -1
    found = lifted(replace(demo(), imus=replace(imus, f_sensor=f)))
    (failed,) = [check for check in found.checks if check.failed]
    assert "sign flipped" in failed.cause
    assert failed.subject == imus.names[2]


def test_what_no_usual_mistake_explains_is_not_given_a_name() -> None:
    imus = demo().imus
    assert imus is not None
    found = lifted(replace(demo(), imus=replace(imus, f_sensor=imus.f_sensor[..., [1, 2, 0]])))
    (failed,) = [check for check in found.checks if check.failed]
    assert "do not belong together" in failed.cause
    assert "axes" in failed.advice


def test_sensors_alone_that_cannot_be_solved_are_checked_by_physics_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def diverge(*_: object) -> None:
        raise SolverError("it diverged")

    monkeypatch.setattr(pipeline, "reconstruct_from_sensors", diverge)
    frozen = replace(FAULTS["all sensors frozen"].plant(demo(1.3)), keypoints=None)
    with pytest.raises(SolverError, match="^all sensors are frozen.*therefore it diverged"):
        reconstruct(frozen, mode="imu")


def test_an_error_that_wrong_samples_lead_to_names_them_first() -> None:
    wrong = FAULTS["accelerations negated"].plant(demo())
    both = "sign flipped.*therefore it diverged"
    with pytest.raises(SolverError, match=both), naming_wrong_samples(wrong):
        raise SolverError("it diverged")
    with pytest.raises(SolverError, match="^it diverged"), naming_wrong_samples(demo()):
        raise SolverError("it diverged")


@pytest.mark.parametrize("seconds", [-2.0, -0.7, 1.3])
def test_the_offset_of_the_clocks_is_estimated_far_beyond_what_is_calibrated(seconds: float) -> None:
    imus = demo().imus
    assert imus is not None
    found = lifted(replace(demo(), imus=replace(imus, times=imus.times + seconds)))
    (clocks,) = [check for check in found.checks if check.name == clock_evidence.NAME]
    assert clocks.value == pytest.approx(abs(seconds - 0.06), abs=0.05)  # its video is late
    assert "start_s" in clocks.advice


def test_clocks_of_motion_that_repeats_itself_cannot_be_told() -> None:
    k, imus = demo().video, demo().imus
    assert imus is not None
    once = 90  # frames of a motion that is then repeated to the sample
    uv, confidence = (np.tile(v[:once], (4, *[1] * (v.ndim - 1))) for v in (k.uv_px, k.confidence))
    kept = np.searchsorted(imus.times, k.times[:once], side="left").clip(0, len(imus) - 1)
    R, f = (np.tile(v[kept], (4, *[1] * (v.ndim - 1))) for v in (imus.R_inertial_sensor, imus.f_sensor))
    again = replace(
        demo(), keypoints=replace(k, uv_px=uv, confidence=confidence),
        imus=replace(imus, times=k.times, R_inertial_sensor=R, f_sensor=f),
    )  # fmt: skip
    (clocks,) = [c for c in lifted(again).checks if c.name == clock_evidence.NAME]
    assert clocks.verdict is Found.NOT_POSSIBLE
    assert "repeats itself" in clocks.advice
