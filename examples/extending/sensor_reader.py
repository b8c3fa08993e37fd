"""A reader of another maker's sensor files: ``python examples/extending/sensor_reader.py``.

The maker is invented. Its CSV has milliseconds, and for each sensor accelerations in g and rates in deg/s:

    # Acme Motion recorder, firmware 2.4
    ms;A17.ax;A17.ay;A17.az;A17.gx;A17.gy;A17.gz
    0;0.01;-0.02;1.00;0.1;0.0;-0.2
"""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.files import Format, add_format, read_sensor_log
from rtof_kin.formats.sensors.readings import Readings, lost, sensor_log
from rtof_kin.formats.sensors.sensor_text import read_table

# [reader]
TITLE = "Acme CSV"
COLUMN = re.compile(r"(?P<sensor>\w+)\.(?P<kind>[ag])(?P<axis>[xyz])")


def is_acme(head: str) -> bool:
    """Whether a file begins as Acme's do."""
    return head.startswith("# Acme Motion")


def read_acme(path: Path, **declared: Any) -> SensorLog:
    """Read all sensors of a trial; `declared` are the fields that the user sets."""
    declaration = Declaration(acceleration_unit="g", angular_unit="deg/s").changed(**declared)
    table = read_table(path, lambda names: "ms" in names, lambda name: name == "ms" or bool(COLUMN.match(name)))
    times = table.columns("ms")[:, 0] / 1000
    if not np.all(np.diff(times) > 0):
        raise FileFormatError(path, "the times in column ms do not increase; sort the lines")
    sensors = dict.fromkeys(found["sensor"] for name in table.names if (found := COLUMN.match(name)))
    readings = [
        Readings(
            name,
            times,
            acceleration=table.columns(*(f"{name}.a{axis}" for axis in "xyz")),
            gyroscope=table.columns(*(f"{name}.g{axis}" for axis in "xyz")),
        )
        for name in sensors
    ]
    return sensor_log([path], TITLE, readings, declaration, (*table.notes, *lost(times)))


ACME = Format(TITLE, "CSV that begins with '# Acme Motion'", is_acme, read_acme, file_is_trial=True)
# [end]


def write_sample(path: Path, seconds: float = 2.0) -> None:
    """Write two sensors that lie still, with noise."""
    rng, lines = np.random.default_rng(0), ["# Acme Motion recorder, firmware 2.4"]
    lines.append("ms;" + ";".join(f"{name}.{k}{axis}" for name in ("A17", "A18") for k in "ag" for axis in "xyz"))
    for ms in range(0, int(1000 * seconds), 10):
        at_rest = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], 2) + 0.01 * rng.normal(size=12)
        lines.append(f"{ms};" + ";".join(f"{value:.4f}" for value in at_rest))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """Add the format, write a file of it and read it."""
    add_format(ACME)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial.csv"
        write_sample(path)
        log = read_sensor_log(path)
    print(log.format, log.names, f"{log.streams[0].rate_hz:.0f} Hz")
    for stream in log.streams:
        force = np.linalg.norm(stream.f_sensor, axis=1).mean()
        print(f"{stream.name}: {force:.2f} m/s^2 at rest, gyroscope {stream.w_sensor.std():.4f} rad/s")


if __name__ == "__main__":
    main()
