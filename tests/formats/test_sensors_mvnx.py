"""MVNX: files of MVN, versions without some tags, and hostile XML."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import mvnx_text, truth

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors import mvnx
from rtof_kin.formats.sensors.mvnx import read_mvnx

TRUTHS = [truth(1, T=6), truth(2, T=6)]


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "walk.mvnx"
    path.write_text(text, encoding="utf-8")
    return path


def frame(index: int, content: str, kind: str = "normal") -> str:
    return f'<frame time="{index * 17}" index="{index}" type="{kind}">{content}</frame>'


def orientations(count: int = 2) -> str:
    return f"<sensorOrientation>{'1 0 0 0 ' * count}</sensorOrientation>"


def test_sensors_and_calibration_poses(tmp_path: Path) -> None:
    log = read_mvnx(written(tmp_path, mvnx_text(TRUTHS)))
    assert log.names == ("00B40001", "00B40002")
    assert log.notes == ("calibration poses (tpose) are no samples",)
    assert (log.declaration.gravity, log.declaration.acceleration_axes) == ("removed", "inertial")
    np.testing.assert_allclose(log.streams[1].f_sensor, TRUTHS[1].f, atol=1e-9)
    np.testing.assert_allclose(log.streams[1].times, np.arange(6) / 60)


def test_raw_tags_of_old_versions_are_reported(tmp_path: Path) -> None:
    old = "<sensorAcceleration>1 2 3 4 5 6</sensorAcceleration>"
    log = read_mvnx(written(tmp_path, mvnx_text(TRUTHS, frame(0, orientations() + old))))
    assert log.notes == ("not read, as their axes differ between versions: sensorAcceleration",)


def test_missing_frames_are_a_gap(tmp_path: Path) -> None:
    frames = "".join(frame(i, orientations()) for i in (10, 11, 12, 15))
    stream = read_mvnx(written(tmp_path, mvnx_text(TRUTHS, frames)))
    np.testing.assert_allclose(stream.streams[0].times, np.array([10, 11, 12, 15]) / 60)
    assert stream.notes == ("2 packets (33.3%) lost in 1 gap, the longest of 0.03 s",)


ONE_FRAME = mvnx_text(TRUTHS, frame(0, orientations()))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE mvnx SYSTEM "http://x/y"><mvnx/>', "refused: DTDForbidden"),
        (mvnx_text(TRUTHS, frame(0, "")), "no frame has sensorOrientation or sensorFreeAcceleration"),
        (ONE_FRAME.replace('frameRate="60"', 'frameRate="0"'), "frameRate of <subject> is 0; it must be positive"),
        (ONE_FRAME.replace('"UTF-8"', '"wrong-8"'), "broken XML|cannot be read"),
    ],
)
def test_damaged_and_hostile_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_mvnx(path)
    assert str(path) in str(caught.value)


def test_too_large_and_missing_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mvnx, "LARGEST_BYTES", 100)
    with pytest.raises(FileFormatError, match="split it"):
        read_mvnx(written(tmp_path, ONE_FRAME))
    with pytest.raises(FileFormatError, match="no such file"):
        read_mvnx(tmp_path / "other.mvnx")
