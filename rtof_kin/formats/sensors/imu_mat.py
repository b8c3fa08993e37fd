"""MATLAB files (v5 to v7) with a struct per sensor, as the recordings of the ``qmt`` toolbox.

A vector ``t`` (or ``time``), s, and for each sensor a struct of its name with some of the fields ``acc``
(T, 3) m/s^2 with gravity, ``gyr`` (T, 3) rad/s, ``mag`` (T, 3), all in sensor axes, and ``quat`` (T, 4),
w x y z, from the sensor to a reference with z up. Other content is ignored.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final, Literal

import numpy as np
from scipy import io as scipy_io

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.readings import Readings, lost, sensor_log

TITLE: Final = "MATLAB structs"
LARGEST_BYTES = 2**30  #: Largest uncompressed content that is read, bytes
_FIELDS: Final = {"acc": 3, "gyr": 3, "mag": 3, "quat": 4}
_HEADER_BYTES: Final = 128
_COMPRESSED: Final = 15
_PIECE: Final = 2**16
_NEWER: Final = "MATLAB 7.3"


def is_imu_mat(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return head.startswith(("MATLAB 5.0 MAT-file", _NEWER))


def read_imu_mat(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the vector of times."""
    declaration = Declaration().changed(**declared)
    variables = matlab_variables(path)
    found = {name: fields for name, value in variables.items() if (fields := _sensor(path, name, value))}
    if not found:
        raise FileFormatError(path, f"no struct in it has a field {', '.join(_FIELDS)}")
    lengths = {len(values) for fields in found.values() for values in fields.values()}
    if len(lengths) > 1:
        raise FileFormatError(path, f"its arrays have different lengths: {sorted(lengths)}")
    times = _times(path, variables, lengths.pop(), declaration.rate_hz)
    sensors = [
        Readings(name, times, fields.get("acc"), fields.get("gyr"), fields.get("mag"), fields.get("quat"))
        for name, fields in found.items()
    ]
    return sensor_log([path], TITLE, sensors, declaration, lost(times))


def matlab_variables(path: Path, simplify_cells: bool = False) -> dict[str, Any]:
    """Load all variables of a MATLAB file (v5 to v7) after summing their uncompressed sizes. Structs are
    `scipy.io.matlab.mat_struct` in arrays of objects, or simplified: dictionaries, and axes of one element are left
    out. Nothing in the file is executed. `FileFormatError`: no such file,
    of MATLAB 7.3, larger than `LARGEST_BYTES`, or damaged.
    """
    damaged = "damaged, or no MATLAB file ({}); save it again"
    # SciPy's reader raises errors of many types.
    with reading(path, damaged, Exception), reading(path, "there is no such file", FileNotFoundError):
        with path.open("rb") as stream:
            if stream.read(len(_NEWER)) == _NEWER.encode():
                problem = "is of MATLAB 7.3, which is not read; save it with the option '-v7'"
                raise FileFormatError(path, problem)
            total = 0
            for size in _sizes(stream):
                total += size
                if total > LARGEST_BYTES:
                    limit = f"{LARGEST_BYTES / 2**20:.0f} MiB"
                    raise FileFormatError(path, f"would fill more than {limit} of memory")
        return dict(
            scipy_io.loadmat(str(path), struct_as_record=False, squeeze_me=False, simplify_cells=simplify_cells)
        )


def _sizes(stream: IO[bytes]) -> Iterator[int]:
    """Yield uncompressed bytes of a file's elements, in pieces: a small file can hold gigabytes."""
    stream.seek(_HEADER_BYTES - 2)
    order: Literal["little", "big"] = "little" if stream.read(2) == b"IM" else "big"
    while len(tag := stream.read(8)) == 8:
        kind, size = (int.from_bytes(tag[i : i + 4], order) for i in (0, 4))
        end = stream.tell() + size
        if kind == _COMPRESSED:
            inflate = zlib.decompressobj()
            while not inflate.eof:
                data = inflate.unconsumed_tail or stream.read(min(_PIECE, end - stream.tell()))
                if not data:
                    break
                yield len(inflate.decompress(data, _PIECE))
        else:
            yield size
        stream.seek(end)


def _sensor(path: Path, name: str, value: Any) -> dict[str, Array]:
    """Return the fields of a sensor's struct; none of another variable."""
    if not (isinstance(value, np.ndarray) and value.dtype == object and value.size == 1):
        return {}
    struct, fields = value.flat[0], {}
    for field, width in _FIELDS.items():
        if field not in getattr(struct, "_fieldnames", ()):
            continue
        array = getattr(struct, field)
        if not (isinstance(array, np.ndarray) and array.dtype.kind in "fiu"):
            raise FileFormatError(path, f"{name}.{field} holds no numbers")
        if array.ndim != 2 or array.shape[1] != width:
            raise FileFormatError(path, f"{name}.{field} has shape {array.shape}, not (T, {width})")
        fields[field] = array.astype(np.float64)
    return fields


def _times(path: Path, variables: dict[str, Any], count: int, rate_hz: float | None) -> Array:
    if rate_hz is not None:
        return np.arange(count) / rate_hz
    given = variables.get("t", variables.get("time"))
    if not isinstance(given, np.ndarray) or given.dtype.kind not in "fiu":
        raise FileFormatError(path, "no vector t or time, s; add it, or declare rate_hz")
    if given.size != count:
        raise FileFormatError(path, f"{given.size} times for {count} samples")
    return given.astype(np.float64).ravel()
