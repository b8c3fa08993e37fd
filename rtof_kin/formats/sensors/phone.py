"""CSV of a phone's gyroscope and accelerometer, by phyphox, Sensor Logger, or written by hand.

=====================  ==================================  ============================================
written by             times, s                            angular velocity rad/s; specific force m/s^2
=====================  ==================================  ============================================
hand                   ``time``                            ``wx``, ``wy``, ``wz``; ``fx``, ``fy``, ``fz``
phyphox                ``Time (s)``                        ``Gyroscope x (rad/s)``, ...;
                                                           ``Acceleration x (m/s^2)``, ...
Sensor Logger          ``seconds_elapsed``                 ``x``, ``y``, ``z`` of ``Gyroscope.csv``;
                                                           of ``TotalAcceleration.csv``
=====================  ==================================  ============================================

Axes are the phone's: x to the right of the screen, y up, z out of it. Files of one folder are one phone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import LONGEST_LINE, SensorTable, cells, read_table

_TITLE: Final = "CSV of a phone"
_TIMES: Final = ("time", "time (s)", "seconds_elapsed")
_GYROSCOPE, _FORCE = "gyroscope", "accelerometer"
_COLUMNS: Final = {
    _GYROSCOPE: (("wx", "wy", "wz"), tuple(f"gyroscope {axis} (rad/s)" for axis in "xyz")),
    _FORCE: (("fx", "fy", "fz"), tuple(f"acceleration {axis} (m/s^2)" for axis in "xyz")),
}
_BY_FILE: Final = {"gyroscope": _GYROSCOPE, "totalacceleration": _FORCE}
"""What columns x, y, z of a file of this name are."""
_LONGEST_GAP: Final = 0.1  # [s] that the accelerometer is interpolated over


def _known(names: Sequence[str]) -> bool:
    have = {name.strip('"').lower() for name in names}
    groups = [set(group) for kinds in _COLUMNS.values() for group in kinds]
    own = any(have >= group for group in groups) or have >= {"seconds_elapsed", "x", "y", "z"}
    return own and not have.isdisjoint(_TIMES)


def phone_files(path: Path) -> list[Path]:
    """Return the files of a phone at a path, which may be a folder; none where it is of something else."""
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    return [one for one in files if _known(cells(_first_line(one)))]


def _first_line(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline(LONGEST_LINE).decode("utf-8-sig", errors="replace")


def read_phone(paths: Sequence[Path]) -> SensorLog:
    """Read gyroscope and, where there is one, accelerometer of a phone as the sensor *phone*.

    Args:
        paths: of `phone_files`.

    Raises:
        FileFormatError: no gyroscope, or damaged.
    """
    found: dict[str, tuple[Array, Array]] = {}
    left: list[str] = []
    for path in paths:
        table = read_table(path, _known, lambda name: True)
        times = next(t for t in (table.column(name) for name in reversed(_TIMES)) if t is not None)
        own = {kind: values for kind in _COLUMNS if (values := _group(table, kind)) is not None}
        found |= {kind: (times, values) for kind, values in own.items()}
        left += [] if own else [path.name]
    if _GYROSCOPE not in found:
        raise FileFormatError(paths[0], f"has no gyroscope; log it too, {_COLUMNS[_GYROSCOPE][1][0]!r}")
    times, w = found[_GYROSCOPE]
    f = None
    if _FORCE in found:
        f = signals.interpolate(*found[_FORCE], times, _LONGEST_GAP)
    notes = (f"left aside: {', '.join(left)}",) if left else ()
    return sensor_log(paths, _TITLE, [Readings("phone", times, f, w)], Declaration(), (*notes, *lost(times)))


def _group(table: SensorTable, kind: str) -> Array | None:
    """Return the columns of a kind (T, 3); None where the file has none."""
    groups = [*_COLUMNS[kind]]
    if _BY_FILE.get(table.path.stem.lower()) == kind:
        groups.append(("x", "y", "z"))
    return next((values for group in groups if (values := table.columns(*group)) is not None), None)
