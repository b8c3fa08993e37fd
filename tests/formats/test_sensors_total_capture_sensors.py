"""Total Capture's sensors as a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import truth, write_total_capture

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.total_capture_sensors import is_total_capture, read_total_capture_sensors


def test_the_dataset_has_60_frames_a_second_unless_declared_otherwise(tmp_path: Path) -> None:
    path = write_total_capture(tmp_path, [truth(1), truth(2)])
    log = read_total_capture_sensors(path)
    assert log.declaration.rate_hz == 60
    np.testing.assert_allclose(log.streams[1].times, np.arange(40) / 60)
    np.testing.assert_allclose(log.streams[1].f_sensor, truth(2).f, atol=1e-9)
    assert read_total_capture_sensors(path, rate_hz=30).streams[0].rate_hz == pytest.approx(30)


def test_damage_is_an_error(tmp_path: Path) -> None:
    path = write_total_capture(tmp_path, [truth(1), truth(2)])
    path.write_text(path.read_text()[:-400])
    with pytest.raises(FileFormatError, match="is cut off"):
        read_total_capture_sensors(path)


def test_a_table_of_other_numbers_is_not_recognised() -> None:
    assert is_total_capture("2\t40\n1\nHead 1 0 0 0 0 0 9.81\n")
    assert not is_total_capture("2\t40\n1\nHead 1 0 0\n")
    assert not is_total_capture("2\t40\n")
    assert not is_total_capture("")
