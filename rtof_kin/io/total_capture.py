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

from rtof_kin.errors import FileFormatError
from rtof_kin.types import Camera

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
    if len(set(names)) != len(names) or any(_is_number(name) for name in names):
        raise FileFormatError(path, "does not begin with a line of joint names", 1)
    if not lines:
        raise FileFormatError(path, f"holds names but no frame; {_AGAIN}")
    columns = len(names) * width
    values = _numbers(path, lines, columns, 2, f"{len(names)} joints of {width} numbers")
    return JointTable(names, values.reshape(len(lines), len(names), width))


def read_sensors(path: str | Path) -> SensorTable:
    """Orientation and specific force of all sensors; further columns (gyroscope, ...) are left out.

    Raises:
        FileFormatError: unreadable, cut off, fewer frames than the file announces, sensors that change.
    """
    path = Path(path)
    lines = _lines(path)
    counts = lines[0].split()
    if len(counts) != 2 or not all(count.isdigit() for count in counts):
        raise FileFormatError(path, "does not begin with the numbers of sensors and frames", 1)
    S, T = map(int, counts)
    block = S + 1
    whole, rest = divmod(len(lines) - 1, block)
    if S == 0 or whole != T or rest:
        raise FileFormatError(
            path, f"announces {T} frames of {S} sensors and holds {whole} whole ones"
            + (f"; {_AGAIN}" if whole < T else ""), len(lines) if whole < T else None,
        )  # fmt: skip
    rows = [line.split() for line in lines[1:]]
    heads = [row[0] if row else "" for row in rows]
    names = tuple(heads[1:block])
    expected = [name for frame in range(1, T + 1) for name in (str(frame), *names)]
    if heads != expected:
        at = next(i for i, (a, b) in enumerate(zip(heads, expected, strict=True)) if a != b)
        raise FileFormatError(path, f"expected {expected[at]!r}, found {heads[at]!r}", at + 2)
    if len(set(names)) < S:
        raise FileFormatError(path, "a sensor stands twice in a frame", 3)
    cells = [row[1:8] for i, row in enumerate(rows) if i % block]
    try:
        values = np.array(cells, dtype=float).reshape(T, S, 7)
    except ValueError:
        values = np.full((T, S, 7), np.nan)
    if not np.isfinite(values).all():
        at = next(i for i, row in enumerate(rows) if i % block and not _are_numbers(row[1:8], 7))
        cut = f"; {_AGAIN}" if at > len(rows) - 3 else ""
        raise FileFormatError(
            path, f"expected a name and at least 7 numbers{_odd(rows[at][1:8])}{cut}", at + 2
        )
    return SensorTable(names, values[..., :4], values[..., 4:])


def read_imu_calibration(path: str | Path) -> dict[str, Array]:
    """Quaternion x y z w by sensor, from ``calib_imu_ref.txt`` or ``calib_imu_bone.txt``.

    Raises:
        FileFormatError: unreadable, cut off, or a quaternion that is not of unit norm.
    """
    path = Path(path)
    first, *lines = _lines(path)
    if not first.strip().isdigit():
        raise FileFormatError(path, "does not begin with the number of sensors", 1)
    quaternions: dict[str, Array] = {}
    filled = [(number, line.split()) for number, line in enumerate(lines, start=2) if line.strip()]
    for number, (name, *cells) in filled:
        if not _are_numbers(cells, 4) or len(cells) != 4:
            raise FileFormatError(
                path, f"expected a sensor's name and four numbers{_odd(cells)}", number
            )
        if name in quaternions:
            raise FileFormatError(path, f"a second line for {name}", number)
        quaternion = np.array(cells, dtype=float)
        if abs(np.linalg.norm(quaternion) - 1) > 0.01:
            raise FileFormatError(path, f"the quaternion of {name} is not of unit norm", number)
        quaternions[name] = quaternion / np.linalg.norm(quaternion)
    if len(quaternions) != int(first):
        cut = f"; {_AGAIN}" if len(quaternions) < int(first) else ""
        raise FileFormatError(
            path, f"announces {int(first)} sensors and holds {len(quaternions)}{cut}"
        )
    return quaternions


