"""The text formats of Total Capture (Trumble et al., BMVC 2017), as they stand in the files.

Nothing is converted here: joint tables are in inches and x y z w, sensors in w x y z and m/s^2, cameras
in metres and the dataset's y-up world. `rtof_kin.datasets.total_capture` brings all of it to this
package's frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import LARGEST_NUMBER, read_text
from rtof_kin.data.camera import Camera

Array = NDArray[np.float64]
_AGAIN = "the download is probably incomplete; fetch and unpack the file again"


@dataclass(frozen=True)
class JointTable:
    """``gt_skel_gbl_pos.txt`` or ``gt_skel_gbl_ori.txt``."""

    names: tuple[str, ...]
    """J joint names, in the file's order."""
    values: Array
    """(T, J, 3) inches, or (T, J, 4) quaternions x y z w; world y up."""


@dataclass(frozen=True)
class SensorTable:
    """``*_Xsens.sensors`` or ``*_Xsens_AuxFields.sensors``."""

    names: tuple[str, ...]
    """S sensor names, in the order of the first frame."""
    quat_wxyz: Array
    """(T, S, 4) from the sensor to its inertial frame."""
    f_sensor: Array
    """(T, S, 3) specific force in sensor axes, gravity included, m/s^2."""


def read_joints(path: str | Path, width: int) -> JointTable:
    """A table with a line of names and then a line for each frame.

    Args:
        width: numbers in a cell: 3 for positions, 4 for orientations.

    Raises:
        FileFormatError: unreadable, cut off, or not such a table; names the line.
    """
    path = Path(path)
    header, *lines = _lines(path)
    names = tuple(header.split())
    if len(set(names)) != len(names) or any(map(_is_number, names)):
        raise FileFormatError(path, "does not begin with a line of different joint names", 1)
    if not lines:
        raise FileFormatError(path, f"holds names but no frame; {_AGAIN}", 1)
    values = _table(path, [line.split() for line in lines], len(names), width)
    if lines[0].endswith("\t") and not lines[-1].endswith("\t"):
        raise FileFormatError(
            path, f"is cut off in the last number of this line; {len(lines) - 1} frames before it are "
            f"whole. {_AGAIN}", len(lines) + 1,
        )  # fmt: skip
    return JointTable(names, values.reshape(len(lines), len(names), width))


def read_sensors(path: str | Path) -> SensorTable:
    """Orientation and specific force of all sensors; further columns (gyroscope, ...) are left out.

    Raises:
        FileFormatError: unreadable, cut off, other frames than the file announces, sensors that change.
    """
    path = Path(path)
    first, *lines = _lines(path)
    counts = first.split()
    if len(counts) != 2 or not all(map(_is_count, counts)):
        raise FileFormatError(path, "does not begin with the numbers of sensors and frames", 1)
    S, T = map(int, counts)
    if S == 0 or T == 0:
        raise FileFormatError(path, f"announces {T} frames of {S} sensors", 1)
    rows = [line.split() for line in lines]
    names = _sensor_names(path, rows, S, T)
    readings = [row[1:8] for i, row in enumerate(rows) if i % (S + 1)]
    values = _numbers(readings, 7)
    if values is None:
        at = next(i for i, row in enumerate(rows) if i % (S + 1) and _numbers([row[1:8]], 7) is None)
        problem = f"expected a sensor's name and at least 7 numbers{_odd(rows[at][1:8])}"
        raise FileFormatError(path, problem, at + 2)
    values = values.reshape(T, S, 7)
    return SensorTable(names, values[..., :4], values[..., 4:])


def _sensor_names(path: Path, rows: list[list[str]], S: int, T: int) -> tuple[str, ...]:
    """The sensors, after checking that T whole frames follow each other, all of the same sensors."""
    announced = f"announces {T} frames of {S} sensors"
    heads = [row[0] if row else "" for row in rows]
    names = tuple(heads[1 : S + 1])
    if len(set(names)) < len(names):
        raise FileFormatError(path, "a sensor stands twice in a frame", 3)
    frames = len(rows) // (S + 1) + 1
    expected = [head for frame in range(1, frames + 1) for head in (str(frame), *names)]
    end = min(T * (S + 1), len(rows))
    at = next((i for i in range(end) if heads[i] != expected[i]), end)
    cut_there = at == len(rows) - 1 < T * (S + 1) - 1
    if at < end and not cut_there:
        raise FileFormatError(
            path, f"{announced}, and where {expected[at]!r} should stand is {heads[at]!r}", at + 2
        )
    whole = len(rows) // (S + 1)
    if len(rows) % (S + 1) == 0 and rows and len(rows[-1]) < max(8, len(rows[1])):
        whole -= 1
    if whole < T:
        raise FileFormatError(
            path, f"{announced} and is cut off here: it holds {whole} whole ones. {_AGAIN}",
            len(rows) + 1,
        )  # fmt: skip
    if len(rows) > T * (S + 1):
        raise FileFormatError(path, f"{announced} and holds {whole} whole ones", T * (S + 1) + 2)
    return names


