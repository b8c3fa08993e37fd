"""`Viewer`: a source in the browser, recorded (`MotionViewer`) or live (`LiveViewer`)."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.measurements_file import MEASUREMENTS, MeasurementsReader, measurements_path
from rtof_kin.view.block_content import block_content
from rtof_kin.view.blocks import frame_at
from rtof_kin.view.camera_layer import VideoFrames
from rtof_kin.view.controls import Controls, Playback
from rtof_kin.view.curves import AngleBlocks, Curves
from rtof_kin.view.layers import Person, RootPath
from rtof_kin.view.legend import PALETTE, Verdict, legend_html, read_verdict, sentences_html
from rtof_kin.view.live_client import LiveClient
from rtof_kin.view.motion_scene import MotionScene, Stage

FASTEST: Final = 60.0  #: [Hz] at which frames are sent
_SLIDER_S: Final = 0.1  # Time between two moves of the slider while playing
_CURVES_S: Final = 0.125  # Time between two updates of the curves while playing
_PATIENCE: Final = 20.0  # [s] for the first frame
_PATH_S: Final = 60.0  # [s] of the root's path
_PATH_STEP: Final = 0.1  # [s] between two points of it
_OLD: Final = 1.0  # [s] without an estimate after which the viewer says so


@dataclass(frozen=True)
class Opened:
    """A motion on the disk with all that belongs to it."""

    motion: MotionReader
    measurements: MeasurementsReader | None
    second: MotionReader | None
    verdict: Verdict
    notes: tuple[str, ...]  #: What is not shown, and how to get it


class MotionFiles:
    """The files of a viewer; a context that opens and closes them."""

    def __init__(self, motion: str | Path, second: str | Path | None = None):
        self._path = motion_path(motion)
        self._second = None if second is None else motion_path(second)
        self._stack = ExitStack()

    def __enter__(self) -> Opened:
        with ExitStack() as stack:
            folder, notes = self._path.parent, []
            motion = stack.enter_context(MotionReader(self._path))
            measurements = None
            if (beside := measurements_path(folder)).is_file():
                measurements = stack.enter_context(MeasurementsReader(beside))
            else:
                notes.append(
                    f"No {MEASUREMENTS} beside the motion: no camera, sensors, detected points or truth. "
                    "Reconstruct again to get it."
                )
            second = None
            if self._second is not None:
                second = stack.enter_context(MotionReader(self._second))
            self._stack = stack.pop_all()
            return Opened(motion, measurements, second, read_verdict(folder), tuple(notes))

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class Viewer(ABC):
    """Scene and panel of a source; `run` shows what it has until it is stopped."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, stop: threading.Event) -> None:
        """Show the present state, at most 60 times a second, until an event is set.

        Raises:
            RtofError: a file turned out to be damaged.
        """
        step = 1 / FASTEST
        due = time.monotonic()
        while not stop.is_set():
            self.update(time.monotonic())
            due = max(due + step, time.monotonic() - step)
            stop.wait(max(due - time.monotonic(), 0.001))

    @abstractmethod
    def update(self, now: float) -> None:
        """Show what belongs to this moment, if it is new. `now`: of `time.monotonic`, s.

        Raises:
            RtofError: a file turned out to be damaged.
        """

    def close(self) -> None:  # noqa: B027
        """Stop all threads."""


class MotionViewer(Viewer):
    """A motion in the browser; `run` plays it until it is stopped."""

    def __init__(self, server: Any, files: Opened, videos: Sequence[str | Path] = ()):
        """Build scene and panel, and show the first frame. `server`: of `local_server`. files: of `MotionFiles`.

        Raises:
            InvalidInputError: more videos than cameras. RtofError: a file cannot be read.
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

    def update(self, now: float) -> None:
        """Show the frame of this moment, if it is another one."""
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

    def close(self) -> None:
        """Stop all threads."""
        self._closing.close()

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
            elif np.isfinite(at := block.video_times[number][i]):
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
            _check_shape(found[number], layer.camera.width_px / layer.camera.height_px)
        return found


def _check_shape(video: VideoFrames, aspect: float) -> None:
    """Raise `InvalidInputError` unless the images have the shape of the camera's."""
    width, height = video.size
    if abs(width / height / aspect - 1) > 0.02:
        raise InvalidInputError(
            f"{video.path}: its images are {width} x {height} px, of another shape than those of the camera; "
            "give the video of this recording"
        )


class LiveViewer(Viewer):
    """Scene of a live estimator; `run` shows its newest pose until it is stopped.

    Attributes:
        shown: number of poses that were shown.
    """

    def __init__(self, server: Any, client: LiveClient):
        """Build scene and panel. `server`: of `local_server`."""
        self._server, self._client = server, client
        self.stage = Stage(server, None, client.skeleton, floor=client.floor)
        self.person = Person(server, "/world/motion", client.skeleton, confidence=False)
        self._path = RootPath(server, "/world/motion/root path")
        self._points: list[tuple[float, Array, int]] = []
        self.shown, self._last, self._at = 0, -np.inf, time.monotonic()
        gui = server.gui
        self.status = gui.add_html(sentences_html([f"live, from {client.url}: waiting for a pose"]))
        with gui.add_folder("shown"):
            for label, handle in (
                ("segments", self.person.body.handle),
                ("joint axes", self.person.axes),
                ("root path", self._path.handle),
                ("floor", self.stage.floor),
            ):
                box = gui.add_checkbox(label, True)
                box.on_update(lambda event, handle=handle: setattr(handle, "visible", event.target.value))
            follow = gui.add_checkbox("follow the person", True)
            follow.on_update(lambda _: setattr(self.stage, "following", follow.value))
        gui.add_html(legend_html())

    def update(self, now: float) -> None:
        """Show the newest pose, if it is new."""
        poses, lag = self._client.latest()
        lines = [f"live, from {self._client.url}"]
        if poses is None:
            lines.append("waiting for a pose")
        else:
            if (seconds := float(poses.times[0])) != self._last:
                self._last, self._at = seconds, now
                self._show(poses)
            lines.append(f"{seconds:.2f} s" + ("" if lag is None else f", {1000 * lag:.0f} ms old"))
            if now - self._at > _OLD:
                lines.append(f"no new pose for {now - self._at:.0f} s: what is shown is old")
        text = sentences_html([*lines, *self._client.sentences])
        if text != self.status.content:
            self.status.content = text

    def _show(self, poses: PoseSequence) -> None:
        content = block_content(poses, self.person.skeleton, self.person.solids)
        self.shown += 1
        with self._server.atomic():
            self.person.show(content, 0)
            self._show_path(float(poses.times[0]), content.p_root[0], int(poses.provenance[0, 0]))
            self.stage.follow(content.p_root[0])

    def _show_path(self, seconds: float, p_root: Array, provenance: int) -> None:
        points = self._points
        if points and 0 <= seconds - points[-1][0] < _PATH_STEP:
            return
        if points and seconds < points[-1][0]:
            points.clear()
        points.append((seconds, p_root, provenance))
        while seconds - points[0][0] > _PATH_S:
            points.pop(0)
        if len(points) > 1:
            colours = PALETTE[[kind for _, _, kind in points]]
            self._path.show(np.array([p for _, p, _ in points]), colours)
