"""Commands that look at a motion: view in 3D, overlay on its video."""

from __future__ import annotations

import threading
import webbrowser
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rtof_kin.cli.options import Browser, Fields, File, Fps, Overwrite, Start, Stop, command
from rtof_kin.cli.terminal import STYLES, ended_by_signals, line, progress, remark, say
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.view.overlay_settings import OverlaySettings

if TYPE_CHECKING:
    from rtof_kin.view.viewer import Opened

Page = Parameter(group="One file that opens offline, instead of a server")


@command
def view(
    motion: Path,
    /,
    *,
    video: list[Path] | None = None,
    beside: Annotated[Path | None, Parameter(metavar="OUT_B")] = None,
    port: Annotated[int, Parameter(metavar="N")] = 0,
    browser: Browser = True,
    html: Annotated[Path | None, Page, Parameter(metavar="FILE")] = None,
    start: Annotated[Start, Page] = None,
    stop: Annotated[Stop, Page] = None,
    fps: Annotated[Fps, Page] = 30.0,
    limit: Annotated[float, Page, Parameter(metavar="MB")] = 50.0,
    overwrite: Annotated[Overwrite, Page] = False,
) -> None:
    """A motion in 3D in the browser, with cameras, sensors, truth and curves.

    The page is served to this machine only, under an address with a secret token; nothing leaves it. Ctrl-C ends.
    Keys: space plays, arrows step by a frame (left, right) or a second (up, down). Needs the extra: pip install
    'rtof-kin[view]'.

    Args:
        motion: output folder of reconstruct or run, or its motion.h5
        video: video of the camera, shown in its frustum; several times for several cameras, in their order
        beside: another motion beside it, e.g. of another setting
        port: of the page; 0: a free one
        html: file to write
        limit: size of the file; longer motions are thinned out
    """
    if html is not None and video:
        raise InvalidInputError("--html: the file has no video; leave out --video")
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.view.static_page import write_static_page
    from rtof_kin.view.viewer import MotionViewer, address, local_server, motion_files

    with ExitStack() as stack:
        if html is not None:
            check_new_file(html, overwrite)
        files = stack.enter_context(motion_files(motion, beside))
        _print_files(files, motion, beside)
        if html is None:
            server = stack.enter_context(local_server(port, "rtof_kin view"))
            with ended_by_signals(), suppress(KeyboardInterrupt), MotionViewer(server, files, video or []) as viewer:
                line("address", f"{address(server)} (this machine only, to who has this address; Ctrl-C ends)")
                if browser:
                    webbrowser.open(address(server, once=True))
                viewer.run(threading.Event())
            return
        server, update = stack.enter_context(local_server()), stack.enter_context(progress())
        page = write_static_page(
            server,
            files,
            html,
            start=start,
            stop=stop,
            rate_hz=fps,
            largest_mb=limit,
            overwrite=overwrite,
            progress=update,
        )
    thinned = f", thinned out to stay below {limit:g} MB" if page.thinned else ""
    say(
        f"wrote {page.path}: {page.size_mb:.1f} MB, {page.frames} frames at {page.rate_hz:.3g} Hz{thinned}; "
        "opens in any browser without a network"
    )


def _print_files(files: Opened, folder: Path, beside: Path | None) -> None:
    """Print what is shown."""
    motion, given = files.motion, files.measurements
    parts = [f"{motion.times[-1] - motion.times[0]:.1f} s at {motion.rate_hz:.0f} Hz"]
    if given is not None:
        first = given.read(0, 1)
        parts += [f"{len(first.views)} camera{'s' if len(first.views) > 1 else ''}"] if first.views else []
        parts += [f"{len(first.sensors)} IMUs"] if first.sensors else []
        parts += ["the truth"] if first.truth is not None else []
    if beside is not None:
        parts.append(f"beside it {beside}")
    line("shows", f"{folder}: {', '.join(parts)}")
    line("verdict", files.verdict.line, STYLES.get(files.verdict.grade, ""))
    for note in files.notes:
        line("missing", note)


@command
def overlay(
    motion: Path,
    video: Path | None = None,
    /,
    *,
    output: File,
    no_video: bool = False,
    settings: Annotated[
        OverlaySettings,
        Fields("start stop angles bands points blur_face title background", shift="video-shift", width_px="width"),
    ],
    view: Annotated[int, Parameter(metavar="N")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Draw a motion on its video, as an MP4.

    Skeleton coloured by what observed it, and none where nothing did; angles with their 95 % bands, faults of sensors
    while they last, and time. Prints the verdict on the motion. Sound and metadata of the video (place, date, device)
    are not copied. Nothing leaves this machine. With --blur-face only the tracked person's face is made
    unrecognisable, not those of other people, nor clothes, gait or the place.

    Args:
        motion: output folder of reconstruct or run
        video: that the motion was computed from, uncropped
        no_video: plain background in place of the video, for privacy
        view: camera of VIDEO, the first is 1
    """
    from rtof_kin.view.film import write_overlay

    if (video is None) != no_video:
        raise InvalidInputError("overlay: name the VIDEO of this motion, or give --no-video")
    with progress() as update:
        result = write_overlay(
            motion, output, video, view=view, settings=settings, overwrite=overwrite, progress=update
        )
    for note in result.notes:
        remark(f"warning: {note}", style="yellow")
    size = Path(result.path).stat().st_size / 1e6
    say(
        f"wrote {result.path}: {result.frames} pictures of {result.width_px} x {result.height_px} px, "
        f"{size:.1f} MB, {result.encoder}; no sound, no metadata of the video"
    )
    if result.without_motion:
        say(f"{result.without_motion} pictures have no skeleton: nobody is observed, or they are outside the motion")
    say(f"motion    {result.verdict.line}", style=STYLES.get(result.verdict.grade, ""))
    if video is not None and settings.blur_face:
        say(
            "faces: only the tracked person's face is made unrecognisable, not those of other people, nor clothes, "
            "gait or the place; look at the whole film before you pass it on"
        )