def read_cameras(path: str | Path) -> dict[int, Camera]:
    """Cameras by number from 1, in the dataset's own world (y up, metres).

    Raises:
        FileFormatError: unreadable, cut off, or numbers that make no camera.
    """
    path = Path(path)
    cells = " ".join(_lines(path)).split()
    if not all(_is_number(cell) for cell in cells):
        raise FileFormatError(path, f"holds something else than numbers{_odd(cells)}")
    if len(cells) < 2 or not all(cell.isdigit() for cell in cells[:2]):
        raise FileFormatError(
            path, "does not begin with the numbers of cameras and distortion terms", 1
        )
    count, order = int(cells[0]), int(cells[1])
    numbers = np.array(cells, dtype=float)
    each = 4 + 4 + order + 9 + 3
    if not (0 < count < 1000 and 0 <= order <= 3) or len(numbers) != 2 + count * each:
        raise FileFormatError(
            path, f"announces {count} cameras with {order} distortion terms, which take "
            f"{2 + count * each} numbers, and holds {len(numbers)}"
            + (f"; {_AGAIN}" if len(numbers) < 2 + count * each else ""),
        )  # fmt: skip
    return {i + 1: _camera(path, i + 1, row, order) for i, row in
            enumerate(numbers[2:].reshape(count, each))}  # fmt: skip


def _camera(path: Path, number: int, row: Array, order: int) -> Camera:
    """min_row max_row min_col max_col, fx fy cx cy, distortion, three rows of R, t."""
    fx, fy, cx, cy = row[4:8]
    distortion = np.zeros(5)
    distortion[[0, 1, 4][:order]] = row[8 : 8 + order]  # radial terms, in OpenCV's k1 k2 p1 p2 k3
    R, t = row[8 + order : 17 + order].reshape(3, 3), row[17 + order :]
    size = int(row[3] - row[2] + 1), int(row[1] - row[0] + 1)
    try:
        return Camera(
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), R, t, *size, distortion=distortion
        )
    except ValueError as error:
        raise FileFormatError(path, f"camera {number}: {error}") from error


# --- text ----------------------------------------------------------------------------------------


def _lines(path: Path) -> list[str]:
    """The lines of a text file, at least one, without empty ones at the end."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"not readable as text ({error}); {_AGAIN}") from error
    lines = text.rstrip().splitlines()
    if not lines:
        raise FileFormatError(path, f"is empty; {_AGAIN}")
    return lines


def _numbers(path: Path, lines: list[str], columns: int, first: int, what: str) -> Array:
    """Numbers (len(lines), columns); the first of the lines has the number `first`."""
    tokens = " ".join(lines).split()
    try:
        values = np.array(tokens, dtype=float)
        even = all(line.count("\t") == lines[0].count("\t") for line in lines)
        if even and len(values) == columns * len(lines) and np.isfinite(values).all():
            return values.reshape(len(lines), columns)
    except ValueError:
        pass
    for i, line in enumerate(lines):
        cells = line.split()
        if len(cells) != columns or not _are_numbers(cells, columns):
            cut = f"; {i} frames before it are whole. {_AGAIN}" if i == len(lines) - 1 else ""
            raise FileFormatError(
                path, f"expected {what}, found {len(cells)} cells{_odd(cells)}{cut}", first + i
            )
    return np.array(tokens, dtype=float).reshape(len(lines), columns)


def _are_numbers(cells: list[str], at_least: int) -> bool:
    return len(cells) >= at_least and all(_is_number(cell) for cell in cells[:at_least])


def _is_number(text: str) -> bool:
    """Whether a word is a finite number: nothing else occurs in sound files."""
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _odd(cells: list[str]) -> str:
    """What to say of the first of them that is no number, if there is one."""
    odd = next((cell for cell in cells if not _is_number(cell)), None)
    return "" if odd is None else f", among them {odd[:40]!r}"
