"""The root's path from standing feet and accelerations: linear least squares over a whole recording.

With r the position of a joint or sensor relative to the root, known from the orientations, and p the
root's: a standing foot does not move, ``d/dt (p + r_foot) = 0``; its ankle is at the floor's height; and
every sensor accelerates as it measured, ``d2/dt2 (p + r_sensor) = a``. Steps of time couple three
frames, so the normal equations are a band of two beside the diagonal. In flight, and from one foot to
the other, accelerations alone carry the path. Where no foot stands for long, as in running, what keeps it
from running away is the lower foot, which moves least: weakly, with Cauchy's loss (reweighted squares).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.contacts import Contacts, detect_contacts

Array = NDArray[np.float64]
_ROUNDS = 5
"""Of reweighting the lower foot."""
_ORIGIN = 1e-3
"""[m] of the first frame's horizontal place about the origin."""
_DIFFERENCES = ((1.0,), (-1.0, 1.0), (1.0, -2.0, 1.0))
"""Of order 0 to 2, forward."""


@dataclass(frozen=True)
class RootPathSettings:
    """What is known of the root's path, and how well."""

    sigma_slip: float = 0.1
    """[m/s] velocity of a standing ankle."""
    sigma_floor: float = 0.02
    """[m] height of a standing ankle."""
    sigma_acceleration: float = 1.0
    """[m/s^2] of a sensor on the root."""
    share_of_motion: float = 0.2
    """[1] of a sensor's acceleration relative to the root that its orientation's error makes wrong."""
    sigma_lower: float = 0.5
    """[m/s] velocity of the lower ankle, standing or not."""
    sigma_lower_height: float = 0.5
    """[m] height of the lower ankle over where it stands, standing or not."""
    drift_per_metre: float = 0.05
    """[1] standard deviation of the path by what was walked; measured, see benchmarks/README.md."""
    sigma_flight: float = 0.5
    """[m/s^2] error of the acceleration that carries the path while no foot stands."""
    sigma_aloft: float = 0.3
    """[m/s] error of the velocity that this grows to at most: then the lower foot knows better."""
    sigma_seen: float = 0.3
    """[m] of the root in every frame in which a camera saw it: errors last for many."""
    sigma_edge: float = 0.05
    """[m] of it in the mean, where a gap begins or ends."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise ShapeError(f"{name} must be positive and finite")


@dataclass(frozen=True)
class RootPath:
    """Where the root went, from above the origin on."""

    p_world: Array
    """(T, 3) m."""
    sigma: Array
    """(T,) m, standard deviation of each horizontal coordinate since the first frame: it grows. NaN where
    no sensor tells of the feet and the root just stays."""

    def __post_init__(self) -> None:
        p = readonly("root path p_world", self.p_world, ("T", 3))
        object.__setattr__(self, "p_world", p)
        object.__setattr__(self, "sigma", readonly("root path sigma", self.sigma, (len(p),)))


def root_path(
    poses: PoseSequence,
    bone_imus: BoneImuSequence,
    contacts: Contacts,
    skeleton: SkeletonModel,
    ankle_height: float,
    settings: RootPathSettings | None = None,
) -> RootPath:
    """The path that fits standing feet and accelerations best.

    Args:
        poses: (T, J) rigid, evenly spaced; its root may be anywhere.
        bone_imus: the sensors at the poses' times. contacts: the same frames.
        ankle_height: z in world of a standing ankle, m.

    Returns:
        A path that begins over the origin. Where no sensor tells of the feet it stays there, with the
        lowest joint of the first frame at that height.
    """
    settings, T = settings or RootPathSettings(), len(poses)
    relative = poses.p_world_joint - poses.p_world_joint[:, :1]
    if T < 4 or not contacts.joints:
        begin = np.array([0.0, 0.0, ankle_height - relative[0, :, 2].min()])
        return RootPath(np.tile(begin, (T, 1)), np.full(T, np.nan))
    system = _System(T, poses.rate_hz)
    system.add(0, np.array([0]), np.array([0.0, 0.0, np.nan]), _ORIGIN**-2)
    p = _walked(system, poses, bone_imus, contacts, skeleton, ankle_height, settings)
    return RootPath(p, _drift(p, contacts, poses.rate_hz, settings))


def path_through_gaps(
    poses: PoseSequence,
    seen: NDArray[np.bool_],
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    settings: RootPathSettings | None = None,
) -> RootPath | None:
    """The root's path where a camera saw somebody for a while only: elsewhere by feet and accelerations.

    Args:
        poses: (T, J) rigid, evenly spaced; its root where a camera saw it is about right.
        seen: (T,) whether it did.
        bone_imus: the sensors at the poses' times.

    Returns:
        The given root where it was seen, with a standard deviation of 0; between, and before and after,
        the path that fits it, standing feet and accelerations best. None where no sensor tells of the
        feet or nothing was seen.
    """
    settings, contacts = settings or RootPathSettings(), detect_contacts(poses, bone_imus, skeleton)
    ankles = poses.p_world_joint[:, skeleton.index(*contacts.joints), 2]
    standing = contacts.standing & seen[:, None]
    if len(poses) < 4 or not standing.any():
        return None
    system = _System(len(poses), poses.rate_hz)
    root = poses.p_world_joint[:, 0]
    system.add(0, np.flatnonzero(seen), root[seen], settings.sigma_seen**-2)
    height = float(np.median(ankles[standing]))
    p = _walked(system, poses, bone_imus, contacts, skeleton, height, settings)
    sigma = np.zeros(len(poses))
    for start, stop in signals.runs(~seen):
        gap = slice(max(start - 1, 0), stop + 1)  # with what was seen at its ends
        own = Contacts(contacts.joints, contacts.standing[gap])
        p[gap] += _shift(root[gap] - p[gap], seen[gap])
        drift = _drift_from(p[gap], seen[gap], own, poses.rate_hz, settings)
        sigma[gap] = np.hypot(settings.sigma_edge, drift)
    p[seen], sigma[seen] = root[seen], 0.0
    return RootPath(p, sigma)


# --- parts ---------------------------------------------------------------------------------------


class _System:
    """Normal equations (T) of three coordinates, a band of two beside the diagonal."""

    def __init__(self, frames: int, rate_hz: float) -> None:
        self.frames, self.rate_hz = frames, rate_hz
        self._band = np.zeros((3, 3, frames))  # coordinate, distance from the diagonal, column
        self._right = np.zeros((3, frames))

    def copy(self) -> _System:
        """One to add more to."""
        return copy.deepcopy(self)

    def add(self, order: int, frames: NDArray[np.intp], target: Array, weight: Array | float) -> None:
        """Derivatives of an order (0 to 2) of the path, by differences from each of some frames on.

        Args:
            frames: (n,), none twice. target: (n, 3) or (3,), m/s^order; NaN where nothing is known.
            weight: (n,) or one for all, inverse variances.
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
        """(T, 3) m."""
        each = zip(self._band, self._right, strict=True)
        return np.stack([solveh_banded(band, right, lower=True) for band, right in each], axis=1)


