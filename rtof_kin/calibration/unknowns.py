"""What may be wrong all through a recording: one small class for each kind. Bones are here, others in
`sensor_unknowns` and `vision_unknowns`.

An unknown says how it corrects the evidence and how its numbers change what residuals compare. All
numbers are zero where nothing is wrong; their prior is normal about zero.

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
    ankles      height of an ankle over the floor it stands on = given + y  m
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.calibration.residuals import Changes, Evidence, Situation
from rtof_kin.solve.joint_space.observations import Attached

Array = NDArray[np.float64]


class Unknown(Protocol):
    """A kind of unknown: K items of w numbers each, k = K w in all."""

    @property
    def name(self) -> str:
        """The kind."""

    @property
    def items(self) -> tuple[str, ...]:
        """K names: of sensors, landmarks, groups of bones."""

    @property
    def searched(self) -> bool:
        """Whether its first number is found by search before all others are found by steps."""

    @property
    def shrinks(self) -> bool:
        """Whether a recording in which all of them are small makes their prior as small."""

    @property
    def nuisance(self) -> bool:
        """Whether it is there for what others tell by it: its numbers stay, whatever is known of them."""

    @property
    def covariance(self) -> Array:
        """(k, k) of the prior."""

    def limited(self, lasting_px: float) -> Unknown:
        """The kind with a prior that allows for no more than a detector's errors that last, px."""

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """The evidence as it would be, were these numbers (k,) zero."""

    def changes(self, at: Situation, y: Array) -> Changes:
        """Derivatives by them at y of what residuals compare."""


class Unlimited:
    """A kind that has nothing to do with a detector's errors."""

    shrinks = False
    nuisance = False

    def limited(self, lasting_px: float) -> Self:
        """As it is."""
        return self


@dataclass(frozen=True)
class _Groups:
    """Index of the group of bones that something grows with."""

    bones: NDArray[np.intp]
    landmarks: NDArray[np.intp]
    sensors: NDArray[np.intp]


@dataclass(frozen=True)
class Bones(Unlimited):
    """By how much longer groups of bones are than they are held to be.

    Accelerations and jerk are compared in body lengths (that of all groups' mean), so that neither says
    how large somebody is. In metres they would: whatever is smoothed has the less energy the smaller it
    is, and the less like measured accelerations, by so many frames that no height stands against it.
    """

    parents: tuple[int, ...]
    """(J,) of the skeleton."""
    groups: tuple[tuple[str, tuple[int, ...]], ...]
    """Name, and joints at the ends of the bones of each; every joint but the root is in one."""
    sigma_size: float
    """[1] of all bones together: how well the body's height is known."""
    sigma_proportion: float
    """[1] of each group beside that: how bodies of one height differ."""
    attached: Attached
    name = "bones"
    searched = False

    @cached_property
    def _of(self) -> _Groups:
        """Which group each joint's, landmark's and sensor's length goes with."""
        J = 1 + max(j for _, joints in self.groups for j in joints)
        bones = np.zeros(J, dtype=np.intp)
        for g, (_, joints) in enumerate(self.groups):
            bones[list(joints)] = g
        segment = bones.copy()  # a segment is as long as the bone that it ends with
        for j in range(J - 1, 0, -1):
            segment[self.parents[j]] = bones[j]
        on = self.attached
        return _Groups(bones, segment[list(on.landmarks)], segment[list(on.sensors)])

    @property
    def items(self) -> tuple[str, ...]:
        """The groups."""
        return tuple(name for name, _ in self.groups)

    @property
    def covariance(self) -> Array:
        """All groups go together, and each a little its own way."""
        G = len(self.groups)
        if G == 1:
            return np.full((1, 1), self.sigma_size**2)
        return np.full((G, G), self.sigma_size**2) + np.eye(G) * self.sigma_proportion**2

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Other offsets, and with them whatever sits on the segments."""
        known, of, scale = evidence.constant, self._of, 1 + float(y.mean())
        longer = evidence.known(
            offsets=known["offsets"] * (1 + y[of.bones]),
            places=known["places"] * (1 + y[of.landmarks]),
            levers=known["levers"] * (1 + y[of.sensors]),
        )
        return replace(
            longer, a_world=scale * evidence.a_world,
            w_acceleration=evidence.w_acceleration / scale**2, length_scale=scale,
        )  # fmt: skip

    def changes(self, at: Situation, y: Array) -> Changes:
        """Along the chains from the root."""
        known, joints, of = at.evidence.constant, at.joints, self._of
        parents = at.space.skeleton.parents
        grown = known["offsets"].T / (1 + y[of.bones])[:, None]
        zero, own = np.zeros((len(at.p), 3)), range(len(y))
        p = np.stack([
            kinematics.positions(parents, grown * (of.bones == g)[:, None], zero, at.R) for g in own
        ], axis=-1)  # fmt: skip

        def attached(on: Sequence[int], places: Array, groups: NDArray[np.intp]) -> Array:
            turned = np.einsum("nkij,jk->nki", at.R[:, list(on)], places / (1 + y[groups]))
            mine = groups[:, None] == np.arange(len(y))
            return np.asarray(p[:, list(on)] + turned[..., None] * mine[:, None])

        by_scale = np.full(len(y), 1 / (len(y) * at.evidence.length_scale))
        return Changes(
            points=attached(joints.landmarks, known["places"] * joints.free.T, of.landmarks),
            sensors=attached(joints.sensors, known["levers"], of.sensors),
            feet=p[:, list(joints.feet), 2:],
            accelerations=at.a_sensors[..., None] * by_scale,
            jerk=-at.root_jerk[:, None, :, None] * by_scale,
        )


def powers_of_time(times: Array, all_times: Array, count: int) -> Array:
    """(T, count) of a constant and, with two, of what grows from the recording's middle on, s."""
    since = times - (all_times[0] + all_times[-1]) / 2
    return np.stack([np.ones_like(since), since], axis=-1)[:, :count]


def each(own: Array) -> Array:
    """(N, K, i, K w) from every item's derivatives by its own numbers (N, K, i, w)."""
    N, K, i, w = own.shape
    out = np.zeros((N, K, i, K, w))
    each = np.arange(K)
    out[:, each, :, each] = np.moveaxis(own, 1, 0)
    return out.reshape(N, K, i, K * w)
