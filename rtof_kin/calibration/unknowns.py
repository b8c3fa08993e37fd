"""Unknown errors of a recording, one class for each kind; sensors and vision have modules of their own.

An unknown corrects the observations and has the derivatives of what residuals compare. All numbers y are
zero without an error; their prior is normal about zero.

::

    delay       t_event = t_stamp - (y_0 + y_1 (t_stamp - t_middle))       s, and s per s
    heading     R_world_bone = R_z(y_0 + y_1 (t - t_middle)) R_measured     rad, and rad/s
    mounting    R_world_bone = R_measured exp(y)                            rad, in the segment's axes
    lever arm   p_bone_sensor = given + y                                   m
    bones       offset_j = (1 + y_g) given_j for the joints of a group g    1
    image       uv_true = uv_seen - y, for each landmark                    px
    place       p_bone_landmark = given + y, for each landmark              m
    focal       f = (1 + y) given                                           1
    tilt        R_camera_world = exp(y) given, about the camera's centre    rad, in the camera's axes
    posture     mean_joint = exp(y) given, of the pose prior                rad, in the parent's axes
    ankles      height of an ankle over the floor it stands on = given + y  m
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes
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

    @property
    @abstractmethod
    def covariance(self) -> Array:
        """(k, k) of the prior."""

    def limited(self, constant_px: float) -> Unknown:  # noqa: ARG002
        """Return the kind with a prior limited by the constant part of a detector's errors, px."""
        return self

    @abstractmethod
    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Return the observations corrected by y (k,)."""

    @abstractmethod
    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Return derivatives by y (k,) of what residuals compare."""


class Isotropic(Unknown):
    """An unknown whose numbers are independent and have one standard deviation."""

    sigma: float
    width = 1
    """w."""

    @property
    def covariance(self) -> Array:
        """(k, k) of the prior."""
        return np.eye(self.width * len(self.items)) * self.sigma**2


@dataclass(frozen=True)
class _Groups:
    """Index of the group of bones that scales each joint, landmark and sensor."""

    bones: Index
    landmarks: Index
    sensors: Index


@dataclass(frozen=True)
class Bones(Unknown):
    """Relative errors of the lengths of groups of bones.

    Accelerations and jerk are compared in body lengths (by the mean of all groups): in metres, smoothing
    would favour a small body.
    """

    parents: tuple[int, ...]
    """(J,) of the skeleton."""
    groups: tuple[tuple[str, tuple[int, ...]], ...]
    """Name, and joints at the ends of the bones of each; every joint but the root is in one."""
    sigma_size: float
    """[1] of all bones together."""
    sigma_proportion: float
    """[1] of each group relative to that."""
    attached: Attached
    name = "bones"

    @cached_property
    def _of(self) -> _Groups:
        J = 1 + max(j for _, joints in self.groups for j in joints)
        bones = np.zeros(J, dtype=np.intp)
        for g, (_, joints) in enumerate(self.groups):
            bones[list(joints)] = g
        segment = bones.copy()  # a segment has the group of the bone that it ends with
        for j in range(J - 1, 0, -1):
            segment[self.parents[j]] = bones[j]
        on = self.attached
        return _Groups(bones, segment[list(on.landmarks)], segment[list(on.sensors)])

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
        known, of, scale = given.constant, self._of, 1 + float(y.mean())
        longer = given.known(
            offsets=known["offsets"] * (1 + y[of.bones]),
            places=known["places"] * (1 + y[of.landmarks]),
            levers=known["levers"] * (1 + y[of.sensors]),
        )
        return replace(
            longer, a_world=scale * given.a_world, w_acceleration=given.w_acceleration / scale**2, length_scale=scale
        )

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives along the chains from the root."""
        known, joints, of = at.given.constant, at.joints, self._of
        parents = at.space.skeleton.parents
        grown = known["offsets"].T / (1 + y[of.bones])[:, None]
        zero, own = np.zeros((len(at.p), 3)), range(len(y))
        p = np.stack(
            [kinematics.positions(parents, grown * (of.bones == g)[:, None], zero, at.R) for g in own], axis=-1
        )

        def attached(on: Sequence[int], places: Array, groups: Index) -> Array:
            turned = np.einsum("nkij,jk->nki", at.R[:, list(on)], places / (1 + y[groups]))
            mine = groups[:, None] == np.arange(len(y))
            return np.asarray(p[:, list(on)] + turned[..., None] * mine[:, None])

        by_scale = np.full(len(y), 1 / (len(y) * at.given.length_scale))
        return Changes(
            points=attached(joints.landmarks, known["places"] * joints.free.T, of.landmarks),
            sensors=attached(joints.sensors, known["levers"], of.sensors),
            feet=p[:, list(joints.feet), 2:],
            accelerations=at.a_sensors[..., None] * by_scale,
            jerk=-at.root_jerk[:, None, :, None] * by_scale,
        )


def powers_of_time(times: Array, all_times: Array, count: int) -> Array:
    """Return (T, count) of a constant and, with two, of the time since the recording's middle, s.

    Args:
        times: (T,) s. all_times: of the recording, s. count: 1 or 2.
    """
    since = times - (all_times[0] + all_times[-1]) / 2
    return np.stack([np.ones_like(since), since], axis=-1)[:, :count]


def each(own: Array) -> Array:
    """Return derivatives by all items (N, K, i, K w).

    Args:
        own: (N, K, i, w) of every item by its own numbers.
    """
    N, K, i, w = own.shape
    out = np.zeros((N, K, i, K, w))
    items = np.arange(K)
    out[:, items, :, items] = np.moveaxis(own, 1, 0)
    return out.reshape(N, K, i, K * w)
