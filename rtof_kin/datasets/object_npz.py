"""Dictionaries of arrays that NumPy saved in an .npz file, that is, as pickles.

Nothing of the file is executed; see `rtof_kin.core.files.pickles`.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.archive import array_members, check_sizes
from rtof_kin.core.files.arrays import LARGEST_BYTES, read_npy_header
from rtof_kin.core.files.pickles import PlainUnpickler, RefusedError, numbers_of, unpickled
from rtof_kin.core.files.text import check_file


def read_object_npz(path: str | Path, wanted: Sequence[str], limit: int = LARGEST_BYTES) -> dict[str, Any]:
    """Read members of an .npz file whose objects are plain data; nothing in the file is executed.

    Args:
        limit: maximum sum of their sizes, bytes.

    Returns:
        By name: a read-only numeric array, or (for a 0-d array of one object) an object made of dict with
        text keys, list, tuple, str, int, float, bool, None and read-only numeric arrays.

    Raises:
        FileFormatError: no such file or member, damaged, too large, or a pickle that names anything else.
    """
    path = Path(path)
    try:
        check_file(path, "an NPZ archive")
        with zipfile.ZipFile(path) as archive:
            there = array_members(path, archive)
            check_sizes(path, [there[name] for name in wanted if name in there], limit)
            for name in wanted:
                if name not in there:
                    raise FileFormatError(path, f"no member {name!r}; there is {', '.join(there) or 'none'}")
                if there[name].compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise FileFormatError(path, f"{name}: compressed in a way that NumPy never uses")
            return {name: _read_member(path, name, archive.read(there[name])) for name in wanted}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, MemoryError) as error:
        raise FileFormatError(path, f"damaged, or no NPZ archive ({error}); get it again") from error


def _read_member(path: Path, name: str, data: bytes) -> Any:
    def read() -> Any:
        stream = io.BytesIO(data)
        shape, fortran, dtype = read_npy_header(stream)
        if not dtype.hasobject:
            return numbers_of(shape, dtype, fortran, stream.read())
        if dtype != np.dtype(object) or shape != ():
            raise RefusedError(f"an array of objects of shape {shape}; expected a single object")
        return PlainUnpickler(stream.read()).content_of_array()

    return unpickled(path, name, read)
