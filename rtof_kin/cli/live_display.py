"""What the command live shows while it runs: a table on a terminal, else one line a second."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.core.errors import RtofError
from rtof_kin.live.samples import OnlineEstimate

_ANGLES: Final = ("hip_flexion", "knee_flexion", "elbow_flexion")
_FRAMES: Final = 600
"""Frames of which the times are summarised."""
_MESSAGES: Final = 8
_TABLE_EVERY, _LINE_EVERY, _ANGLES_EVERY = 0.2, 1.0, 0.5  # [s]
_STYLES: Final = {"ok": "green", "waiting": "dim", "late": "yellow", "lossy": "yellow"}


class LiveDisplay:
    """Output of a live session on the console.

    Args:
        now: seconds of the system.
    """

    def __init__(self, console: Console, skeleton: SkeletonModel, now: Callable[[], float] = time.monotonic):
        self._console, self._skeleton, self._now = console, skeleton, now
        self._last: OnlineEstimate | None = None
        self._seconds: deque[float] = deque(maxlen=_FRAMES)
        self._lags: deque[float] = deque(maxlen=_FRAMES)
        self._said: deque[Text] = deque(maxlen=_MESSAGES)
        self._told = 0
        self._begun = self._shown = now()
        self._computed = -math.inf
        self._known: list[tuple[str, str]] = []
        self.frames = 0
        """Estimates so far."""
        self._live: Live | None = None

    def __enter__(self) -> Self:
        self._begun = self._shown = self._now()
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- sink --------------------------------------------------------------------------------------

    def send(self, estimate: OnlineEstimate) -> None:
        """Take an estimate."""
        self._last = estimate
        self.frames += 1
        self._seconds.append(estimate.seconds)
        self._lags.append(estimate.lag_s)

    def tell(self, sentence: str) -> None:
        """Take a message; without a terminal it is printed at once."""
        if self._live is None:
            self._console.print(sentence, soft_wrap=True)
        else:
            self._told += 1
            self._said.append(Text(sentence))

    def due(self) -> bool:
        """Return whether it is time to show the present state again."""
        return self._now() - self._shown >= (_LINE_EVERY if self._live is None else _TABLE_EVERY)

    def show(self, status: Mapping[str, Any]) -> None:
        """Show the present state.

        Args:
            status: of the streams, see `rtof_kin.live.monitor.Monitor.status`.
        """
        self._shown = self._now()
        if self._live is None:
            self._console.print(self._line(status), soft_wrap=True)
        else:
            self._live.update(self._table(status), refresh=True)

    def close(self) -> None:
        """Leave the last messages on the terminal; may be called twice."""
        if self._live is not None:
            self._live.stop()
            self._live = None
            if self._told > len(self._said):
                self._console.print(f"{self._told - len(self._said)} messages before these")
            for sentence in self._said:
                self._console.print(sentence, soft_wrap=True)

    # --- content -----------------------------------------------------------------------------------

    def _figures(self, rate: float | None) -> str:
        """Return rate, lag and time of a frame in words."""
        if not self._seconds:
            return "no estimate yet"
        p50, p99 = 1000 * np.percentile(self._seconds, [50, 99])
        parts = [] if rate is None else [f"{rate:.0f} Hz"]
        parts += [f"lag {1000 * np.median(self._lags):.0f} ms", f"frame {p50:.1f} ms (p99 {p99:.1f})"]
        return ", ".join(parts)

    def _line(self, status: Mapping[str, Any]) -> str:
        streams = [*status["sensors"], *([status["camera"]] if status["camera"] else [])]
        good = sum(one["state"] == "ok" for one in streams)
        angles = "; ".join(f"{name} {text}" for name, text in self._angles())
        parts = [
            f"{self._now() - self._begun:6.1f} s",
            self._figures(status["rate_hz"]),
            f"{good} of {len(streams)} streams ok",
        ]
        return ", ".join(parts) + (f"; {angles} deg" if angles else "")

    def _table(self, status: Mapping[str, Any]) -> Group:
        streams = Table(
            "stream",
            Column("state", no_wrap=True),
            Column("rate\n[Hz]", justify="right"),
            Column("loss\n[%]", justify="right"),
            Column("late\n[ms]", justify="right"),
            "says",
            box=SIMPLE_HEAD,
            pad_edge=False,
        )
        for one in (*([status["camera"]] if status["camera"] else []), *status["sensors"]):
            state = str(one["state"])
            streams.add_row(
                Text(str(one["name"])),
                Text(state, _STYLES.get(state, "bold red")),
                *(_number(one[key]) for key in ("rate_hz", "loss_percent", "latency_ms")),
                Text("" if state == "ok" else str(one["sentence"])),
            )
        angles = Table(
            Column("angle [deg]"),
            Column("left", justify="right"),
            Column("right", justify="right"),
            box=SIMPLE_HEAD,
            pad_edge=False,
        )
        found = dict(self._angles())
        for name in _ANGLES:
            what = name.replace("_", " ")
            angles.add_row(what, found.get(f"left {what}", ""), found.get(f"right {what}", ""))
        figures = self._figures(status["rate_hz"])
        head = Text(f"{self._now() - self._begun:.0f} s   {figures}   end with Ctrl-C", "bold")
        return Group(head, streams, angles, *self._said)

    def _angles(self) -> list[tuple[str, str]]:
        """Names and values in degrees of the shown angles that are known."""
        if self._last is None or self._now() - self._computed < _ANGLES_EVERY:
            return self._known
        self._computed = self._now()
        try:
            angles = clinical_angles(self._last.poses, self._skeleton)
        except RtofError:  # the skeleton has no clinical angles
            return []
        wanted = [f"{side}_{name}" for name in _ANGLES for side in ("left", "right")]
        names = [name for name in wanted if name in angles.names]
        values = angles.select(names).values[0]
        self._known = [
            (name.replace("_", " "), f"{np.degrees(value):.0f}")
            for name, value in zip(names, values, strict=True)
            if math.isfinite(value)
        ]
        return self._known


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.0f}"
