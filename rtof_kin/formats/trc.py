"""Track row column files (.trc): markers over time, as OpenSim and Pose2Sim read and write them.

Cells are separated by tabs. After ``PathFileType`` come a line of keys and one of their values, a line with the name
of a marker in every third cell, a line ``X1 Y1 Z1 X2 ...``, perhaps an empty one, and a line for each frame: its
number, its time in s and three coordinates for each marker. A missing marker has three empty cells; their tabs stay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import LARGEST_NUMBER, read_text
from rtof_kin.formats.markers import MarkerBlocks, MarkerSequence
from rtof_kin.formats.world_axes import METRES, R_WORLD_GROUND, world_of_file

_KEYS: Final = (
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
)
_HEADER: Final = 5
"""Lines above the first frame."""


def read_trc(path: str | Path, *, up: str = "y") -> MarkerSequence:
    """Read markers into a world with z up, metres.

    Args:
        up: the file's axis that points up, see `rtof_kin.formats.world_axes.UP`; y in OpenSim's and Pose2Sim's files.
            "opensim" is y with the x axis kept, as in files that go with an .osim of this package (`R_WORLD_GROUND`).

    Raises:
        FileFormatError: no such file, incomplete or inconsistent; names the line. InvalidInputError: unknown `up`.
    """
    path, R_world_file = Path(path), _world_of_file(up)
    lines = read_text(path, "a TRC file, which begins with PathFileType").splitlines()
    frames, count, metres = _read_header(path, lines)
    names = _read_names(path, lines[3].split("\t"), count)
    rows = [(n, line) for n, line in enumerate(lines[_HEADER:], _HEADER + 1) if line.strip()]
    if len(rows) != frames:
        raise FileFormatError(
            path, f"NumFrames announces {frames} frames and {len(rows)} follow; is the file cut off?", len(lines)
        )
    table = np.array([_read_row(path, n, line, 2 + 3 * count) for n, line in rows])
    p_file = table[:, 1:].reshape(frames, count, 3) * metres
    try:
        return MarkerSequence(table[:, 0], names, p_file @ R_world_file.T)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _world_of_file(up: str) -> Array:
    return R_WORLD_GROUND if up == "opensim" else world_of_file(up)


def _read_header(path: Path, lines: Sequence[str]) -> tuple[int, int, float]:
    """Return numbers of frames and of markers, and metres per unit."""
    if not lines[0].startswith("PathFileType"):
        raise FileFormatError(path, f"expected PathFileType, found {lines[0][:40]!r}", 1)
    if len(lines) <= _HEADER:
        raise FileFormatError(path, "ends before the first frame", len(lines))
    keys, values = lines[1].split(), lines[2].split()
    if len(values) != len(keys):
        raise FileFormatError(path, f"{len(values)} values for the {len(keys)} keys above them", 3)
    header = dict(zip(keys, values, strict=True))
    missing = [key for key in ("NumFrames", "NumMarkers", "Units") if key not in header]
    if missing:
        raise FileFormatError(path, f"the key {missing[0]} is missing", 2)
    for key in ("NumFrames", "NumMarkers"):
        if not (header[key].isascii() and header[key].isdigit() and 0 < len(header[key]) < 10):
            raise FileFormatError(path, f"{key} is {header[key][:40]!r}, not a number of them", 3)
    unit = header["Units"].lower()
    if unit not in METRES:
        raise FileFormatError(path, f"Units {header['Units'][:40]!r}; known: {', '.join(METRES)}", 3)
    return int(header["NumFrames"]), int(header["NumMarkers"]), METRES[unit]


def _read_names(path: Path, cells: list[str], count: int) -> tuple[str, ...]:
    names = [cell.strip() for cell in cells[2::3]]
    while names and not names[-1]:
        names.pop()
    between = [cell for i, cell in enumerate(cells[2:]) if i % 3 and cell.strip()]
    if len(names) != count or not all(names) or between:
        found = f"found {len(names)}" + (f", and {between[0][:40]!r} between" if between else "")
        raise FileFormatError(path, f"expected Frame#, Time and {count} names, one in every third cell; {found}", 4)
    return tuple(names)


def _read_row(path: Path, line: int, text: str, wanted: int) -> list[float]:
    """Return time and coordinates of a frame, NaN where a cell is empty."""
    cells = text.split("\t")
    if len(cells) < wanted or any(cell.strip() for cell in cells[wanted:]):
        raise FileFormatError(
            path,
            f"{len(cells)} cells where there are {wanted} columns; a marker that was not seen has "
            "empty cells with their tabs",
            line,
        )
    try:
        values = [float(cell) if cell.strip() else np.nan for cell in cells[1:wanted]]
    except ValueError as error:
        raise FileFormatError(path, f"not a number: {error}", line) from error
    if any(abs(value) > LARGEST_NUMBER for value in values):
        raise FileFormatError(path, "a number is infinite; leave the cells of a gap empty", line)
    return values


def write_trc(
    path: str | Path, markers: MarkerSequence | MarkerBlocks, *, up: str = "y", unit: str = "m", overwrite: bool = False
) -> None:
    """Write markers, which `read_trc` reads back to 1e-9 units, and OpenSim too.

    Args:
        up: as for `read_trc`; y for OpenSim. unit: of lengths in the file, m, cm or mm.
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
        InvalidInputError: unknown axis or unit, or a name with a tab or a line end.
    """
    path, R_world_file = Path(path), _world_of_file(up)
    if unit not in METRES:
        raise InvalidInputError(f"unit: {unit!r}; give one of {', '.join(METRES)}")
    odd = [n for n in markers.names if not n.strip() or "\t" in n or len(n.splitlines()) > 1]
    if odd:
        raise InvalidInputError(f"marker name {odd[0]!r}: empty, or a tab or a line's end in it; rename it")
    markers = MarkerBlocks.of(markers)
    T, M, rate = len(markers), len(markers.names), f"{markers.rate_hz:.10g}"
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        list(_KEYS),
        [rate, rate, str(T), str(M), unit, rate, "1", str(T)],
        ["Frame#", "Time", *(cell for name in markers.names for cell in (name, "", "")), ""],
        ["", "", *(f"{axis}{i + 1}" for i in range(M) for axis in "XYZ"), ""],
    ]
    with new_file(path, overwrite) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines("\t".join(line) + "\n" for line in head)
        frames = enumerate(markers.times.tolist(), 1)
        for p_world in markers.blocks():
            p_file = (p_world @ R_world_file / METRES[unit]).reshape(len(p_world), 3 * M)
            for row, (number, time) in zip(p_file.tolist(), frames, strict=False):
                cells = ("" if math.isnan(value) else f"{value:.9f}" for value in row)
                # A tab ends the line as in OpenSim's files; without it OpenSim misses an empty last cell.
                stream.write("\t".join([str(number), repr(time), *cells, ""]) + "\n")