def _walked(
    system: _System, poses: PoseSequence, bone_imus: BoneImuSequence, contacts: Contacts,
    skeleton: SkeletonModel, ankle_height: float, settings: RootPathSettings,
) -> Array:  # fmt: skip
    """The path (T, 3) that feet and accelerations add to what a system has."""
    relative = poses.p_world_joint - poses.p_world_joint[:, :1]
    feet = relative[:, skeleton.index(*contacts.joints)]
    _add_feet(system, feet, contacts, ankle_height, settings)
    index = skeleton.index(*bone_imus.joints)
    turned = np.einsum("tsij,sj->tsi", poses.R_world_bone[:, index], bone_imus.p_bone_sensor)
    _add_sensors(system, relative[:, index] + turned, bone_imus.a_world, settings)
    return _with_lower_foot(system, feet, settings.sigma_lower)


def _add_feet(
    system: _System, feet: Array, contacts: Contacts, ankle_height: float, settings: RootPathSettings
) -> None:
    """Standing ankles (T, C, 3), relative to the root, do not move and are at a height; weakly, so is the
    lower one always.
    """
    heights = np.where([False, False, True], ankle_height - feet, np.nan)
    every = np.arange(system.frames)
    lower = heights[every, feet[..., 2].argmin(axis=1)]
    system.add(0, every, lower, settings.sigma_lower_height**-2)
    moves = -signals.derivative(feet, system.rate_hz, 1)
    for i, stands in enumerate(contacts.standing.T):
        still = np.flatnonzero(stands[1:] & stands[:-1])
        system.add(1, still, moves[still, i], settings.sigma_slip**-2)
        system.add(0, np.flatnonzero(stands), heights[stands, i], settings.sigma_floor**-2)


