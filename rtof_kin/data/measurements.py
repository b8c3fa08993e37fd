"""`Measurements`: what a motion was computed from, at the times of the motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, freeze
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.data.stream_faults import StreamFault


@dataclass(frozen=True)
class Measurements:
    """Detected points, measured orientations and reference of a motion; what is absent is empty or None."""

    times: Array
    """(T,) s, those of the motion."""
    views: tuple[KeypointSequence, ...] = ()
    """Landmarks of the skeleton seen by each camera at these times, and the cameras as calibrated."""
    sensors: tuple[str, ...] = ()
    """S names of the sensors."""
    segments: tuple[str, ...] = ()
    """S segments that carry them, by their proximal joint."""
    R_world_sensor: Array = field(default_factory=lambda: np.empty((0, 0, 3, 3)))
    """(T, S, 3, 3) measured orientation of the sensors in world, as calibrated; NaN as a whole where missing
    or rejected."""
    R_bone_sensor: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    """(S, 3, 3) mounting: sensor axes to those of the segment's link frame."""
    p_bone_sensor: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(S, 3) position of the sensors in the segment's link frame, m."""
    truth: PoseSequence | None = None
    """Known poses at these times."""
    faults: tuple[StreamFault, ...] = ()
    """Faults of keypoints and sensors, and how they were handled."""
    floor_height: float | None = None
    """z of a flat floor in world, m."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("measurements times", self.times))
        set_(self, "sensors", checked_names("measurements: sensor", self.sensors))
        set_(self, "segments", checked_names("measurements: segment", self.segments))
        T, S = len(self.times), len(self.sensors)
        if len(self.segments) != S:
            raise InvalidInputError(f"measurements: {S} sensors, but {len(self.segments)} segments")
        if S == 0:
            set_(self, "R_world_sensor", np.empty((T, 0, 3, 3)))
        shapes = {"R_world_sensor": (T, S, 3, 3), "R_bone_sensor": (S, 3, 3), "p_bone_sensor": (S, 3)}
        freeze(self, "measurements", **shapes)
        for name in ("R_world_sensor", "R_bone_sensor"):
            checked_rotations(f"measurements {name}", getattr(self, name))
        for what, part in (*(("view", view) for view in self.views), ("truth", self.truth)):
            if part is not None and not np.array_equal(part.times, self.times):
                raise InvalidInputError(f"measurements: the {what} has other times")
