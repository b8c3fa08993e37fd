"""HDF5 files of named arrays: written row by row, and read by rows although they may come from anyone.

Arrays have chunks of rows with checksums, compressed by gzip; the root group has attributes. The same calls give the
same bytes. Nothing outside the file is opened, and no filter that is not part of HDF5 is loaded.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, reading
from rtof_kin.core.files.arrays import check_ratio, read_npz_as_saved
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import LARGEST_NUMBER, check_file, measurable

_MANTISSA: Final = 23  #: [bits] of a 32-bit float


def multiples(values: ArrayLike, bits: int) -> Array:
    """Return the nearest multiples of ``2^-bits``; zero is positive, so that equal numbers are equal bits.

    The zero bytes of numbers with no more digits than needed vanish in a compressed file.
    """
    return np.asarray(np.ldexp(np.round(np.ldexp(np.asarray(values, dtype=float), bits)), -bits) + 0.0)


def short_floats(values: ArrayLike, bits: int) -> NDArray[np.float32]:
    """Return 32-bit floats with a mantissa of at most 22 bits: a relative error of at most ``2^-(bits + 1)``."""
    exact = np.array(values, dtype=np.float32)
    cut = _MANTISSA - bits
    whole = exact.view(np.uint32)
    rounded = (whole + np.uint32(1 << (cut - 1))) >> np.uint32(cut) << np.uint32(cut)
    return np.where(np.isfinite(exact), rounded.view(np.float32), exact)


def rotation_vectors(R: Array, bits: int) -> NDArray[np.float32]:
    """Return the rotation vectors (..., 3), rad, of matrices (..., 3, 3), shorter than quaternions; NaN where not
    finite.
    """
    return multiples(so3.known_log(R), bits).astype(np.float32)


_CHUNK: Final = 1 << 16  #: [bytes] of a chunk at most, unless a row is larger
_ROWS: Final = 512  #: Rows of a chunk at most
_MOST_ARRAYS: Final = 1000
_CACHE: Final = 2**20  #: [bytes] of an array that stay decompressed: it is read in order
_LARGEST_WHOLE: Final = 512 * 2**20  #: [bytes] of an array that is read as a whole
_FORMAT: Final = ("v110", "v110")
"""Oldest and newest version of the format in a file: with checksums of what is no array, too."""
_DAMAGED: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, MemoryError, OverflowError)
"""What h5py raises for a damaged file."""


class _Stream(io.FileIO):
    """A file that remembers the first error of writing; HDF5, which does not survive one, goes on into nothing."""

    problem: OSError | None = None

    def write(self, data: Any) -> int:
        """Write bytes, unless an error has come before; return their number as if they were written."""
        if self.problem is None:
            try:
                with memoryview(data).cast("B") as rest:
                    done = 0
                    while done < len(rest):
                        done += super().write(rest[done:]) or 0
            except OSError as error:
                self.problem = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.problem = self.problem or error
            return size or 0


class Hdf5Writer:
    """An HDF5 file that appears complete at the end of the context, or not at all."""

    def __init__(self, path: Path, about: Mapping[str, Mapping[str, str]], overwrite: bool = True):
        """Write nothing yet; `about` has attributes by the name of an array, or its end, e.g. unit, frame and shape."""
        self._path, self._about, self._overwrite = path, about, overwrite
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Open the file; raise `OutputExistsError` where it exists, `WritingError` where it cannot be written."""
        with ExitStack() as failed:
            target = failed.enter_context(new_file(self._path, self._overwrite))
            self._stream = failed.enter_context(_Stream(target, "w+"))
            self._file = failed.enter_context(h5py.File(self._stream, "w", libver=_FORMAT))
            self._open = failed.pop_all()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        with self._open:
            self._file.close()
            if problem := self._stream.problem:
                raise problem
            if error is not None:
                raise error

    def __contains__(self, name: str) -> bool:
        return name in self._file

    def describe(self, **attributes: Any) -> None:
        """Set attributes of the file: numbers, texts, or arrays of these."""
        for name, value in attributes.items():
            array = np.asarray(value)
            self._file.attrs[name] = np.char.encode(array, "utf-8") if array.dtype.kind == "U" else array

    def append(self, rows: Mapping[str, NDArray[Any]], at: int | None = None) -> None:
        """Append rows to arrays, each of which may have another number of them. `InvalidInputError`: another type or
        shape than before. `OSError`: the disk is full; it becomes a `WritingError` at the end of the context.

        Args:
            rows: (n, ...) by the array's name; type and shape of a row are always the same.
            at: number of the first of them, by default that of rows so far; rows between are NaN or 0.
        """
        for name, array in rows.items():
            if name not in self._file:
                self._create(name, array, (0, *array.shape[1:]), (None, *array.shape[1:]))
            dataset = self._file[name]
            if dataset.maxshape[0] is not None or (array.dtype, array.shape[1:]) != (dataset.dtype, dataset.shape[1:]):
                raise InvalidInputError(
                    f"{self._path}: rows {array.shape[1:]} of {array.dtype} do not continue {name}, which "
                    f"has {dataset.shape[1:]} of {dataset.dtype}"
                )
            start = len(dataset) if at is None else at
            dataset.resize(start + len(array), axis=0)
            dataset[start:] = array
        if self._stream.problem is not None:
            raise self._stream.problem

    def add(self, name: str, array: NDArray[Any]) -> None:
        """Write a whole array; a name that exists raises `InvalidInputError`, for OSError see `append`."""
        if name in self._file:
            raise InvalidInputError(f"{self._path}: {name} was already written")
        self._create(name, array, array.shape, array.shape)[...] = array

    def add_text(self, name: str, text: str) -> None:
        """Write a long text as an array of its bytes, which has a checksum."""
        self.add(name, np.frombuffer(text.encode(), dtype=np.uint8))

    def _create(
        self, name: str, array: NDArray[Any], shape: tuple[int, ...], largest: tuple[int | None, ...]
    ) -> h5py.Dataset:
        row = max(math.prod(array.shape[1:]) * array.dtype.itemsize, 1)
        rows = min(max(_CHUNK // row, 1), _ROWS if largest[0] is None else len(array))
        chunks = (max(rows, 1), *(max(size, 1) for size in array.shape[1:]))
        how: dict[str, Any] = {"chunks": chunks, "compression": "gzip", "compression_opts": 4, "shuffle": True}
        how["fillvalue"] = np.nan if array.dtype.kind == "f" else 0
        dataset = self._file.create_dataset(
            name,
            shape,
            array.dtype,
            maxshape=tuple(size or None for size in largest),
            fletcher32=True,
            track_times=False,
            **how,
        )
        ends = [end for end in self._about if name.endswith(end)]
        for key, text in self._about[max(ends, key=len)].items() if ends else ():
            dataset.attrs[key] = np.bytes_(text.encode())
        return dataset


class BlockWriter:
    """A file that is written by blocks; it appears complete at the end of the context, or not at all."""

    _arrays: Hdf5Writer

    def __enter__(self) -> Self:
        """Open the file; `WritingError` where it cannot be written."""
        self._arrays.__enter__()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        with ExitStack() as closing:
            closing.push(self._arrays)
            if error is not None:
                raise error
            self._finish()

    def _finish(self) -> None:
        """Write what is known at the end."""
        raise NotImplementedError


def held(path: Path, file: h5py.File, name: str) -> Any:
    """Return what an open file holds itself under a name; `FileFormatError` where that leads to another file, KeyError
    where there is nothing.
    """
    link = file.get(name, getlink=True)
    if link is not None and not isinstance(link, h5py.HardLink):
        raise FileFormatError(path, f"{name}: leads to another file; not opened")
    return file[name]


class ArrayFile(AbstractContextManager["ArrayFile"]):
    """Arrays and attributes of an .h5 or .npz file; a context that closes it.

    Attributes:
        path: the file. shapes: of its arrays. attributes: of an .h5 file; an .npz file has arrays in their place.
    """

    def __init__(self, path: Path):
        """Open the file; an .npz is read whole. `FileFormatError`: no such file, damaged, too large, or anything else
        than arrays of numbers in it.
        """
        self.path = path
        self._arrays: dict[str, Any] = {}
        self.attributes: dict[str, NDArray[Any]] = {}
        self._file: h5py.File | None = None
        if path.suffix == ".npz":
            saved = read_npz_as_saved(path, kinds="fiubU")
            self._arrays = {name: array for name, array in saved.items() if array.ndim and array.dtype.kind != "U"}
            self.attributes = {name: array for name, array in saved.items() if name not in self._arrays}
        else:
            check_file(path, "an HDF5 file")
            with self._reading():
                self._file = h5py.File(path, "r", locking=False, rdcc_nbytes=_CACHE)
            try:
                with self._reading():
                    self._look()
            except FileFormatError:
                self.close()
                raise
        self.shapes: dict[str, tuple[int, ...]] = {name: array.shape for name, array in self._arrays.items()}

    def __exit__(self, *_: object) -> None:
        self.close()

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return rows of an array; KeyError where there is no such array, `FileFormatError` where it is damaged or has
        a number beyond any measurement.
        """
        array = self._arrays[name]
        with self._reading(name):
            found: NDArray[Any] = array[start:stop]
        if found.dtype.kind == "f" and not measurable(found):
            raise FileFormatError(self.path, f"{name}: holds a number beyond {LARGEST_NUMBER:g}")
        return found

    def whole(self, name: str) -> NDArray[Any]:
        """Return an array of at most 512 MiB; a larger one is a `FileFormatError`, else errors as `rows`."""
        array = self._arrays[name]
        if array.size * array.dtype.itemsize > _LARGEST_WHOLE:
            raise FileFormatError(self.path, f"{name}: larger than {_LARGEST_WHOLE / 2**20:.0f} MiB")
        return self.rows(name, 0, len(array))

    def text(self, name: str) -> str:
        """Return a text of `Hdf5Writer.add_text`, or of an .npz file; errors as `whole`."""
        if name in self.attributes:
            return str(self.attributes[name])
        return self.whole(name).tobytes().decode()

    def _look(self) -> None:
        """Check all that the file consists of."""
        assert self._file is not None
        if len(self._file) > _MOST_ARRAYS:
            raise FileFormatError(self.path, f"{len(self._file)} arrays; no file of this package has so many")
        for name in self._file:
            array = held(self.path, self._file, name)
            if not isinstance(array, h5py.Dataset) or array.dtype.kind not in "fiub" or not array.ndim:
                raise FileFormatError(self.path, f"{name}: no array of numbers")
            if array.external or array.is_virtual or array.chunks is None or array.compression not in (None, "gzip"):
                raise FileFormatError(self.path, f"{name}: kept in another way than this package does; not opened")
            if math.prod(array.chunks) * array.dtype.itemsize > 16 * _CHUNK:
                raise FileFormatError(self.path, f"{name}: has larger chunks than this package writes; not opened")
            self._arrays[name] = array
        full = sum(array.size * array.dtype.itemsize for array in self._arrays.values())
        check_ratio(self.path, full, self.path.stat().st_size)
        for name, value in self._file.attrs.items():
            found = np.asarray(value)
            if found.dtype.kind == "S":
                found = np.char.decode(found, "utf-8")
            if found.dtype.kind not in "fiubU":
                raise FileFormatError(self.path, f"{name}: neither numbers nor text")
            self.attributes[name] = found

    def _reading(self, what: str = "") -> AbstractContextManager[None]:
        """Turn errors of reading into `FileFormatError`."""
        problem = f"{what}: damaged" if what else "damaged, or no HDF5 file"
        return reading(self.path, f"{problem} ({{}}); reconstruct again", *_DAMAGED)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return arrays and attributes of an .h5 or .npz file of results, by name, the same of either; see `ArrayFile`."""
    with ArrayFile(path) as file:
        arrays = file.attributes | {name: file.whole(name) for name in file.shapes}
        return arrays | ({"header": np.array(file.text("header"))} if "header" in arrays else {})
