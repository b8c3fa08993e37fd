"""What may be wrong all through a recording: one small class for each kind.

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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import quaternions as quat
from rtof_kin import rotations as so3
from rtof_kin.joint_space.evidence import Changes, Evidence, Situation
from rtof_kin.joint_space.observations import Attached

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
    def covariance(self) -> Array:
        """(k, k) of the prior."""

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """The evidence as it would be, were these numbers (k,) zero."""

    def changes(self, at: Situation, y: Array) -> Changes:
        """Derivatives by them at y of what residuals compare."""


Sampled = Callable[[Array], tuple[Array, Array, Array, Array]]
"""Times (T,) -> quaternions (T, S, 4) and their weights (T, S), accelerations, their weights."""


@dataclass(frozen=True)
class Delay:
    """By how much the video is late; and by how much more a second, where the clocks differ."""

    sigma: float
    """[s]"""
    sigma_drift: float | None
    """[s/s]; None where the clocks run alike."""
    sampled: Sampled
    """The sensors at any times."""
    name = "delay"
    searched = True
    items = ("video",)

    @property
    def covariance(self) -> Array:
        """(1, 1), or (2, 2) with the clocks' drift."""
        return np.diag(np.square([v for v in (self.sigma, self.sigma_drift) if v is not None]))

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """The sensors at the times of what the video shows."""
        if not y.any():
            return evidence
        q, w, a, w_a = self.sampled(evidence.times - _powers(evidence.times, evidence.times, len(y)) @ y)
        return replace(evidence.changed(quat_sensor=q, w_sensor=w), a_world=a, w_acceleration=w_a)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Orientations and accelerations go back in time.

        Slopes of accelerations are taken after a low-pass: before it they are mostly noise, with which a
        delay would seem to be known many times better than it is.
        """
        rate, R = at.evidence.rate_hz, at.R_measured
        known = at.evidence.rows["w_sensor"][at.index] > 0  # elsewhere there is no orientation to go by
        steps = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * rate
        steps = steps * (known[1:] & known[:-1])[..., None]
        turning = np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
        powers = _powers(at.times, at.evidence.times, len(y))
        return Changes(
            turns=-turning[..., None] * powers[:, None, None],
            accelerations=-at.evidence.jerk_world[at.index][1:-1, ..., None] * powers[1:-1, None, None],
        )


@dataclass(frozen=True)
class Heading:
    """By how much each sensor's reference is to be turned about the vertical, and how that grows."""

    items: tuple[str, ...]
    sigma: float
    """[rad]"""
    sigma_drift: float | None
    """[rad/s]; None where headings stay."""
    name = "heading"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of a sensor's constant and growth, sensor after sensor."""
        own = [v for v in (self.sigma, self.sigma_drift) if v is not None]
        return np.diag(np.square(np.tile(own, len(self.items))))

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Orientations and accelerations turned."""
        own = y.reshape(len(self.items), -1)
        angle = _powers(evidence.times, evidence.times, own.shape[1]) @ own.T
        zero = np.zeros_like(angle)
        turn = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
        a = so3.about_axis("z", angle) @ evidence.a_world[..., None]
        q = quat.multiply(turn, evidence.rows["quat_sensor"])
        return replace(evidence.changed(quat_sensor=q), a_world=a[..., 0])

    def changes(self, at: Situation, y: Array) -> Changes:
        """About world's z."""
        S = len(self.items)
        powers = _powers(at.times, at.evidence.times, len(y) // S)
        a = at.a_world
        across = np.stack([-a[..., 1], a[..., 0], np.zeros_like(a[..., 0])], axis=-1)
        return Changes(
            turns=_each(at.R_measured[..., 2, :, None] * powers[:, None, None]),
            accelerations=_each(across[..., None] * powers[1:-1, None, None]),
        )


@dataclass(frozen=True)
class Mounting:
    """How each sensor's segment is turned from where the sensor says it is."""

    items: tuple[str, ...]
    axes: Array
    """(S, 3) directions of the bones in their segments, about which a sensor slips most; 0 for none."""
    sigma_swing: float
    """[rad] about axes across the bone."""
    sigma_twist: float
    """[rad] about it."""
    name = "mounting"
    searched = False

    @property
    def covariance(self) -> Array:
        """Swing and twist apart, sensor after sensor."""
        out = np.eye(3 * len(self.items)) * self.sigma_swing**2
        for s, axis in enumerate(self.axes):
            own = slice(3 * s, 3 * s + 3)
            out[own, own] += (self.sigma_twist**2 - self.sigma_swing**2) * np.outer(axis, axis)
        return out

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Orientations turned in their segments."""
        q = quat.multiply(evidence.rows["quat_sensor"], quat.exp(y.reshape(-1, 3)))
        return evidence.changed(quat_sensor=q)

    def changes(self, at: Situation, y: Array) -> Changes:
        """In the segment's axes."""
        turn = quat.right_jacobian(y.reshape(-1, 3))
        return Changes(turns=_each(np.broadcast_to(turn, (len(at.times), *turn.shape))))


@dataclass(frozen=True)
class LeverArm:
    """Where each sensor sits in its segment."""

    items: tuple[str, ...]
    sigma: float
    """[m] per axis."""
    name = "lever arm"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of three axes, sensor after sensor."""
        return np.eye(3 * len(self.items)) * self.sigma**2

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Other lever arms."""
        return evidence.known(levers=evidence.constant["levers"] + y.reshape(-1, 3).T)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Along the segments' axes."""
        own = list(at.joints.sensors)
        return Changes(sensors=_each(at.R[:, own]))


@dataclass(frozen=True)
class _Groups:
    """Index of the group of bones that something grows with."""

    bones: NDArray[np.intp]
    landmarks: NDArray[np.intp]
    sensors: NDArray[np.intp]


@dataclass(frozen=True)
class Bones:
    """By how much longer groups of bones are than they are held to be."""

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
        known, of = evidence.constant, self._of
        longer = 1 + y[of.bones]
        return evidence.known(
            offsets=known["offsets"] * longer,
            places=known["places"] * (1 + y[of.landmarks]),
            levers=known["levers"] * (1 + y[of.sensors]),
        )

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

        return Changes(
            points=attached(joints.landmarks, known["places"] * joints.free.T, of.landmarks),
            sensors=attached(joints.sensors, known["levers"], of.sensors),
            feet=p[:, list(joints.feet), 2:],
        )


@dataclass(frozen=True)
class ImageBias:
    """By how much a detector sees each landmark beside where it is, always in the same direction."""

    items: tuple[str, ...]
    sigma_px: Array
    """(L,) px per axis."""
    name = "image bias"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of u and v, landmark after landmark."""
        return np.diag(np.repeat(self.sigma_px, 2) ** 2)

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Landmarks moved back."""
        return evidence.changed(uv_px=evidence.rows["uv_px"] - y.reshape(-1, 2))

    def changes(self, at: Situation, y: Array) -> Changes:
        """Each its own."""
        return Changes(image=-_each(np.broadcast_to(np.eye(2), (len(at.times), len(self.items), 2, 2))))


@dataclass(frozen=True)
class Places:
    """Where each landmark of a detector really sits, from where it is held to sit in its segment.

    The image of an offset is taken at the poses that the calibration starts from; it is linear in it.
    """

    items: tuple[str, ...]
    sigma: float
    """[m] per axis."""
    slopes: Array
    """(T, L, 2, 3) px per m along the segment's axes: `image_slopes`."""
    name = "place"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of three axes, landmark after landmark."""
        return np.eye(3 * len(self.items)) * self.sigma**2

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Landmarks seen where they are held to sit."""
        shift = np.einsum("tlij,lj->tli", self.slopes, y.reshape(-1, 3))
        return evidence.changed(uv_px=evidence.rows["uv_px"] - shift)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Along the segments' axes."""
        return Changes(image=-_each(self.slopes[at.index]))


@dataclass(frozen=True)
class Focal:
    """By how much longer the focal length is."""

    sigma: float
    """[1]"""
    name = "focal length"
    searched = False
    items = ("camera",)

    @property
    def covariance(self) -> Array:
        """(1, 1)"""
        return np.full((1, 1), self.sigma**2)

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Another focal length."""
        K = np.array(evidence.constant["K"])
        K[:2, :2] *= 1 + y[0]
        return evidence.known(K=K)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Away from the principal point."""
        from_centre = at.image_by_point[0] - at.evidence.constant["K"][:2, 2]
        return Changes(image=-from_centre[..., None] / (1 + y[0]))


@dataclass(frozen=True)
class Tilt:
    """How the camera is turned from where it is held to look, about its centre."""

    sigma: float
    """[rad] about each axis."""
    name = "camera tilt"
    searched = False
    items = ("camera",)

    @property
    def covariance(self) -> Array:
        """(3, 3)"""
        return np.eye(3) * self.sigma**2

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Another orientation of the camera."""
        turn, known = so3.exp(y), evidence.constant
        return evidence.known(
            R_camera_world=turn @ known["R_camera_world"], t_camera_world=turn @ known["t_camera_world"]
        )

    def changes(self, at: Situation, y: Array) -> Changes:
        """As if the landmarks turned the other way about the camera."""
        R = at.evidence.constant["R_camera_world"]
        camera = at.landmarks @ R.T + at.evidence.constant["t_camera_world"]
        left = quat.right_jacobian(-y)
        return Changes(points=-R.T @ so3.skew(camera) @ left)


def _powers(times: Array, all_times: Array, count: int) -> Array:
    """(T, count) of a constant and, with two, of what grows from the recording's middle on, s."""
    since = times - (all_times[0] + all_times[-1]) / 2
    return np.stack([np.ones_like(since), since], axis=-1)[:, :count]


def _each(own: Array) -> Array:
    """(N, K, i, K w) from every item's derivatives by its own numbers (N, K, i, w)."""
    N, K, i, w = own.shape
    out = np.zeros((N, K, i, K, w))
    each = np.arange(K)
    out[:, each, :, each] = np.moveaxis(own, 1, 0)
    return out.reshape(N, K, i, K * w)
