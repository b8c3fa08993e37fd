"""`Streams`: all samples of a recording, `Source`, which reads their files block by block, and corrections by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times, indices_of
from rtof_kin.core.errors import (
    CalibrationError,
    FileFormatError,
    InvalidInputError,
    RtofError,
    UnitError,
    UnknownNameError,
    reading,
)
from rtof_kin.core.files.arrays import WaitingArray, csv_blocks, npz_rows, npz_shapes, read_npz
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.input_table import InputTable
from rtof_kin.core.over_time import ALL, BLOCK, Part, Stream
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import ImuSequence, UnitCheck
from rtof_kin.data.keypoints import KeypointSequence, detector_point, layout_and_point
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.tables import ImusTable, KeypointsTable
from rtof_kin.vision.layouts import mirrored


@dataclass(frozen=True)
class Streams:
    """All that changes over time in a recording; None or nothing where there is none."""

    keypoints: Stream[KeypointSequence] | None
    views: tuple[Stream[KeypointSequence], ...]
    imus: Stream[ImuSequence] | None
    truth: Stream[PoseSequence] | None

    def parts(self, rows: Callable[[Stream[Any]], Any]) -> dict[str, Any]:
        """Return the fields of a `Recording` that hold the samples (None where there are none) that `rows` takes of a
        stream.
        """

        def of(stream: Stream[Any] | None) -> Any:
            return None if stream is None else rows(stream)

        parts = {"keypoints": of(self.keypoints), "imus": of(self.imus), "truth": of(self.truth)}
        views = () if parts["keypoints"] is None else map(of, self.views)
        return parts | {"views": tuple(view for view in views if view is not None)}

    def check_clocks(self) -> None:
        """Check that all streams overlap in time with the first one; raise `InvalidInputError` where one does not."""
        named = {"keypoints": self.keypoints, "IMU": self.imus, "truth": self.truth}
        named |= {f"view {i}": view for i, view in enumerate(self.views, start=1)}
        (first, times), *others = ((what, part.times) for what, part in named.items() if part is not None)
        for what, other in others:
            if not (other[0] <= times[-1] and times[0] <= other[-1]):
                raise InvalidInputError(
                    f"{what} times run from {other[0]:g} to {other[-1]:g} s, those of the "
                    f"{first} from {times[0]:g} to {times[-1]:g} s; shift them to one clock"
                )


Arrange = Callable[[Path, dict[str, Array]], tuple[tuple[str, ...], dict[str, Array]]]
"""From a .csv file and its columns to names and arrays."""


@dataclass(frozen=True)
class Table:
    """Arrays of a file, float64: most have one row for each sample, the others are constant."""

    arrays: Mapping[str, Array | WaitingArray]  #: By name
    with_rows: frozenset[str]  #: Names of those with a row for each sample

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array."""
        return {name: array.shape for name, array in self.arrays.items()}

    def column(self, name: str) -> Array | None:
        """Return a whole array (T,); None where there is none."""
        return self.arrays[name][ALL] if name in self.arrays else None

    def rows(self, rows: slice) -> dict[str, Any]:
        """Return rows of all arrays that have them, and the others."""
        return {name: array[rows] if name in self.with_rows else array for name, array in self.arrays.items()}


