"""Dictionaries of arrays that NumPy saved in an .npz file, that is, as pickles.

Loading a pickle calls whatever functions it names. Here a pickle may name NumPy's array constructors
only, and even these are replaced by stand-ins that hold data: nothing of the file is executed. Pickles of
protocols 2 to 4 are read, including those of Python 2 and of NumPy before 2.0.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import LARGEST_BYTES, check_sizes, read_npy_header
from rtof_kin.core.files.text import check_file

LARGEST_STEPS: Final = 2_000_000
"""Maximum number of operations of a pickle; Human3.6M's archives have about 60,000."""
_DEEPEST: Final = 20
_CONSTRUCTORS: Final = {
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy": ("ndarray", "dtype"),
    "_codecs": ("encode",),
}
"""Names that a pickle may use, by module."""


def read_object_npz(path: str | Path, wanted: Sequence[str], limit: int = LARGEST_BYTES) -> dict[str, Any]:
    """Read members of an .npz file whose objects are plain data; nothing in the file is executed.

    Args:
        path: the archive. wanted: names of the members to read. limit: maximum sum of their sizes, bytes.

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
            there = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            check_sizes(path, [there[name] for name in wanted if name in there], limit)
            for name in wanted:
                if name not in there:
                    raise FileFormatError(path, f"no member {name!r}; there is {', '.join(there) or 'none'}")
                if there[name].compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise FileFormatError(path, f"{name}: compressed in a way that NumPy never uses")
            return {name: _read_member(path, name, archive.read(there[name])) for name in wanted}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, MemoryError) as error:
        raise FileFormatError(path, f"damaged, or no NPZ archive ({error}); get it again") from error


class _RefusedError(RtofError):
    """The pickle holds or does something that plain data do not need."""


def _read_member(path: Path, name: str, data: bytes) -> Any:
    stream = io.BytesIO(data)
    try:
        shape, fortran, dtype = read_npy_header(stream)
        if not dtype.hasobject:
            return _numbers(shape, dtype, fortran, stream.read())
        if dtype != np.dtype(object) or shape != ():
            raise _RefusedError(f"an array of objects of shape {shape}; expected a single object")
        return _Reader(stream.read()).content()
    except _RefusedError as error:
        raise FileFormatError(path, f"{name}: not opened: {error}") from error
    except (
        pickle.UnpicklingError, AttributeError, ValueError, LookupError, TypeError, OverflowError,
        SyntaxError, RecursionError,
    ) as error:  # fmt: skip
        why = f"{type(error).__name__}: {str(error)[:200]}"
        raise FileFormatError(path, f"{name}: damaged, or no array ({why}); get it again") from error


class _Name:
    """Stand-in for one of `_CONSTRUCTORS`, callable by the pickle."""

    __slots__ = ("name", "reader")

    def __init__(self, name: str, reader: _Reader) -> None:
        self.name, self.reader = name, reader

    def __call__(self, *args: Any) -> Any:
        if self.name == "_reconstruct" and isinstance(args[0], _Name) and args[0].name == "ndarray":
            return _Array()
        if self.name == "dtype" and type(args[0]) is str:
            return _Dtype(args[0])
        if self.name == "scalar" and isinstance(args[0], _Dtype):
            return _numbers((), args[0].numpy(), False, self.reader.encoded(args[1])).item()
        if self.name == "encode" and args[1:] in (("latin1",), ("latin-1",)):
            return self.reader.encoded(args[0])
        raise _RefusedError(f"it calls {self.name} in a way that NumPy does not")


class _Dtype:
    """Stand-in for a numeric NumPy type."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "|"

    def __setstate__(self, state: Any) -> None:
        if type(state[1]) is not str or any(part is not None for part in state[2:5]):
            raise _RefusedError("an array of records, not of numbers")
        self.order = state[1]

    def numpy(self) -> np.dtype[Any]:
        if not re.fullmatch(r"[fiu][1248]|b1", self.code) or self.order not in tuple("<>|="):
            raise _RefusedError(f"an array of type {self.order + self.code!r}, not of numbers")
        return np.dtype(self.order + self.code)


class _Array:
    """Stand-in for an array: its state is (version, shape, type, Fortran order, data)."""

    state: tuple[Any, ...] = ()

    def __setstate__(self, state: Any) -> None:
        if type(state) is not tuple or len(state) != 5 or not isinstance(state[2], _Dtype):
            raise _RefusedError("it sets the state of an array in a way that NumPy does not")
        self.state = state


