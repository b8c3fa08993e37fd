"""`MotionViewer`: a motion of the disk in the browser, served by `local_server` to this machine alone."""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, SourceError
from rtof_kin.core.local_door import LOOPBACK, Door
from rtof_kin.core.packages import install, optional
from rtof_kin.formats.measurements_file import MEASUREMENTS, MeasurementsReader, measurements_path
from rtof_kin.view.blocks import frame_at
from rtof_kin.view.camera_layer import VideoFrames
from rtof_kin.view.controls import Controls, Playback
from rtof_kin.view.curves import AngleBlocks, Curves
from rtof_kin.view.legend import Verdict, read_verdict
from rtof_kin.view.motion_scene import MotionScene

FASTEST: Final = 60.0  #: [Hz] at which frames are sent
_SLIDER_S: Final = 0.1  # Time between two moves of the slider while playing
_CURVES_S: Final = 0.125  # Time between two updates of the curves while playing
_PATIENCE: Final = 20.0  # [s] for the first frame
_OTHER_SHAPE: Final = 0.02  # Largest relative difference of the aspect ratios of a video and its camera


@dataclass(frozen=True)
class Opened:
    """A motion on the disk with all that belongs to it."""

    motion: MotionReader
    measurements: MeasurementsReader | None
    second: MotionReader | None
    verdict: Verdict
    notes: tuple[str, ...]  #: What is not shown, and how to get it


@contextmanager
def motion_files(motion: str | Path, second: str | Path | None = None) -> Iterator[Opened]:
    """Open the files of a viewer and close them at the end. `motion`, `second`: folders or files of motions.
    `FileFormatError`: a file is missing or damaged, or the measurements are of another motion.
    """
    path, notes = motion_path(motion), []
    with ExitStack() as stack:
        opened, measurements = stack.enter_context(MotionReader(path)), None
        if (beside := measurements_path(path.parent)).is_file():
            measurements = stack.enter_context(MeasurementsReader(beside))
            if not np.array_equal(measurements.times, opened.times):
                raise FileFormatError(beside, "is not of the motion.h5 beside it; reconstruct again")
        else:
            notes.append(
                f"No {MEASUREMENTS} beside the motion: no camera, sensors, detected points or truth. "
                "Reconstruct again to get it."
            )
        other = None if second is None else stack.enter_context(MotionReader(motion_path(second)))
        yield Opened(opened, measurements, other, read_verdict(path.parent), tuple(notes))


class MotionViewer(AbstractContextManager["MotionViewer"]):
    """A motion in the browser; `run` plays it until it is stopped."""

    def __init__(self, server: Any, files: Opened, videos: Sequence[str | Path] = ()):
        """Build scene and panel, and show the first frame. `server`: of `local_server`. `files`: of `motion_files`.
        `InvalidInputError`: more videos than cameras; `RtofError`: a file cannot be read.
        """
        self._files, self._closing = files, ExitStack()
        motion, notes = files.motion, files.notes
        with self._closing as failed:
            self.scene = MotionScene(server, motion, files.measurements, files.second)
            failed.callback(self.scene.close)
            self.playback = Playback(float(motion.times[0]), float(motion.times[-1]))
            if not self.scene.stage.measured:
                notes += ("The floor was not given: it is drawn at the lowest point of the first second.",)
            self.controls = Controls(
                server, self.scene, self.playback, motion.rate_hz, files.verdict, notes, bool(videos)
            )
            self._angles = AngleBlocks(motion)
            failed.callback(self._angles.close)
            self.curves = Curves(server, self._angles)
            self._videos = self._open(videos, failed)
            self.scene.show(0, _PATIENCE)
            self._closing = failed.pop_all()
        self._slider_at = self._curves_at = -np.inf
        self._curve_frame: int | None = None
        self.frame = 0
        self.sent = 0
        """Number of frames that were sent to the browsers."""

    def __exit__(self, *_: object) -> None:
        """Stop all threads."""
        self._closing.close()

    def run(self, stop: threading.Event) -> None:
        """Show the present frame, at most 60 times a second, until an event is set.

        Raises:
            RtofError: a file turned out to be damaged.
        """
        step = 1 / FASTEST
        due = time.monotonic()
        while not stop.is_set():
            self.update(time.monotonic())
            due = max(due + step, time.monotonic() - step)
            stop.wait(max(due - time.monotonic(), 0.001))

    def update(self, now: float) -> None:
        """Show the frame of a moment, if it is another one. `now`: of `time.monotonic`, s."""
        wanted = self.playback.at(now)
        frame = frame_at(self._files.motion.times, wanted)
        if frame != self.frame or self.controls.changed:
            self._show(frame, wanted, now)
        time_shown = float(self._files.motion.times[self.frame])
        if now - self._slider_at > _SLIDER_S or not self.playback.playing:
            self._slider_at = now
            self.controls.show_time(time_shown)
            self.controls.show_playing()
        self._show_curves(time_shown, now)

    # --- what is shown ---------------------------------------------------------------------------

    def _show(self, frame: int, wanted: float, now: float) -> None:
        self.controls.changed = False
        block = self.scene.show(frame)
        motion = self._files.motion
        if block is None:
            self.controls.changed = True
            self.playback.seek(wanted, now)
            self.controls.tell("loading")
            return
        self.frame, i = frame, frame - block.motion.start
        self.sent += 1
        unknown = self.scene.person.unknown_positions(block.motion, i)
        text = f"frame {frame} of {len(motion)}, {motion.times[frame]:.3f} s"
        if unknown:
            text += f"; {unknown} positions are unknown by more than 2 m and have no ellipsoid"
        self.controls.tell(text)
        for number, video in self._videos.items():
            if video.problem is not None:
                self.controls.tell(str(video.problem))
            elif np.isfinite(at := block.cameras[number].video_times[i]):
                video.request(float(at))

    def _show_curves(self, time_shown: float, now: float) -> None:
        if self.frame == self._curve_frame and not self.curves.changed:
            return
        if now - self._curves_at < _CURVES_S:
            return
        self._curves_at = now
        if self.curves.show(self.frame, time_shown):
            self._curve_frame, self.curves.changed = self.frame, False

    def _open(self, videos: Sequence[str | Path], opened: ExitStack) -> dict[int, VideoFrames]:
        """Return the videos by camera; they are closed with `opened`."""
        cameras = self.scene.cameras
        if len(videos) > len(cameras):
            raise InvalidInputError(
                f"{len(videos)} videos, but the motion has {len(cameras)} cameras"
                + ("" if self._files.measurements else f" ({MEASUREMENTS} is missing; reconstruct again)")
            )
        found: dict[int, VideoFrames] = {}
        for number, path in enumerate(videos):
            layer = cameras[number]
            found[number] = opened.enter_context(VideoFrames(path, layer.show_image))
            width, height = found[number].size
            if abs(width / height * layer.camera.height_px / layer.camera.width_px - 1) > _OTHER_SHAPE:
                raise InvalidInputError(
                    f"{path}: its images are {width} x {height} px, of another shape than those of the camera; "
                    "give the video of this recording"
                )
        return found


