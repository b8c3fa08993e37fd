"""Long recordings: reconstructed part by part, in bounded memory, and several parts at once on several cores.

Parts overlap by a margin that the lifter, the filters and the fragments forget, and begin where a fragment of the
whole begins, so the frames that are kept are those of a reconstruction in one piece but for what is estimated from a
part as a whole (outliers, inflation of covariances). Calibration and an unknown camera are estimated once, before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count, pairwise
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.array_types import Array, Index, blocks_of
from rtof_kin.core.choices import MODES, Mode
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError, RtofError, UnknownNameError
from rtof_kin.core.jobs import in_order, is_shared
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.part_results import Seam, cut, lost, sample
from rtof_kin.reconstruction.pipeline import explaining, run
from rtof_kin.reconstruction.prepare import Job, Progress, even_times, silent
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import Given, SetupEstimate, estimate_setup, excerpt
from rtof_kin.reconstruction.sensors_alone import frame_times
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording, RecordingSource

PART_SECONDS: Final = 30.0  #: [s] Length of a part without its margins
MARGIN_SECONDS: Final = 2.0  #: [s] by which a part is longer at either end, or two fragments where these are longer
LONG_SECONDS: Final = 120.0  #: [s] Recordings beyond this are reconstructed in parts, see `is_long`
_STEP_SECONDS: Final = 2.0  #: [s] by which video and sensors may be out of step
_SLICES: Final = 12
_SLICE_SECONDS: Final = 4.0  #: Number and length [s] of the slices of a recording by which it is calibrated
_FEW_HZ: Final = 5.0  #: Frames per second that show where in a recording the person is and moves


@dataclass(frozen=True)
class Part:
    """Frames of a part, of the whole recording."""

    start: int
    stop: int  #: Frames [start, stop) that are kept
    first: int
    last: int  #: Frames [first, last) with the margins

    @property
    def kept(self) -> slice:
        """Frames that are kept, counted from `first`."""
        return slice(self.start - self.first, self.stop - self.first)


def parts_of(frames: int, rate_hz: float, step: int, seconds: float = PART_SECONDS) -> list[Part]:
    """Return the parts of a recording, borders at multiples of frames; the last has half of `seconds` at least."""
    length = max(round(seconds * rate_hz / step), 1) * step
    margin = max(-(-round(MARGIN_SECONDS * rate_hz) // step), 4) * step
    borders = [*range(0, max(frames - length // 2, 1), length), frames]
    return [Part(a, b, max(a - margin, 0), min(b + margin, frames)) for a, b in pairwise(borders)]


def is_long(source: RecordingSource) -> bool:
    """Return whether a recording is reconstructed in parts: if longer than `LONG_SECONDS`, unless of a camera
    in the hand whose heading drifts, which is known only relative to the mean over what is solved.
    """
    if source.stop_s - source.start_s <= LONG_SECONDS:
        return False
    seen = source.between(source.start_s, source.start_s).keypoints
    return seen is None or not seen.camera.heading_drift


def reconstruct_in_parts(
    source: RecordingSource,
    skeleton: SkeletonModel | None = None,
    mode: Mode | None = None,
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool = False,
    priors: CalibrationPriors | None = None,
    calibration: SelfCalibration | None = None,
    known: SelfCalibration | None = None,
    progress: Progress | None = None,
    seconds: float | None = None,
) -> Iterator[Reconstruction]:
    """Yield the reconstruction of a recording part by part: one part, unless it is long.

    Parts follow one another without a gap, their configurations are continuous. A part that cannot be reconstructed,
    e.g. because nobody is seen, has poses of NaN and a warning that says why. `RtofError`: no part can be
    reconstructed; the error of the first one. Errors of the calibration, and those of `reconstruct`.
    Inside `core.jobs.work_shared`, processes of one thread each solve parts side by side; the result is the same to
    the bit where this process has one thread, too.

    Args:
        skeleton, mode, lifter, settings, calibrate, priors, calibration, known: as for `reconstruct`.
        progress: called with (stage, steps done, steps in all); stage 'parts' counts the parts.
        seconds: length of a part. Default: `PART_SECONDS`, and one part where the recording is not `is_long`.
    """
    mode = source.usual_mode if mode is None else mode
    if mode not in MODES:
        raise UnknownNameError("mode", [mode], MODES)
    if priors is not None and (calibration is not None or not calibrate):
        raise InvalidInputError("priors: of a calibration that is not made; give calibrate=True alone")
    given = Given(calibrate, priors, calibration, known)
    if seconds is None and not is_long(source):
        job = Job.of(source.whole(), skeleton, lifter, settings, progress)
        with explaining(job):
            setup = estimate_setup(job, mode, given)
        yield run(job, mode, setup).scored()
        return
    settings, report = settings or ReconstructionSettings(), progress or silent
    times = _frame_times(source, mode)
    rate_hz = float(1 / np.median(np.diff(times)))
    parts = parts_of(len(times), rate_hz, settings.frames // 2, seconds or PART_SECONDS)
    job = Job.of(_between(source, times[: parts[0].stop]), skeleton, lifter, settings, progress)
    with explaining(job):
        seen = cache(partial(_thinned, source))
        setup = estimate_setup(job, mode, given, *_excerpts(source, job, mode, seen))
    certified, spans = -1, [times[part.start : part.stop] for part in parts]
    if settings.certificate:
        certified = len(parts) // 2 if source.frame_times is None else _liveliest(seen(), spans)
    one = replace(job, progress=silent) if is_shared() else job

    def task(number: int, part: Part) -> Callable[[], Reconstruction] | RtofError:
        """Return what solves a part, or why it cannot be read."""
        own, of_part = times[part.first : part.last], replace(job.settings, certificate=number == certified)
        once = replace(setup, warnings=setup.warnings if number == 0 else ())
        try:
            recording = _with_sensors(_between(source, own), job.recording)
        except RtofError as error:
            return error
        return partial(_part_run, replace(one, recording=recording, times=own, settings=of_part), mode, once, part)

    missing, seam, like = list[tuple[Array, RtofError]](), Seam(), None
    report("parts", 0, len(parts))
    solved = in_order(map(task, count(), parts))
    for done, (part, found) in enumerate(zip(parts, solved, strict=True), start=1):
        report("parts", done, len(parts))
        if isinstance(found, RtofError):
            missing.append((times[part.start : part.stop], found))
            continue
        like = like or sample(found)
        yield from _lost(like, source, job, setup, missing)
        missing, kept = [], seam.continued(found, part.kept, part.first)
        del found
        yield kept
        del kept
        return_free_memory()  # before the next part
    if like is None:
        raise missing[0][1]
    yield from _lost(like, source, job, setup, missing)


def _part_run(job: Job, mode: Mode, setup: SetupEstimate, part: Part) -> Reconstruction:
    """Solve a part; return the frames that are kept, but all with a path of the root, which `Seam` continues."""
    found = run(job, mode, setup)
    return found if found.root_sigma is not None else cut(found, part.kept, part.first)


def _liveliest(seen: KeypointSequence, spans: Sequence[Array]) -> int:
    """Return the number of the part whose points move most in the image."""
    part = np.searchsorted([times[-1] for times in spans[:-1]], seen.times[1:])
    return int(np.argmax(np.bincount(part, _moves(seen), len(spans))))


def _moves(keypoints: KeypointSequence) -> Array:
    """(T - 1,) px by which all points move from one frame to the next."""
    parts = (np.diff(keypoints.uv_px[rows.start : rows.stop + 1], axis=0) for rows in blocks_of(len(keypoints) - 1))
    return np.concatenate([np.zeros(0), *(np.nan_to_num(np.abs(part)).sum(axis=(1, 2)) for part in parts)])


def moved_in(keypoints: KeypointSequence, seconds: float) -> tuple[Array, Index]:
    """Return, for each frame, the px (T,) by which all points move in some seconds from it on, and their last frame."""
    so_far = np.concatenate([[0.0], np.cumsum(_moves(keypoints))])
    last = np.searchsorted(keypoints.times, keypoints.times + seconds, "right") - 1
    return so_far[last] - so_far, last


def _frame_times(source: RecordingSource, mode: Mode) -> Array:
    """(T,) s of all frames, evenly spaced."""
    if mode != "imu":
        if source.frame_times is None:
            raise InvalidInputError(f"mode {mode} needs keypoints and the recording has none; use 'imu'")
        return even_times(source.frame_times)
    first, last = (_between(source, np.array([end])).imus for end in (source.start_s, source.stop_s))
    if first is None or last is None:
        raise InvalidInputError("mode imu needs IMUs and the recording has none; use 'lift' or 'rto'")
    return frame_times(first, stop=float(last.times[-1]))


def _between(source: RecordingSource, times: Array) -> Recording:
    """The recording during some frames, and a little longer, as video and sensors may be out of step."""
    return source.between(float(times[0]) - _STEP_SECONDS, float(times[-1]) + _STEP_SECONDS)


def _with_sensors(recording: Recording, first: Recording) -> Recording:
    """A part in which the sensors of the first one have no samples, with missing ones: the camera goes on."""
    if recording.imus is not None or first.imus is None:
        return recording
    few = first.imus[:2]
    R, f = np.full_like(few.R_inertial_sensor, np.nan), np.full_like(few.f_sensor, np.nan)
    times = recording.video.times[[0, -1]]
    return replace(recording, imus=replace(few, times=times, R_inertial_sensor=R, f_sensor=f))


def _lost(
    like: Reconstruction,
    source: RecordingSource,
    job: Job,
    setup: SetupEstimate,
    missing: Iterable[tuple[Array, RtofError]],
) -> Iterator[Reconstruction]:
    """Parts that could not be reconstructed."""

    def corrected(**of_part: Any) -> Job:
        return setup.corrected(replace(job, **of_part)).calibrated(setup.calibration)

    for times, error in missing:
        recording, on_clock = like.recording, corrected(times=times).times
        assert on_clock is not None
        with suppress(RtofError):  # nothing was recorded
            part = _with_sensors(_between(source, times), job.recording)
            recording = corrected(times=times, recording=part).recording
        yield lost(like, recording, on_clock, str(error))


def _excerpts(
    source: RecordingSource, job: Job, mode: Mode, thinned: Callable[[], KeypointSequence]
) -> tuple[list[Job], Job]:
    """Jobs by which clocks and calibration of a long recording are estimated, and the one for its camera."""
    sensed, keypoints = job.sensed(mode), job.recording.keypoints
    if mode == "imu" or keypoints is None or not (sensed or keypoints.camera.uncertainty is not None):
        return [], job
    seen = thinned()
    slices = [_between(source, times) for times in _lively_slices(seen)] if sensed else []
    filmed = _between(source, excerpt(seen).times) if keypoints.camera.uncertainty is not None else job.recording
    return [replace(job, recording=recording) for recording in slices], replace(job, recording=filmed)


def _thinned(source: RecordingSource) -> KeypointSequence:
    """The keypoints of the whole recording, at most `_FEW_HZ` frames a second."""
    every, begin, found = max(1, round(source.rate_hz / _FEW_HZ)), source.start_s, list[KeypointSequence]()
    while begin <= source.stop_s:
        stop = begin + PART_SECONDS
        with suppress(InvalidInputError):  # nothing was recorded
            if (seen := source.between(begin, stop).keypoints) is not None:
                found.append(replace(seen[::every], own_times=None, turning=None))
        begin = np.nextafter(stop, np.inf)
    return replace(
        found[0],
        times=np.concatenate([few.times for few in found]),
        uv_px=np.concatenate([few.uv_px for few in found]),
        confidence=np.concatenate([few.confidence for few in found]),
    )


def _lively_slices(keypoints: KeypointSequence) -> Iterator[Array]:
    """Yield times of short slices in which the points move most, one of each equal part with any motion."""
    times, (moved, last) = keypoints.times, moved_in(keypoints, _SLICE_SECONDS)
    for part in np.array_split(np.flatnonzero(times <= times[-1] - _SLICE_SECONDS), _SLICES):
        if len(part) and moved[first := part[np.argmax(moved[part])]] > 0:
            yield times[first : last[first] + 1]