class _Reader(pickle.Unpickler):
    """Unpickler of one object in an array of shape () that imports nothing."""

    def __init__(self, data: bytes) -> None:
        self.encodable = len(data)
        self.finished: dict[int, tuple[Any, Any]] = {}
        self.stream = io.BytesIO(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # for wrongly escaped texts
            for steps, (opcode, argument, _) in enumerate(pickletools.genops(data)):
                # The unpickler allocates a memo as long as its largest index.
                large_index = opcode.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > LARGEST_STEPS
                if steps > LARGEST_STEPS or large_index:
                    raise _RefusedError(f"a pickle of more than {LARGEST_STEPS} operations")
                if opcode.name in ("EXT1", "EXT2", "EXT4"):  # their cache bypasses find_class
                    raise _RefusedError(f"it wants number {argument} of the extension registry")
        super().__init__(self.stream, encoding="latin1")

    def find_class(self, module: str, name: str) -> _Name:
        """Return the stand-in of an allowed name; raise for any other."""
        if name not in _CONSTRUCTORS.get(module, ()):
            raise _RefusedError(
                f"it wants to run {f'{module}.{name}'[:200]}. Do not trust this file; get it from where it "
                "was published"
            )
        return _Name(name, self)

    def content(self) -> Any:
        """Load the one object of the array."""
        outer = self.load()
        if self.stream.read(1):
            raise _RefusedError("data after the end of the pickle")
        if not isinstance(outer, _Array):
            raise _RefusedError("the pickle is not that of an array")
        _, shape, dtype, _, items = outer.state
        if shape != () or dtype.code not in ("O", "O8", "O4") or type(items) is not list or len(items) != 1:
            raise _RefusedError("the pickle is not that of an array of one object")
        return self.plain(items[0], 0)

    def encoded(self, data: Any) -> bytes:
        """Return the bytes that pickles of Python 2 keep as text; the total is limited to the file's size."""
        if type(data) is bytes:
            return data
        if type(data) is not str:
            raise _RefusedError("an array whose data are not bytes")
        self.encodable -= len(data)
        if self.encodable < 0:
            raise _RefusedError("it repeats more text than the file holds")
        return data.encode("latin1")

    def plain(self, value: Any, depth: int) -> Any:
        """Replace stand-ins by arrays; each object is visited once."""
        if value is None or type(value) in (str, bool, int, float):
            return value
        if id(value) in self.finished:
            _, result = self.finished[id(value)]
            if result is self:
                raise _RefusedError("an object that contains itself")
            return result
        if depth > _DEEPEST:
            raise _RefusedError(f"lists or dictionaries nested more than {_DEEPEST} deep")
        self.finished[id(value)] = (value, self)
        result = self._plain_object(value, depth)
        self.finished[id(value)] = (value, result)
        return result

    def _plain_object(self, value: Any, depth: int) -> Any:
        if type(value) is dict:
            if not all(type(key) is str for key in value):
                raise _RefusedError("a dictionary with a key that is not text")
            return {key: self.plain(item, depth + 1) for key, item in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.plain(item, depth + 1) for item in value)
        if isinstance(value, _Array):
            _, shape, dtype, fortran, data = value.state
            return _numbers(shape, dtype.numpy(), bool(fortran), self.encoded(data))
        kind = f"numpy {value.name}" if isinstance(value, _Name) else type(value).__name__.strip("_")
        raise _RefusedError(f"{kind} among the data")


def _numbers(shape: Any, dtype: np.dtype[Any], fortran: bool, data: bytes) -> NDArray[Any]:
    """Return a read-only array of numbers in native byte order, once its size agrees with the data."""
    if dtype.kind not in "fiub":
        raise _RefusedError(f"an array of {dtype}, not of numbers")
    if not (isinstance(shape, tuple) and len(shape) <= 8 and all(type(n) is int for n in shape)):
        raise _RefusedError("an array whose shape is not a tuple of at most 8 integers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise _RefusedError(f"an array of shape {shape} and type {dtype} with {len(data)} bytes")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    if not dtype.isnative:
        array = array.astype(dtype.newbyteorder("="))
        array.flags.writeable = False
    return array
