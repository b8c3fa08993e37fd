"""`LiveViewer`: the newest estimate of ``rtof-kin live`` in the browser."""

from __future__ import annotations

import threading
import time
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.view.provenance_colours import PALETTE
from rtof_kin.view.scene.block_content import block_content
from rtof_kin.view.scene.layers import PathLayer
from rtof_kin.view.scene.live_client import LiveClient
from rtof_kin.view.scene.people import Person
from rtof_kin.view.scene.stage import Stage
from rtof_kin.view.scene.words import legend_html, sentences_html

_STEP: Final = 1 / 60
_PATH_S: Final = 60.0
"""[s] of the root's path."""
_PATH_STEP: Final = 0.1
"""[s] between two points of it."""
_OLD: Final = 1.0
"""[s] without an estimate after which the viewer says so."""


class LiveViewer:
    """Scene of a live estimator; `run` shows its newest pose until it is stopped.

    Attributes:
        shown: number of poses that were shown.
    """

    def __init__(self, server: Any, client: LiveClient):
        """Build scene and panel.

        Args:
            server: of `local_server`.
        """
        self._server, self._client = server, client
        self.stage = Stage(server, None, client.skeleton, floor=client.floor)
        self.person = Person(server, "/world/motion", client.skeleton, confidence=False)
        self._path = PathLayer(server, "/world/motion/root path")
        self._points: list[tuple[float, Array, int]] = []
        self.shown, self._last, self._at = 0, -np.inf, time.monotonic()
        gui = server.gui
        self.status = gui.add_html(sentences_html([f"live, from {client.url}: waiting for a pose"]))
        with gui.add_folder("shown"):
            for label, handle in (
                ("segments", self.person.body.handle),
                ("joint axes", self.person.axes.handle),
                ("root path", self._path.handle),
                ("floor", self.stage.floor),
            ):
                box = gui.add_checkbox(label, True)
                box.on_update(lambda event, handle=handle: setattr(handle, "visible", event.target.value))
            follow = gui.add_checkbox("follow the person", True)
            follow.on_update(lambda _: setattr(self.stage, "following", follow.value))
        gui.add_html(legend_html())

    def run(self, stop: threading.Event) -> None:
        """Show the newest pose until an event is set."""
        while not stop.is_set():
            self.update(time.monotonic())
            stop.wait(_STEP)

    def update(self, now: float) -> None:
        """Show the newest pose if it is new.

        Args:
            now: of `time.monotonic`, s.
        """
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