def _add_sensors(system: _System, sensors: Array, a_world: Array, settings: RootPathSettings) -> None:
    """Sensors (T, S, 3), relative to the root, accelerate as measured; those that move much about it tell
    less, for they do so by orientations that are off.
    """
    own = signals.derivative(sensors, system.rate_hz, 2)
    wrong = settings.share_of_motion * np.linalg.norm(own, axis=2)
    weight = 1 / (settings.sigma_acceleration**2 + wrong**2)
    for s in range(sensors.shape[1]):
        system.add(2, np.arange(len(own)), a_world[1:-1, s] - own[:, s], weight[:, s])


def _with_lower_foot(system: _System, feet: Array, sigma: float) -> Array:
    """The path (T, 3) with Cauchy's loss of the lower ankle's velocity, by reweighted least squares."""
    every = np.arange(system.frames - 1)
    moves = -signals.derivative(feet, system.rate_hz, 1)[every, feet[:-1, :, 2].argmin(axis=1)]
    weight = np.full(len(every), sigma**-2)
    for _ in range(_ROUNDS):
        whole = system.copy()
        whole.add(1, every, moves, weight)
        p = whole.solve()
        slip = np.linalg.norm(signals.derivative(p, system.rate_hz, 1) - moves, axis=1)
        weight = 1 / (sigma**2 + slip**2)
    return p


def _drift(p: Array, contacts: Contacts, rate_hz: float, settings: RootPathSettings) -> Array:
    """(T,) m: by what was walked, and by flights, whose errors grow with the square of their length."""
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1))])
    flown = np.zeros(len(p))
    for start, stop in signals.runs(~contacts.standing.any(axis=1)):
        since = np.minimum(np.arange(len(p)) - start, stop - start)[start:] / rate_hz
        slow = np.minimum(settings.sigma_flight * since / 2, settings.sigma_aloft)
        flown[start:] += (slow * since) ** 2
    return np.asarray(np.sqrt((settings.drift_per_metre * walked) ** 2 + flown))


def _shift(off: Array, seen: NDArray[np.bool_]) -> Array:
    """(n, 3) m: what the ends are off by, of those that were seen, and evenly from one to the other."""
    share = np.linspace(0.0, 1.0, len(off))[:, None] if seen[0] and seen[-1] else float(seen[-1])
    return np.asarray((1 - share) * off[0] + share * off[-1])


def _drift_from(
    p: Array, seen: NDArray[np.bool_], contacts: Contacts, rate_hz: float, settings: RootPathSettings
) -> Array:
    """(n,) m since the end that is nearer of those that were seen."""
    back = Contacts(contacts.joints, contacts.standing[::-1])
    ends = (
        _drift(p, contacts, rate_hz, settings) if seen[0] else np.inf,
        _drift(p[::-1], back, rate_hz, settings)[::-1] if seen[-1] else np.inf,
    )
    return np.asarray(np.minimum(*ends))
