"""Poses of all joints over time, and who observed them.

Axes are time, then element, then component: (T, J, 3). Missing is NaN in the value and 0 in the
confidence, both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, readonly
from rtof_kin.core.errors import ShapeError

Array = NDArray[np.float64]


class Provenance(IntEnum):
    """Who saw a joint at an instant."""

    NOBODY = 0
    PRIOR = 1
    BRIDGED = 2
    IMU = 3
    CAMERA = 4
    CAMERA_AND_IMU = 5


@dataclass(frozen=True)
class PoseSequence:
    """Joint positions and segment orientations of one person in world."""

    times: Array
    """(T,) seconds, strictly increasing."""
    p_world_joint: Array
    """(T, J, 3) m; NaN where unknown."""
    R_world_bone: Array
    """(T, J, 3, 3) orientation of each joint's segment; NaN where unknown."""
    names: tuple[str, ...]
    """J joint names."""
    provenance: NDArray[np.uint8] = None  # type: ignore[assignment]
    """(T, J) `Provenance` of each joint; NOBODY where not given."""
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether the position is an estimate to rely on; where not given, whether it is finite."""
    orientation_observed: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether all three angles of the segment were seen; where False, its twist follows the
    parent. One row (J,) stands for all frames; all False where not given."""
    direction_observed: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether points of the segment beside joints showed the direction of its bone, as the far end
    of a hand does; what joints show of it follows from `position_observed`. Given like `orientation_observed`."""
    sigma_rad: Array = None  # type: ignore[assignment]
    """(T, J) standard deviation per axis of the orientations, rad; NaN where it is not known, as it is
    everywhere where not given."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("pose names", self.names))
        set_(self, "times", checked_times("pose times", self.times))
        T, J = len(self.times), len(self.names)
        p = readonly("pose p_world_joint", self.p_world_joint, (T, J, 3))
        R = readonly("pose R_world_bone", self.R_world_bone, (T, J, 3, 3))
        checked_rotations("pose R_world_bone", R)
        known = np.isfinite(p).all(axis=-1)
        provenance = np.zeros((T, J)) if self.provenance is None else self.provenance
        if not np.all(np.isin(provenance, list(Provenance))):
            raise ShapeError(f"pose provenance: a value is none of {', '.join(map(repr, Provenance))}")
        valid = known if self.valid is None else self.valid
        valid = readonly("pose valid", valid, (T, J), np.bool_) & known
        set_(self, "p_world_joint", p)
        set_(self, "R_world_bone", R)
        set_(self, "provenance", readonly("pose provenance", provenance, (T, J), np.uint8))
        set_(self, "valid", readonly("pose valid", valid, (T, J), np.bool_))
        for name in ("orientation_observed", "direction_observed"):
            observed = np.zeros(J) if getattr(self, name) is None else getattr(self, name)
            if np.ndim(observed) == 1:  # the same in all frames
                observed = np.tile(observed, (T, 1))
            set_(self, name, readonly(f"pose {name}", observed, (T, J), np.bool_))
        sigma = np.full((T, J), np.nan) if self.sigma_rad is None else self.sigma_rad
        sigma = readonly("pose sigma_rad", sigma, (T, J))
        if np.any(sigma <= 0):
            raise ShapeError("pose sigma_rad: not positive; write NaN where it is not known")
        set_(self, "sigma_rad", sigma)

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return self.with_poses(frames, self.p_world_joint[frames])

    def with_poses(self, frames: slice, p_world_joint: Array, R_world_bone: Array | None = None) -> Self:
        """Some of the frames in other poses; with the same orientations where none are given, else their
        spread is not known any more.
        """
        sigma_rad = self.sigma_rad[frames]
        return replace(
            self,
            times=self.times[frames],
            p_world_joint=p_world_joint,
            R_world_bone=self.R_world_bone[frames] if R_world_bone is None else R_world_bone,
            provenance=self.provenance[frames],
            valid=self.valid[frames],
            orientation_observed=self.orientation_observed[frames],
            direction_observed=self.direction_observed[frames],
            sigma_rad=sigma_rad if R_world_bone is None else np.full_like(sigma_rad, np.nan),
        )

    @property
    def position_observed(self) -> NDArray[np.bool_]:
        """(T, J) whether somebody saw where a joint is; without any provenance, whether it is valid."""
        given = bool(self.provenance.any())
        return np.asarray(self.valid & ((self.provenance >= Provenance.IMU) | (not given)))

    @property
    def rate_hz(self) -> float:
        """Frames per second, from the median step; 60 for a single frame."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0
