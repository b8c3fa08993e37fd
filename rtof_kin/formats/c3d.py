"""C3D files: points over time; analog channels (force plates, EMG) are not read.

A file has blocks of 512 bytes: a header, parameters in groups, then the frames (user guide at c3d.org).
The library c3d, in pure Python, parses header and parameters. ezc3d, in C++, crashes the interpreter on
damaged files, so it only writes.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any, Final

import c3d
import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, WritingError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import check_file
from rtof_kin.core.packages import optional
from rtof_kin.formats.markers import MarkerBlocks, MarkerSequence
from rtof_kin.formats.world_axes import METRES, world_of_file

LARGEST_BYTES: Final = 2**31
"""Largest file that is read, bytes."""
_BLOCK: Final = 512
_LARGEST_HEAD: Final = 510 * _BLOCK
"""The first block of parameters and their number of blocks are stored in one byte each."""
_PROCESSORS: Final = (b"\x54", b"\x55", b"\x56")
"""Intel, DEC (VAX) and MIPS (SGI)."""
_DERIVED: Final = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of POINT that list points which a model derived and which are no positions."""
_FRAMES_OF_16_BITS: Final = 0xFFFF


class _Reader(c3d.Reader):  # type: ignore[misc]
    """Header and parameters; unlike in its base they may disagree, as in files of some programs."""

    def _check_metadata(self) -> None:
        pass


def read_c3d(path: str | Path, *, up: str | None = None) -> MarkerSequence:
    """Read the points of a file into a world with z up, metres.

    A point with a negative residual is missing. Points without a label are named ``*1``, ``*2``, ... by
    their place; angles, forces, moments and powers that a model stored as points are left out.

    Args:
        up: the axis of the file that points up, see `rtof_kin.formats.world_axes.UP`; by default the one that the
            file declares vertical on a screen (POINT:Y_SCREEN).

    Returns:
        The points. Times count from the frame numbered 1, so a trimmed file does not begin at 0.

    Raises:
        FileFormatError: no such file, damaged, cut off, without points, or without unit or vertical axis.
        InvalidInputError: unknown `up`.
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
    try:
        return MarkerSequence(times, names, p_file[:, kept] @ R_world_file.T * METRES[unit])
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _read_bytes(path: Path) -> bytes:
    try:
        check_file(path, "a C3D file of moderate size", LARGEST_BYTES)
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
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
        cut = [p for group in reader.group_values() for p in group.param_values() if _is_cut(p)]
    except Exception as error:
        raise FileFormatError(path, f"its parameters are cut off or damaged ({error!r:.80})") from error
    if cut:
        raise FileFormatError(path, f"its parameter {cut[0].name[:40]} is cut off or damaged")
    return reader


def _is_cut(parameter: Any) -> bool:
    return parameter.bytes_per_element not in (-1, 1, 2, 4) or len(parameter.bytes) != parameter.total_bytes


def _texts(reader: Any, name: str) -> list[str]:
    """Return the texts of a parameter of POINT and of its continuations: LABELS, LABELS2, LABELS3, ..."""
    texts: list[str] = []
    number, parameter = 1, reader.get(f"POINT:{name}")
    while parameter is not None:
        if parameter.bytes_per_element == -1 and parameter.bytes:
            data, width = parameter.bytes, parameter.dimensions[0] if parameter.dimensions else 1
            pieces = (data[i : i + width] for i in range(0, len(data), width))
            texts += [piece.decode("latin-1").strip(" \0") for piece in pieces]
        number += 1
        parameter = reader.get(f"POINT:{name}{number}")
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
    path: str | Path, markers: MarkerSequence | MarkerBlocks, *, up: str = "z", overwrite: bool = False
) -> None:
    """Write points in mm, which `read_c3d` reads back to the format's 32 bits.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False.
        InvalidInputError: unknown axis, or times that are not whole frames of one rate.
        WritingError: it cannot be written.
    """
    ezc3d = optional("ezc3d", "", "writing C3D", "pip install ezc3d, or conda install -c conda-forge ezc3d")

    R_world_file, markers = world_of_file(up), MarkerBlocks.of(markers)
    rate = markers.rate_hz
    first = round(float(markers.times[0]) * rate)
    if first < 0 or np.abs(markers.times * rate - first - np.arange(len(markers))).max() > 1e-3:
        raise InvalidInputError(
            "marker times: C3D has a number for each frame and no times; resample to one rate, with "
            "times that are multiples of its step"
        )
    p_file = np.concatenate(list(markers.blocks())) @ R_world_file / METRES["mm"]
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["UNITS"]["value"], point["RATE"]["value"] = ["mm"], [rate]
    point["LABELS"]["value"] = list(markers.names)
    file.add_parameter("POINT", "X_SCREEN", ["+X" if up[-1] != "x" else "+Y"])
    file.add_parameter("POINT", "Y_SCREEN", [up.upper() if up[0] == "-" else f"+{up.upper()}"])
    file["header"]["points"]["first_frame"] = first
    # ezc3d writes NaN with residual 0; a missing point has residual -1 in this format.
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
            read_c3d(whole)  # ezc3d reports no error where the disk is full
        except (FileFormatError, RuntimeError) as error:
            raise WritingError(f"{path}: cannot be written whole ({error}); name another file") from error
