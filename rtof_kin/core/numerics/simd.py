"""CasADi functions of a frame over many frames: compiled to SIMD code with a frame per vector element, or interpreted.

CasADi's own code is scalar. Here the same expressions are generated with vectors in place of numbers, so eight frames
take little longer than one. Arguments and results are arrays of columns (n, width), a number per row and a frame per
column; the array of the next frame is the same array shifted by one column.
"""

from __future__ import annotations

import ctypes
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import ShapeError
from rtof_kin.core.numerics.c_compiler import Buffered, built, native

Index = NDArray[np.int64]
_OPTIONS = ("-O1", "-fexpensive-optimizations", "-fno-math-errno")
"""The second avoids slow transitions between vector instruction sets with GCC."""
GROUP = 8  #: Numbers of a placed output that are stored together; the longest vector


@dataclass(frozen=True)
class FrameFunction:
    """A function of one frame, to be evaluated for many."""

    name: str
    inputs: tuple[int, ...]  #: Numbers of each input
    outputs: tuple[int, ...]  #: Numbers of each output
    shared: tuple[int, ...] = ()  #: Indices of inputs that are the same for all frames
    placed: bool = False  #: True if the last output is scattered in groups of `GROUP` numbers
    expression: Any = None  #: CasADi SX function with dense inputs and outputs; None where it was compiled earlier

    @classmethod
    def of(cls, expression: Any, shared: tuple[int, ...] = (), placed: bool = False) -> Self:
        """Return that of an expression."""
        inputs = tuple(map(expression.nnz_in, range(expression.n_in())))
        outputs = tuple(map(expression.nnz_out, range(expression.n_out())))
        return cls(expression.name(), inputs, outputs, shared, placed, expression)


class Compiled(NamedTuple):
    """Functions with their code."""

    functions: dict[str, FrameFunction]  #: By name
    code: dict[str, Any]  #: By name
    remarks: Any  #: What was kept with them


