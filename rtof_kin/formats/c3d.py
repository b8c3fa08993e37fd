"""C3D files: the points over time; what is analog (force plates, EMG, ...) is not read.

A file is blocks of 512 bytes: a header, parameters in groups, then the frames. The layout is that of the
C3D format's user guide (c3d.org). It is parsed here and not by a library: ezc3d's parser, in C++, crashes
the interpreter on damaged files. Writing, from arrays that are known to be sound, is left to ezc3d.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError, WritingError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import check_file
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.world_axes import METRES, world_of_file

Array = NDArray[np.float64]
LARGEST_BYTES = 2**31
"""Files of more bytes than this are refused."""
_BLOCK = 512
_LARGEST_SECTION = 255 * _BLOCK
"""One byte counts the blocks of parameters."""
_MAGIC = 0x50
_PROCESSORS = {84: "<", 85: "dec", 86: ">"}
"""Intel, DEC (VAX) and MIPS (SGI): the order of bytes in a number."""
_NO_POSITIONS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of POINT that list points which are none: what a model derived from them."""
_FRAMES_OF_16_BITS = 0xFFFF
Parameters = Mapping[tuple[str, str], "_Parameter"]
"""By names of group and parameter, in capitals."""


@dataclass(frozen=True)
class _Words:
    """How the numbers of a file are stored."""

    processor: str

    @property
    def order(self) -> str:
        return ">" if self.processor == ">" else "<"

    def integers(self, data: bytes) -> NDArray[np.int64]:
        return np.frombuffer(data, f"{self.order}i2").astype(np.int64)

    def floats(self, data: bytes) -> Array:
        if self.processor != "dec":
            return np.frombuffer(data, f"{self.order}f4").astype(np.float64)
        # A VAX number has its 16-bit halves the other way round, and an exponent that is larger by 2.
        halves = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].astype("<u2")
        return np.frombuffer(halves.tobytes(), "<f4").astype(np.float64) / 4


@dataclass(frozen=True)
class _Parameter:
    kind: int
    """-1 text, 1 bytes, 2 integers of 16 bits, 4 numbers of 32 bits."""
    dimensions: tuple[int, ...]
    data: bytes
    words: _Words

    def texts(self) -> list[str]:
        """Its texts, without the blanks at their ends."""
        if self.kind != -1 or not self.dimensions or not self.dimensions[0]:
            return []
        width = self.dimensions[0]
        pieces = (self.data[i : i + width] for i in range(0, len(self.data), width))
        return [piece.decode("latin-1").strip(" \0") for piece in pieces]

    def number(self) -> float | None:
        """Its first number; integers count as unsigned, as frames and points are."""
        if self.kind == 4 and len(self.data) >= 4:
            return float(self.words.floats(self.data[:4])[0])
        if self.kind == 2 and len(self.data) >= 2:
            return float(self.words.integers(self.data[:2])[0] & 0xFFFF)
        return float(self.data[0]) if self.kind == 1 and self.data else None


def read_c3d(path: str | Path, *, up: str | None = None) -> MarkerSequence:
    """Read the points of a file into a world with z up, metres.

    A point whose residual is negative was not seen. Points without a label are called ``*1``, ``*2``, ...
    by their place; angles, forces, moments and powers that a model stored as points are left out.

    Args:
        path: the file.
        up: the axis of the file that points up, see `rtof_kin.formats.world_axes.UP`; where not given, the
            one that the file says is vertical on a screen (POINT:Y_SCREEN).

    Returns:
        The points. Times count from the frame numbered 1, so a trimmed file does not begin at 0.

    Raises:
        FileFormatError: no such file, damaged, cut off, without points, or it says neither the unit nor
            which axis points up. ShapeError: `up` is no axis.
    """
    path = Path(path)
    data = _read_bytes(path)
    words, parameters = _read_parameters(path, data)
    R_world_file = world_of_file(_up(path, parameters) if up is None else up)
    rate, first = _rate(path, data, words, parameters), words.integers(data[6:8])[0] & 0xFFFF
    p_file = _points(path, data, words, parameters)
    names = _labels(parameters, p_file.shape[1])
    derived = {n for group in _NO_POSITIONS for n in _texts(parameters, "POINT", group) if n}
    kept = [i for i, name in enumerate(names) if name not in derived]
    if not kept:
        raise FileFormatError(path, "there is no point in it")
    p_world = p_file[:, kept] @ R_world_file.T * _metres(path, parameters)
    times = (max(int(first), 1) - 1 + np.arange(len(p_world))) / rate
    try:
        return MarkerSequence(times, tuple(names[i] for i in kept), p_world)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _read_bytes(path: Path) -> bytes:
    try:
        check_file(path, "a C3D file of moderate size", LARGEST_BYTES)
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    if len(data) < 2 * _BLOCK or data[1] != _MAGIC or data[0] == 0:
        raise FileFormatError(path, "not a C3D file, which has a header and parameters")
    return data


