"""The folder of a recorded session, and the recording that `finish` makes of it.

``live/`` has everything as it came (see `rtof_kin.live.recorder`) and stays. Beside it `finish` puts
the files of a recording: the samples with a usable time, sorted, on one clock that starts at zero.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError, WritingError
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.files.folder import locked
from rtof_kin.core.files.manifest import MANIFEST, write_manifest
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.live.stream_checks import unknown_landmarks, unknown_sensors
from rtof_kin.recording.index import INDEX, UNFINISHED
from rtof_kin.recording.recording import Recording

LIVE, SETUP = UNFINISHED.parts  #: Folder of everything as it came, and the one in it with camera, body and calibration
CHUNK: Final = "{:06d}.npz"  #: Names of the files in it
_MADE: Final = "recording"
_SAME_SAMPLE: Final = 1e-4  # [s]
_FROZEN: Final = 0.3  # [s] of identical numbers
_UNION: Final = 1.2  # [-] times of all sensors together against those of one, where they share their times
_SAID: Final = 100
_ESTIMATES: Final = ("p_world_joint", "R_world_bone", "provenance")

Chunk = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Stream:
    """Samples of one sensor or of the camera, sorted, each time once."""

    times: Array
    values: tuple[Array, ...]
    lost: int
    left_out: int
    repeated: int

    @classmethod
    def of(cls, times: Array, *values: Array) -> _Stream:
        """Sort samples; those without a time, twins and repetitions of the same numbers are left out."""
        order = np.argsort(times, kind="stable")
        order = order[np.isfinite(times[order])]
        order = order[np.append(True, np.diff(times[order]) > _SAME_SAMPLE)] if len(order) else order
        left_out = len(times) - len(order)
        times, values = times[order], tuple(value[order] for value in values)
        kept = ~_repeated(times, np.concatenate([value.reshape(len(times), -1) for value in values], axis=1))
        kept_values = tuple(value[kept] for value in values)
        steps = np.diff(times)
        lost = int(np.sum(np.maximum(np.round(steps / np.median(steps)) - 1, 0))) if len(steps) else 0
        return cls(times[kept], kept_values, lost, left_out, int(np.sum(~kept)))


def _repeated(times: Array, numbers: Array) -> Mask:
    """Return the mask (T,) of samples that repeat the one before, in long runs."""
    repeated = np.zeros(len(times), dtype=np.bool_)
    known = np.asarray(np.isfinite(numbers).any(axis=1))
    numbers = np.nan_to_num(numbers)
    same = known[1:] & np.all(numbers[1:] == numbers[:-1], axis=1)
    for start, stop in signals.runs(same):
        if times[stop] - times[start] > _FROZEN:
            repeated[start + 1 : stop + 1] = True
    return repeated


def finish(folder: str | Path) -> tuple[str, ...]:
    """Make a recording of a session's folder, also of one that was killed. `folder`: that a `Recorder` wrote.

    Returns:
        Notes about losses, which the recording has too.

    Raises:
        FileFormatError: it is no folder of a session. OutputExistsError: it is a recording already, or a
            session is at work on it.
        InvalidInputError: nothing usable was recorded. WritingError: it cannot be written.
    """
    folder = Path(folder)
    if (folder / INDEX).exists():
        raise OutputExistsError(f"{folder}: is a recording already; delete {INDEX} to make it again")
    if not (folder / LIVE / SETUP / INDEX).is_file():
        raise FileFormatError(folder, f"no folder of a live session: there is no {LIVE}/{SETUP}/{INDEX}")
    with locked(folder / LIVE) as held:
        if held is False:
            raise OutputExistsError(f"{folder}: a session is recorded there; end it first (Ctrl-C)")
        setup = Recording.load(folder / LIVE / SETUP)
        chunks, notes = _read(folder / LIVE)
        _put(_recording(setup, chunks, notes, folder.name), folder)
    return tuple(notes)


def _read(live: Path) -> tuple[list[Chunk], list[str]]:
    """Return the readable files in their order, and notes about others."""
    chunks, notes = [], []
    for path in sorted(live.glob("[0-9]*.npz")):
        try:
            found = read_npz_as_saved(path, kinds="fiubU")
            chunks.append({name: values for name, values in found.items() if name not in _ESTIMATES})
        except FileFormatError as error:
            notes.append(f"left out: {error}")
    said = [str(text) for chunk in chunks for text in chunk.get("sentences", ())]
    more = [f"and {len(said) - _SAID} more messages in {LIVE}/"] if len(said) > _SAID else []
    return chunks, [*said[:_SAID], *more, *notes]


def _recording(setup: Recording, chunks: Sequence[Chunk], notes: list[str], name: str) -> Recording:
    """Return the recording; what cannot be a part of it is noted."""
    keypoints, imus = _keypoints(setup, chunks, notes), _imus(setup, chunks, notes)
    parts = [part for part in (imus, keypoints) if part is not None]
    if max((part.times[0] for part in parts), default=0.0) > min((part.times[-1] for part in parts), default=0.0):
        notes.append("the video and the sensors were never there at the same time; the video is left out")
        keypoints = None
    if imus is None and keypoints is None:
        raise InvalidInputError(f"session {name}: nothing usable was recorded")
    start = min(float(part.times[0]) for part in (imus, keypoints) if part is not None)
    if imus is not None:
        imus = replace(imus, times=imus.times - start)
    if keypoints is not None:
        keypoints = replace(keypoints, times=keypoints.times - start)
    text = "\n".join(filter(None, (setup.notes, f"live session; its clock was at {start:.6f} s", *notes)))
    return replace(setup, name=name, keypoints=keypoints, imus=imus, notes=text)


# --- video ---------------------------------------------------------------------------------------


def _keypoints(setup: Recording, chunks: Sequence[Chunk], notes: list[str]) -> KeypointSequence | None:
    filmed = [chunk for chunk in chunks if "uv_px" in chunk]
    if not filmed:
        return None
    if setup.keypoints is None:
        notes.append("the video is left out: the setup has no camera")
        return None
    names = tuple(dict.fromkeys(str(name) for chunk in filmed for name in chunk["landmarks"]))
    unknown = unknown_landmarks(names, setup)
    names = tuple(name for name in names if name not in unknown)
    parts = [_selected(chunk, names) for chunk in filmed]
    times, uv, confidence = (np.concatenate(column) for column in zip(*parts, strict=True))
    stream = _Stream.of(times - float(filmed[-1]["video_delay_s"]), uv, confidence)
    if len(stream.times) == 0 or not names:
        return None
    _note(notes, "video", stream)
    uv, confidence = stream.values
    return KeypointSequence(setup.keypoints.camera, stream.times, uv, confidence, names)


def _selected(chunk: Chunk, names: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return times (T,), pixels (T, L, 2) and confidences (T, L) of a file in the order of names."""
    have = [str(name) for name in chunk["landmarks"]]
    T = len(chunk["video_time"])
    uv, confidence = np.full((T, len(names), 2), np.nan), np.zeros((T, len(names)))
    for i, name in enumerate(names):
        if name in have:
            uv[:, i] = chunk["uv_px"][:, have.index(name)]
            confidence[:, i] = chunk["confidence"][:, have.index(name)]
    return np.asarray(chunk["video_time"]), uv, confidence


