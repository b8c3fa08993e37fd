"""Points in space over time, and their files: track row columns (``.trc``) and ``.c3d``.

In a ``.trc``, as OpenSim and Pose2Sim write them, cells are separated by tabs. After ``PathFileType`` come a line of
keys and one of their values, a line with the name of a marker in every third cell, a line ``X1 Y1 Z1 X2 ...``,
perhaps an empty one, and a line for each frame: its number, its time in s and three coordinates for each marker. A
missing marker has three empty cells; their tabs stay.

Of a ``.c3d`` points are read; analog channels (force plates, EMG) are not. A file has blocks of 512 bytes: a header,
parameters in groups, then the frames (user guide at c3d.org). The library c3d, in pure Python, parses header and
parameters. ezc3d, in C++, crashes the interpreter on damaged files, so it only writes: header and parameters, since it
needs all frames in memory. It reads at most 65,535 frames.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import c3d
import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, WritingError, reading
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import check_file, measurable, numbers_of, read_text
from rtof_kin.core.over_time import OverTime
from rtof_kin.core.packages import optional
from rtof_kin.formats.trial_results import TrialResults, add_parameters
from rtof_kin.formats.world_axes import METRES, R_WORLD_GROUND, world_of_file


@dataclass(frozen=True)
class MarkerSequence(OverTime):
    """Positions of markers, or of other named points, in world."""

    times: Array  #: (T,) seconds, strictly increasing
    names: tuple[str, ...]  #: M names
    p_world: Array  #: (T, M, 3) m; NaN as a whole where missing
    rows = ("p_world",)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("marker names", self.names))
        set_(self, "times", checked_times("marker times", self.times))
        shape = len(self.times), len(self.names), 3
        p = np.array(readonly("markers p_world", self.p_world, shape))
        if np.any(np.isinf(p)) or not measurable(p):
            raise InvalidInputError("markers p_world: infinite; write NaN where a marker was not seen")
        p[np.isnan(p).any(axis=-1)] = np.nan
        set_(self, "p_world", readonly("markers p_world", p, shape))

    def blocks(self) -> Iterator[Array]:
        """Yield the markers in one block; see `MarkerBlocks`."""
        yield self.p_world


@dataclass(frozen=True)
class MarkerBlocks:
    """Markers that may be longer than memory allows, for writers."""

    times: Array  #: (T,) seconds, strictly increasing
    names: tuple[str, ...]  #: M names
    blocks: Callable[[], Iterator[Array]]
    """Returns p_world (n, M, 3), m, of consecutive frames, T in all; NaN as a whole where missing."""


def rate_hz(times: Array) -> float:
    """Return frames per second, by the mean step of times (T,), s; 60 for a single frame."""
    return (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 else 60.0


_HEADER: Final = 5  #: Lines above the first frame


def read_trc(path: str | Path, *, up: str = "y") -> MarkerSequence:
    """Read markers into a world with z up, metres. `FileFormatError`: no such file, incomplete or inconsistent; names
    the line. `InvalidInputError`: unknown `up`.

    Args:
        up: the file's axis that points up, see `rtof_kin.formats.world_axes.UP`; y in OpenSim's and Pose2Sim's files.
            "opensim" is y with the x axis kept, as in files that go with an .osim of this package (`R_WORLD_GROUND`).
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
    cells, what = 1 + 3 * count, "cells of time and markers; one that was not seen has empty cells with their tabs"
    of = [(n, line.split("\t")[1:]) for n, line in rows]
    kept = [(n, row if any(map(str.strip, row[cells:])) else row[:cells]) for n, row in of]  # tabs may follow
    table = np.array([numbers_of(path, n, row, cells, what, gaps=True) for n, row in kept])
    p_file = table[:, 1:].reshape(frames, count, 3) * metres
    with reading(path):
        return MarkerSequence(table[:, 0], names, p_file @ R_world_file.T)


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
    """Return the names, usually one in every third cell; some files of OpenSim have a cell more."""
    names = [cell.strip() for cell in cells[2:] if cell.strip()]
    if len(names) != count:
        raise FileFormatError(path, f"expected Frame#, Time and {count} names; found {len(names)}", 4)
    return tuple(names)


