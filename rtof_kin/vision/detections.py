"""`Detections`: the keypoints of all people that a detector found in a video, in the detector's layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import InvalidInputError, ShapeError

Ints = NDArray[np.int64]
NO_IDENTITY: Final = -1
_LARGEST_RELATIVE = 3.0  # coordinates of which none is larger are fractions of the image size
_MOST_PEOPLE, _MOST_NUMBERS = 500, 2**27
_HIGHEST_CONFIDENCE = 10.0
_BODY_OF_WHOLE: Final = {133: 23, 136: 26}
"""Points of a whole body (COCO's, Halpe's) -> of its body and feet, which come first."""


@dataclass(frozen=True)
class Person:
    """One person in one frame."""

    points: Array
    """(K, 3) x, y, confidence."""
    identity: int = NO_IDENTITY
    """Number given by a tracker, -1 without one."""


@dataclass(frozen=True)
class Detections:
    """Points of up to P people in T frames; the order of people may change between frames."""

    uv_px: Array
    """(T, P, K, 2); NaN where not detected."""
    confidence: Array
    """(T, P, K) in [0, 1]; 0 where not detected."""
    times: Array | None = None
    """(T,) s, if the file has them."""
    names: tuple[str, ...] | None = None
    """K names of the points in the file, if it has them."""
    identity: Ints | None = None
    """(T, P) numbers given by a tracker, -1 where there is none; None without a tracker."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        uv = np.array(readonly("detections uv_px", self.uv_px, ("T", "P", "K", 2)))
        confidence = np.array(readonly("detections confidence", self.confidence, uv.shape[:3]))
        if 0 in uv.shape:
            raise InvalidInputError("there is no person in any frame; check the detector's output")
        low, high = float(np.nanmin(confidence, initial=0.0)), float(np.nanmax(confidence, initial=0.0))
        if high > _HIGHEST_CONFIDENCE or low < 0:
            problem = f"ranges from {low:g} to {high:g}; give values from 0 to 1 (divide by the detector's maximum)"
            raise InvalidInputError(f"detections confidence: {problem}")
        confidence = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
        missing = ~np.isfinite(uv).all(axis=-1) | (confidence == 0)
        uv[missing], confidence[missing] = np.nan, 0.0
        set_(self, "uv_px", readonly("detections uv_px", uv, uv.shape))
        set_(self, "confidence", readonly("detections confidence", confidence, uv.shape[:3]))
        if self.times is not None:
            times = checked_times("detections times", self.times)
            set_(self, "times", times)
            if len(times) != len(uv):
                raise ShapeError(f"detections times: {len(times)}, but there are {len(uv)} frames")
        if self.names is not None and len(self.names) != uv.shape[2]:
            raise ShapeError(f"detections: {len(self.names)} names for {uv.shape[2]} points")
        if self.identity is not None:
            identity = readonly("detections identity", self.identity, uv.shape[:2], np.int64)
            set_(self, "identity", identity)

    @classmethod
    def of_frames(
        cls, frames: Mapping[int, Sequence[Person]], times: Array | None = None, names: tuple[str, ...] | None = None
    ) -> Self:
        """Create detections from the people of each frame.

        Args:
            frames: frame number -> people; frames without an entry are empty. times: (T,) s.

        Raises:
            InvalidInputError: no people, different numbers of points, or too much data.
        """
        sizes = {number: {len(p.points) for p in people} for number, people in frames.items()}
        K = next((size for some in sizes.values() for size in some), None)
        if K is None:
            raise InvalidInputError("there is no person in any frame; check the detector's output")
        for number, some in sizes.items():
            if some - {K}:
                problem = f"a person has {max(some - {K})} points, others have {K}; use one layout"
                raise InvalidInputError(f"frame {number}: {problem}")
        T, P = max(frames) + 1, max(map(len, frames.values()))
        if P > _MOST_PEOPLE or T * P * K > _MOST_NUMBERS:
            raise InvalidInputError(f"{T} frames of up to {P} people with {K} points are too much; split the recording")
        points, identity = np.zeros((T, P, K, 3)), np.full((T, P), NO_IDENTITY)
        for number, people in frames.items():
            for p, person in enumerate(people):
                points[number, p], identity[number, p] = person.points, person.identity
        tracked = np.any(identity != NO_IDENTITY)
        return cls(points[..., :2], points[..., 2], times, names, identity if tracked else None)

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def present(self) -> Mask:
        """(T, P) True where a person was detected."""
        return np.asarray((self.confidence > 0).any(axis=-1))

    def in_pixels(self, width_px: int | None, height_px: int | None) -> Self:
        """Return detections in pixels; coordinates up to 3 are taken as fractions of the image size.

        Raises:
            InvalidInputError: the image size is missing.
        """
        largest = float(np.nanmax(np.abs(self.uv_px), initial=0.0))
        if largest > _LARGEST_RELATIVE:
            return self
        if width_px is None or height_px is None:
            raise InvalidInputError(
                f"the coordinates are fractions of the image (the largest is {largest:.2g}), so its "
                "width_px and height_px are needed"
            )
        return replace(self, uv_px=self.uv_px * [width_px, height_px])


def of_body(found: Detections) -> Detections:
    """Return detections without face and hands, where they are of a whole body; else unchanged.

    Args:
        found: in any layout.
    """
    K = _BODY_OF_WHOLE.get(found.uv_px.shape[2])
    if K is None:
        return found
    names = None if found.names is None else found.names[:K]
    return replace(found, uv_px=found.uv_px[:, :, :K], confidence=found.confidence[:, :, :K], names=names)
