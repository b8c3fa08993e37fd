"""The root's path from standing feet and accelerations: linear least squares over a whole recording.

With r the position of a joint or sensor relative to the root, from the orientations, and p the root's: a
standing foot does not move, ``d/dt (p + r_foot) = 0``; its ankle is at the floor's height; every sensor
accelerates as measured, ``d2/dt2 (p + r_sensor) = a``. Time steps couple three frames, so the normal
equations are banded. In flight accelerations alone determine the path. Drift without contacts, as in
running, is bounded by a weak velocity constraint on the lower foot with Cauchy's loss (reweighted squares).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

FEET = ("LeftFoot", "RightFoot")


# Of a standing foot:
_QUIET = 5.0  # [m/s^2] RMS acceleration of the ankle over `_WINDOW`
_WINDOW = 0.12  # [s]
_FOOT_RATE, _SHANK_RATE = 2.0, 3.0  # [rad/s] of a foot with a sensor; of the shank, where the foot has none
_HEIGHT = 0.1  # [m] over the lower ankle
_SHORTEST = 0.1  # [s] duration of a contact
_SPEED = 0.8  # [m/s] of an ankle without sensors, by the poses
# Standard deviations of the observations and of the drift:
_SLIP = 0.1  # [m/s] velocity of a standing ankle
_FLOOR = 0.02  # [m] height of a standing ankle
_ACCELERATION = 1.0  # [m/s^2] of a sensor on the root
_SHARE_OF_MOTION = 0.2  # [-] error of a sensor's acceleration relative to the root
_LOWER, _LOWER_HEIGHT = 0.5, 0.5  # [m/s], [m] velocity and height of the lower ankle, standing or not
_DRIFT_PER_METRE = 0.05  # [-] of the distance walked; measured, see benchmarks/README.md
_FLIGHT = 0.5  # [m/s^2] error of the acceleration while no foot stands
_ALOFT = 0.3  # [m/s] largest error of the velocity from that
_SEEN = 0.3  # [m] of the root in a frame with keypoints; errors are correlated
_PLACE = 0.05  # [m] of the root in a frame by points in space; errors last
_EDGE = 0.05  # [m] of the mean root where a gap begins or ends
_ORIGIN = 1e-3  # [m] of the first frame's horizontal position about the origin
_ROUNDS = 5  # of reweighting the lower foot
_DIFFERENCES = ((1.0,), (-1.0, 1.0), (1.0, -2.0, 1.0))  # of order 0 to 2, forward


@dataclass(frozen=True)
class Contacts:
    """Standing feet, frame by frame."""

    joints: tuple[str, ...]  # C names of the ankles
    standing: Mask  # (T, C)


@dataclass(frozen=True)
class ContactPoints:
    """Positions at which joints stand, frame by frame."""

    joints: tuple[str, ...]  # C names
    p_world: Array  # (T, C, 3) m; NaN as a whole where a joint does not stand

    def __len__(self) -> int:
        return len(self.p_world)


def detect_contacts(
    poses: PoseSequence, bone_imus: BoneImuSequence | None, skeleton: SkeletonModel, from_poses: bool = False
) -> Contacts:
    """Detect standing feet.

    A foot stands while its ankle hardly accelerates (zero-velocity detection; Skog et al. 2010), its segment hardly
    rotates and it is not above the other foot.

    Args:
        poses: (T, J) with finite orientations; its root may be anywhere.
        bone_imus: sensors at the poses' times; a foot is detected by its own or its shank's.
        from_poses: whether feet without such a sensor are included, detected by their speed in the poses.

    Returns:
        Contacts of both feet, or of those with sensors; a foot does not stand where its sensor has gaps.
    """
    sources = {foot: _source(foot, bone_imus, skeleton) for foot in FEET if foot in skeleton.names}
    feet = tuple(foot for foot, source in sources.items() if from_poses or source is not None)
    if not feet or len(poses) < 3:
        return Contacts(feet, np.zeros((len(poses), len(feet)), dtype=bool))
    p = poses.p_world_joint[:, skeleton.index(*feet)]
    standing = p[..., 2] - p[..., 2].min(axis=1, keepdims=True) < _HEIGHT
    for i, foot in enumerate(feet):
        source = sources[foot]
        if bone_imus is None or source is None:
            speed = np.linalg.norm(np.gradient(p[:, i], axis=0), axis=-1) * poses.rate_hz
            standing[:, i] &= speed < _SPEED
        else:
            standing[:, i] &= _still(poses, bone_imus, skeleton, foot, source)
        for start, stop in signals.runs(standing[:, i]):
            if stop - start < _SHORTEST * poses.rate_hz:
                standing[start:stop, i] = False
    return Contacts(feet, standing)


def by_hand(contacts: Contacts, times: Array, corrections: Iterable[Correction]) -> Contacts:
    """Return contacts at times (T,), s, with the feet that stand as a person said."""
    standing = contacts.standing.copy()
    for one in corrections:
        foot = f"{one.what.title()}Foot"
        if one.kind == "foot_contact" and foot in contacts.joints:
            standing[one.within(times), contacts.joints.index(foot)] = True
    return replace(contacts, standing=standing)


def contact_points(contacts: Contacts, p_world: Array, height: float | None) -> ContactPoints:
    """Return the median horizontal position of each contact, of positions (T, C, 3), m, at a height of the
    ankles, m; None: the median one.
    """
    places = np.full_like(p_world, np.nan)
    for i, own in enumerate(contacts.standing.T):
        for start, stop in signals.runs(own):
            places[start:stop, i] = np.median(p_world[start:stop, i], axis=0)
    if height is not None:
        places[..., 2] = np.where(contacts.standing, height, np.nan)
    return ContactPoints(contacts.joints, places)


def _source(foot: str, bone_imus: BoneImuSequence | None, skeleton: SkeletonModel) -> str | None:
    """Return the segment whose sensor observes a foot: its own, or the shank."""
    near = (foot, skeleton.names[skeleton.parents[skeleton.names.index(foot)]])
    joints = () if bone_imus is None else bone_imus.joints
    return next((name for name in near if name in joints), None)


def _still(poses: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel, foot: str, source: str) -> Mask:
    """Return (T,) frames in which the ankle hardly accelerates and the segment hardly rotates."""
    rate, (j,) = poses.rate_hz, skeleton.index(source)
    s = bone_imus.joints.index(source)
    ankle = np.zeros(3) if source == foot else skeleton.joint_offsets[skeleton.index(foot)[0]]
    R = poses.R_world_bone[:, j]
    from_ankle = R @ (bone_imus.p_bone_sensor[s] - ankle)
    a = bone_imus.a_world[1:-1, s] - signals.derivative(from_ankle, rate, 2)
    square = np.sum(a**2, axis=-1)
    width = max(round(_WINDOW * rate), 1)
    quiet = uniform_filter1d(np.where(np.isfinite(square), square, 1e6), width) < _QUIET**2
    turning = so3.log(np.swapaxes(R[:-2], -1, -2) @ R[2:]) * rate / 2
    fastest = _FOOT_RATE if source == foot else _SHANK_RATE
    return np.pad(quiet & (np.linalg.norm(turning, axis=-1) < fastest), 1, mode="edge")


@dataclass(frozen=True)
class RootPath:
    """Path of the root from above the origin."""

    p_world: Array  # (T, 3) m
    sigma: Array  # (T,) m, of each horizontal coordinate since the first frame; NaN without foot sensors


def root_path(
    poses: PoseSequence,
    bone_imus: BoneImuSequence,
    contacts: Contacts,
    skeleton: SkeletonModel,
    ankle_height: float,
    places: Array | None = None,
) -> RootPath:
    """Estimate the root's path from contacts and accelerations.

    Args:
        poses: (T, J) rigid, evenly spaced; its root may be anywhere.
        ankle_height: z in world of a standing ankle, m.
        places: (T, 3) m, where points in space show the root, NaN where they do not; they end its drift.

    Returns:
        A path that, without places, begins over the origin. Without foot sensors it stays there, with the lowest joint
        of the first frame at that height.
    """
    T = len(poses)
    relative = poses.p_world_joint - poses.p_world_joint[:, :1]
    if T < 4 or not contacts.joints:
        begin = np.array([0.0, 0.0, ankle_height - relative[0, :, 2].min()])
        return RootPath(np.tile(begin, (T, 1)), np.full(T, np.nan))
    system = _System(T, poses.rate_hz)
    if places is None:
        system.add(0, np.array([0]), np.array([0.0, 0.0, np.nan]), _ORIGIN**-2)
    else:
        system.add(0, np.arange(T), places, _PLACE**-2)
    p = _walked(system, poses, bone_imus, contacts, skeleton, ankle_height)
    return RootPath(p, _drift(p, np.asarray(~contacts.standing.any(axis=1)), poses.rate_hz))


def path_through_gaps(
    poses: PoseSequence, seen: Mask, bone_imus: BoneImuSequence, skeleton: SkeletonModel
) -> RootPath | None:
    """Estimate the root's path in frames without keypoints from contacts and accelerations.

    Args:
        poses: (T, J) rigid, evenly spaced. seen: (T,) frames with keypoints, where its root is valid.

    Returns:
        The given root with a standard deviation of 0 where seen, else the estimate. None without foot
        sensors or without keypoints.
    """
    contacts = detect_contacts(poses, bone_imus, skeleton)
    ankles = poses.p_world_joint[:, skeleton.index(*contacts.joints), 2]
    standing = contacts.standing & seen[:, None]
    if len(poses) < 4 or not standing.any():
        return None
    system = _System(len(poses), poses.rate_hz)
    root = poses.p_world_joint[:, 0]
    system.add(0, np.flatnonzero(seen), root[seen], _SEEN**-2)
    height = float(np.median(ankles[standing]))
    p = _walked(system, poses, bone_imus, contacts, skeleton, height)
    sigma, flying = np.zeros(len(poses)), np.asarray(~contacts.standing.any(axis=1))
    for start, stop in signals.runs(~seen):
        gap = slice(max(start - 1, 0), stop + 1)  # with the frames seen at its ends
        first, last = seen[gap][[0, -1]]
        off = root[gap] - p[gap]
        share = np.linspace(0.0, 1.0, len(off))[:, None] if first and last else float(last)
        p[gap] += (1 - share) * off[0] + share * off[-1]
        drift = np.full(len(off), np.inf)  # since the nearer of the ends that were seen
        if first:
            drift = _drift(p[gap], flying[gap], poses.rate_hz)
        if last:
            back = _drift(p[gap][::-1], flying[gap][::-1], poses.rate_hz)[::-1]
            drift = np.minimum(drift, back)
        sigma[gap] = np.hypot(_EDGE, drift)
    p[seen], sigma[seen] = root[seen], 0.0
    return RootPath(p, sigma)


class _System:
    """Normal equations of three coordinates (T,), with two subdiagonals."""

    def __init__(self, frames: int, rate_hz: float) -> None:
        self.frames, self.rate_hz = frames, rate_hz
        self._band = np.zeros((3, 3, frames))  # coordinate, distance from the diagonal, column
        self._right = np.zeros((3, frames))

    def add(self, order: int, frames: Index, target: Array, weight: Array | float) -> None:
        """Observe derivatives of order 0 to 2 by forward differences from each frame (n,), none twice.

        The target (n, 3) or (3,), m/s^order, may be NaN; the weight (n,) or () is an inverse variance.
        """
        target = np.broadcast_to(target, (len(frames), 3)).T
        weight = np.where(np.isfinite(target), weight, 0.0)
        weighted = weight * np.nan_to_num(target)
        stencil = self.rate_hz**order * np.array(_DIFFERENCES[order])
        for a, left in enumerate(stencil):
            self._right[:, frames + a] += left * weighted
            for b, right in enumerate(stencil[a:]):
                self._band[:, b, frames + a] += left * right * weight

    def solve(self) -> Array:
        """Return the path (T, 3), m."""
        each = zip(self._band, self._right, strict=True)
        return np.stack([solveh_banded(band, right, lower=True) for band, right in each], axis=1)


def _walked(
    system: _System,
    poses: PoseSequence,
    bone_imus: BoneImuSequence,
    contacts: Contacts,
    skeleton: SkeletonModel,
    ankle_height: float,
) -> Array:
    """Add feet and accelerations to a system and return its path (T, 3)."""
    rate, every = poses.rate_hz, np.arange(system.frames)
    relative = poses.p_world_joint - poses.p_world_joint[:, :1]
    feet = relative[:, skeleton.index(*contacts.joints)]
    heights = np.where([False, False, True], ankle_height - feet, np.nan)
    lower = heights[every, feet[..., 2].argmin(axis=1)]
    system.add(0, every, lower, _LOWER_HEIGHT**-2)
    moves = -signals.derivative(feet, rate, 1)
    for i, stands in enumerate(contacts.standing.T):
        still = np.flatnonzero(stands[1:] & stands[:-1])
        system.add(1, still, moves[still, i], _SLIP**-2)
        system.add(0, np.flatnonzero(stands), heights[stands, i], _FLOOR**-2)
    index = skeleton.index(*bone_imus.joints)
    turned = np.einsum("tsij,sj->tsi", poses.R_world_bone[:, index], bone_imus.p_bone_sensor)
    own = signals.derivative(relative[:, index] + turned, rate, 2)
    wrong = _SHARE_OF_MOTION * np.linalg.norm(own, axis=2)
    weight = 1 / (_ACCELERATION**2 + wrong**2)
    for s in range(len(index)):
        system.add(2, every[:-2], bone_imus.a_world[1:-1, s] - own[:, s], weight[:, s])
    moves = moves[every[:-1], feet[:-1, :, 2].argmin(axis=1)]
    slower = np.full(len(moves), _LOWER**-2)
    for _ in range(_ROUNDS):  # Cauchy's loss on the lower ankle's velocity, by reweighting
        whole = copy.deepcopy(system)
        whole.add(1, every[:-1], moves, slower)
        p = whole.solve()
        slip = np.linalg.norm(signals.derivative(p, rate, 1) - moves, axis=1)
        slower = 1 / (_LOWER**2 + slip**2)
    return p


def _drift(p: Array, flying: Mask, rate_hz: float) -> Array:
    """Return the drift (T,), m: by distance walked, and by flights with the square of their duration."""
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1))])
    flown = np.zeros(len(p))
    for start, stop in signals.runs(flying):
        since = np.minimum(np.arange(len(p)) - start, stop - start)[start:] / rate_hz
        slow = np.minimum(_FLIGHT * since / 2, _ALOFT)
        flown[start:] += (slow * since) ** 2
    return np.asarray(np.sqrt((_DRIFT_PER_METRE * walked) ** 2 + flown))