class Source:
    """Reads files once, block by block, and keeps their rows until they are needed, most of them outside of memory."""

    def __init__(self, closing: ExitStack):
        """Take what forgets the rows."""
        self._closing = closing

    def npz(self, path: Path, axes: Mapping[str, int], constants: Sequence[str] = ()) -> Table:
        """Open an .npz file of arrays with a row for each sample (axes by name), and of constants; others raise
        `UnknownNameError`.
        """
        shapes = npz_shapes(path)
        indices_of(f"array in {path}", sorted(shapes), (*axes, *constants))
        with_rows = frozenset(name for name, shape in shapes.items() if len(shape) == axes.get(name))
        long = [name for name in shapes if name in with_rows and axes[name] > 1]
        short = read_npz(path, names=[name for name in shapes if name not in long])
        blocks = ({name: rows} for name in long for rows in npz_rows(path, name, BLOCK))
        return Table({**short, **self._kept(blocks)}, with_rows)

    def csv(self, path: Path, arrange: Arrange) -> tuple[tuple[str, ...], Table]:
        """Read a .csv file; return its names and arrays."""
        blocks = csv_blocks(path, BLOCK)
        names, first = arrange(path, next(blocks))
        arrays = self._kept(chain([first], (arrange(path, columns)[1] for columns in blocks)))
        return names, Table(arrays, frozenset(arrays))

    def keep(self, times: Array, blocks: Iterable[Part]) -> Stream[Part]:
        """Return the stream of samples at times (T,), s, that can only be made in their order."""
        parts = iter(blocks)
        first = next(parts)
        own = (part.cut(slice(None)).items() for part in chain([first], parts))
        kept = self._kept({name: array for name, array in some if isinstance(array, np.ndarray)} for some in own)

        def part(rows: slice) -> Part:
            some: dict[str, Any] = {name: array[rows] for name, array in kept.items()}
            return replace(first, **some)  # type: ignore[type-var]

        return Stream(times, part)

    def checked(self, stream: Stream[Part]) -> Stream[Part]:
        """Return a stream all of whose samples are checked; errors count them from the start of the whole."""
        unit, names = UnitCheck(), tuple[str, ...]()
        try:
            checked_times("times", stream.times)
            for part in stream.blocks():
                if isinstance(part, ImuSequence):
                    unit.add(part.R_inertial_sensor, part.f_sensor)
                    names = part.names
            if names:
                unit.check(names)
        except RtofError:
            stream.part(ALL)
            raise
        return stream

    def _kept(self, blocks: Iterable[Mapping[str, Array]]) -> dict[str, WaitingArray]:
        """Return the arrays of blocks of rows, by name."""
        arrays: dict[str, WaitingArray] = {}
        for name, rows in (pair for block in blocks for pair in block.items()):
            if name not in arrays:
                arrays[name] = self._closing.enter_context(closing(WaitingArray(rows.shape[1:])))
            arrays[name].append(rows)
        return arrays