# --- sensors -------------------------------------------------------------------------------------


def _imus(setup: Recording, chunks: Sequence[Chunk], notes: list[str]) -> ImuSequence | None:
    worn = [chunk for chunk in chunks if "sensors" in chunk]
    names = list(dict.fromkeys(str(name) for chunk in worn for name in chunk["sensors"]))
    unknown = unknown_sensors(names, setup)
    if unknown:
        notes.append(f"left out, as the calibration does not have them: {', '.join(unknown)}")
    order = setup.calibration.sensors if setup.calibration is not None else names
    parts = []
    for name in [name for name in order if name in names]:
        stream = _sensor(name, worn)
        if len(stream.times) < 2:
            notes.append(f"sensor {name}: left out, it has {len(stream.times)} samples")
            continue
        _note(notes, f"sensor {name}", stream)
        try:
            R, f = (value[:, None] for value in stream.values)
            parts.append(ImuSequence(stream.times, R, f, (name,)))
        except RtofError as error:
            notes.append(f"sensor {name}: left out: {error}")
    return _joined(parts) if parts else None


def _sensor(name: str, chunks: Sequence[Chunk]) -> _Stream:
    """Return orientations (T, 3, 3), rotations to the last digit, and specific forces (T, 3)."""
    times, R, f = [], [], []
    for chunk in chunks:
        have = [str(one) for one in chunk["sensors"]]
        mine = chunk["imu_sensor"] == (have.index(name) if name in have else -1)
        times.append(chunk["imu_time"][mine])
        R.append(chunk["R_inertial_sensor"][mine])
        f.append(chunk["f_sensor"][mine])
    stream = _Stream.of(np.concatenate(times), np.concatenate(R), np.concatenate(f))
    rotations, forces = np.full(stream.values[0].shape, np.nan), stream.values[1]
    known = np.isfinite(stream.values[0]).all(axis=(-2, -1))
    exact = stream.values[0][known]
    rotations[known] = exact if so3.is_rotation(exact) else so3.nearest_rotation(exact)
    return replace(stream, values=(rotations, np.where(np.isinf(forces), np.nan, forces)))


