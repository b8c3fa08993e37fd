"""Samples of live streams, and the interfaces of what gives samples and of what takes estimates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence


@dataclass(frozen=True)
class ImuSample:
    """One sample of one inertial sensor."""

    sensor: str  #: Name, as in the calibration
    time: float  #: [s] on the clock of its source
    R_inertial_sensor: Array  #: (3, 3) orientation; NaN where missing
    f_sensor: Array  #: (3,) specific force, m/s^2, gravity included; NaN where missing


@dataclass(frozen=True)
class FrameSample:
    """Detected points of one frame of the video."""

    time: float  #: [s] on the clock of its source
    uv_px: Array  #: (L, 2) px; NaN where unseen
    confidence: Array  #: (L,) in [0, 1]; 0 where unseen


Sample = ImuSample | FrameSample


class Clock(Enum):
    """What the time stamps of a source refer to."""

    COMMON = "common"  #: The clock of the other sources with a common clock, as in a recording or over LSL
    OWN = "own"  #: A clock of its own; it is mapped by the earliest arrivals


class Source(Protocol):
    """Gives samples as they arrive; a thread of its own may collect them."""

    @property
    def name(self) -> str:
        """Short name for messages, such as ``lsl:DOTs``."""

    @property
    def clock(self) -> Clock:
        """Clock of the time stamps."""

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the L points of a frame; empty for a source of sensors."""

    @property
    def finished(self) -> bool:
        """Whether no further sample will come."""

    def start(self) -> None:
        """Begin to collect. `SourceError`: the stream does not exist, or not once; a port is taken; a damaged file."""

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, without waiting."""

    def notices(self) -> list[str]:
        """Return sentences since the last call about what the source left out or mended, and why."""

    def close(self) -> None:
        """Stop; may be called twice."""


@dataclass(frozen=True)
class OnlineEstimate:
    """Pose of one instant."""

    poses: PoseSequence  #: One frame, on the clock of the sensors
    lag_s: float  #: Age of the pose when it was estimated: newest time of any stream minus its own, s
    seconds: float  #: Time that the estimate took, s
    confidence: Confidence | None = None  #: Of that frame, where asked for


class Sink(Protocol):
    """Takes estimates: an outlet, a server, a recorder."""

    def send(self, estimate: OnlineEstimate) -> None:
        """Take an estimate; must not wait for a slow listener."""

    def tell(self, sentence: str) -> None:
        """Take a message about the streams."""

    def close(self) -> None:
        """Stop; may be called twice."""