# --- what all readers share ----------------------------------------------------------------------


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the name of a file in front of errors that data types raise inside."""
    try:
        with reading(path, "{}", InvalidInputError, CalibrationError):
            yield
    except UnitError as error:
        raise UnitError(f"{path}: {error}") from error


def data_path(table: InputTable, or_folder: bool = False, field: str = "file", name: str | None = None) -> Path:
    """Return the file (or folder) inside the recording's folder that a field of a table names, one of several by its
    name.
    """
    name = str(getattr(table, field)) if name is None else name
    path = path_inside(table.path.parent, name)
    if path is None:
        raise table.error(field, f"{name!r} leads out of the folder; name a file inside it")
    if not path.is_file() and not (or_folder and path.is_dir()):
        raise table.error(field, f"there is no file {path}; put it there or correct the name")
    return path


def needed(path: Path, shapes: Mapping[str, tuple[int, ...]], name: str, shape: str) -> tuple[int, ...]:
    """Return the shape of a required array with axes e.g. ``"(T, S, 4)"``, or raise `FileFormatError`."""
    if name not in shapes:
        have = ", ".join(shapes) or "nothing"
        raise FileFormatError(path, f"no array {name!r} of shape {shape}; there is {have}")
    if len(shapes[name]) != shape.count(",") + 1:
        raise FileFormatError(path, f"{name}: expected shape {shape}, got {shapes[name]}")
    return shapes[name]


def times_of(table: KeypointsTable | ImusTable, path: Path, arrays: Table, T: int) -> Array:
    """Return times (T,) in s: those of the file, or evenly spaced at ``rate_hz``; ``start_s`` is added."""
    times = arrays.column("times")
    if times is not None and table.rate_hz is not None:
        raise table.error("rate_hz", f"{path} has times of its own; give only one of the two")
    if times is not None:
        return times + table.start_s
    if table.rate_hz is None:
        raise table.error("rate_hz", f"missing, and {path} has no times; give one of the two")
    return table.start_s + np.arange(T) / table.rate_hz


def csv_names(path: Path, columns: list[str], endings: Sequence[str], optional: int = 0) -> tuple[str, ...]:
    """Return names in the order of their first column; so many of the last endings of a name's columns are not
    required.
    """
    names: dict[str, None] = {}
    for column in columns:
        ending = next((end for end in endings if column.endswith(end)), None)
        if ending is None:
            raise FileFormatError(
                path, f"column {column!r}: expected 'time', or a name with one of the endings {', '.join(endings)}", 1
            )
        names[column.removesuffix(ending)] = None
    if not names:
        raise FileFormatError(path, f"no column ends in {endings[0]}", 1)
    required = endings[: len(endings) - optional]
    missing = [name + end for name in names for end in required if name + end not in columns]
    if missing:
        raise FileFormatError(path, f"the column {missing[0]!r} is missing", 1)
    return tuple(names)


# --- corrections by hand: what is left out, and sides that are exchanged ---------------------------

_STREAMS: Final = ("all", "image", "sensors")  #: What is left out as a whole


def corrected(streams: Streams, corrections: Iterable[Correction], path: Path) -> Streams:
    """Return the streams of a recording with the corrections that their samples do not have yet. `UnknownNameError`: a
    sensor that is left out is not there.

    Args:
        path: of ``recording.toml``, for messages.
    """
    for one in corrections:
        if one.applied:
            continue
        if one.kind == "exchange_sides" and streams.keypoints is not None:
            streams = replace(streams, keypoints=_mapped(streams.keypoints, partial(_exchanged, one)))
        if one.kind != "leave_out":
            continue
        if one.what in ("all", "image"):
            unseen = partial(_unseen, one)
            first = None if streams.keypoints is None else _mapped(streams.keypoints, unseen)
            streams = replace(streams, keypoints=first, views=tuple(_mapped(view, unseen) for view in streams.views))
        if one.what != "image" and streams.imus is not None:
            names = streams.imus.part(slice(0, 1)).names
            if one.what not in (*_STREAMS, *names):
                raise UnknownNameError("sensor", [one.what], names, path, "[[corrections]] what")
            left = [i for i, name in enumerate(names) if one.what in (*_STREAMS, name)]
            streams = replace(streams, imus=_mapped(streams.imus, partial(_silent, one, left)))
    return streams


def _mapped(stream: Stream[Part], change: Callable[[Part], Part]) -> Stream[Part]:
    return Stream(stream.times, lambda rows: change(stream.part(rows)))


def _unseen(one: Correction, keypoints: KeypointSequence) -> KeypointSequence:
    confidence = np.where(one.within(keypoints.times)[:, None], 0.0, keypoints.confidence)
    return replace(keypoints, confidence=confidence)


def _exchanged(one: Correction, keypoints: KeypointSequence) -> KeypointSequence:
    """Exchange left and right of all points that have both."""
    names = keypoints.names
    order = list(range(len(names)))
    for i, name in enumerate(names):
        layout, point = layout_and_point(name)
        other = detector_point(layout, mirrored(point)) if layout else mirrored(point)
        order[i] = names.index(other) if other in names else i
    own = one.within(keypoints.times)
    uv, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
    uv[own], confidence[own] = keypoints.uv_px[own][:, order], keypoints.confidence[own][:, order]
    return replace(keypoints, uv_px=uv, confidence=confidence)


def _silent(one: Correction, sensors: list[int], imus: ImuSequence) -> ImuSequence:
    R, f, lost = imus.R_inertial_sensor.copy(), imus.f_sensor.copy(), np.ix_(one.within(imus.times), np.array(sensors))
    R[lost], f[lost] = np.nan, np.nan
    return replace(imus, R_inertial_sensor=R, f_sensor=f)