# --- parameters ----------------------------------------------------------------------------------


def _read_parameters(path: Path, data: bytes) -> tuple[_Words, Parameters]:
    start = (data[0] - 1) * _BLOCK
    section = data[start : start + _LARGEST_SECTION]
    if len(section) < 4 or section[3] not in _PROCESSORS:
        raise FileFormatError(path, "its parameters are of no known processor; is it damaged?")
    words = _Words(_PROCESSORS[section[3]])
    groups: dict[int, str] = {}
    found: dict[tuple[int, str], _Parameter] = {}
    try:
        at = 4
        while at and section[at]:
            at = _read_entry(section, at, words, groups, found)
    except (IndexError, struct.error) as error:
        raise FileFormatError(path, "its parameters are cut off or damaged; get it again") from error
    return words, {(groups.get(group, ""), name): p for (group, name), p in found.items()}


def _read_entry(
    section: bytes, at: int, words: _Words, groups: dict[int, str], found: dict[tuple[int, str], _Parameter]
) -> int:
    """Read a group or a parameter; returns where the next one begins, 0 after the last one."""
    length, group = struct.unpack_from("<bb", section, at)
    name_end = at + 2 + abs(length)
    name = section[at + 2 : name_end].decode("latin-1").strip(" \0").upper()
    (step,) = struct.unpack_from(f"{words.order}H", section, name_end)
    if group < 0:
        groups[-group] = name
    else:
        kind, axes = struct.unpack_from("<bB", section, name_end + 2)
        dimensions = tuple(section[name_end + 4 : name_end + 4 + axes])
        begin = name_end + 4 + axes
        end = begin + abs(kind) * math.prod(dimensions)
        if kind not in (-1, 1, 2, 4) or end > (name_end + step if step else len(section)):
            raise IndexError
        found[group, name] = _Parameter(kind, dimensions, section[begin:end], words)
    return name_end + step if step else 0


def _texts(parameters: Parameters, group: str, name: str) -> list[str]:
    """All texts of a parameter and of those that go on with it: LABELS, LABELS2, LABELS3, ..."""
    texts: list[str] = []
    going_on = name
    while (group, going_on) in parameters:
        texts += parameters[group, going_on].texts()
        going_on = f"{name}{2 if going_on == name else int(going_on.removeprefix(name)) + 1}"
    return texts


def _number(parameters: Parameters, group: str, name: str) -> float | None:
    parameter = parameters.get((group, name))
    return None if parameter is None else parameter.number()


def _up(path: Path, parameters: Parameters) -> str:
    vertical = "".join(_texts(parameters, "POINT", "Y_SCREEN")[:1]).strip().lower().lstrip("+")
    if vertical not in ("x", "y", "z", "-x", "-y", "-z"):
        raise FileFormatError(
            path, "does not say which axis points up (POINT:Y_SCREEN); declare it, e.g. up='z'"
        )
    return vertical


def _metres(path: Path, parameters: Parameters) -> float:
    unit = "".join(_texts(parameters, "POINT", "UNITS")[:1]).strip().lower()
    if unit not in METRES:
        raise FileFormatError(path, f"POINT:UNITS is {unit[:20]!r}; known: {', '.join(METRES)}")
    return METRES[unit]


def _rate(path: Path, data: bytes, words: _Words, parameters: Parameters) -> float:
    rate = _number(parameters, "POINT", "RATE")
    rate = float(words.floats(data[20:24])[0]) if rate is None else rate
    if not 1e-3 < rate < 1e6:
        raise FileFormatError(path, f"POINT:RATE is {rate:g} frames per second")
    return rate


def _labels(parameters: Parameters, points: int) -> list[str]:
    given = _texts(parameters, "POINT", "LABELS")[:points]
    given += [""] * (points - len(given))
    return [name or f"*{i}" for i, name in enumerate(given, 1)]


# --- frames --------------------------------------------------------------------------------------


