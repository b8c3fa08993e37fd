"""`write_overlay`: a film of a motion, on its video or on a plain background."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_folder
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.folder import check_new_file, new_file
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MEASUREMENTS, measurements_path, read_measurements
from rtof_kin.view.canvas import resized
from rtof_kin.view.film_files import FilmSource, Mp4Writer, check_size, check_times, scale_of
from rtof_kin.view.legend import Verdict, read_verdict
from rtof_kin.view.overlay_settings import OverlaySettings
from rtof_kin.view.painter import Painter
from rtof_kin.view.projected_motion import PictureView, ProjectedMotion, ScaledView, virtual_view

Progress = Callable[[str, int, int], None]
_STAGE: Final = "draw"


@dataclass(frozen=True)
class ResultFiles:
    """Contents of the output folder of a reconstruction that an overlay needs."""

    motion: Motion  #: The motion
    mode: str  #: Mode of the reconstruction
    measurements: Measurements  #: What it was computed from
    verdict: Verdict  #: Of the summary


@dataclass(frozen=True)
class OverlayResult:
    """What was written."""

    path: Path  #: The file
    width_px: int  #: Width of the pictures, px
    height_px: int  #: Height of the pictures, px
    frames: int  #: Number of pictures
    without_motion: int  #: Number of those without a person
    encoder: str  #: Name of the encoder
    notes: tuple[str, ...]  #: What does not fit between video and motion
    verdict: Verdict  #: Of the motion, which is not drawn on the pictures


def read_result(folder: str | Path) -> ResultFiles:
    """Read the output of `reconstruct` or `run`. `FileFormatError`: a file is missing or damaged; of an output of an
    earlier version, the message says what to do.
    """
    folder = motion_folder(folder)
    with MotionReader(folder) as reader:
        motion, mode = reader.read(), reader.mode
    path = measurements_path(folder)
    if not path.is_file():
        raise FileFormatError(
            folder / MEASUREMENTS,
            "is missing, which has the cameras and the times of the video: this "
            "output is of an earlier version; run rtof-kin reconstruct (or run) again",
        )
    measurements = read_measurements(path)
    if not np.array_equal(measurements.times, motion.times):
        raise FileFormatError(path, "is not of the motion.h5 beside it; reconstruct again")
    return ResultFiles(motion, mode, measurements, read_verdict(folder))


def write_overlay(
    folder: str | Path,
    output: str | Path,
    video: str | Path | None = None,
    *,
    view: int = 1,
    settings: OverlaySettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> OverlayResult:
    """Draw a motion on its video, or on a plain background, and write it as an MP4.

    Sound and metadata of the video are not copied.

    `folder`: output of `reconstruct` or `run`. `output`: file to write, .mp4. `video`: that the motion was
    computed from; None for a plain background. `view`: number of the camera, from 1. `overwrite`: replace an existing
    file. `progress`: called with ("draw", pictures done, pictures in all). `RtofError`: an input is missing, damaged or
    does not fit; the output exists or cannot be written.
    """
    settings = settings or OverlaySettings()
    if Path(output).suffix.lower() != ".mp4":
        raise InvalidInputError(f"{output}: its name must end with .mp4")
    check_new_file(output, overwrite)
    result = read_result(folder)
    chosen = choose_view(result, view, video is not None)
    notes: tuple[str, ...] = ()
    times, shift = result.motion.times, 0.0
    if video is None:
        source = FilmSource.plain((chosen.camera.width_px, chosen.camera.height_px), times, settings.background)
    else:
        source, times, shift = FilmSource.of_video(video, chosen), chosen.video_times, settings.shift
        assert source.metadata is not None
        notes = check_size(video, source.size, chosen) + check_times(video, source.metadata, chosen, shift)
    width = settings.width_px or source.size[0]
    size = width, max(round(source.size[1] * width / source.size[0]), 1)
    scale = size[0] / source.size[0] * scale_of(source.size, chosen)
    scaled = ScaledView(chosen, scale, *size, times)
    title = _title(result) if settings.title is None else " ".join(settings.title.split())
    painter = Painter(ProjectedMotion(result.motion, scaled), title, result.measurements.faults, settings)
    with new_file(output, overwrite) as file:
        with Mp4Writer(file, size, source.rate_hz) as writer:
            frames, without = _draw(source, painter, writer, size, shift, settings, progress)
        if frames == 0:
            first = "its beginning" if settings.start is None else f"{settings.start:g} s"
            last = "its end" if settings.stop is None else f"{settings.stop:g} s"
            raise InvalidInputError(f"overlay: no picture is from {first} to {last}; see --from and --to")
    return OverlayResult(Path(output), *size, frames, without, writer.encoder, notes, result.verdict)


def choose_view(result: ResultFiles, number: int, with_video: bool) -> PictureView:
    """Return the camera of a motion, or a virtual one where there was none. `number`: of the camera, from 1.
    `InvalidInputError`: no camera of this number, or none with the geometry of the video.
    """
    views = result.measurements.views
    if not views:
        if with_video:
            raise InvalidInputError(
                f"overlay: this motion (mode {result.mode}) is from sensors alone, so its place in a video "
                "is unknown; leave the video out and say --no-video"
            )
        return virtual_view(result.motion)
    if not 1 <= number <= len(views):
        raise InvalidInputError(f"overlay: there is no camera {number}; give --view from 1 to {len(views)}")
    view = views[number - 1]
    if with_video and view.camera.stabilised and view.turning is None:
        raise InvalidInputError(
            "overlay: the camera was handheld, and its keypoints were stabilised before they were imported, "
            "so where the motion is in the video is unknown; say --no-video"
        )
    return view


def _title(result: ResultFiles) -> str:
    """Return what a motion was computed from, without any name."""
    m = result.measurements
    parts = [("camera", len(m.views)), ("sensor", len(m.sensors))]
    counted = [f"{n} {word}{'s' if n > 1 else ''}" for word, n in parts if n]
    return " and ".join(counted) + f", mode {result.mode}"


def _draw(
    source: FilmSource,
    painter: Painter,
    writer: Mp4Writer,
    size: tuple[int, int],
    shift: float,
    settings: OverlaySettings,
    progress: Progress | None,
) -> tuple[int, int]:
    """Draw all pictures; return their number, and that of those without a person."""
    frames = without = total = 0
    first = -np.inf if settings.start is None else settings.start
    last = np.inf if settings.stop is None else settings.stop
    for picture in source.pictures:
        if picture.time > last:
            total = picture.index
            break
        total = max(picture.total, picture.index + 1)
        if picture.time >= first:
            image = resized(picture.image, size)
            without += not painter.paint(image, picture.time + shift)
            writer.write(image, picture.stamp)
            frames += 1
        if progress is not None:
            progress(_STAGE, picture.index + 1, total)
    if progress is not None and total:
        progress(_STAGE, total, total)
    return frames, without
