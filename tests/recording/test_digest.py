"""SHA-256 of a recording's numbers: the same of any form of the files, another one of any other number."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import CameraUncertainty
from rtof_kin.recording.reader import RecordingReader
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.session import Session
from rtof_kin.recording.streams import BLOCK

DEMO = Recording.load(model_path("demo"))


def demo() -> Recording:
    """The demo, whose sensors have more samples than a block of the reader, with a second camera."""
    assert DEMO.imus is not None
    imus = DEMO.imus
    twice = replace(
        imus,
        times=np.r_[imus.times, imus.times + imus.times[-1] - imus.times[0] + 1 / 60],
        R_inertial_sensor=np.concatenate([imus.R_inertial_sensor] * 2),
        f_sensor=np.concatenate([imus.f_sensor] * 2),
    )
    assert len(twice.times) > BLOCK
    return replace(DEMO, imus=twice, views=(DEMO.video[150:400:2],))


def test_digest_is_that_of_the_saved_and_of_the_streamed_recording(tmp_path: Path) -> None:
    recording = demo()
    recording.save(tmp_path / "saved")
    digest = recording.digest()
    assert Recording.load(tmp_path / "saved").digest() == digest
    with RecordingReader.open(tmp_path / "saved") as reader:
        assert reader.digest() == digest


def test_labels_and_the_form_of_files_do_not_matter(tmp_path: Path) -> None:
    recording = demo()
    labelled = replace(
        recording, name="other", notes="a", acknowledgement="b", session=Session(subject="c", date="2026-01-31")
    )
    labelled.save(tmp_path / "a")
    arrays = dict(np.load(tmp_path / "a" / "keypoints.npz"))
    np.savez(tmp_path / "a" / "keypoints.npz", **dict(reversed(arrays.items())))
    assert Recording.load(tmp_path / "a").digest() == recording.digest()


def _later(recording: Recording) -> dict[str, Any]:
    return {"keypoints": replace(recording.video, times=np.nextafter(recording.video.times, np.inf))}


def _other_sample(recording: Recording) -> dict[str, Any]:
    assert recording.imus is not None
    f = recording.imus.f_sensor.copy()
    f[-1, 0, 0] = np.nextafter(f[-1, 0, 0], np.inf)
    return {"imus": replace(recording.imus, f_sensor=f)}


@pytest.mark.parametrize(
    "change",
    [
        _later,
        _other_sample,
        lambda _: {"mass_kg": 70.0},
        lambda _: {"floor_height": 0.0},
        lambda _: {"views": ()},
        lambda _: {"truth": None},
        lambda r: {"calibration": replace(r.calibration, p_bone_sensor=r.calibration.p_bone_sensor + 1e-9)},
    ],
)
def test_any_other_number_gives_another_digest(change: Any) -> None:
    recording = demo()
    assert replace(recording, **change(recording)).digest() != recording.digest()


@pytest.mark.parametrize("degrees", [2.896076792883497, 3.2240400206284368, 5.0, 0.1, 7.3, 1 / 3])
def test_an_uncertain_camera_is_saved_exactly(tmp_path: Path, degrees: float) -> None:
    tilt = degrees * float(np.radians(1.0))  # as it is read
    camera = replace(DEMO.video.camera, uncertainty=CameraUncertainty(0.1, tilt, roll=tilt), heading_drift=tilt)
    recording = replace(DEMO, keypoints=replace(DEMO.video[:60], camera=camera), imus=None, calibration=None)
    recording.save(tmp_path / "a")
    after = Recording.load(tmp_path / "a")
    assert after.digest() == recording.digest()
    assert after.video.camera.uncertainty == camera.uncertainty
    assert after.video.camera.heading_drift == tilt
