"""`write_overlay`: a film of a motion, on its video or on a plain background."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.folder import check_new_file, new_file
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MEASUREMENTS, MeasurementsReader
from rtof_kin.view.canvas import resized
from rtof_kin.view.film_files import FilmSource, Mp4Writer, check_size, check_times, scale_of
from rtof_kin.view.legend import Verdict
from rtof_kin.view.overlay_settings import OverlaySettings
from rtof_kin.view.painter import Painter
from rtof_kin.view.projected_motion import PictureView, ProjectedMotion, virtual_view
from rtof_kin.view.viewer import motion_files
from rtof_kin.vision.video import Progress


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
    with motion_files(folder) as result:
        if (measurements := result.measurements) is None:
            raise FileFormatError(
                result.motion.path.with_name(MEASUREMENTS),
                "is missing, which has the cameras and the times of the video: this "
                "output is of an earlier version; run rtof-kin reconstruct (or run) again",
            )
        chosen = choose_view(result.motion, measurements, view, video is not None)
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
        projected, facts = ProjectedMotion(result.motion, chosen.scaled(scale, size, times)), measurements.read(0, 1)
        title = _title(facts, result.motion.mode) if settings.title is None else " ".join(settings.title.split())
        painter = Painter(projected, title, facts.faults, settings)
        with new_file(output, overwrite) as file:
            with Mp4Writer(file, size, source.rate_hz) as writer:
                frames, without = _draw(source, painter, writer, size, shift, settings, progress)
            if frames == 0:
                first = "its beginning" if settings.start is None else f"{settings.start:g} s"
                last = "its end" if settings.stop is None else f"{settings.stop:g} s"
                raise InvalidInputError(f"overlay: no picture is from {first} to {last}; see --start and --stop")
        return OverlayResult(Path(output), *size, frames, without, writer.encoder, notes, result.verdict)


def choose_view(motion: MotionReader, measurements: MeasurementsReader, number: int, with_video: bool) -> PictureView:
    """Return the camera of a motion, or a virtual one where there was none. `number`: of the camera, from 1.
    `InvalidInputError`: no camera of this number, or none with the geometry of the video.
    """
    views = measurements.read(0, 1).views
    if not views:
        if with_video:
            raise InvalidInputError(
                f"overlay: this motion (mode {motion.mode}) is from sensors alone, so its place in a video "
                "is unknown; leave the video out and say --no-video"
            )
        return virtual_view(motion)
    if not 1 <= number <= len(views):
        raise InvalidInputError(f"overlay: there is no camera {number}; give --view from 1 to {len(views)}")
    if with_video and views[number - 1].camera.stabilised and views[number - 1].turning is None:
        raise InvalidInputError(
            "overlay: the camera was handheld, and its keypoints were stabilised before they were imported, "
            "so where the motion is in the video is unknown; say --no-video"
        )
    return PictureView.of(measurements, number - 1)


def _title(m: Measurements, mode: str) -> str:
    """Return what a motion was computed from, without any name."""
    parts = [("camera", len(m.views)), ("sensor", len(m.sensors))]
    counted = [f"{n} {word}{'s' if n > 1 else ''}" for word, n in parts if n]
    return " and ".join(counted) + f", mode {mode}"


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
            progress("draw", picture.index + 1, total)
    if progress is not None and total:
        progress("draw", total, total)
    return frames, without
