"""`Detections`: what a detector found in a video, everybody in it, in its own layout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import ShapeError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
NO_IDENTITY = -1
SHARES_UP_TO = 3.0
"""Coordinates none of which is larger are shares of the image's size; no person is so few pixels."""
_MOST_PEOPLE = 500
_MOST_NUMBERS = 2**27
_HIGHEST_CONFIDENCE = 10.0


@dataclass(frozen=True)
class Person:
    """One person in one frame, as a file has them."""

    points: Array
    """(K, 3) x, y, confidence."""
    identity: int = NO_IDENTITY
    """What a tracker calls them; -1 where there is none."""


@dataclass(frozen=True)
class Detections:
    """The points of up to P people in T frames."""

    uv_px: Array
    """(T, P, K, 2); NaN where unseen. The order of people may change from frame to frame."""
    confidence: Array
    """(T, P, K) in [0, 1]; 0 where unseen."""
    times: Array | None = None
    """(T,) s, where the file has them."""
    names: tuple[str, ...] | None = None
    """K names of the points in the file's words, where it has them."""
    identity: Ints | None = None
    """(T, P) what a tracker calls each person, -1 for nobody; None where there was no tracker."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        uv = np.array(readonly("detections uv_px", self.uv_px, ("T", "P", "K", 2)))
        confidence = np.array(readonly("detections confidence", self.confidence, uv.shape[:3]))
        if 0 in uv.shape:
            raise ShapeError("there is nobody in any frame; look at the detector's own output")
        highest = float(np.nanmax(confidence, initial=0.0))
        if highest > _HIGHEST_CONFIDENCE or np.nanmin(confidence, initial=0.0) < 0:
            raise ShapeError(
                f"detections confidence: reaches from {np.nanmin(confidence):g} to {highest:g}; give "
                "values from 0 to 1, divided by the detector's maximum"
            )
        confidence = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
        missing = ~np.isfinite(uv).all(axis=-1) | (confidence == 0)
        uv[missing], confidence[missing] = np.nan, 0.0
        set_(self, "uv_px", readonly("detections uv_px", uv, uv.shape))
        set_(self, "confidence", readonly("detections confidence", confidence, uv.shape[:3]))
        if self.times is not None:
            times = checked_times("detections times", self.times)
            if len(times) != len(uv):
                raise ShapeError(f"detections times: {len(times)}, but there are {len(uv)} frames")
            set_(self, "times", times)
        if self.names is not None and len(self.names) != uv.shape[2]:
            raise ShapeError(f"detections: {len(self.names)} names for {uv.shape[2]} points")
        if self.identity is not None:
            identity = readonly("detections identity", self.identity, uv.shape[:2], np.int64)
            set_(self, "identity", identity)

    @classmethod
    def of_frames(
        cls,
        frames: Sequence[Sequence[Person]] | Mapping[int, Sequence[Person]],
        times: Array | None = None,
        names: tuple[str, ...] | None = None,
    ) -> Self:
        """From lists of people, frame by frame, or by the frame's number where some are left out.

        Raises:
            ShapeError: nobody is in any frame, their numbers of points differ, or it is far too much.
        """
        numbered = frames if isinstance(frames, Mapping) else dict(enumerate(frames))
        everybody = [person for people in numbered.values() for person in people]
        if not everybody:
            raise ShapeError("there is nobody in any frame; look at the detector's own output")
        K = len(everybody[0].points)
        for number, people in numbered.items():
            for person in people:
                if len(person.points) != K:
                    raise ShapeError(
                        f"frame {number}: a person has {len(person.points)} points, others have {K}; "
                        "all must be in one layout"
                    )
        T, P = max(numbered) + 1, max(map(len, numbered.values()))
        if P > _MOST_PEOPLE or T * P * K > _MOST_NUMBERS:
            raise ShapeError(
                f"{T} frames of up to {P} people with {K} points are too much; cut the recording into parts"
            )
        points, identity = np.zeros((T, P, K, 3)), np.full((T, P), NO_IDENTITY)
        for number, people in numbered.items():
            for p, person in enumerate(people):
                points[number, p], identity[number, p] = person.points, person.identity
        tracked = np.any(identity != NO_IDENTITY)
        return cls(points[..., :2], points[..., 2], times, names, identity if tracked else None)

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(T, P) whether there is a person."""
        return np.asarray((self.confidence > 0).any(axis=-1))

    def ordered(self, order: Iterable[int]) -> Self:
        """The points in another order; those not in it are left out."""
        index = list(order)
        names = None if self.names is None else tuple(self.names[i] for i in index)
        return replace(
            self, uv_px=self.uv_px[:, :, index], confidence=self.confidence[:, :, index], names=names
        )

    def in_pixels(self, width_px: int | None, height_px: int | None) -> Self:
        """The same in pixels, where coordinates are shares of the image's width and height.

        Raises:
            ShapeError: they are shares, and the size of the image is not given.
        """
        largest = float(np.nanmax(np.abs(self.uv_px), initial=0.0))
        if largest > SHARES_UP_TO:
            return self
        if width_px is None or height_px is None:
            raise ShapeError(
                f"the coordinates are shares of the image (the largest is {largest:.2g}), so its "
                "width_px and height_px are needed"
            )
        return replace(self, uv_px=self.uv_px * [width_px, height_px])
