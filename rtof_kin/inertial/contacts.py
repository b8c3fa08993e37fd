"""Detection of feet standing on a flat floor from inertial sensors, and the positions where they stand.

A foot stands while its ankle hardly accelerates (zero-velocity detection; Skog et al. 2010), its segment
hardly rotates and it is not above the other foot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

FEET = ("LeftFoot", "RightFoot")


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds of a standing foot."""

    acceleration: float = 5.0  # [m/s^2] RMS of the ankle over `window`
    window: float = 0.12  # [s]
    foot_rate: float = 2.0  # [rad/s] of a foot with a sensor
    shank_rate: float = 3.0  # [rad/s] of the shank, where the foot has no sensor
    height: float = 0.1  # [m] over the lower ankle
    shortest: float = 0.1  # [s] duration of a contact
    speed: float = 0.8  # [m/s] of an ankle without sensors, by the poses

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InvalidInputError(f"{name} must be positive and finite")


@dataclass(frozen=True)
class Contacts:
    """Standing feet, frame by frame."""

    joints: tuple[str, ...]
    """C names of the ankles."""
    standing: Mask
    """(T, C)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", checked_names("contact joints", self.joints))
        standing = readonly("contacts standing", self.standing, ("T", len(self.joints)), np.bool_)
        object.__setattr__(self, "standing", standing)


@dataclass(frozen=True)
class Footholds:
    """Positions at which joints stand, frame by frame."""

    joints: tuple[str, ...]
    """C names."""
    p_world: Array
    """(T, C, 3) m; NaN as a whole where a joint does not stand."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", checked_names("foothold joints", self.joints))
        p = readonly("footholds p_world", self.p_world, ("T", len(self.joints), 3))
        missing = np.isnan(p)
        if np.isinf(p).any() or (missing.any(axis=2) & ~missing.all(axis=2)).any():
            raise InvalidInputError("footholds p_world: a place is finite, or NaN as a whole")
        object.__setattr__(self, "p_world", p)

    def __len__(self) -> int:
        return len(self.p_world)


def detect_contacts(
    poses: PoseSequence,
    bone_imus: BoneImuSequence | None,
    skeleton: SkeletonModel,
    settings: ContactSettings | None = None,
    from_poses: bool = False,
) -> Contacts:
    """Detect standing feet.

    Args:
        poses: (T, J) with finite orientations; its root may be anywhere.
        bone_imus: sensors at the poses' times; a foot is detected by its own or its shank's. skeleton: the subject's.
        from_poses: whether feet without such a sensor are included, detected by their speed in the poses.

    Returns:
        Contacts of both feet, or of those with sensors; a foot does not stand where its sensor has gaps.
    """
    settings = settings or ContactSettings()
    sources = {foot: _source(foot, bone_imus, skeleton) for foot in FEET if foot in skeleton.names}
    feet = tuple(foot for foot, source in sources.items() if from_poses or source is not None)
    if not feet or len(poses) < 3:
        return Contacts(feet, np.zeros((len(poses), len(feet)), dtype=bool))
    p = poses.p_world_joint[:, skeleton.index(*feet)]
    standing = p[..., 2] - p[..., 2].min(axis=1, keepdims=True) < settings.height
    for i, foot in enumerate(feet):
        source = sources[foot]
        if bone_imus is None or source is None:
            speed = np.linalg.norm(np.gradient(p[:, i], axis=0), axis=-1) * poses.rate_hz
            standing[:, i] &= speed < settings.speed
        else:
            standing[:, i] &= _still(poses, bone_imus, skeleton, foot, source, settings)
        for start, stop in signals.runs(standing[:, i]):
            if stop - start < settings.shortest * poses.rate_hz:
                standing[start:stop, i] = False
    return Contacts(feet, standing)


def footholds(contacts: Contacts, p_world: Array, height: float) -> Footholds:
    """Return the median horizontal position of each contact, at a height.

    Args:
        p_world: (T, C, 3) their positions, m. height: of the ankles, m.
    """
    places = np.full_like(p_world, np.nan)
    for i, own in enumerate(contacts.standing.T):
        for start, stop in signals.runs(own):
            places[start:stop, i, :2] = np.median(p_world[start:stop, i, :2], axis=0)
            places[start:stop, i, 2] = height
    return Footholds(contacts.joints, places)


def _source(foot: str, bone_imus: BoneImuSequence | None, skeleton: SkeletonModel) -> str | None:
    """Return the segment whose sensor observes a foot: its own, or the shank."""
    near = (foot, skeleton.names[skeleton.parents[skeleton.names.index(foot)]])
    joints = () if bone_imus is None else bone_imus.joints
    return next((name for name in near if name in joints), None)


def _still(
    poses: PoseSequence,
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    foot: str,
    source: str,
    settings: ContactSettings,
) -> Mask:
    """Return (T,) frames in which the ankle hardly accelerates and the segment hardly rotates."""
    rate, (j,) = poses.rate_hz, skeleton.index(source)
    s = bone_imus.joints.index(source)
    ankle = np.zeros(3) if source == foot else skeleton.joint_offsets[skeleton.index(foot)[0]]
    R = poses.R_world_bone[:, j]
    from_ankle = R @ (bone_imus.p_bone_sensor[s] - ankle)
    a = bone_imus.a_world[1:-1, s] - signals.derivative(from_ankle, rate, 2)
    square = np.sum(a**2, axis=-1)
    width = max(round(settings.window * rate), 1)
    quiet = uniform_filter1d(np.where(np.isfinite(square), square, 1e6), width) < settings.acceleration**2
    turning = so3.log(np.swapaxes(R[:-2], -1, -2) @ R[2:]) * rate / 2
    fastest = settings.foot_rate if source == foot else settings.shank_rate
    return np.pad(quiet & (np.linalg.norm(turning, axis=-1) < fastest), 1, mode="edge")
