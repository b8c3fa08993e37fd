"""Pickles of plain data (dictionaries, lists, text, numbers, NumPy arrays), read without executing anything.

Loading a pickle calls whatever functions it names. Here a pickle may name NumPy's array constructors
only, and even these are replaced by stand-ins that hold data: nothing of the file is executed. Pickles of
protocols 2 to 5 are read, including those of Python 2 and of NumPy before 2.0.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.text import check_file

LARGEST_STEPS: Final = 2_000_000
"""Maximum number of operations of a pickle; Human3.6M's archives have about 60,000."""
_DEEPEST: Final = 20
_CONSTRUCTORS: Final = {
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy.core.numeric": ("_frombuffer",),
    "numpy._core.numeric": ("_frombuffer",),
    "numpy": ("ndarray", "dtype"),
    "_codecs": ("encode",),
}
"""Names that a pickle may use, by module."""


def read_pickle(path: str | Path, limit: int = 2**26) -> Any:
    """Read a pickle of plain data; nothing in the file is executed.

    Args:
        limit: largest size, bytes.

    Returns:
        An object made of dict with text keys, list, tuple, str, int, float, bool, None and read-only numeric arrays.

    Raises:
        FileFormatError: no such file, damaged, too large, or it names or holds anything else.
    """
    path = Path(path)
    try:
        check_file(path, "a pickle of plain data", limit)
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    return unpickled(path, "its pickle", lambda: PlainUnpickler(data).content())


def unpickled(path: Path, what: str, read: Callable[[], Any]) -> Any:
    """Return what a function reads; raise `FileFormatError` where a pickle is damaged or refused.

    Args:
        read: uses a `PlainUnpickler`.
    """
    try:
        return read()
    except RefusedError as error:
        raise FileFormatError(path, f"{what}: not opened: {error}") from error
    except (
        pickle.UnpicklingError,
        AttributeError,
        ValueError,
        LookupError,
        TypeError,
        OverflowError,
        SyntaxError,
        RecursionError,
        EOFError,
        MemoryError,
    ) as error:
        why = f"{type(error).__name__}: {str(error)[:200]}"
        raise FileFormatError(path, f"{what}: damaged, or no array ({why}); get it again") from error


class RefusedError(RtofError):
    """The pickle holds or does something that plain data do not need."""


class _Name:
    """Stand-in for one of `_CONSTRUCTORS`, callable by the pickle."""

    __slots__ = ("name", "reader")

    def __init__(self, name: str, reader: PlainUnpickler) -> None:
        self.name, self.reader = name, reader

    def __call__(self, *args: Any) -> Any:
        if self.name == "_reconstruct" and isinstance(args[0], _Name) and args[0].name == "ndarray":
            return _Array()
        if self.name == "_frombuffer" and isinstance(args[1], _Dtype):  # of protocol 5
            array, (data, dtype, shape, order) = _Array(), args
            array.state = (1, shape, dtype, order == "F", bytes(data) if type(data) is bytearray else data)
            return array
        if self.name == "dtype" and type(args[0]) is str:
            return _Dtype(args[0])
        if self.name == "scalar" and isinstance(args[0], _Dtype):
            return numbers_of((), args[0].numpy(), False, self.reader.encoded(args[1])).item()
        if self.name == "encode" and args[1:] in (("latin1",), ("latin-1",)):
            return self.reader.encoded(args[0])
        raise RefusedError(f"it calls {self.name} in a way that NumPy does not")


