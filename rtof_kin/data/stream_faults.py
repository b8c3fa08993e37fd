"""Faults of a stream of measurements and their treatment."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rtof_kin.core.errors import InvalidInputError


class FaultKind(Enum):
    """Fault and treatment, as a sentence."""

    SIDES = "left and right were exchanged in the keypoints; they were exchanged back"
    SIDES_IN_DOUBT = "left and right of the keypoints may be exchanged; when that ended is unclear, so they were kept"
    SOMEBODY_ELSE = "the keypoints jumped to another person and back; they were left out"
    JUMP = "the keypoints jumped and did not come back; which person is tracked is unclear"
    UNSEEN = "nobody is seen in this gap; positions in it are bridged, or not valid"
    ENDED = "no samples: stopped, began late, or out of reach; there the motion is from the rest alone"
    STUCK = "the sensor repeated one sample; it was left out"
    SATURATED = "the accelerometer was at the end of its range; its acceleration was left out"
    DISAGREES = (
        "the sensor's orientation disagreed with the image and the other sensors, e.g. because it slipped "
        "or its heading was disturbed; it was left out"
    )
    FOREIGN = "the sensor does not move as the video shows; it was left out"


@dataclass(frozen=True)
class StreamFault:
    """A fault of a stream over an interval."""

    kind: FaultKind
    what: str
    """Segment of the sensor, or the keypoints, e.g. those of the legs."""
    start: float
    """Time of the first affected sample, s."""
    stop: float
    """Time of the last one, s."""

    def __post_init__(self) -> None:
        if not self.start <= self.stop:
            raise InvalidInputError(f"stream fault: it ends at {self.stop:g} s, before {self.start:g} s")

    def __str__(self) -> str:
        return f"{self.what}, {self.start:.2f} to {self.stop:.2f} s: {self.kind.value}"
