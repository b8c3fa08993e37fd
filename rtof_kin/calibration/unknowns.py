"""Unknown errors of a recording, one class for each kind: of bones, sensors, video, detector and floor.

An unknown corrects the observations and has the derivatives of what residuals compare. All numbers y are
zero without an error; their prior is normal about zero.

::

    delay       t_event = t_stamp - y                                       s
    heading     R_world_bone = R_z(y) R_measured                            rad
    mounting    R_world_bone = R_measured exp(y)                            rad, in the segment's axes
    bones       offset_j = (1 + y_g) given_j for the joints of a group g    1
    image       uv_true = uv_seen - y, for each landmark                    px
    place       p_bone_point = given + y for a detector's points of a joint m
    ankles      height of an ankle over the floor it stands on = given + y  m

A recording does not show lever arms, drifts of headings, the neutral posture, the camera's tilt or a focal length that
is right to 2 % (docs/calibration.md): they are not unknowns. It hardly shows places either, but mountings are no better
known than they are. A drift of the clocks is found before (`clocks`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index
from rtof_kin.solve.joint_space.observations import Attached


class Unknown(ABC):
    """A kind of unknown: K items of w numbers each, k = K w in all.

    Attributes:
        name: the kind. items: K names: of sensors, landmarks, groups of bones.
        searched: whether its first number is found by search, before Gauss-Newton steps.
        shrinks: whether its prior is learned from the recording.
        nuisance: whether its estimate is kept even if unobserved, because others depend on it.
    """

    name: str
    items: tuple[str, ...]
    searched = False
    shrinks = False
    nuisance = False
    sigma: float | Array
    """Standard deviation of each number before the calibration, where all are independent and of one size."""

    @property
    def covariance(self) -> Array:
        """(k, k) of the prior."""
        return np.eye(len(self.items)) * self.sigma**2

    def limited(self, constant_px: float) -> Unknown:  # noqa: ARG002
        """Return the kind with a prior limited by the constant part of a detector's errors, px."""
        return self

    @abstractmethod
    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Return the observations corrected by y (k,)."""

    @abstractmethod
    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Return derivatives by y (k,) of what residuals compare."""


@dataclass(frozen=True)
class Bones(Unknown):
    """Relative errors of the lengths of groups of bones.

    Accelerations and jerk are compared in body lengths (by the mean of all groups): in metres, smoothing
    would favour a small body.
    """

    parents: tuple[int, ...]  # (J,) of the skeleton
    groups: tuple[tuple[str, tuple[int, ...]], ...]
    """Name, and joints at the ends of the bones of each; every joint but the root is in one."""
    sigma_size: float  # [1] of all bones together
    sigma_proportion: float  # [1] of each group relative to that
    attached: Attached
    name = "bones"

    @cached_property
    def _of(self) -> tuple[Index, Index, Index]:
        """Index of the group of bones that scales each joint, landmark and sensor."""
        J = 1 + max(j for _, joints in self.groups for j in joints)
        bones = np.zeros(J, dtype=np.intp)
        for g, (_, joints) in enumerate(self.groups):
            bones[list(joints)] = g
        segment = bones.copy()  # a segment has the group of the bone that it ends with
        for j in range(J - 1, 0, -1):
            segment[self.parents[j]] = bones[j]
        on = self.attached
        return bones, segment[list(on.landmarks)], segment[list(on.sensors)]

    @property
    def items(self) -> tuple[str, ...]:  # type: ignore[override]
        """The groups."""
        return tuple(name for name, _ in self.groups)

    @property
    def covariance(self) -> Array:
        """(k, k) of the prior: a common and an individual part."""
        G = len(self.groups)
        own = 0.0 if G == 1 else self.sigma_proportion
        return np.full((G, G), self.sigma_size**2) + np.eye(G) * own**2

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Scale offsets, places and levers."""
        known, (bones, landmarks, sensors), scale = given.constant, self._of, 1 + float(y.mean())
        longer = given.known(
            offsets=known["offsets"] * (1 + y[bones]),
            places=known["places"] * (1 + y[landmarks]),
            levers=known["levers"] * (1 + y[sensors]),
        )
        return replace(
            longer, a_world=scale * given.a_world, w_acceleration=given.w_acceleration / scale**2, length_scale=scale
        )

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives along the chains from the root."""
        known, joints, (bones, landmarks, sensors) = at.given.constant, at.joints, self._of
        parents = at.space.skeleton.parents
        grown = known["offsets"].T / (1 + y[bones])[:, None]
        zero, own = np.zeros((len(at.p), 3)), range(len(y))
        p = np.stack([kinematics.positions(parents, grown * (bones == g)[:, None], zero, at.R) for g in own], axis=-1)

        def attached(on: Sequence[int], places: Array, groups: Index) -> Array:
            turned = np.einsum("nkij,jk->nki", at.R[:, list(on)], places / (1 + y[groups]))
            mine = groups[:, None] == np.arange(len(y))
            return np.asarray(p[:, list(on)] + turned[..., None] * mine[:, None])

        by_scale = np.full(len(y), 1 / (len(y) * at.given.length_scale))
        return Changes(
            points=attached(joints.landmarks, known["places"] * joints.free.T, landmarks),
            sensors=attached(joints.sensors, known["levers"], sensors),
            feet=p[:, list(joints.feet), 2:],
            accelerations=at.a_sensors[..., None] * by_scale,
            jerk=-at.root_jerk[:, None, :, None] * by_scale,
        )


