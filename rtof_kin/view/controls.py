"""Panel of the viewer: verdict, playback, layers, views, legend, and its keys."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from rtof_kin.view.legend import Verdict, legend_html, sentences_html, verdict_html
from rtof_kin.view.motion_scene import ELLIPSOIDS, IMAGE, MotionScene

SPEEDS: Final = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
"""Speeds relative to real time, by label."""
_RELATIVE, _WORLD = "relative to the root", "in world"
_SLIDER_STEP: Final = 0.001  # [s]


class Playback:
    """Position, speed and pause of a motion; may be used by several threads."""

    def __init__(self, start: float, stop: float):
        """Pause at the start. `start`, `stop`: times of the first and the last frame, s."""
        self.start, self.stop = start, stop
        self.repeat = True
        self.playing = False
        """Whether the time moves on."""
        self._lock, self._speed = threading.Lock(), 1.0
        self._time, self._since = start, 0.0

    def at(self, now: float) -> float:
        """Return the time to show, s; playing ends at the last frame, or begins again.

        `now`: of a monotonic clock, s.
        """
        with self._lock:
            if not self.playing:
                return self._time
            time = self._time + (now - self._since) * self._speed
            if time > self.stop:
                self._time, self._since = (self.start if self.repeat else self.stop), now
                self.playing = self.repeat and self.stop > self.start
                return self._time
            return time

    def play(self, now: float, playing: bool = True) -> None:
        """Go on, from the start if at the end, or pause. `now`: of the clock, s. `playing`: False to pause."""
        time = self.at(now)
        with self._lock:
            if playing and time >= self.stop:
                time = self.start
            self._time, self._since, self.playing = time, now, playing

    def seek(self, time: float, now: float) -> None:
        """Go to a time, without pausing. `time`: s; limited to those of the motion. `now`: of the clock, s."""
        with self._lock:
            self._time, self._since = min(max(time, self.start), self.stop), now

    def set_speed(self, speed: float, now: float) -> None:
        """Change the speed. `now`: of the clock, s."""
        time = self.at(now)
        with self._lock:
            self._time, self._since, self._speed = time, now, speed


class Controls:
    """What a person sets, and what the viewer tells. `changed` is set by whatever needs a frame redrawn."""

    def __init__(
        self,
        server: Any,
        scene: MotionScene,
        playback: Playback,
        rate_hz: float,
        verdict: Verdict,
        notes: Sequence[str] = (),
        images: bool = False,
    ):
        """Build the panel. `verdict`: first line. `notes`: what is not shown, and why."""
        self._server, self._scene, self._playback, self._step = server, scene, playback, 1 / rate_hz
        self.changed, self._images = True, images
        gui = server.gui
        gui.add_html(verdict_html(verdict))
        if notes:
            gui.add_html(sentences_html(notes))
        with gui.add_folder("playback"):
            self._add_playback(gui)
        self.status = gui.add_html("")
        gui.add_html(
            legend_html(cameras=bool(scene.cameras), truth=scene.truth is not None, second=scene.second is not None)
        )
        with gui.add_folder("shown"):
            self._add_layers(gui)
        with gui.add_folder("view", expand_by_default=False):
            self._add_views(gui)
        self._add_keys(gui)

    def tell(self, sentence: str) -> None:
        """Show a sentence below the playback."""
        text = sentences_html([sentence])
        if self.status.content != text:
            self.status.content = text

    def show_time(self, seconds: float) -> None:
        """Move the slider. `seconds`: time that is shown, s."""
        self._slider.value = float(np.clip(round(seconds, 3), self._slider.min, self._slider.max))

    def show_playing(self) -> None:
        """Name the button after what it does."""
        label = "pause" if self._playback.playing else "play"
        if self._button.label != label:
            self._button.label = label

    # --- parts of the panel ----------------------------------------------------------------------

    def _add_playback(self, gui: Any) -> None:
        playback = self._playback
        self._slider = gui.add_slider(
            "time [s]",
            min=_down(playback.start),
            max=-_down(-playback.stop),
            step=_SLIDER_STEP,
            initial_value=_down(playback.start),
        )
        self._slider.on_update(self._scrub)
        self._button = gui.add_button("play")
        self._button.on_click(lambda _: self._toggle())
        moves = {"-1 frame": -self._step, "+1 frame": self._step}
        steps = gui.add_button_group("step", tuple(moves))
        steps.on_click(lambda event: self._move(moves[event.target.value]))
        speeds = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        speeds.on_update(lambda _: playback.set_speed(SPEEDS[speeds.value], time.monotonic()))
        repeat = gui.add_checkbox("repeat", playback.repeat)
        repeat.on_update(lambda _: setattr(playback, "repeat", repeat.value))

    def _add_layers(self, gui: Any) -> None:
        for label, set_visible in self._scene.layers.items():
            if label == IMAGE and not self._images:
                continue
            box = gui.add_checkbox(label, label != ELLIPSOIDS)
            set_visible(label != ELLIPSOIDS)
            box.on_update(lambda event, set_visible=set_visible: set_visible(event.target.value))
        if ELLIPSOIDS in self._scene.layers:
            kind = gui.add_dropdown("ellipsoids", (_RELATIVE, _WORLD))
            kind.on_update(lambda _: self._choose_ellipsoids(kind.value == _RELATIVE))
        if self._scene.truth is not None or self._scene.second is not None:
            beside = gui.add_slider("beside by [m]", min=0.0, max=3.0, step=0.1, initial_value=0.0)
            beside.on_update(lambda _: self._scene.put_beside(beside.value))

    def _add_views(self, gui: Any) -> None:
        self._follow = gui.add_checkbox("follow the person", self._scene.stage.following)
        self._follow.on_update(lambda _: self._set_following(self._follow.value))
        for number, _ in enumerate(self._scene.cameras):
            label = "look through the camera" + (f" {number + 1}" if len(self._scene.cameras) > 1 else "")
            button = gui.add_button(label)
            button.on_click(lambda event, number=number: self.look_through(event.client, number))
        free = gui.add_button("free view")
        free.on_click(lambda event: self.look_freely(event.client))

    def _add_keys(self, gui: Any) -> None:
        keys: tuple[tuple[str, str, Callable[[], None]], ...] = (
            ("play or pause", "space", self._toggle),
            ("one frame back", "arrowleft", lambda: self._move(-self._step)),
            ("one frame on", "arrowright", lambda: self._move(self._step)),
            ("one second back", "arrowdown", lambda: self._move(-1.0)),
            ("one second on", "arrowup", lambda: self._move(1.0)),
            ("to the start", "home", lambda: self._seek(self._playback.start)),
            ("to the end", "end", lambda: self._seek(self._playback.stop)),
        )
        for label, key, act in keys:
            gui.add_command(label, hotkey=key).on_trigger(lambda _, act=act: act())

    # --- what the parts do -----------------------------------------------------------------------

    def _scrub(self, event: Any) -> None:
        if event.client is not None:  # not moved by `show_time`
            self._seek(float(event.target.value))

    def _seek(self, seconds: float) -> None:
        self._playback.seek(seconds, time.monotonic())
        self.changed = True

    def _toggle(self) -> None:
        self._playback.play(time.monotonic(), not self._playback.playing)
        self.changed = True

    def _move(self, seconds: float) -> None:
        now = time.monotonic()
        self._playback.play(now, False)
        self._playback.seek(self._playback.at(now) + seconds, now)
        self.changed = True

    def _choose_ellipsoids(self, relative: bool) -> None:
        self._scene.person.relative = relative
        self.changed = True

    def _set_following(self, following: bool) -> None:
        self._scene.stage.following = following
        self.changed = True

    def look_through(self, client: Any, number: int) -> None:
        """Put a browser's view into a camera, with its image behind the person.

        `client`: of viser; None for all of them.
        """
        layer = self._scene.cameras[number]
        R = layer.R_world_camera
        self._look(client, number, -R[:, 1], layer.center, layer.center + R[:, 2], layer.vertical_view)

    def look_freely(self, client: Any) -> None:
        """Return to the first view. `client`: of viser; None for all of them."""
        first = self._server.initial_camera
        self._look(client, None, (0.0, 0.0, 1.0), first.position, first.look_at, first.fov)

    def _look(self, client: Any, behind: int | None, up: Any, position: Any, look_at: Any, fov: float) -> None:
        """Put the view of a browser, or of all, somewhere. `behind`: camera whose image is behind the person."""
        self._scene.behind = behind
        self._follow.value = behind is None
        self._set_following(behind is None)
        for one in [client] if client is not None else list(self._server.get_clients().values()):
            with one.atomic():
                one.camera.up_direction, one.camera.position = up, position
                one.camera.look_at, one.camera.fov = look_at, fov


def _down(seconds: float) -> float:
    """Return a time rounded down to the step of the slider."""
    return round(math.floor(seconds / _SLIDER_STEP + 1e-6) * _SLIDER_STEP, 3)
