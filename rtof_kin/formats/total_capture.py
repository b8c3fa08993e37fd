"""Text formats of Total Capture (Trumble et al., BMVC 2017), in the files' own units and frames.

Joint tables are in inches and x y z w, sensors at 60 Hz in w x y z and m/s^2, cameras in metres and the
dataset's y-up world. `rtof_kin.datasets.total_capture` converts them to this package's frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.text import LARGEST_NUMBER, numbers_of, read_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.readings import Readings, sensor_log

TITLE: Final = "Total Capture .sensors"
_RATE_HZ: Final = 60.0
_AGAIN: Final = "the download is probably incomplete; fetch and unpack the file again"


@dataclass(frozen=True)
class JointTable:
    """``gt_skel_gbl_pos.txt`` or ``gt_skel_gbl_ori.txt``."""

    names: tuple[str, ...]  #: J joint names, in the file's order
    values: Array  #: (T, J, 3) inches, or (T, J, 4) quaternions x y z w; world y up


@dataclass(frozen=True)
class SensorTable:
    """``*_Xsens.sensors`` or ``*_Xsens_AuxFields.sensors``."""

    names: tuple[str, ...]  #: S sensor names, in the order of the first frame
    quat_wxyz: Array  #: (T, S, 4) from the sensor to its inertial frame
    f_sensor: Array  #: (T, S, 3) specific force in sensor axes, gravity included, m/s^2


def read_joints(path: str | Path, width: int) -> JointTable:
    """Read names and then a line for each frame: 3 numbers per joint for positions, 4 for orientations;
    `FileFormatError`, which names the line: unreadable, cut off, or not such a table.
    """
    path = Path(path)
    header, *lines = _lines(path)
    names = tuple(header.split())
    if len(set(names)) != len(names) or any(map(_is_number, names)):
        raise FileFormatError(path, "does not begin with a line of different joint names", 1)
    if not lines:
        raise FileFormatError(path, f"holds names but no frame; {_AGAIN}", 1)
    rows = [line.split() for line in lines]
    if lines[0].endswith("\t") and rows[-1] and not lines[-1].endswith("\t"):
        rows[-1].pop()  # cut off in its last number
    T, J = len(rows), len(names)
    values = _numbers(path, rows, range(2, T + 2), J * width, f"numbers for {J} joints")
    return JointTable(names, values.reshape(T, J, width))


def read_sensors(path: str | Path) -> SensorTable:
    """Read orientation and specific force of all sensors; further columns (gyroscope, ...) are ignored.
    `FileFormatError`: unreadable, cut off, other frames than announced, or sensors that change.
    """
    path = Path(path)
    first, *lines = _lines(path)
    counts = first.split()
    if len(counts) != 2 or not all(map(_is_count, counts)):
        raise FileFormatError(path, "does not begin with the numbers of sensors and frames", 1)
    S, T = map(int, counts)
    rows = [line.split() for line in lines]
    if not S * T or len(rows) != T * (S + 1) or len(rows[-1]) < len(rows[1]):
        problem = f"announces {T} frames of {S} sensors and holds {len(rows) // (S + 1)} whole ones; {_AGAIN}"
        raise FileFormatError(path, problem, len(rows) + 1)
    heads = [row[0] if row else "" for row in rows]
    names = tuple(heads[1 : S + 1])
    if len(set(names)) < S:
        raise FileFormatError(path, "a sensor stands twice in a frame", 3)
    expected = [head for frame in range(1, T + 1) for head in (str(frame), *names)]
    for line, (head, found) in enumerate(zip(expected, heads, strict=True), 2):
        if head != found:
            raise FileFormatError(path, f"where {head!r} should stand is {found!r}", line)
    cells = [row[1:8] for i, row in enumerate(rows) if i % (S + 1)]
    places = [i + 2 for i in range(len(rows)) if i % (S + 1)]
    values = _numbers(path, cells, places, 7, "numbers after a sensor's name").reshape(T, S, 7)
    return SensorTable(names, values[..., :4], values[..., 4:])


def is_sensors(head: str) -> bool:
    """Implement `sensors.files.Format.recognise`."""
    rows = [line.split() for line in head.splitlines()[:3]]
    counts = [len(row) for row in rows]
    return len(rows) == 3 and counts[:2] == [2, 1] and counts[2] >= 8 and rows[1][0] == "1"


def read_sensor_log(path: Path, **declared: Any) -> SensorLog:
    """Implement `sensors.files.Format.read` for `read_sensors`; without the calibration of other files."""
    declaration = Declaration(rate_hz=_RATE_HZ).changed(**declared)
    table = read_sensors(path)
    times = np.arange(len(table.f_sensor)) / (declaration.rate_hz or _RATE_HZ)
    sensors = [
        Readings(name, times, table.f_sensor[:, s], quaternions=table.quat_wxyz[:, s])
        for s, name in enumerate(table.names)
    ]
    return sensor_log([path], TITLE, sensors, declaration)


def read_imu_calibration(path: str | Path) -> dict[str, Array]:
    """Read quaternions x y z w by sensor, from ``calib_imu_ref.txt`` or ``calib_imu_bone.txt``; `FileFormatError`:
    unreadable, cut off, or a quaternion that is not of unit norm.
    """
    path = Path(path)
    first, *lines = _lines(path)
    if not _is_count(first.strip()):
        raise FileFormatError(path, "does not begin with the number of sensors", 1)
    quaternions: dict[str, Array] = {}
    for number, cells in enumerate(map(str.split, lines), start=2):
        if not cells:
            continue
        values = _numbers(path, [cells[1:]], [number], 4, "numbers after a sensor's name")
        name, norm = cells[0], np.linalg.norm(values[0])
        if name in quaternions:
            raise FileFormatError(path, f"a second line for {name}; remove one", number)
        if not abs(norm - 1) < 0.01:
            raise FileFormatError(path, f"the quaternion of {name} has norm {norm:.3g}, not 1", number)
        quaternions[name] = values[0] / norm
    announced, found = int(first), len(quaternions)
    if found != announced:
        cut = f"; {_AGAIN}" if found < announced else ""
        raise FileFormatError(path, f"announces {announced} sensors and holds {found}{cut}")
    return quaternions


def read_cameras(path: str | Path) -> dict[int, Camera]:
    """Read cameras by number from 1, in the dataset's own world (y up, metres); `FileFormatError`: unreadable, cut off,
    or numbers that make no camera.
    """
    path = Path(path)
    cells = " ".join(_lines(path)).split()
    numbers = _numbers(path, [cells], [1], len(cells), "numbers")
    if len(cells) < 2 or not all(map(_is_count, cells[:2])):
        problem = "does not begin with the numbers of cameras and distortion terms"
        raise FileFormatError(path, problem, 1)
    count, order = int(cells[0]), int(cells[1])
    each = 4 + 4 + order + 9 + 3
    wanted = 2 + count * each
    if not (0 < count < 1000 and 0 <= order <= 3) or len(cells) != wanted:
        cut = f"; {_AGAIN}" if len(cells) < wanted else ""
        raise FileFormatError(
            path,
            f"announces {count} cameras with {order} distortion terms, which take {wanted} "
            f"numbers, and holds {len(cells)}{cut}",
        )
    rows = numbers[0, 2:].reshape(count, each)
    return {i: _camera(path, i, row, order) for i, row in enumerate(rows, 1)}


def _camera(path: Path, number: int, row: Array, order: int) -> Camera:
    """Make a camera of min_row max_row min_col max_col, fx fy cx cy, distortion, three rows of R, t."""
    fx, fy, cx, cy = row[4:8]
    distortion = np.zeros(5)
    distortion[[0, 1, 4][:order]] = row[8 : 8 + order]  # radial terms, in OpenCV's k1 k2 p1 p2 k3
    R, t = row[8 + order : 17 + order].reshape(3, 3), row[17 + order :]
    size = int(row[3] - row[2] + 1), int(row[1] - row[0] + 1)
    with reading(path, f"camera {number}: {{}}", ValueError):
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), R, t, *size, distortion=distortion)


# --- text ----------------------------------------------------------------------------------------


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file, at least one, without empty ones at the end."""
    lines = read_text(path, f"a table of Total Capture; {_AGAIN}").splitlines()
    while not lines[-1].strip():
        lines.pop()
    return lines


def _numbers(path: Path, rows: Sequence[Sequence[str]], lines: Sequence[int], columns: int, what: str) -> Array:
    """Return numbers (len(rows), columns); a row of another length, or a cell that is not finite, is an error."""
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        values = np.zeros(0)
    if values.shape == (len(rows), columns) and np.all(np.abs(values) <= LARGEST_NUMBER):
        return values
    parsed = [numbers_of(path, line, row, columns, f"{what} ({_AGAIN})") for line, row in zip(lines, rows, strict=True)]
    return np.array(parsed)


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _is_number(text: str) -> bool:
    try:
        return abs(float(text)) <= LARGEST_NUMBER
    except ValueError:
        return False
