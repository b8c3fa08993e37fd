"""The command overlay: a film of a motion on its video."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rtof_kin.cli.terminal import STYLES, add_output, command, err, out, progress

_OTHERS = (
    "only the tracked person's face is made unrecognisable, not those of other people, nor clothes, gait or the place"
)


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    from rtof_kin.view.overlay_settings import BACKGROUNDS

    parser = command(
        commands,
        "overlay",
        _overlay,
        "draw a motion on its video, as an MP4 or GIF",
        "Skeleton coloured by what observed it, and none where nothing did; angles with their 95 % bands, "
        "faults of sensors while they last, and time. Prints the verdict on the motion. Sound and metadata "
        "of the video (place, date, device) are not copied. Nothing leaves this machine.",
    )
    parser.add_argument("motion", metavar="OUT", help="output folder of reconstruct or run")
    parser.add_argument("video", metavar="VIDEO", nargs="?", help="that the motion was computed from, uncropped")
    add_output(parser, None, "file to write: .mp4, or .gif for slides")
    add = parser.add_argument
    add("--no-video", action="store_true", help="plain background in place of the video, for privacy")
    add("--background", choices=BACKGROUNDS, default="white", help="colour with --no-video")
    add(
        "--blur-face",
        action="store_true",
        help=f"pixelate the face, and the whole picture where its place is uncertain: {_OTHERS}",
    )
    add(
        "--angles",
        type=_names,
        metavar="NAMES",
        default=None,
        help="angles to label, e.g. right_knee_flexion,left_hip_adduction, or none; default: flexion of "
        "knees, hips and elbows where it is observed",
    )
    add("--bands", action="store_true", help="95 %% ellipse of every joint's position in the image")
    add("--points", action="store_true", help="crosses at the detected points")
    add("--title", metavar="TEXT", help="beside the time; default: cameras, sensors and mode")
    add("--view", type=int, default=1, metavar="N", help="camera of VIDEO, the first is 1")
    add(
        "--shift",
        type=float,
        default=0.0,
        metavar="S",
        help="how much later VIDEO begins than the video that people were detected in, s",
    )
    add("--from", type=float, dest="start", metavar="S", help="begin there, s of VIDEO")
    add("--to", type=float, dest="stop", metavar="S", help="end there, s of VIDEO")
    add("--width", type=int, metavar="PX", help="of the pictures; default: the video's, 480 for a GIF")


def _names(text: str) -> tuple[str, ...]:
    return () if text.strip() == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def _overlay(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.view.film import write_overlay
    from rtof_kin.view.overlay_settings import OverlaySettings

    if options.video is None and not options.no_video:
        raise InvalidInputError("overlay: name the VIDEO of this motion, or say --no-video")
    if options.video is not None and options.no_video:
        raise InvalidInputError("overlay: leave out the VIDEO, or --no-video")
    settings = OverlaySettings(
        angles=options.angles,
        bands=options.bands,
        points=options.points,
        blur_face=options.blur_face,
        title=options.title,
        background=options.background,
        shift=options.shift,
        start=options.start,
        stop=options.stop,
        width_px=options.width,
    )
    with progress() as update:
        result = write_overlay(
            options.motion,
            options.output,
            options.video,
            view=options.view,
            settings=settings,
            overwrite=options.overwrite,
            progress=update,
        )
    for note in result.notes:
        err.print(f"warning: {note}", style="yellow", soft_wrap=True)
    _print_result(result, options.video is not None and options.blur_face)


def _print_result(result: Any, blurred: bool) -> None:
    size = Path(result.path).stat().st_size / 1e6
    out.print(
        f"wrote {result.path}: {result.frames} pictures of {result.width_px} x {result.height_px} px, "
        f"{size:.1f} MB, {result.encoder}; no sound, no metadata of the video",
        soft_wrap=True,
    )
    if result.without_motion:
        out.print(
            f"{result.without_motion} pictures have no skeleton: nobody is observed, or they are outside the motion",
            soft_wrap=True,
        )
    out.print(f"motion    {result.verdict.line}", style=STYLES.get(result.verdict.grade, ""), soft_wrap=True)
    if result.encoder == "mpeg4":
        out.print("this PyAV cannot encode H.264: the file is MPEG-4 part 2, which browsers do not play")
    if blurred:
        out.print(f"faces: {_OTHERS}; look at the whole film before you pass it on", soft_wrap=True)