class _Dtype:
    """Stand-in for a numeric NumPy type."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "|"

    def __setstate__(self, state: Any) -> None:
        if type(state[1]) is not str or any(part is not None for part in state[2:5]):
            raise RefusedError("an array of records, not of numbers")
        self.order = state[1]

    def numpy(self) -> np.dtype[Any]:
        if not re.fullmatch(r"[fiu][1248]|b1", self.code) or self.order not in tuple("<>|="):
            raise RefusedError(f"an array of type {self.order + self.code!r}, not of numbers")
        return np.dtype(self.order + self.code)


class _Array:
    """Stand-in for an array: its state is (version, shape, type, Fortran order, data)."""

    state: tuple[Any, ...] = ()

    def __setstate__(self, state: Any) -> None:
        if type(state) is not tuple or len(state) != 5 or not isinstance(state[2], _Dtype):
            raise RefusedError("it sets the state of an array in a way that NumPy does not")
        self.state = state


class PlainUnpickler(pickle.Unpickler):
    """Unpickler of one object that imports nothing."""

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
                    raise RefusedError(f"a pickle of more than {LARGEST_STEPS} operations")
                if opcode.name in ("EXT1", "EXT2", "EXT4"):  # their cache bypasses find_class
                    raise RefusedError(f"it wants number {argument} of the extension registry")
        super().__init__(self.stream, encoding="latin1")

    def find_class(self, module: str, name: str) -> _Name:
        """Return the stand-in of an allowed name; raise for any other."""
        if name not in _CONSTRUCTORS.get(module, ()):
            raise RefusedError(
                f"it wants to run {f'{module}.{name}'[:200]}. Do not trust this file; get it from where it "
                "was published"
            )
        return _Name(name, self)

    def content(self) -> Any:
        """Return the object."""
        return self.plain(self._loaded(), 0)

    def content_of_array(self) -> Any:
        """Return the one object of an array of shape ()."""
        outer = self._loaded()
        if not isinstance(outer, _Array):
            raise RefusedError("the pickle is not that of an array")
        _, shape, dtype, _, items = outer.state
        if shape != () or dtype.code not in ("O", "O8", "O4") or type(items) is not list or len(items) != 1:
            raise RefusedError("the pickle is not that of an array of one object")
        return self.plain(items[0], 0)

    def _loaded(self) -> Any:
        outer = self.load()
        if self.stream.read(1):
            raise RefusedError("data after the end of the pickle")
        return outer

    def encoded(self, data: Any) -> bytes:
        """Return the bytes that pickles of Python 2 keep as text; the total is limited to the file's size."""
        if type(data) is bytes:
            return data
        if type(data) is not str:
            raise RefusedError("an array whose data are not bytes")
        self.encodable -= len(data)
        if self.encodable < 0:
            raise RefusedError("it repeats more text than the file holds")
        return data.encode("latin1")

    def plain(self, value: Any, depth: int) -> Any:
        """Replace stand-ins by arrays; each object is visited once."""
        if value is None or type(value) in (str, bool, int, float):
            return value
        if id(value) in self.finished:
            _, result = self.finished[id(value)]
            if result is self:
                raise RefusedError("an object that contains itself")
            return result
        if depth > _DEEPEST:
            raise RefusedError(f"lists or dictionaries nested more than {_DEEPEST} deep")
        self.finished[id(value)] = (value, self)
        result = self._plain_object(value, depth)
        self.finished[id(value)] = (value, result)
        return result

    def _plain_object(self, value: Any, depth: int) -> Any:
        if type(value) is dict:
            if not all(type(key) is str for key in value):
                raise RefusedError("a dictionary with a key that is not text")
            return {key: self.plain(item, depth + 1) for key, item in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.plain(item, depth + 1) for item in value)
        if isinstance(value, _Array):
            _, shape, dtype, fortran, data = value.state
            return numbers_of(shape, dtype.numpy(), bool(fortran), self.encoded(data))
        kind = f"numpy {value.name}" if isinstance(value, _Name) else type(value).__name__.strip("_")
        raise RefusedError(f"{kind} among the data")


def numbers_of(shape: Any, dtype: np.dtype[Any], fortran: bool, data: bytes) -> NDArray[Any]:
    """Return a read-only array of numbers in native byte order, once its size agrees with the data.

    Args:
        data: bytes of all numbers.

    Raises:
        RefusedError: another type, an impossible shape, or more or fewer bytes.
    """
    if dtype.kind not in "fiub":
        raise RefusedError(f"an array of {dtype}, not of numbers")
    if not (isinstance(shape, tuple) and len(shape) <= 8 and all(type(n) is int for n in shape)):
        raise RefusedError("an array whose shape is not a tuple of at most 8 integers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise RefusedError(f"an array of shape {shape} and type {dtype} with {len(data)} bytes")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    if not dtype.isnative:
        array = array.astype(dtype.newbyteorder("="))
        array.flags.writeable = False
    return array
