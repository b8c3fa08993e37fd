"""Physics of the first seconds, names and numbers of live streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from live_support import demo, frame_samples, imu_samples

from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.samples import FrameSample, ImuSample
from rtof_kin.live.stream_checks import FirstSeconds, number_faults


def imus(seconds: float) -> list[ImuSample]:
    return [sample for sample in imu_samples(seconds) if isinstance(sample, ImuSample)]


def checked(samples: list[ImuSample]) -> list[str]:
    """All sentences about samples that are checked as they come."""
    first, sentences = FirstSeconds(), list[str]()
    for sample in samples:
        first.add(Arrived("imus", sample, sample.time, sample.time))
        while (due := first.due()) is not None:
            sentences += due()
    return sentences


def at_rest(seconds: float = 5.0) -> list[ImuSample]:
    """One sensor that lies still on its side."""
    rng = np.random.default_rng(0)
    R = so3.exp(np.array([1.0, 0.3, 0.2]))
    return [
        ImuSample("a", float(t), R, -R.T @ GRAVITY_WORLD + rng.normal(0, 0.02, 3)) for t in np.arange(0, seconds, 0.01)
    ]


def test_sound_sensors_give_no_sentence() -> None:
    assert checked(imus(6.0)) == []
    assert checked(at_rest()) == []


def test_gravity_that_was_removed_is_told_with_the_declaration() -> None:
    removed = [replace(s, f_sensor=s.f_sensor + s.R_inertial_sensor.T @ GRAVITY_WORLD) for s in at_rest()]
    (sentence,) = checked(removed)
    assert "specific force" in sentence
    assert "gravity = removed" in sentence


@pytest.mark.parametrize("samples", [at_rest(), imus(5.0)])
def test_order_of_the_quaternion_is_told_once(samples: list[ImuSample]) -> None:
    def misread(R: np.ndarray) -> np.ndarray:
        return np.asarray(so3.from_quat_wxyz(so3.to_quat_wxyz(R)[[1, 2, 3, 0]]))

    wrong = [replace(s, R_inertial_sensor=misread(s.R_inertial_sensor)) for s in samples]
    sentences = [text for text in checked(wrong) if "direction of gravity" in text]
    assert len(sentences) == 1
    assert "quaternion_order = xyzw" in sentences[0]


def test_sensors_of_one_source_share_a_sentence() -> None:
    wrong = [replace(s, f_sensor=s.f_sensor / 9.80665) for s in imus(5.0)]
    (sentence,) = checked(wrong)
    for name in demo().calibration.sensors:
        assert name in sentence


def test_memory_of_the_first_seconds_is_given_back() -> None:
    first = FirstSeconds()
    for sample in imus(8.0):
        first.add(Arrived("imus", sample, sample.time, sample.time))
        while (due := first.due()) is not None:
            due()
    assert not first._first


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"R_inertial_sensor": np.diag([1.0, 1.0, -1.0])}, "mirrored"),
        ({"R_inertial_sensor": 1.1 * np.eye(3)}, "rotation"),
        ({"R_inertial_sensor": np.diag([1.0, 1.0, np.nan])}, "finite"),
        ({"f_sensor": np.array([0.0, np.inf, 0.0])}, "finite"),
    ],
)
def test_numbers_that_are_of_no_use(change: dict[str, np.ndarray], word: str) -> None:
    good = imus(0.1)[0]
    faults = number_faults([good, replace(good, **change), *frame_samples(0.1)])
    assert [bool(fault) for fault in faults[:2]] == [False, True]
    assert word in faults[1]
    assert not any(faults[2:])


def test_missing_numbers_are_no_fault() -> None:
    good = imus(0.1)[0]
    missing = replace(good, R_inertial_sensor=np.full((3, 3), np.nan), f_sensor=np.full(3, np.nan))
    assert number_faults([missing]) == [""]


def test_frames_of_other_numbers() -> None:
    frame = frame_samples(0.1)[0]
    assert isinstance(frame, FrameSample)
    assert "infinite" in number_faults([replace(frame, uv_px=frame.uv_px * np.inf)])[0]
    assert "confidence" in number_faults([replace(frame, confidence=frame.confidence + 2)])[0]
