"""The command view: a motion, or the live estimator, in 3D in the browser."""

from __future__ import annotations

import argparse
import signal
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from rtof_kin.cli.terminal import STYLES, command, out, progress

if TYPE_CHECKING:
    from rtof_kin.view.viewer import Opened

_NO_ADDRESS: Final = ""
"""Value of --live without an address."""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "view",
        _view,
        "a motion in 3D in the browser, with cameras, sensors, truth and curves",
        "OUT is the output of reconstruct or run. The page is served to this machine only, under an address "
        "with a secret token; nothing leaves it. Ctrl-C ends. Keys: space plays, arrows step by a frame "
        "(left, right) or a second (up, down). Needs the extra: pip install 'rtof-kin[view]'.",
    )
    parser.add_argument("motion", metavar="OUT", nargs="?", help="output folder, or its motion.h5")
    parser.add_argument(
        "--video",
        action="append",
        default=[],
        metavar="FILE",
        help="video of the camera, shown in its frustum; several times for several cameras, in their order",
    )
    parser.add_argument("--second", metavar="OUT_B", help="another motion beside it, e.g. of another setting")
    parser.add_argument(
        "--live",
        nargs="?",
        const=_NO_ADDRESS,
        metavar="ADDRESS",
        help="show rtof-kin live instead; ADDRESS is the one it printed, with its token",
    )
    parser.add_argument("--port", type=int, default=0, help="of the page; 0: a free one")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    _add_page(parser)


def _add_page(parser: argparse.ArgumentParser) -> None:
    page = parser.add_argument_group("one file that opens offline, instead of a server")
    page.add_argument("--html", metavar="FILE", help="file to write")
    page.add_argument("--from", dest="start", type=float, metavar="S", help="begin at this time")
    page.add_argument("--to", dest="stop", type=float, metavar="S", help="end at this time")
    page.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="frames per second, at most")
    page.add_argument(
        "--limit", type=float, default=50.0, metavar="MB", help="of the file; longer motions are thinned out"
    )
    page.add_argument("--overwrite", action="store_true", help="replace what an earlier run wrote there")


def _view(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError

    if (options.motion is None) == (options.live is None):
        raise InvalidInputError("name the output folder of a motion, or --live ADDRESS")
    if options.live is not None:
        if options.html or options.video or options.second:
            raise InvalidInputError("--live shows the live estimator alone; leave out --html, --video, --second")
        _live(options)
    elif options.html is not None:
        if options.video:
            raise InvalidInputError("--html: the file has no video; leave out --video")
        _page(options)
    else:
        _motion(options)


def _motion(options: argparse.Namespace) -> None:
    from rtof_kin.view.local_server import local_server
    from rtof_kin.view.viewer import MotionFiles, MotionViewer

    with ExitStack() as stack:
        files = stack.enter_context(MotionFiles(options.motion, options.second))
        _tell(files, options)
        server = stack.enter_context(local_server(options.port, "rtof_kin view"))
        stop = stack.enter_context(_until_interrupted())
        viewer = stack.enter_context(MotionViewer(server, files, options.video))
        _open(server, options)
        viewer.run(stop)


def _page(options: argparse.Namespace) -> None:
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.view.local_server import local_server
    from rtof_kin.view.static_page import write_static_page
    from rtof_kin.view.viewer import MotionFiles

    check_new_file(options.html, options.overwrite)
    with MotionFiles(options.motion, options.second) as files, local_server() as server:
        _tell(files, options)
        with progress() as update:
            page = write_static_page(
                server,
                files,
                options.html,
                start=options.start,
                stop=options.stop,
                rate_hz=options.rate,
                largest_mb=options.limit,
                overwrite=options.overwrite,
                progress=update,
            )
    thinned = f", thinned out to stay below {options.limit:g} MB" if page.thinned else ""
    out.print(
        f"wrote {page.path}: {page.size_mb:.1f} MB, {page.frames} frames at {page.rate_hz:.3g} Hz{thinned}; "
        "opens in any browser without a network",
        soft_wrap=True,
    )


def _live(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.view.live_client import LiveClient, live_address
    from rtof_kin.view.local_server import local_server
    from rtof_kin.view.viewer import LiveViewer

    if options.live == _NO_ADDRESS:
        raise InvalidInputError(
            "--live: give the address that rtof-kin live ... --out ws printed, e.g. --live "
            "http://127.0.0.1:8765/kq0T.../"
        )
    url = live_address(options.live)
    with LiveClient(url) as client, local_server(options.port, "rtof_kin live") as server:
        out.print(f"shows the estimates of {url}", soft_wrap=True)
        viewer = LiveViewer(server, client)
        with _until_interrupted() as stop:
            _open(server, options)
            viewer.run(stop)


# --- what is said --------------------------------------------------------------------------------


def _tell(files: Opened, options: argparse.Namespace) -> None:
    """Print what is shown."""
    motion, given = files.motion, files.measurements
    parts = [f"{motion.times[-1] - motion.times[0]:.1f} s at {motion.rate_hz:.0f} Hz"]
    if given is not None:
        first = given.first
        parts += [f"{len(first.views)} camera{'s' if len(first.views) > 1 else ''}"] if first.views else []
        parts += [f"{len(first.sensors)} IMUs"] if first.sensors else []
        parts += ["the truth"] if first.truth is not None else []
    if options.second is not None:
        parts.append(f"beside it {options.second}")
    _line("shows", f"{options.motion}: {', '.join(parts)}")
    _line("verdict", files.verdict.line, STYLES.get(files.verdict.grade, ""))
    for note in files.notes:
        _line("missing", note)


def _line(name: str, text: str, style: str = "") -> None:
    out.print(Text(f"{name:9} ", "bold"), Text(text, style), soft_wrap=True, sep="")


def _open(server: Any, options: argparse.Namespace) -> None:
    """Print the address and open the browser."""
    from rtof_kin.view.local_server import address

    url = address(server)
    _line("address", f"{url} (this machine only, to who has this address; Ctrl-C ends)")
    if not options.no_browser:
        webbrowser.open(address(server, once=True))


@contextmanager
def _until_interrupted() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C, or the end of the process, sets."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {kind: signal.signal(kind, lambda *_: stop.set()) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
