"""`RenamedSensors`: a source whose sensors get the names that the calibration has for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self

from rtof_kin.core.errors import CalibrationError, UnknownNameError
from rtof_kin.formats.sensors.sensor_map import read_sensor_map, same_sensor
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.live.samples import Clock, ImuSample, Sample, Source
from rtof_kin.recording.recording import Recording


class RenamedSensors:
    """A source with other names of its sensors; those that a map does not name keep theirs.

    Args:
        names: in the calibration, by serial number, its last characters, or name.
    """

    def __init__(self, source: Source, names: Mapping[str, str]):
        self._source, self._names = source, dict(names)
        self._known: dict[str, str] = {}
        self.name = source.name
        """Of the source."""

    @classmethod
    def of_file(cls, source: Source, path: str | Path, setup: Recording) -> Self:
        """Rename by a map of sensors.

        Args:
            path: two columns, the stream's sensor, and its segment or its name in the calibration.

        Raises:
            FileFormatError: no such map. CalibrationError: the setup has no calibration.
            UnknownNameError: a segment without a sensor.
        """
        if setup.calibration is None:
            raise CalibrationError(f"map {path}: the setup {setup.name} has no sensors that it could name")
        sensors = setup.calibration.sensors
        worn = dict(zip(setup.calibration.joints, sensors, strict=True))
        names: dict[str, str] = {}
        for key, place in read_sensor_map(path).items():
            if place in sensors:
                names[key] = place
                continue
            joint = known_segment(place, setup.skeleton, path)
            if joint not in worn:
                where = f"segment in {path} (no sensor of the setup is on it)"
                raise UnknownNameError(where, [place], sensors)
            names[key] = worn[joint]
        return cls(source, names)

    @property
    def clock(self) -> Clock:
        """Clock of the time stamps."""
        return self._source.clock

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors seen so far, as in the calibration."""
        return tuple(map(self._renamed, self._source.sensors))

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points of a frame."""
        return self._source.landmarks

    @property
    def finished(self) -> bool:
        """Whether no further sample will come."""
        return self._source.finished

    def start(self) -> None:
        """Begin to collect.

        Raises:
            SourceError: as the source does.
        """
        self._source.start()

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, renamed."""
        return [
            replace(sample, sensor=self._renamed(sample.sensor)) if isinstance(sample, ImuSample) else sample
            for sample in self._source.poll()
        ]

    def notices(self) -> list[str]:
        """Return what the source says, with its own names."""
        return self._source.notices()

    def close(self) -> None:
        """Stop the source."""
        self._source.close()

    def _renamed(self, sensor: str) -> str:
        if sensor not in self._known:
            fits = (name for key, name in self._names.items() if same_sensor(key, sensor))
            self._known[sensor] = next(fits, sensor)
        return self._known[sensor]
