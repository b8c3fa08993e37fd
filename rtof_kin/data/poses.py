"""Poses of all joints over time, with their provenance.

Axes are time, element, component. Missing is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, freeze, readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.over_time import OverTime


class Provenance(IntEnum):
    """Source of a joint's position in a frame; members from IMU on are observations."""

    NOBODY = 0
    PRIOR = 1
    BRIDGED = 2
    IMU = 3
    CAMERA = 4
    CAMERA_AND_IMU = 5


Rgb = tuple[int, int, int]
COLOURS: Final[dict[Provenance, Rgb]] = {
    Provenance.CAMERA_AND_IMU: (0, 158, 115),
    Provenance.CAMERA: (86, 180, 233),
    Provenance.IMU: (230, 159, 0),
    Provenance.BRIDGED: (204, 121, 167),
    Provenance.PRIOR: (150, 150, 150),
    Provenance.NOBODY: (150, 150, 150),
}
"""RGB by provenance, distinguishable with a colour vision deficiency (Okabe and Ito, 2008)."""
LONGEST_BRIDGE: Final = 0.5
"""[s] Longest interval between two observations of a joint in which it is valid: it is interpolated."""


def valid_positions(provenance: NDArray[np.uint8], times: Array, parents: Sequence[int]) -> Mask:
    """Return which positions (T, J) are valid: observed, or between two observations at most `LONGEST_BRIDGE`
    apart and not out of the image.

    A sensor turns the segment that ends in a joint; where a camera is used, the joint is observed by it only
    if the segment's other end is valid.

    Args:
        provenance: (T, J) of the joints. times: (T,) s. parents: of the joints, parents first.
    """
    camera, by_imu = provenance >= Provenance.CAMERA, provenance == Provenance.IMU
    has_camera = bool(camera.any() or np.any(provenance == Provenance.BRIDGED))
    valid = _bridged(camera if has_camera else by_imu, times)
    for j, parent in enumerate(parents):
        if parent >= 0:
            valid[:, j] |= by_imu[:, j] & valid[:, parent]
    return np.asarray(_bridged(valid, times) & (provenance[:, :1] != Provenance.BRIDGED))


def _bridged(observed: Mask, times: Array) -> Mask:
    """The mask (T, J) with short intervals between two observations filled."""
    out = np.array(observed)
    for column in out.T:
        known = np.flatnonzero(column)
        for k in np.flatnonzero(np.diff(known) > 1):
            if times[known[k + 1]] - times[known[k]] <= LONGEST_BRIDGE:
                column[known[k] : known[k + 1]] = True
    return out


def _not_given() -> Any:
    """Return None, for which `__post_init__` computes the default from the other fields."""
    return None


@dataclass(frozen=True)
class PoseSequence(OverTime):
    """Joint positions and segment orientations of one person in world."""

    times: Array  #: (T,) seconds, strictly increasing
    p_world_joint: Array  #: (T, J, 3) m; NaN where missing
    R_world_bone: Array  #: (T, J, 3, 3) orientation of each joint's segment; NaN where missing
    names: tuple[str, ...]  #: J joint names
    provenance: NDArray[np.uint8] = field(default_factory=_not_given)
    """(T, J) `Provenance` of each joint. Default: NOBODY."""
    valid: Mask = field(default_factory=_not_given)
    """(T, J) True if the position was observed or shortly bridged (`valid_positions`). Default: finite."""
    orientation_observed: Mask = field(default_factory=_not_given)
    """(T, J), or (J,) for all frames, True if all three angles of the segment were observed; else its twist
    follows the parent. Default: False."""
    direction_observed: Mask = field(default_factory=_not_given)
    """(T, J), or (J,) for all frames, True if points of the segment other than joints, e.g. the far end of a
    hand, showed its direction. Default: False."""
    sigma_rad: Array = field(default_factory=_not_given)
    """(T, J) standard deviation per axis of the orientations, rad. Default: NaN (unknown)."""
    rows = (
        *("p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed", "direction_observed"),
        "sigma_rad",
    )

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("pose names", self.names))
        set_(self, "times", checked_times("pose times", self.times))
        T, J = len(self.times), len(self.names)
        freeze(self, "pose", p_world_joint=(T, J, 3), R_world_bone=(T, J, 3, 3))
        checked_rotations("pose R_world_bone", self.R_world_bone)
        finite = np.isfinite(self.p_world_joint).all(axis=-1)
        provenance = np.zeros((T, J)) if self.provenance is None else np.asarray(self.provenance)
        if not ((provenance >= 0) & (provenance <= max(Provenance)) & (provenance % 1 == 0)).all():
            raise InvalidInputError(f"pose provenance: a value is not one of {', '.join(map(repr, Provenance))}")
        set_(self, "provenance", readonly("pose provenance", provenance, (T, J), np.uint8))
        valid = readonly("pose valid", finite if self.valid is None else self.valid, (T, J), np.bool_)
        set_(self, "valid", readonly("pose valid", valid & finite, (T, J), np.bool_))
        for name in ("orientation_observed", "direction_observed"):
            observed = np.zeros(J) if getattr(self, name) is None else getattr(self, name)
            if np.ndim(observed) == 1:
                observed = np.tile(observed, (T, 1))
            set_(self, name, readonly(f"pose {name}", observed, (T, J), np.bool_))
        if self.sigma_rad is None:
            set_(self, "sigma_rad", np.full((T, J), np.nan))
        freeze(self, "pose", sigma_rad=(T, J))
        if np.any(self.sigma_rad <= 0):
            raise InvalidInputError("pose sigma_rad: not positive; write NaN where it is not known")

    def with_poses(self, frames: slice, p_world_joint: Array, R_world_bone: Array | None = None) -> Self:
        """Return some frames with other poses. p_world_joint: (T', J, 3) m. R_world_bone: (T', J, 3, 3); if given,
        `sigma_rad` becomes NaN, else orientations are kept.
        """
        own = self.cut(frames) | {"p_world_joint": p_world_joint}
        if R_world_bone is not None:
            own |= {"R_world_bone": R_world_bone, "sigma_rad": np.full_like(own["sigma_rad"], np.nan)}
        return replace(self, **own)

    @property
    def position_observed(self) -> Mask:
        """Mask (T, J) of observed positions; without any provenance, `valid`."""
        given = bool(self.provenance.any())
        return np.asarray(self.valid & ((self.provenance >= Provenance.IMU) | (not given)))
