"""A pickle of arrays in dictionaries, read as data.

A pickle is a program: unpickling it runs whatever it names. Here none is ever unpickled. The operations
that NumPy writes for dictionaries, lists, numbers, texts and numeric arrays are carried out one by one on
stand-ins; nothing that a file names is imported or called, and any other operation or name is refused.
Pickles of protocol 2 and later are read, those of Python 2 and of NumPy before 2.0 among them.
"""

from __future__ import annotations

import math
import pickletools
import re
import warnings
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import RtofError

LARGEST_STEPS = 2_000_000
"""A pickle of more operations than this is refused; Human3.6M has about 60,000."""
_DEEPEST = 20
_NAMES = {
    "numpy.core.multiarray _reconstruct": "array",
    "numpy._core.multiarray _reconstruct": "array",
    "numpy.core.multiarray scalar": "scalar",
    "numpy._core.multiarray scalar": "scalar",
    "numpy ndarray": "ndarray",
    "numpy dtype": "dtype",
    "_codecs encode": "encode",
}
"""What a pickle may name, and what that stands for here."""
_VALUES = {
    "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
    "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINSTRING", "SHORT_BINSTRING",
}  # fmt: skip
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, type] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUT, _GET = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}
_MARK = object()


class RefusedError(RtofError):
    """The file holds or does something that data have no need of; whoever reads it says which file."""