def columns_of(unknowns: Sequence[Unknown]) -> tuple[slice, ...]:
    """Return the columns of each kind in y (G,)."""
    stops = np.cumsum([len(u.covariance) for u in unknowns]).astype(int).tolist()
    return tuple(slice(a, b) for a, b in zip([0, *stops], stops, strict=False))


def items_of(unknowns: Sequence[Unknown]) -> list[tuple[str, str, slice]]:
    """Return kind and name of every item, and its columns in y (G,)."""
    out, first = list[tuple[str, str, slice]](), 0
    for unknown in unknowns:
        width = len(unknown.covariance) // len(unknown.items)
        for item in unknown.items:
            out.append((unknown.name, item, slice(first, first + width)))
            first += width
    return out


def corrected(given: CalibrationObservations, unknowns: Sequence[Unknown], y: Array) -> CalibrationObservations:
    """Return observations corrected by y (G,) of all kinds, one after the other."""
    for unknown, part in zip(unknowns, columns_of(unknowns), strict=True):
        given = unknown.correct(given, y[part])
    return given


def each(own: Array) -> Array:
    """Return derivatives by all items (N, K, i, K w) of each item's own (N, K, i, w)."""
    N, K, i, w = own.shape
    out = np.zeros((N, K, i, K, w))
    items = np.arange(K)
    out[:, items, :, items] = np.moveaxis(own, 1, 0)
    return out.reshape(N, K, i, K * w)


Sampled = Callable[[Array], tuple[Array, Array, Array, Array]]
"""Times (T,) -> quaternions (T, S, 4) and their weights (T, S), accelerations, their weights."""


@dataclass(frozen=True)
class Delay(Unknown):
    """Delay of the video."""

    sigma: float  # [s]
    sampled: Sampled  # The sensors at any times
    name = "delay"
    searched = True
    items = ("video",)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Sample the sensors at the corrected times of the video."""
        q, w, a, w_a = self.sampled(given.times - y[0])
        return replace(given.changed(quat_sensor=q, w_sensor=w), a_world=a, w_acceleration=w_a)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives by time; those of accelerations after a low-pass, as they are mostly noise."""
        rate, R = at.given.rate_hz, at.R_measured
        known = at.given.rows["w_sensor"][at.index] > 0
        steps = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * rate
        steps = steps * (known[1:] & known[:-1])[..., None]
        turning = np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
        return Changes(turns=-turning[..., None], accelerations=-at.given.jerk_world[at.index][1:-1, ..., None])


@dataclass(frozen=True)
class Heading(Unknown):
    """Rotation of each sensor's reference about the vertical."""

    items: tuple[str, ...]
    sigma: float  # [rad]
    name = "heading"

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate orientations and accelerations."""
        a = so3.about_axis("z", y) @ given.a_world[..., None]
        turn = np.stack([np.cos(y / 2), 0 * y, 0 * y, np.sin(y / 2)], axis=-1)
        q = quat.multiply(turn, given.rows["quat_sensor"])
        return replace(given.changed(quat_sensor=q), a_world=a[..., 0])

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives by rotations about world's z."""
        a = at.a_world
        across = np.stack([-a[..., 1], a[..., 0], np.zeros_like(a[..., 0])], axis=-1)
        return Changes(turns=each(at.R_measured[..., 2, :, None]), accelerations=each(across[..., None]))


