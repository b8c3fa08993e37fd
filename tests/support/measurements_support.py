"""Measurements as a file."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MeasurementsWriter


def write_measurements(path: str | Path, measurements: Measurements) -> None:
    with MeasurementsWriter(path) as writer:
        writer.append(measurements)