class Over:
    """A function bound to arrays, which it reads and writes in place for all frames; compiled, or interpreted."""

    def __init__(
        self,
        code: Any,
        given: FrameFunction,
        frames: int,
        inputs: Sequence[Array],
        outputs: Sequence[Array],
        places: Index | None = None,
    ) -> None:
        """Bind a function to arrays. `ShapeError`: an array has too few frames or numbers, or another memory layout.

        Args:
            code: the function in its library (`compile_simd`), None to interpret it.
            inputs: (n, >= `whole(frames)`) columns, or (n,) if shared.
            outputs: the same; columns after the last frame, up to whole vectors, are set to zero. All columns have the
                same stride.
            places: (groups,) of a placed output (frames, k): column of each group in the row of a frame; rows may
                overlap.
        """
        ins, outs = list(inputs), list(outputs)
        if len(ins) != len(given.inputs) or len(outs) != len(given.outputs):
            raise ShapeError(f"{given.name}: give {len(given.inputs)} inputs and {len(given.outputs)} outputs")
        columns = [a for i, a in enumerate(ins) if i not in given.shared]
        columns += outs[:-1] if given.placed else outs
        width = columns[0].strides[0]
        for i, array in enumerate(ins):
            shape = (given.inputs[i],) if i in given.shared else (given.inputs[i], whole(frames))
            _check(f"{given.name} input {i}", array, shape, width)
        for i, array in enumerate(outs):
            if given.placed and i == len(outs) - 1:
                groups = () if places is None else places
                least = int(np.max(groups, initial=0)) + GROUP
                _check(f"{given.name} output {i}", array, (frames, least), array.strides[0])
                if len(groups) * GROUP != given.outputs[i] or np.min(groups, initial=0) < 0:
                    raise ShapeError(f"{given.name} output {i}: give a place for each group of {GROUP} numbers")
            else:
                _check(f"{given.name} output {i}", array, (given.outputs[i], whole(frames)), width)
        place = np.zeros(0, np.int64) if places is None else np.array(places, dtype=np.int64)
        if code is None:
            self._run: Callable[[], None] = _Interpreted(given, frames, ins, outs, place)
            return
        spare = np.zeros(int(place.max(initial=0)) + GROUP)
        self._kept = ins, outs, place, spare
        step = outs[-1].strides[0] // spare.itemsize
        numbers = (ctypes.c_longlong(n) for n in (width // spare.itemsize, step, frames))
        addresses = (ctypes.c_void_p(a.ctypes.data) for a in (place, spare))
        self._run = partial(code, _pointers(ins), _pointers(outs), *addresses, *numbers)

    def __call__(self) -> None:
        """Evaluate."""
        self._run()


class _Interpreted:
    """A function evaluated by CasADi frame by frame, with the arrays of an `Over`."""

    def __init__(
        self, given: FrameFunction, frames: int, inputs: list[Array], outputs: list[Array], places: Index
    ) -> None:
        f = given.expression
        self._mapped = Buffered(f.map(f"{f.name()}_{frames}", "serial", frames, list(given.shared), []))
        self._pairs = [
            (own if i in given.shared else own.reshape(frames, -1).T, array if i in given.shared else array[:, :frames])
            for i, (own, array) in enumerate(zip(self._mapped.inputs, inputs, strict=True))
        ]
        found = [own.reshape(frames, -1) for own in self._mapped.outputs]
        columns = outputs[:-1] if given.placed else outputs
        self._found = [(own.T, array[:, : whole(frames)]) for own, array in zip(found, columns, strict=False)]
        self._placed = (found[-1], outputs[-1][:frames]) if given.placed else None
        self._frames, self._places = frames, (places[:, None] + np.arange(GROUP)).ravel()

    def __call__(self) -> None:
        for own, array in self._pairs:
            own[:] = array
        self._mapped()
        for own, array in self._found:
            array[:, : self._frames], array[:, self._frames :] = own, 0.0
        if self._placed is not None:
            own, rows = self._placed
            rows[:, self._places] = own


class Columns:
    """Column arrays for functions over the same frames, padded with zeros before and after.

    Attributes:
        frames: number of frames. inside: slice of the frames among the columns.
    """

    def __init__(self, frames: int) -> None:
        self.frames, self.inside = frames, slice(GROUP, GROUP + frames)
        self._width = whole(frames) + 2 * GROUP

    def zeros(self, numbers: int) -> Array:
        """Return zeros (numbers, width), aligned to a cache line."""
        count = numbers * self._width
        raw = np.zeros(count + GROUP)
        first = -raw.ctypes.data // raw.itemsize % GROUP
        return raw[first : first + count].reshape(numbers, self._width)

    def given(self, rows: Array) -> Array:
        """Return the columns of rows (N, n)."""
        out = self.zeros(rows.shape[1])
        out[:, self.inside] = rows.T
        return out

    def rows(self, columns: Array) -> Array:
        """Return the rows (N, n) of columns."""
        return np.ascontiguousarray(columns[:, self.inside].T)

    def at(self, columns: Array, k: int = 0) -> Array:
        """Return columns shifted by k frames, -`GROUP` <= k <= `GROUP`, as an input."""
        return columns[:, GROUP + k :]


class Mapped:
    """A function from arrays (N, n) to arrays (N, n)."""

    def __init__(self, code: Any, given: FrameFunction, frames: int) -> None:
        self._columns = Columns(frames)
        zeros, at = self._columns.zeros, self._columns.at
        self._outputs = [zeros(count) for count in given.outputs]
        inputs, self._targets = list[Array](), list[Array]()
        for i, count in enumerate(given.inputs):
            own = np.zeros(count) if i in given.shared else zeros(count)
            inputs.append(own if i in given.shared else at(own))
            self._targets.append(own if i in given.shared else own[:, self._columns.inside].T)
        self._over = Over(code, given, frames, inputs, [at(a) for a in self._outputs])

    def __call__(self, *values: Array) -> list[Array]:
        """Return outputs (N, n) for inputs (N, n), or (n,) if shared."""
        for target, value in zip(self._targets, values, strict=True):
            target[:] = value
        self._over()
        return [self._columns.rows(array) for array in self._outputs]


def whole(frames: int) -> int:
    """Return the number of frames rounded up to whole vectors of any length."""
    return -(-frames // GROUP) * GROUP


def c_name(name: str) -> str:
    """Return the name of a function in C."""
    return f"over_frames_{name}"


def compile_simd(build: Callable[[], tuple[Sequence[FrameFunction], Any]], made_of: str = "") -> Compiled | None:
    """Compile functions together, or load them from the cache; None if impossible, see `c_compiler.built`.

    Args:
        build: functions, and what is kept with them: strings, numbers, lists and dictionaries.
        made_of: identifies what `build` makes, which then is not called where it was compiled before.
    """

    def text() -> str:
        from rtof_kin.core.numerics.simd_codegen import source  # needs CasADi

        functions, remarks = build()
        described = [(g.name, g.inputs, g.outputs, g.shared, g.placed) for g in functions]
        return f"{source(functions)}\nconst char *const described = {json.dumps(json.dumps([described, remarks]))};\n"

    def loaded(library: Path) -> Compiled:
        opened = ctypes.CDLL(str(library))
        try:
            described, remarks = json.loads(ctypes.c_char_p.in_dll(opened, "described").value or b"")
            found = [FrameFunction(g[0], tuple(g[1]), tuple(g[2]), tuple(g[3]), g[4]) for g in described]
            return Compiled({g.name: g for g in found}, {g.name: opened[c_name(g.name)] for g in found}, remarks)
        except (AttributeError, ValueError) as error:
            raise OSError(f"{library.name}: {error}") from error

    if not made_of:
        from rtof_kin.core.numerics.simd_codegen import identity

        made_of = identity(build()[0])
    return built(made_of, text, loaded, (*_OPTIONS, *native()))


def _check(name: str, array: Array, shape: tuple[int, ...], width: int) -> None:
    """Raise if an array has another type, layout or shape than a function needs."""
    strides = (width, array.itemsize)[-array.ndim :]
    if array.dtype != np.float64 or (array.size and array.strides != strides):
        raise ShapeError(f"{name}: give columns of double precision, of one width with the others")
    if array.ndim != len(shape) or (np.array(array.shape) < shape).any():
        raise ShapeError(f"{name}: {array.shape} where {shape} is expected")


def _pointers(arrays: Sequence[NDArray[Any]]) -> Any:
    return (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))