def read_imu_calibration(path: str | Path) -> dict[str, Array]:
    """Quaternion x y z w by sensor, from ``calib_imu_ref.txt`` or ``calib_imu_bone.txt``.

    Raises:
        FileFormatError: unreadable, cut off, or a quaternion that is not of unit norm.
    """
    path = Path(path)
    first, *lines = _lines(path)
    if not _is_count(first.strip()):
        raise FileFormatError(path, "does not begin with the number of sensors", 1)
    quaternions: dict[str, Array] = {}
    for number, cells in enumerate(map(str.split, lines), start=2):
        if not cells:
            continue
        values = _numbers([cells[1:]], 4)
        if values is None:
            problem = f"expected a sensor's name and four numbers{_odd(cells[1:])}"
            raise FileFormatError(path, problem, number)
        name, norm = cells[0], np.linalg.norm(values[0])
        if name in quaternions:
            raise FileFormatError(path, f"a second line for {name}; remove one", number)
        if not abs(norm - 1) < 0.01:
            raise FileFormatError(path, f"the quaternion of {name} has norm {norm:.3g}, not 1", number)
        quaternions[name] = values[0] / norm
    if len(quaternions) != int(first):
        problem = f"announces {int(first)} sensors and holds {len(quaternions)}"
        raise FileFormatError(path, problem + _cut(len(quaternions) < int(first)))
    return quaternions


def read_cameras(path: str | Path) -> dict[int, Camera]:
    """Cameras by number from 1, in the dataset's own world (y up, metres).

    Raises:
        FileFormatError: unreadable, cut off, or numbers that make no camera.
    """
    path = Path(path)
    cells = " ".join(_lines(path)).split()
    numbers = _numbers([cells], len(cells))
    if numbers is None:
        raise FileFormatError(path, f"holds something else than numbers{_odd(cells)}")
    if len(cells) < 2 or not all(map(_is_count, cells[:2])):
        problem = "does not begin with the numbers of cameras and distortion terms"
        raise FileFormatError(path, problem, 1)
    count, order = int(cells[0]), int(cells[1])
    each = 4 + 4 + order + 9 + 3
    wanted = 2 + count * each
    if not (0 < count < 1000 and 0 <= order <= 3) or len(cells) != wanted:
        raise FileFormatError(
            path, f"announces {count} cameras with {order} distortion terms, which take {wanted} "
            f"numbers, and holds {len(cells)}{_cut(len(cells) < wanted)}",
        )  # fmt: skip
    return {i + 1: _camera(path, i + 1, row, order) for i, row in
            enumerate(numbers[0, 2:].reshape(count, each))}  # fmt: skip


def _camera(path: Path, number: int, row: Array, order: int) -> Camera:
    """min_row max_row min_col max_col, fx fy cx cy, distortion, three rows of R, t."""
    fx, fy, cx, cy = row[4:8]
    distortion = np.zeros(5)
    distortion[[0, 1, 4][:order]] = row[8 : 8 + order]  # radial terms, in OpenCV's k1 k2 p1 p2 k3
    R, t = row[8 + order : 17 + order].reshape(3, 3), row[17 + order :]
    size = int(row[3] - row[2] + 1), int(row[1] - row[0] + 1)
    try:
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), R, t, *size, distortion=distortion)
    except ValueError as error:
        raise FileFormatError(path, f"camera {number}: {error}") from error


# --- text ----------------------------------------------------------------------------------------


def _lines(path: Path) -> list[str]:
    """The lines of a text file, at least one, without empty ones at the end."""
    lines = read_text(path, f"a table of Total Capture; {_AGAIN}").splitlines()
    while not lines[-1].strip():
        lines.pop()
    return lines


def _table(path: Path, rows: list[list[str]], joints: int, width: int) -> Array:
    """Numbers (T, joints * width) of the rows, of which the first stands in line 2."""
    columns = joints * width
    values = _numbers(rows, columns)
    if values is not None:
        return values
    at = next(i for i, row in enumerate(rows) if _numbers([row], columns) is None)
    found = f"found {len(rows[at])} cells{_odd(rows[at])}"
    if at == len(rows) - 1:
        found += f": the file is cut off here; {at} frames before it are whole. {_AGAIN}"
    raise FileFormatError(path, f"expected {joints} joints of {width} numbers, {found}", at + 2)


def _numbers(rows: list[list[str]], columns: int) -> Array | None:
    """Numbers (len(rows), columns); None if a row has another length or a cell is no finite number."""
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        return None
    fits = values.shape == (len(rows), columns) and np.all(np.abs(values) <= LARGEST_NUMBER)
    return values if fits else None


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _is_number(text: str) -> bool:
    """Whether a word is a finite number: nothing else occurs in sound files."""
    try:
        return abs(float(text)) <= LARGEST_NUMBER
    except ValueError:
        return False


def _odd(cells: list[str]) -> str:
    """What to say of the first of them that is no number, if there is one."""
    odd = next((cell for cell in cells if not _is_number(cell)), None)
    return "" if odd is None else f", among them {odd[:40]!r}"


def _cut(off: bool) -> str:
    return f"; {_AGAIN}" if off else ""