def read_pickle(stream: IO[bytes], size: int) -> Any:
    """The one object in the pickle of an array of shape () that NumPy wrote; nothing is executed.

    Args:
        stream: at the start of the pickle; left at its end.
        size: of what the stream holds, bytes: as many bytes of text may be encoded, and no more.

    Returns:
        dict with text keys, list, tuple, str, int, float, bool, None and read-only numeric arrays.

    Raises:
        RefusedError: it names or does anything else; the message says what it wanted to run.
        ValueError, LookupError, TypeError, OverflowError: it is damaged.
    """
    program = _Program(size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of texts that are escaped wrongly
        for steps, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
            if steps > LARGEST_STEPS:
                raise RefusedError(f"a pickle of more than {LARGEST_STEPS} operations")
            program.step(opcode.name, argument)
    (outer,) = program.stack
    if not isinstance(outer, _Array):
        raise RefusedError("the pickle is not that of an array")
    _, shape, dtype, _, items = outer.state
    if shape != () or dtype.code not in ("O", "O8", "O4") or type(items) is not list:
        raise RefusedError("the pickle is not that of an array of one object")
    (content,) = items
    return program.plain(content, 0)


def numbers(shape: Any, dtype: np.dtype[Any], fortran: bool, data: bytes) -> NDArray[Any]:
    """A read-only array of numbers from its bytes; no memory is set aside before they are counted."""
    if dtype.kind not in "fiub" or dtype.hasobject:
        raise RefusedError(f"an array of {dtype}, not of numbers")
    if not (isinstance(shape, tuple) and len(shape) <= 8 and all(type(n) is int for n in shape)):
        raise RefusedError("an array whose shape is no tuple of at most 8 integers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise RefusedError(f"an array of shape {shape} and type {dtype} with {len(data)} bytes")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class _Name:
    """Something of another module, named and never looked up."""

    role: str


@dataclass(eq=False)
class _Dtype:
    """Stand-in for a NumPy type: its code, and its byte order once that is known."""

    code: str
    order: str = "|"

    def numpy(self) -> np.dtype[Any]:
        if not re.fullmatch(r"[fiu][1248]|b1", self.code) or self.order not in tuple("<>|="):
            raise RefusedError(f"an array of type {self.order + self.code!r}, not of numbers")
        return np.dtype(self.order + self.code)


@dataclass(eq=False)
class _Array:
    """Stand-in for an array, and what will fill it."""

    state: tuple[Any, ...] = ()


class _Program:
    """A pickle as a list of operations on a stack."""

    def __init__(self, size: int) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.encodable = size
        self.finished: dict[int, tuple[Any, Any]] = {}

    def step(self, name: str, argument: Any) -> None:
        """Carry out one operation."""
        stack = self.stack
        if name in _VALUES:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name in _PUT:
            self.memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in _GET:
            stack.append(self.memo[argument])
        elif name == "MARK":
            stack.append(_MARK)
        elif name in _TUPLES:
            items = self.pop(_TUPLES[name])
            stack.append(tuple(items))
        elif name == "TUPLE":
            stack.append(tuple(self.pop_to_mark()))
        elif name in ("APPEND", "APPENDS", "SETITEM", "SETITEMS"):
            self.fill(name)
        elif name not in ("PROTO", "FRAME", "STOP"):
            self.step_beyond_data(name, argument)

    def step_beyond_data(self, name: str, argument: Any) -> None:
        """Carry out one of the operations by which a pickle could run code, on stand-ins."""
        if name in ("GLOBAL", "INST"):
            self.stack.append(_named(argument))
        elif name == "STACK_GLOBAL":
            self.stack.append(_named(" ".join(map(str, self.pop(2)))))
        elif name == "REDUCE":
            called, arguments = self.pop(2)
            self.stack.append(self.stand_in(called, arguments))
        elif name == "BUILD":
            (state,) = self.pop(1)
            _complete(self.stack[-1], state)
        elif name in ("PERSID", "BINPERSID"):
            raise RefusedError("it wants an object by a persistent id, which data do not need")
        elif name in ("EXT1", "EXT2", "EXT4"):
            raise RefusedError(f"it wants number {argument} of the extension registry")
        else:
            raise RefusedError(f"it does {name}, which NumPy does for no array")

    def pop(self, count: int) -> list[Any]:
        items = self.stack[-count:]
        if len(items) < count or any(item is _MARK for item in items):
            raise ValueError("the pickle takes what it never gave")
        del self.stack[-count:]
        return items

    def pop_to_mark(self) -> list[Any]:
        items: list[Any] = []
        while (item := self.stack.pop()) is not _MARK:
            items.append(item)
        return items[::-1]

    def fill(self, name: str) -> None:
        """Add the items on top of the stack to the list or the dictionary below them."""
        into_list = name.startswith("APPEND")
        items = self.pop_to_mark() if name.endswith("S") else self.pop(1 if into_list else 2)
        target = self.stack[-1]
        if into_list and type(target) is list:
            target.extend(items)
        elif not into_list and type(target) is dict:
            if not all(type(key) is str for key in items[::2]):
                raise RefusedError("a dictionary with a key that is no text")
            target.update(zip(items[::2], items[1::2], strict=True))
        else:
            raise ValueError(f"{name} on something else")

    def stand_in(self, called: Any, arguments: Any) -> Any:
        """What a call would give, made here: nothing is called."""
        role = called.role if isinstance(called, _Name) else ""
        if role == "array" and arguments[0] == _Name("ndarray"):
            return _Array()
        if role == "dtype" and type(arguments[0]) is str:
            return _Dtype(arguments[0])
        if role == "scalar" and isinstance(arguments[0], _Dtype):
            return numbers((), arguments[0].numpy(), False, self.encoded(arguments[1])).item()
        if role == "encode" and arguments[1:] in (("latin1",), ("latin-1",)):
            return self.encoded(arguments[0])
        raise RefusedError(f"it calls {role or 'something'} as NumPy does for no array")

    def encoded(self, data: Any) -> bytes:
        """Bytes that older pickles hold as text."""
        if type(data) is bytes:
            return data
        if type(data) is not str:
            raise RefusedError("an array whose bytes are none")
        self.encodable -= len(data)
        if self.encodable < 0:
            raise RefusedError("it makes more of its text than the file holds")
        return data.encode("latin1")

    def plain(self, value: Any, depth: int) -> Any:
        """The value with arrays in place of stand-ins; each object is visited once."""
        if value is None or type(value) in (str, bool, int, float):
            return value
        if id(value) in self.finished:
            _, known = self.finished[id(value)]
            if known is _MARK:
                raise RefusedError("something that contains itself")
            return known
        if depth > _DEEPEST:
            raise RefusedError(f"lists or dictionaries nested more than {_DEEPEST} deep")
        self.finished[id(value)] = (value, _MARK)
        result: Any
        if type(value) is dict:
            result = {key: self.plain(item, depth + 1) for key, item in value.items()}
        elif type(value) in (list, tuple):
            result = type(value)(self.plain(item, depth + 1) for item in value)
        elif isinstance(value, _Array):
            _, shape, dtype, fortran, data = value.state
            result = numbers(shape, dtype.numpy(), bool(fortran), self.encoded(data))
        else:
            kind = f"numpy {value.role}" if isinstance(value, _Name) else type(value).__name__
            raise RefusedError(f"{kind.strip('_')} among the data")
        self.finished[id(value)] = (value, result)
        return result


def _named(text: str) -> _Name:
    """The stand-in for what a pickle names as 'module name'."""
    if text not in _NAMES:
        wanted = text.replace(" ", ".")[:200]
        raise RefusedError(
            f"it wants to run {wanted}. Data need nothing of the kind: do not trust this file, and get "
            "it from where it was published"
        )
    return _Name(_NAMES[text])


def _complete(target: Any, state: Any) -> None:
    """Give a stand-in its state."""
    if isinstance(target, _Array) and type(state) is tuple and len(state) == 5:
        if not isinstance(state[2], _Dtype):
            raise RefusedError("an array without a type")
        target.state = state
    elif isinstance(target, _Dtype) and type(state) is tuple and len(state) >= 8:
        if type(state[1]) is not str or any(part is not None for part in state[2:5]):
            raise RefusedError("an array of records, not of numbers")
        target.order = state[1]
    else:
        raise RefusedError("it sets the state of something that is no array")
