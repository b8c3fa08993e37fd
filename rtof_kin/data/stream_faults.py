"""What was found wrong with a stream of measurements, and what was done about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rtof_kin.core.errors import ShapeError


class FaultKind(Enum):
    """What may be found wrong, and what is done about it."""

    SIDES = "left and right were exchanged in the keypoints; they were exchanged back"
    SIDES_IN_DOUBT = (
        "left and right of the keypoints may be exchanged; when that ended could not be told, so they "
        "were left as they are"
    )
    SOMEBODY_ELSE = "the keypoints jumped to somebody else and back; they were left out"
    JUMP = "the keypoints jumped and did not come back; who is followed could not be told"
    STUCK = "the sensor repeated one sample; it was left out"
    SATURATED = "the accelerometer was at the end of its range; its acceleration was left out"
    DISAGREES = (
        "the sensor's orientation disagreed with the image and the other sensors, as of one that "
        "slipped or whose heading was disturbed; it was left out"
    )


@dataclass(frozen=True)
class StreamFault:
    """One thing that was wrong with one stream for some time."""

    kind: FaultKind
    what: str
    """The sensor's segment, or the keypoints: those of legs, say."""
    start: float
    """s, the first sample that it befell."""
    stop: float
    """s, the last one."""

    def __post_init__(self) -> None:
        if not self.start <= self.stop:
            raise ShapeError(f"stream fault: it ends at {self.stop:g} s, before {self.start:g} s")

    def __str__(self) -> str:
        return f"{self.what}, {self.start:.2f} to {self.stop:.2f} s: {self.kind.value}"
