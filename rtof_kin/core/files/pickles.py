"""Pickles of plain data (dictionaries, lists, text, numbers, NumPy arrays), read without executing anything.

Loading a pickle calls whatever functions it names. Here it may name those by which NumPy makes arrays, and functions of
this module stand in for them. Protocols 2 to 5 are read, including those of Python 2 and of NumPy before 2.0.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import LARGEST_BYTES, array_members, check_sizes, read_npy_header
from rtof_kin.core.files.text import check_file

_MODULES: Final = r"numpy|numpy\._?core\.(multiarray|numeric)|_codecs"
_OBJECTS: Final = b"".join(getattr(pickle, name) for name in ("EXT1", "EXT2", "EXT4", "NEWOBJ", "NEWOBJ_EX"))
"""Operations that make instances of classes, or that take functions from a registry without `find_class`."""


class _PlainUnpickler(pickle._Unpickler):  # the one written in Python: no index of its memo allocates memory
    """Unpickler that imports and calls nothing but its own functions."""

    def __init__(self, stream: io.BytesIO):
        super().__init__(stream, encoding="latin1")
        self.left = stream.getbuffer().nbytes  # bytes that all arrays may have, so that none is made many times

    def find_class(self, module: str, name: str) -> Any:
        """Return the function of its own that stands for one of NumPy's; any other name is an error."""
        own = {
            "_reconstruct": lambda *_: np.empty(0),
            "_frombuffer": lambda data, kind, shape, order: self._array(shape, kind, order == "F", b"".join([data])),
            "scalar": lambda kind, data: self._array((), kind, False, data).item(),
            "dtype": lambda code, *_: SimpleNamespace(code=code, order="|"),
            "ndarray": lambda *_: None,
            "encode": lambda text, _: text,  # of bytes, which stay text until they are an array's
        }
        if not re.fullmatch(_MODULES, module) or name not in own:
            problem = f"it wants to run {f'{module}.{name}'[:200]}. Do not trust this file; get it from its publisher"
            raise pickle.UnpicklingError(problem)
        return own[name]

    def load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]  # type: ignore[attr-defined]
        if type(target) is np.ndarray:
            target.__setstate__(self._state(*state[1:]))
        elif type(target) is SimpleNamespace and state[2:5] == (None, None, None):
            target.order = state[1]
        else:
            raise pickle.UnpicklingError("it sets the state of something else than an array of numbers")

    dispatch = {code: run for code, run in pickle._Unpickler.dispatch.items() if code not in _OBJECTS}
    dispatch[pickle.BUILD[0]] = load_build  # type: ignore[assignment]

    def _array(self, *state: Any) -> Any:
        array: Any = np.empty(0)
        array.__setstate__(self._state(*state))
        return array

    def _state(self, shape: Any, kind: Any, fortran: Any, data: Any) -> tuple[Any, ...]:
        """Return the state of an array once type, shape and data agree, and none of them can harm NumPy."""
        objects = kind.code in ("O", "O4", "O8")
        if not objects and not re.fullmatch(r"[<>|=]([fiu][1248]|b1)", kind.order + kind.code):
            raise pickle.UnpicklingError(f"an array of type {kind.order + kind.code!r}, not of numbers")
        dtype = np.dtype("O" if objects else kind.order + kind.code)
        data = data.encode("latin1") if type(data) is str else data
        size = math.prod(shape) * (1 if objects else dtype.itemsize)
        self.left -= size
        if not all(type(n) is int and n >= 0 for n in shape) or size != len(data) or self.left < 0:
            raise pickle.UnpicklingError(f"an array of shape {shape} and type {dtype} with {len(data)} bytes")
        if type(data) is not (list if objects else bytes):
            raise pickle.UnpicklingError("an array whose data are not bytes")
        return 1, shape, dtype, bool(fortran), data


def read_pickle(path: str | Path, limit: int = 2**26) -> Any:
    """Read a pickle of dictionaries, lists, text, numbers and arrays, of at most `limit` bytes; nothing is executed.
    `FileFormatError`: no such file, damaged, too large, or it names or holds anything else.
    """
    path = Path(path)
    check_file(path, "a pickle of plain data", limit)
    return _loaded(path, "its pickle", io.BytesIO(path.read_bytes()))


def read_object_npz(path: Path, names: tuple[str, ...], limit: int = LARGEST_BYTES) -> list[Any]:
    """Read members, of at most `limit` bytes in all, that NumPy saved as pickles of one object; nothing is executed.
    `FileFormatError`: no such file or member, damaged, too large, or a pickle that names anything else.
    """
    check_file(path, "an NPZ archive")
    try:
        with zipfile.ZipFile(path) as archive:
            there = array_members(path, archive)
            check_sizes(path, [there[name] for name in names if name in there], limit)
            if missing := [name for name in names if name not in there]:
                raise FileFormatError(path, f"no member {missing[0]!r}; there is {', '.join(there) or 'none'}")
            return [_loaded(path, name, io.BytesIO(archive.read(there[name])), boxed=True) for name in names]
    except FileFormatError:
        raise
    except Exception as error:  # zipfile and its decompressors raise many
        raise FileFormatError(path, f"damaged, or no NPZ archive ({error}); get it again") from error


def _loaded(path: Path, what: str, stream: io.BytesIO, boxed: bool = False) -> Any:
    """Return the object of a pickle, or of an .npy array of one object (`boxed`)."""
    try:
        if boxed and read_npy_header(stream)[::2] != ((), np.dtype(object)):
            raise pickle.UnpicklingError("not an array of one object")
        found = _PlainUnpickler(stream).load()
        if stream.read(1):
            raise pickle.UnpicklingError("data after the end of the pickle")
        return found.item() if boxed else found
    except Exception as error:  # whatever operations raise that NumPy never writes
        why = (
            str(error)[:300] if type(error) is pickle.UnpicklingError else f"{type(error).__name__}: {str(error)[:200]}"
        )
        raise FileFormatError(path, f"{what}: not opened, or damaged: {why}") from error