_DOORS: Final = WeakKeyDictionary[Any, Door]()
_LOG: Final = logging.getLogger("rtof_kin.view.viewer.server")
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False  # else what a client sends wrongly is printed with a traceback


@contextmanager
def local_server(port: int = 0, title: str = "rtof_kin") -> Iterator[Any]:
    """Yield a `viser.ViserServer` at the loopback address that is stopped at the end.

    It cannot be shared over viser's public relay, and answers only who knows its `address`, see
    `rtof_kin.core.local_door`.

    `port`: TCP port; 0: a free one. `SourceError`: the port is taken; `RtofError`: the extra is not installed.
    """
    viser = optional("viser", "view")
    if not 0 <= port < 1 << 16:
        raise SourceError(f"port {port}: a port is a number from 1 to 65535, or 0 for a free one")
    door = Door()
    with redirect_stdout(io.StringIO()), _guarded(door) as guarded:  # only the command line prints
        server = viser.ViserServer(host=LOOPBACK, port=port, label=title, verbose=False)
    try:
        if port and server.get_port() != port:
            raise SourceError(f"{LOOPBACK}:{port}: taken; end the other program, or give another port")
        try:
            assert guarded, "it is served in another way"
            _keep_local(server)
        except (AttributeError, AssertionError, RtofError) as error:  # viser's own names have changed
            raise RtofError(
                f"this version of viser cannot be kept to this machine ({error}): {install('view')} viser==1.1.1"
            ) from error
        _DOORS[server] = door
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any, once: bool = False) -> str:
    """Return the address of the page, with its secret token.

    `server`: of `local_server`. once: the one that leads there once, to start a browser with.
    """
    door = _DOORS[server]
    return f"http://{LOOPBACK}:{server.get_port()}{door.ticket if once else door.path}"


@contextmanager
def _guarded(door: Door) -> Iterator[list[int]]:
    """Have viser, which offers no way to do so, serve behind a door; yields the ports of servers."""
    websockets = optional("websockets.asyncio.server", "view")
    serve, ports = websockets.serve, list[int]()

    def behind(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            refused = door.answer(request)
            return process_request(connection, request) if refused is None else refused

        ports.append(port)
        return serve(handler, host, port, process_request=answer, logger=_LOG, **options)

    websockets.serve = behind
    try:
        yield ports
    finally:
        websockets.serve = serve


def _keep_local(server: Any) -> None:
    """Take away the relay, and let no error of a client reach the terminal."""
    messages = optional("viser._messages", "view")
    connections = server._websock_server
    for kind in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        connections.unregister_handler(kind)
    loop = connections._background_event_loop
    loop.call_soon_threadsafe(loop.set_exception_handler, lambda *_: None)
