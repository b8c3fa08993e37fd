"""`SessionSummary`: what happened in a live session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class StreamSummary:
    """Samples of one stream in the whole session."""

    received: int
    """With a usable time."""
    lost: int
    """That did not come, by the stream's own rate."""
    late: int
    """That came after newer ones of other streams."""
    too_late: int
    """That came too late for the estimate."""
    left_out: int
    """Not used for their numbers, because they repeated, or for their time."""


@dataclass(frozen=True)
class SessionSummary:
    """What happened in a session."""

    frames: int
    """Number of estimates."""
    seconds: float
    """From the first to the last sample, s."""
    frame_ms_p50: float
    """[ms] Median time for a frame, all included; NaN without frames."""
    frame_ms_p99: float
    """[ms] 99th percentile of it."""
    streams: Mapping[str, StreamSummary]
    """By sensor, and ``video``."""
    sentences: tuple[str, ...]
    """What was told, with the time; at most 1000."""
    folder: Path | None
    """Recording of the session; None where none was made."""