def _joined(parts: Sequence[ImuSequence]) -> ImuSequence:
    """Join sensors: at all of their times where they share most of them, else resampled to even times."""
    every = np.sort(np.concatenate([part.times for part in parts]))
    times = every[np.append(True, np.diff(every) > _SAME_SAMPLE)]
    if len(times) > _UNION * max(len(part) for part in parts):
        return ImuSequence.joined(parts)
    R, f = np.full((len(times), len(parts), 3, 3), np.nan), np.full((len(times), len(parts), 3), np.nan)
    for s, part in enumerate(parts):
        at = np.searchsorted(times, part.times + _SAME_SAMPLE / 2) - 1
        R[at, s], f[at, s] = part.R_inertial_sensor[:, 0], part.f_sensor[:, 0]
    return ImuSequence(times, R, f, tuple(name for part in parts for name in part.names))


def _note(notes: list[str], what: str, stream: _Stream) -> None:
    total = len(stream.times) + stream.repeated + stream.lost
    texts = [f"{stream.lost} of {total} samples did not come"] if stream.lost else []
    texts += [f"{stream.repeated} repeated the ones before"] if stream.repeated else []
    texts += [f"{stream.left_out} had no usable time"] if stream.left_out else []
    if texts:
        notes.append(f"{what}: {', '.join(texts)}")


# --- files ---------------------------------------------------------------------------------------


def _put(recording: Recording, folder: Path) -> None:
    """Write the recording's files beside ``live/``; the one that makes it a recording comes last."""
    made = folder / LIVE / _MADE
    shutil.rmtree(made, ignore_errors=True)
    try:
        recording.save(made)
        names = [path.name for path in made.iterdir() if path.name not in (INDEX, MANIFEST)]
        for name in (*names, INDEX):
            os.replace(made / name, folder / name)
        shutil.rmtree(made)
        own = [folder / name for name in (*names, INDEX)]
        write_manifest(folder, INDEX, paths=sorted([*own, *(folder / LIVE).rglob("*")]))
    except BaseException as error:  # what came stays, and it can be tried again
        with suppress(OSError):
            (folder / INDEX).unlink(missing_ok=True)
        shutil.rmtree(made, ignore_errors=True)
        if isinstance(error, OSError | WritingError):
            problem = error.__cause__ or error
            raise WritingError(f"{folder}: cannot be written ({problem}); make room and try again") from error
        raise