def _points(path: Path, data: bytes, words: _Words, parameters: Parameters) -> Array:
    """Points (T, M, 3) in the file's axes and unit; NaN where one was not seen."""
    _, points, analog, first, last = (int(n) & 0xFFFF for n in words.integers(data[:10]))
    scale = _number(parameters, "POINT", "SCALE")
    scale = float(words.floats(data[12:16])[0]) if scale is None else scale
    start = _number(parameters, "POINT", "DATA_START")
    start = start or float(words.integers(data[16:18])[0])
    if points == 0 or start < 2 or not np.isfinite(scale):
        raise FileFormatError(path, f"{points} points that begin in block {start:g}, scale {scale:g}")
    width = 4 if scale < 0 else 2
    frame_bytes = width * (4 * points + analog)
    frames_data = data[(int(start) - 1) * _BLOCK :]
    frames = _frames(parameters, last - first + 1, len(frames_data) // frame_bytes)
    if not 0 < frames <= len(frames_data) // frame_bytes:
        raise FileFormatError(
            path, f"announces {frames} frames and holds {len(frames_data) // frame_bytes}; it is "
            "damaged or was cut off"
        )  # fmt: skip
    parse: Callable[[bytes], Any] = words.floats if scale < 0 else words.integers
    table = np.frombuffer(frames_data, np.uint8, frames * frame_bytes).reshape(frames, frame_bytes)
    values = parse(table[:, : 4 * width * points].tobytes()).reshape(frames, points, 4)
    p = values[..., :3] * (1.0 if scale < 0 else scale)
    # Infinities too: where a coordinate is none, its point was not seen.
    return np.where((values[..., 3:] < 0) | ~np.isfinite(p), np.nan, p)


def _frames(parameters: Parameters, by_header: int, fitting: int) -> int:
    """Number of frames, which the header's 16 bits cannot hold in long trials."""
    fields = [parameters.get(("TRIAL", f"ACTUAL_{end}_FIELD")) for end in ("START", "END")]
    pairs = [p.words.integers(p.data) & 0xFFFF for p in fields if p and p.kind == 2]
    if len(pairs) == 2 and all(len(pair) >= 2 for pair in pairs):
        first, last = (int(pair[0] + (pair[1] << 16)) for pair in pairs)
        return last - first + 1
    for name in ("LONG_FRAMES", "FRAMES"):
        number = _number(parameters, "POINT", name)
        if number and np.isfinite(number):
            return fitting if number == _FRAMES_OF_16_BITS else int(number)
    return by_header


# --- writing -------------------------------------------------------------------------------------


def write_c3d(path: str | Path, markers: MarkerSequence, *, up: str = "z", overwrite: bool = False) -> None:
    """Write points in mm, which `read_c3d` reads back to the format's 32 bits.

    Args:
        up: the axis that shall point up in the file.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for.
        ShapeError: no such axis, or times that are not whole frames of one rate.
        WritingError: it cannot be written.
    """
    import ezc3d  # only who writes waits for it

    R_world_file = world_of_file(up)
    rate = markers.rate_hz
    first = round(float(markers.times[0]) * rate)
    if first < 0 or np.abs(markers.times * rate - first - np.arange(len(markers))).max() > 1e-3:
        raise ShapeError(
            "marker times: C3D has a number for each frame and no times; resample to one rate, with "
            "times that are multiples of its step"
        )
    p_file = markers.p_world @ R_world_file / METRES["mm"]
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["UNITS"]["value"], point["RATE"]["value"] = ["mm"], [rate]
    point["LABELS"]["value"] = list(markers.names)
    file.add_parameter("POINT", "X_SCREEN", ["+X" if up[-1] != "x" else "+Y"])
    file.add_parameter("POINT", "Y_SCREEN", [up.upper() if up[0] == "-" else f"+{up.upper()}"])
    file["header"]["points"]["first_frame"] = first
    # ezc3d would write NaN with residual 0; the format's sign for a point not seen is residual -1.
    points = p_file.transpose(2, 1, 0)
    seen = np.isfinite(points[:1])
    file["data"]["points"] = np.concatenate([np.where(seen, points, 0.0), np.ones_like(seen)])
    file["data"]["meta_points"] = {
        "residuals": np.where(seen, 0.0, -1.0),
        "camera_masks": np.zeros((7, *seen.shape[1:]), dtype=bool),
    }
    with new_file(path, overwrite) as whole:
        try:
            file.write(str(whole))
            read_c3d(whole)  # ezc3d says nothing where the disk is full
        except (FileFormatError, RuntimeError) as error:
            raise WritingError(f"{path}: cannot be written whole ({error}); name another file") from error
