"""Senders of LSL streams that stay on this machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import numpy as np
import pylsl
from numpy.typing import ArrayLike

_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
pylsl.util.set_config_content(  # each worker has ports enough: eleven streams take more than the usual 32
    f"[ports]\nBasePort = {20000 + 512 * _WORKER}\nPortRange = 256\n"
    f"[lab]\nKnownPeers = {{127.0.0.1}}\nSessionID = tests{_WORKER}\n"
    "[multicast]\nResolveScope = machine\n[log]\nlevel = -3\n"
    "[tuning]\nTimeProbeInterval = 0.01\nTimeProbeMaxRTT = 0.05\n"
)
_NUMBERS = count()
DEADLINE_S = 60.0


def unique(name: str) -> str:
    """A stream's name that no other test has."""
    return f"{name}-{os.getpid()}-{next(_NUMBERS)}"


class Sender:
    """An outlet with labelled channels."""

    def __init__(
        self,
        name: str,
        labels: Sequence[str],
        units: Sequence[str] = (),
        rate_hz: float = 60.0,
        source_id: str | None = None,
        channels: int | None = None,
    ):
        source_id = f"source-{name}" if source_id is None else source_id
        width = channels or len(labels)
        info = pylsl.StreamInfo(name, "IMU", width, rate_hz, "double64", source_id)
        described = info.desc().append_child("channels")
        for i, label in enumerate(labels):
            channel = described.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", units[i] if units else "")
        self._outlet: Any = pylsl.StreamOutlet(info)

    def wait(self) -> None:
        """Wait until somebody listens."""
        assert self._outlet.wait_for_consumers(DEADLINE_S)

    def send(self, values: ArrayLike, stamp: float = 0.0) -> None:
        self._outlet.push_sample(np.asarray(values, dtype=float), stamp)

    def stop(self) -> None:
        self._outlet = None


def until(holds: Callable[[], Any], what: str = "") -> Any:
    """Call a function until it returns something true, and return that."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        if found := holds():
            return found
        time.sleep(0.005)
    raise AssertionError(f"nothing within {DEADLINE_S:g} s: {what}")