def write_trc(
    path: str | Path, markers: MarkerSequence | MarkerBlocks, *, up: str = "y", unit: str = "m", overwrite: bool = False
) -> None:
    """Write markers, which `read_trc` reads back to 1e-9 units, and OpenSim too. `OutputExistsError`: the file exists
    and `overwrite` is False; `RtofError`: it cannot be written; `InvalidInputError`: unknown axis or unit, or a name
    with a tab or a line end.

    Args:
        up: as for `read_trc`; y for OpenSim. unit: of lengths in the file, m, cm or mm.
    """
    path, R_world_file = Path(path), _world_of_file(up)
    if unit not in METRES:
        raise InvalidInputError(f"unit: {unit!r}; give one of {', '.join(METRES)}")
    odd = [n for n in markers.names if not n.strip() or "\t" in n or len(n.splitlines()) > 1]
    if odd:
        raise InvalidInputError(f"marker name {odd[0]!r}: empty, or a tab or a line's end in it; rename it")
    T, M, rate = len(markers.times), len(markers.names), f"{rate_hz(markers.times):.10g}"
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        ["DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"],
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


LARGEST_BYTES: Final = 2**31  #: Largest file that is read, bytes
_BLOCK: Final = 512
_LARGEST_HEAD: Final = 510 * _BLOCK
"""The first block of parameters and their number of blocks are stored in one byte each."""
_PROCESSORS: Final = (b"\x54", b"\x55", b"\x56")  #: Intel, DEC (VAX) and MIPS (SGI)
_DERIVED: Final = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of POINT that list points which a model derived and which are no positions."""
_FRAMES_OF_16_BITS: Final = 0xFFFF


class _Reader(c3d.Reader):  # type: ignore[misc]
    """Header and parameters; unlike in its base they may disagree, as in files of some programs."""

    def _check_metadata(self) -> None:
        pass


def read_c3d(path: str | Path, *, up: str | None = None) -> MarkerSequence:
    """Read the points of a file into a world with z up, metres.

    A point with a negative residual is missing. Points without a label are named ``*1``, ``*2``, ... by their place;
    angles, forces, moments and powers that a model stored as points are left out. `FileFormatError`: no such file,
    damaged, cut off, without points, or without unit or vertical axis; `InvalidInputError`: unknown `up`.

    Args:
        up: the axis of the file that points up, see `rtof_kin.formats.world_axes.UP`; by default the one that the
            file declares vertical on a screen (POINT:Y_SCREEN).

    Returns:
        The points. Times count from the frame numbered 1, so a trimmed file does not begin at 0.
    """
    path = Path(path)
    data = _read_bytes(path)
    reader = _read_head(path, data)
    R_world_file = world_of_file(_up(path, reader) if up is None else up)
    unit = "".join(_texts(reader, "UNITS")[:1]).strip().lower()
    if unit not in METRES:
        raise FileFormatError(path, f"POINT:UNITS is {unit[:20]!r}; known: {', '.join(METRES)}")
    rate = _number(reader, "RATE", reader.header.frame_rate)
    if not 1e-3 < rate < 1e6:
        raise FileFormatError(path, f"POINT:RATE is {rate:g} frames per second")
    p_file = _points(path, data, reader)
    labels = _texts(reader, "LABELS")[: p_file.shape[1]]
    labels += [""] * (p_file.shape[1] - len(labels))
    derived = {name for group in _DERIVED for name in _texts(reader, group) if name}
    kept = [i for i, name in enumerate(labels) if name not in derived]
    if not kept:
        raise FileFormatError(path, "there is no point in it")
    times = (max(reader.header.first_frame, 1) - 1 + np.arange(len(p_file))) / rate
    names = tuple(labels[i] or f"*{i + 1}" for i in kept)
    with reading(path):
        return MarkerSequence(times, names, p_file[:, kept] @ R_world_file.T * METRES[unit])


def _read_bytes(path: Path) -> bytes:
    with reading(path, "cannot be read: {}", OSError):
        check_file(path, "a C3D file of moderate size", LARGEST_BYTES)
        data = path.read_bytes()
    if len(data) < 2 * _BLOCK or data[1] != 0x50 or data[0] == 0:
        raise FileFormatError(path, "not a C3D file, which has a header and parameters")
    at = (data[0] - 1) * _BLOCK + 3
    if data[at : at + 1] not in _PROCESSORS:
        raise FileFormatError(path, "its parameters are of no known processor; is it damaged?")
    return data


def _read_head(path: Path, data: bytes) -> Any:
    """Read header and parameters; anything that the library raises means damage."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader = _Reader(io.BytesIO(data[:_LARGEST_HEAD]))
        whole = [p for group in reader.group_values() for p in group.param_values()]
        cut = [p for p in whole if p.bytes_per_element not in (-1, 1, 2, 4) or len(p.bytes) != p.total_bytes]
    except Exception as error:
        raise FileFormatError(path, f"its parameters are cut off or damaged ({error!r:.80})") from error
    if cut:
        raise FileFormatError(path, f"its parameter {cut[0].name[:40]} is cut off or damaged")
    return reader


