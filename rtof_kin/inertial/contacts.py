"""When feet stand still on the floor, as inertial sensors tell it, and the places where they stand.

A foot stands where its ankle hardly accelerates for a while (zero-velocity detection; Skog et al. 2010),
its segment hardly turns, and it is not above the other foot. The floor is flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.checks import checked_names, readonly
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
FEET = ("LeftFoot", "RightFoot")


@dataclass(frozen=True)
class ContactSettings:
    """What counts as standing."""

    acceleration: float = 5.0
    """[m/s^2] root mean square of an ankle's, over `window`, that a standing foot stays below."""
    window: float = 0.12
    """[s] over which an ankle must be quiet."""
    foot_rate: float = 2.0
    """[rad/s] of a foot with a sensor: faster, it rolls over the toes and the ankle moves."""
    shank_rate: float = 3.0
    """[rad/s] of the shank, where the foot has no sensor: faster, it swings."""
    height: float = 0.1
    """[m] over the lower ankle that a standing foot's may be."""
    shortest: float = 0.1
    """[s] Contacts that last for less are none."""
    speed: float = 0.8
    """[m/s] of an ankle that no sensor tells of, as the poses have it: faster, it swings."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise ShapeError(f"{name} must be positive and finite")


@dataclass(frozen=True)
class Contacts:
    """Which feet stand, frame by frame. Feet that no sensor tells of are not there."""

    joints: tuple[str, ...]
    """C names of the ankles."""
    standing: Mask
    """(T, C)."""

    def __post_init__(self) -> None:
        joints = checked_names("contact joints", self.joints)
        object.__setattr__(self, "joints", joints)
        standing = readonly("contacts standing", self.standing, ("T", len(joints)), np.bool_)
        object.__setattr__(self, "standing", standing)

    def __len__(self) -> int:
        return len(self.standing)


@dataclass(frozen=True)
class Footholds:
    """Where joints stand still, frame by frame."""

    joints: tuple[str, ...]
    """C names."""
    p_world: Array
    """(T, C, 3) m; NaN as a whole where a joint does not stand."""

    def __post_init__(self) -> None:
        joints = checked_names("foothold joints", self.joints)
        object.__setattr__(self, "joints", joints)
        p = readonly("footholds p_world", self.p_world, ("T", len(joints), 3))
        missing = np.isnan(p)
        if np.isinf(p).any() or (missing.any(axis=2) & ~missing.all(axis=2)).any():
            raise ShapeError("footholds p_world: a place is finite, or NaN as a whole where none is")
        object.__setattr__(self, "p_world", p)

    def __len__(self) -> int:
        return len(self.p_world)


def detect_contacts(
    poses: PoseSequence,
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    settings: ContactSettings | None = None,
) -> Contacts:
    """Which feet stand on a flat floor.

    Args:
        poses: (T, J) with finite orientations; its root may be anywhere.
        bone_imus: the sensors at the poses' times. A foot is judged by its own sensor, or its shank's.
        skeleton: the subject's.

    Returns:
        Contacts of the feet that have such a sensor; where it says nothing, the foot does not stand.
    """
    feet = tuple(f for f in FEET if f in skeleton.names and _source(f, bone_imus, skeleton) is not None)
    return _contacts(feet, poses, bone_imus, skeleton, settings or ContactSettings())


def standing_feet(
    poses: PoseSequence,
    bone_imus: BoneImuSequence | None,
    skeleton: SkeletonModel,
    settings: ContactSettings | None = None,
) -> Contacts:
    """The same of both feet: one that no sensor tells of stands where the poses hardly move its ankle."""
    feet = tuple(foot for foot in FEET if foot in skeleton.names)
    return _contacts(feet, poses, bone_imus, skeleton, settings or ContactSettings())


def _contacts(
    feet: tuple[str, ...], poses: PoseSequence, bone_imus: BoneImuSequence | None,
    skeleton: SkeletonModel, settings: ContactSettings,
) -> Contacts:  # fmt: skip
    if not feet or len(poses) < 3:
        return Contacts(feet, np.zeros((len(poses), len(feet)), dtype=bool))
    p = poses.p_world_joint[:, skeleton.index(*feet)]
    standing = p[..., 2] - p[..., 2].min(axis=1, keepdims=True) < settings.height
    for i, foot in enumerate(feet):
        source = None if bone_imus is None else _source(foot, bone_imus, skeleton)
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
    """A place for every contact: the middle of where the joint is meanwhile, at a height.

    Args:
        contacts: C joints. p_world: (T, C, 3) theirs, m. height: of all places, z in world, m.
    """
    places = np.full_like(p_world, np.nan)
    for i in range(len(contacts.joints)):
        for start, stop in signals.runs(contacts.standing[:, i]):
            places[start:stop, i, :2] = np.median(p_world[start:stop, i, :2], axis=0)
            places[start:stop, i, 2] = height
    return Footholds(contacts.joints, places)


def _source(foot: str, bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> str | None:
    """The segment whose sensor tells most of a foot: its own, or the shank."""
    (j,) = skeleton.index(foot)
    near = (foot, skeleton.names[skeleton.parents[j]])
    return next((name for name in near if name in bone_imus.joints), None)


def _still(
    poses: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel, foot: str, source: str,
    settings: ContactSettings,
) -> Mask:  # fmt: skip
    """(T,) whether an ankle hardly accelerates and the segment with the sensor hardly turns."""
    rate, (j,) = poses.rate_hz, skeleton.index(source)
    s = bone_imus.joints.index(source)
    ankle = np.zeros(3) if source == foot else skeleton.joint_offsets[skeleton.index(foot)[0]]
    R = poses.R_world_bone[:, j]
    from_ankle = R @ (bone_imus.p_bone_sensor[s] - ankle)
    a = bone_imus.a_world[1:-1, s] - signals.derivative(from_ankle, rate, 2)
    square = np.sum(a**2, axis=-1)
    known = np.isfinite(square)
    width = max(round(settings.window * rate), 1)
    quiet = uniform_filter1d(np.where(known, square, 1e6), width) < settings.acceleration**2
    turning = so3.log(np.swapaxes(R[:-2], -1, -2) @ R[2:]) * rate / 2
    fastest = settings.foot_rate if source == foot else settings.shank_rate
    slow = np.linalg.norm(turning, axis=-1) < fastest
    return np.pad(quiet & slow, 1, mode="edge")