@dataclass(frozen=True)
class Mounting(Unknown):
    """Rotation of each sensor's segment from its measured orientation."""

    items: tuple[str, ...]
    axes: Array  # (S, 3) directions of the bones in their segments; 0 for none
    sigma_swing: float  # [rad] about axes across the bone
    sigma_twist: float  # [rad] about the bone
    name = "mounting"

    @property
    def covariance(self) -> Array:
        """(3S, 3S), swing and twist of sensor after sensor."""
        out = np.eye(3 * len(self.items)) * self.sigma_swing**2
        for s, axis in enumerate(self.axes):
            own = slice(3 * s, 3 * s + 3)
            out[own, own] += (self.sigma_twist**2 - self.sigma_swing**2) * np.outer(axis, axis)
        return out

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate orientations in their segments."""
        q = quat.multiply(given.rows["quat_sensor"], quat.exp(y.reshape(-1, 3)))
        return given.changed(quat_sensor=q)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives in the segment's axes."""
        turn = quat.right_jacobian(y.reshape(-1, 3))
        return Changes(turns=each(np.broadcast_to(turn, (len(at.x), *turn.shape))))


_LEAST_SHARE = 0.25  # Constant part of the errors, per sigma of a bias's prior, below which there is no bias
_CLOSED_PX = 1e-3  # [px] Prior of a bias where there is none


@dataclass(frozen=True)
class ImageBias(Unknown):
    """Constant error of a detector's landmarks in the image."""

    items: tuple[str, ...]
    sigma_px: Array  # (L,) px per axis
    name = "image bias"
    shrinks = True

    def limited(self, constant_px: float) -> Self:
        """Return the biases limited by the constant part of the errors; white errors have none."""
        limited = np.minimum(self.sigma_px, constant_px)
        biased = constant_px > _LEAST_SHARE * self.sigma_px
        return replace(self, sigma_px=np.where(biased, limited, _CLOSED_PX))

    @property
    def covariance(self) -> Array:
        """(2L, 2L), landmark after landmark."""
        return np.diag(np.repeat(self.sigma_px, 2) ** 2)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Subtract the biases."""
        return given.changed(uv_px=given.rows["uv_px"] - y.reshape(-1, 2))

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives by each landmark's own bias."""
        return Changes(image=-each(np.broadcast_to(np.eye(2), (len(at.x), len(self.items), 2, 2))))


@dataclass(frozen=True)
class Places(Unknown):
    """Where a detector sees each joint: an error that the points next to it share, in the axes of their segments."""

    items: tuple[str, ...]
    of_point: tuple[int, ...]  # Item of each of the L points
    sigma: Array  # (K,) m per axis
    name = "place"
    nuisance = True

    @property
    def covariance(self) -> Array:
        """(3K, 3K), joint after joint."""
        return np.diag(np.repeat(self.sigma, 3) ** 2)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Move the points in their segments."""
        return given.known(places=given.constant["places"] + y.reshape(-1, 3)[list(self.of_point)].T)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives along the segments' axes."""
        turned = at.R[:, list(at.joints.landmarks)] * at.joints.free[..., None]
        mine = np.array(self.of_point)[:, None] == np.arange(len(self.items))
        points = turned[..., None, :] * mine[:, None, :, None]
        return Changes(points=points.reshape(*turned.shape[:3], len(y)))


@dataclass(frozen=True)
class Ankles(Unknown):
    """Error of the ankles' height over the floor; people and shoes differ, and heels leave the floor."""

    sigma: float  # [m]
    name = "ankle height"
    nuisance = True
    items = ("feet",)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Raise the floor."""
        return given.known(floor=given.constant["floor"] + y)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives, equal for both feet in all frames."""
        return Changes(feet=-np.ones((len(at.x), len(at.joints.feet), 1, 1)))


def open_sensors(priors: CalibrationPriors, skeleton: SkeletonModel, sensors: tuple[str, ...]) -> Iterator[Unknown]:
    """Yield the unknowns of sensors on segments that priors leave open, in the order in which they correct."""
    if priors.sigma_heading is not None:
        yield Heading(sensors, priors.sigma_heading)
    if priors.sigma_swing is not None:
        axes = np.array([skeleton.bone_axis(joint) for joint in sensors])
        yield Mounting(sensors, axes, priors.sigma_swing, priors.sigma_twist)