def read_c3d_events(path: str | Path) -> list[tuple[str, float]]:
    """Read the events of a file: context and label, such as 'Left Foot Strike', and s on the clock of `read_c3d`;
    `FileFormatError` where it is damaged.
    """
    path = Path(path)
    reader = _read_head(path, _read_bytes(path))
    contexts, labels = (_texts(reader, name, "EVENT") for name in ("CONTEXTS", "LABELS"))
    names = map(" ".join, zip(contexts, labels, strict=False))
    parts = [_floats(reader, p.bytes) for p in _continued(reader, "EVENT:TIMES") if p.bytes_per_element == 4]
    times = np.concatenate([*parts, np.zeros(0)])
    return list(zip(names, (times[: len(times) // 2 * 2].reshape(-1, 2) @ [60.0, 1.0]).tolist(), strict=False))


def _continued(reader: Any, name: str) -> Iterator[Any]:
    """Yield a parameter and its continuations: LABELS, LABELS2, LABELS3, ..."""
    number, parameter = 1, reader.get(name)
    while parameter is not None:
        yield parameter
        number += 1
        parameter = reader.get(f"{name}{number}")


def _texts(reader: Any, name: str, group: str = "POINT") -> list[str]:
    """Return the texts of a parameter and of its continuations."""
    texts: list[str] = []
    for parameter in _continued(reader, f"{group}:{name}"):
        if parameter.bytes_per_element == -1 and parameter.bytes:
            data, width = parameter.bytes, parameter.dimensions[0] if parameter.dimensions else 1
            pieces = (data[i : i + width] for i in range(0, len(data), width))
            texts += [piece.decode("latin-1").strip(" \0") for piece in pieces]
    return texts


def _number(reader: Any, name: str, default: float) -> float:
    """Return the first number of a parameter of POINT, integers as unsigned."""
    parameter = reader.get(f"POINT:{name}")
    if parameter is None or not parameter.bytes or parameter.bytes_per_element == -1:
        return float(default)
    if parameter.bytes_per_element == 4:
        return float(_floats(reader, parameter.bytes[:4])[0])
    return float(parameter.uint16_value if parameter.bytes_per_element == 2 else parameter.uint8_value)


def _up(path: Path, reader: Any) -> str:
    vertical = "".join(_texts(reader, "Y_SCREEN")[:1]).strip().lower().lstrip("+")
    if vertical not in ("x", "y", "z", "-x", "-y", "-z"):
        raise FileFormatError(path, "does not say which axis points up (POINT:Y_SCREEN); declare it, e.g. up='z'")
    return vertical


def _integers(reader: Any, data: bytes, kind: str = "i2") -> NDArray[np.int64]:
    return np.frombuffer(data, (">" if reader.proc_type == "MIPS" else "<") + kind).astype(np.int64)


def _floats(reader: Any, data: bytes) -> Array:
    with np.errstate(invalid="ignore"):  # signalling NaN
        if reader.proc_type != "DEC":
            order = ">" if reader.proc_type == "MIPS" else "<"
            return np.frombuffer(data, f"{order}f4").astype(np.float64)
        # A VAX number has its 16-bit halves swapped and an exponent that is larger by 2.
        halves = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1]
        return np.frombuffer(halves.tobytes(), "<f4").astype(np.float64) / 4


def _points(path: Path, data: bytes, reader: Any) -> Array:
    """Return the points (T, M, 3) in the file's axes and unit; NaN where missing."""
    header = reader.header
    points, scale = header.point_count, _number(reader, "SCALE", header.scale_factor)
    start = _number(reader, "DATA_START", 0) or header.data_block
    if points == 0 or start < 2 or not np.isfinite([scale, start]).all():
        raise FileFormatError(path, f"{points} points that begin in block {start:g}, scale {scale:g}")
    width = 4 if scale < 0 else 2
    frame_bytes = width * (4 * points + header.analog_count)
    frames_data = data[(int(start) - 1) * _BLOCK :]
    fitting = len(frames_data) // frame_bytes
    frames = _frames(reader, fitting)
    if not 0 < frames <= fitting:
        raise FileFormatError(path, f"announces {frames} frames and holds {fitting}; it is damaged or was cut off")
    table = np.frombuffer(frames_data, np.uint8, frames * frame_bytes).reshape(frames, frame_bytes)
    parse: Any = _floats if scale < 0 else _integers
    values = parse(reader, table[:, : 4 * width * points].tobytes()).reshape(frames, points, 4)
    p = values[..., :3] * (1.0 if scale < 0 else scale)
    return np.where((values[..., 3:] < 0) | ~np.isfinite(p), np.nan, p)


def _frames(reader: Any, fitting: int) -> int:
    """Return the number of frames, which the header's 16 bits cannot hold in long trials."""
    fields = [reader.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
    pairs = [_integers(reader, p.bytes, "u2") for p in fields if p and p.bytes_per_element == 2]
    if len(pairs) == 2 and all(len(pair) >= 2 for pair in pairs):
        first, last = (int(pair[0] + (pair[1] << 16)) for pair in pairs)
        return last - first + 1
    for name in ("LONG_FRAMES", "FRAMES"):
        number = _number(reader, name, 0)
        if number and np.isfinite(number):
            return fitting if number == _FRAMES_OF_16_BITS else int(number)
    return int(reader.header.last_frame - reader.header.first_frame + 1)


def write_c3d(
    path: str | Path,
    markers: MarkerSequence | MarkerBlocks,
    *,
    up: str = "z",
    results: TrialResults | None = None,
    zero_s: float = 0.0,
    overwrite: bool = False,
) -> None:
    """Write points in mm, which `read_c3d` reads back to the format's 32 bits, in blocks. `OutputExistsError`: the file
    exists and `overwrite` is False; `InvalidInputError`: unknown axis, or times that are not whole frames of one rate;
    `WritingError`: it cannot be written.

    Args:
        results: what the file has beside them. zero_s: time of the results at which the clock of `markers` shows 0.
    """
    ezc3d = optional("ezc3d", "", "writing C3D", "pip install ezc3d, or conda install -c conda-forge ezc3d")

    R_world_file, rate, count = world_of_file(up), rate_hz(markers.times), len(markers.times)
    first = round(float(markers.times[0]) * rate)
    if first < 0 or np.abs(markers.times * rate - first - np.arange(count)).max() > 1e-3:
        raise InvalidInputError(
            "marker times: C3D has a number for each frame and no times; resample to one rate, with "
            "times that are multiples of its step"
        )
    results = results or TrialResults()
    names, flat = (*markers.names, *results.flat), results.flat.values()
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["UNITS"]["value"], point["RATE"]["value"] = ["mm"], [rate]
    point["LABELS"]["value"] = list(names)
    vertical = up.upper() if up[0] == "-" else f"+{up.upper()}"
    add_parameters(file, "POINT", X_SCREEN=["+X" if up[-1] != "x" else "+Y"], Y_SCREEN=[vertical])
    ends = {"ACTUAL_START_FIELD": first + 1, "ACTUAL_END_FIELD": first + count}
    add_parameters(file, "TRIAL", **{end: [n & _FRAMES_OF_16_BITS, n >> 16] for end, n in ends.items()})
    file["data"]["points"] = np.ones((4, len(names), 1))
    results.add_to(file, zero_s)

    def blocks(at: int = 0) -> Iterator[Array]:
        for p_world in markers.blocks():
            beside = [values[at : at + len(p_world), None] for values in flat]
            yield np.concatenate([p_world @ R_world_file / METRES["mm"], *beside], axis=1)
            at += len(p_world)

    with new_file(path, overwrite) as whole:
        try:
            file.write(str(whole))
            _write_frames(whole, first, count, blocks())
        except (FileFormatError, RuntimeError) as error:
            raise WritingError(f"{path}: cannot be written whole ({error}); name another file") from error


def _write_frames(path: Path, first: int, count: int, blocks: Iterator[Array]) -> None:
    """Replace the one frame of a file that ezc3d wrote, which needs all of them in memory.

    blocks: (n, M, 3) of `count` frames from `first`; missing where all three are NaN, with residual -1.
    """
    head = bytearray(path.read_bytes())
    reader = _read_head(path, bytes(head))  # ezc3d reports no error where the disk is full
    start = (int(_number(reader, "DATA_START", 0)) - 1) * _BLOCK
    frames = re.search(rb"[\x06\xfa].FRAMES..\x02\x00", head[:start], re.DOTALL)
    if frames is None or len(head) <= start:
        raise FileFormatError(path, "ends before its frames")
    struct.pack_into("<H", head, frames.end(), min(count, _FRAMES_OF_16_BITS))
    struct.pack_into("<2H", head, 6, *(min(frame, _FRAMES_OF_16_BITS) for frame in (first + 1, first + count)))
    with path.open("wb") as stream:
        stream.write(head[:start])
        for p_file in blocks:
            seen = np.isfinite(p_file).any(axis=2, keepdims=True)
            values = np.concatenate([np.where(seen, p_file, 0.0), np.where(seen, 0.0, -1.0)], axis=2)
            stream.write(values.astype("<f4").tobytes())
        stream.write(bytes(-stream.tell() % _BLOCK))
