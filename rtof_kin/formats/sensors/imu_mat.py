"""MATLAB files (v5 to v7) with a struct for each sensor, as the ``qmt`` toolbox's recordings are.

A vector ``t`` (or ``time``), s, and for each sensor a struct of its name with some of the fields ``acc``
(T, 3) m/s^2 with gravity, ``gyr`` (T, 3) rad/s, ``mag`` (T, 3), all in sensor axes, and ``quat`` (T, 4),
w x y z, from the sensor to a reference with z up. Anything else in the file is left aside.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import io as scipy_io

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log

Array = NDArray[np.float64]
TITLE = "MATLAB structs"
LARGEST_BYTES = 2**30
"""Files that hold more than this, uncompressed, are refused."""
_FIELDS = {"acc": 3, "gyr": 3, "mag": 3, "quat": 4}
_TIMES = ("t", "time")
_HEADER_BYTES, _COMPRESSED, _PIECE = 128, 15, 2**16
_NEWER = "MATLAB 7.3"


def is_imu_mat(head: str) -> bool:
    """Whether a file that begins so is a MATLAB file."""
    return head.startswith(("MATLAB 5.0 MAT-file", _NEWER))


def read_imu_mat(path: Path, **declared: Any) -> SensorLog:
    """The sensors of one file.

    Args:
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` instead of
            the vector of times.

    Raises:
        FileFormatError: damaged, of MATLAB 7.3 (HDF5), too large, without times or without sensors.
    """
    declaration = Declaration().changed(**declared)
    variables = _variables(path)
    found: dict[str, dict[str, Array]] = {}
    for name, value in variables.items():
        fields = _sensor(path, name, value)
        if fields:
            found[name] = fields
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


def _variables(path: Path) -> dict[str, Any]:
    """Everything in the file, after counting how much that will be."""
    try:
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
        return dict(scipy_io.loadmat(str(path), struct_as_record=False, squeeze_me=False))
    except FileFormatError:
        raise
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except Exception as error:  # SciPy's reader raises whatever it stumbles over
        raise FileFormatError(path, f"damaged, or no MATLAB file ({error}); save it again") from error


def _sizes(stream: IO[bytes]) -> Iterator[int]:
    """Bytes of a file's elements, uncompressed, a piece at a time: a small file can hold gigabytes."""
    stream.seek(_HEADER_BYTES - 2)
    order: Literal["little", "big"] = "little" if stream.read(2) == b"IM" else "big"
    while len(tag := stream.read(8)) == 8:
        kind, size = (int.from_bytes(tag[i : i + 4], order) for i in (0, 4))
        end = stream.tell() + size
        if kind == _COMPRESSED:
            yield from _inflated_sizes(stream, end)
        else:
            yield size
        stream.seek(end)


def _inflated_sizes(stream: IO[bytes], end: int) -> Iterator[int]:
    inflate, data = zlib.decompressobj(), b""
    while not inflate.eof:
        data = inflate.unconsumed_tail or stream.read(min(_PIECE, end - stream.tell()))
        if not data:
            return
        yield len(inflate.decompress(data, _PIECE))


def _sensor(path: Path, name: str, value: Any) -> dict[str, Array]:
    """The fields of a struct that are a sensor's; none where it is something else."""
    if not (isinstance(value, np.ndarray) and value.dtype == object and value.size == 1):
        return {}
    struct = value.flat[0]
    fields = {}
    for field, width in _FIELDS.items():
        if field not in getattr(struct, "_fieldnames", ()):
            continue
        array = getattr(struct, field)
        if not (isinstance(array, np.ndarray) and array.dtype.kind in "fiu"):
            raise FileFormatError(path, f"{name}.{field} holds no numbers")
        if array.ndim != 2 or array.shape[1] != width:
            problem = f"{name}.{field} has shape {array.shape}, not (T, {width})"
            raise FileFormatError(path, problem)
        fields[field] = array.astype(np.float64)
    return fields


def _times(path: Path, variables: dict[str, Any], count: int, rate_hz: float | None) -> Array:
    if rate_hz is not None:
        return np.arange(count) / rate_hz
    given = next((variables[name] for name in _TIMES if name in variables), None)
    if not isinstance(given, np.ndarray) or given.dtype.kind not in "fiu":
        raise FileFormatError(path, f"no vector {' or '.join(_TIMES)}, s; add it, or declare rate_hz")
    if given.size != count:
        raise FileFormatError(path, f"{given.size} times for {count} samples")
    return given.astype(np.float64).ravel()
