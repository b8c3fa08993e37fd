"""What a whole recording shows, as the unknowns of its calibration correct it, fragment by fragment.

`Evidence` is what `Observations` collected; an unknown (`unknowns`) takes one and gives a corrected one.
`Situation` is one fragment of it beside a body's states there: every residual that an unknown can
change, and how residuals change with states and with what the unknown changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from rtof_kin.body import kinematics
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.solve.energy.problem import FragmentData
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.joint_space.observations import Attached, Observations, fragment_of

Array = NDArray[np.float64]
_CUTOFF_HZ = 2.0
"""Of accelerations whose slope is taken."""


@dataclass(frozen=True)
class Evidence:
    """Everything observed in T frames, and what is held for known; see `Observations`."""

    times: Array
    """(T,) stamps of the video, s."""
    rows: Mapping[str, Array]
    """Name -> (T, ...) as `FrameEnergy.observation` names them."""
    constant: Mapping[str, Array]
    """Name -> value as `FrameEnergy.constant` names them."""
    a_world: Array
    """(T, S, 3) acceleration of the sensors, m/s^2."""
    w_acceleration: Array
    """(T, S) 1 / sigma^2 of each."""
    length_scale: float = 1.0
    """[1] As `FragmentData` has it."""
    worth_of_motion: float = 1.0
    """[1] What accelerations and jerk count."""

    @classmethod
    def of(cls, data: Observations, times: Array) -> Self:
        """As it was observed."""
        return cls(times, data.rows, data.constant, data.a_world, data.w_acceleration)

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return float(1 / np.median(np.diff(self.times))) if len(self.times) > 1 else 60.0

    @cached_property
    def jerk_world(self) -> Array:
        """(T, S, 3) slope of the low-passed accelerations, m/s^3; 0 next to where there is none."""
        if len(self.times) < 4:
            return np.zeros_like(self.a_world)
        smooth = signals.low_pass(self.a_world, self.rate_hz, min(_CUTOFF_HZ, 0.4 * self.rate_hz))
        near = round(self.rate_hz / (2 * _CUTOFF_HZ))
        known = minimum_filter1d((self.w_acceleration > 0).astype(float), 2 * near + 1, axis=0)
        return np.asarray(np.gradient(smooth, axis=0) * self.rate_hz * known[..., None])

    def changed(self, **rows: Array) -> Self:
        """Other rows of observations."""
        return replace(self, rows={**self.rows, **rows})

    def known(self, **constants: Array) -> Self:
        """Other constants."""
        return replace(self, constant={**self.constant, **constants})

    def fragment(self, first: int, frames: int) -> FragmentData:
        """N frames from `first`; weights are 0 where they are not the recording's."""
        data = fragment_of(
            self.rows, self.constant, self.a_world, self.w_acceleration, self.rate_hz, first, frames
        )[2]
        worth = self.worth_of_motion
        return replace(
            data, length_scale=self.length_scale, w_acceleration=worth * data.w_acceleration,
            w_jerk=worth * data.w_jerk,
        )  # fmt: skip


@dataclass(frozen=True)
class Changes:
    """Derivatives by some unknowns (..., k) of what they change in a fragment; None where they do not."""

    points: Array | None = None
    """(N, L, 3, k) landmarks in world, m."""
    image: Array | None = None
    """(N, L, 2, k) where they were seen, px."""
    turns: Array | None = None
    """(N, S, 3, k) measured orientations: rotation vectors in the segment's axes, rad."""
    accelerations: Array | None = None
    """(N - 2, S, 3, k) measured accelerations, m/s^2."""
    sensors: Array | None = None
    """(N, S, 3, k) places of the sensors in world, m."""
    feet: Array | None = None
    """(N, F, 1, k) height of the ankles, m."""
    jerk: Array | None = None
    """(N - 3, 1, 3, k) jerk of the root, m/s^3, relative to the size that it is judged by."""


@dataclass(frozen=True)
class Residuals:
    """One kind of residual in a fragment with its derivatives."""

    value: Array
    """(N, R, i)"""
    by_state: Array
    """(N, R, i, D) in tangent coordinates of the frame itself."""
    weight: Array
    """(N, R) of the residual's square, its robust loss included."""


class Situation:
    """Bodies and evidence in one fragment.

    Attributes:
        p, R: (N, J, 3) and (N, J, 3, 3) joints and segments in world.
        landmarks, sensors: (N, L, 3), (N, S, 3) their places in world.
        R_measured: (N, S, 3, 3) segments as the sensors have them.
        times: (N,) stamps, s.
    """

    def __init__(self, space: StateSpace, joints: Attached, evidence: Evidence, first: int, x: Array) -> None:
        """Pose the bodies of states x (N, 3 + 4A)."""
        index = np.clip(np.arange(first, first + len(x)), 0, len(evidence.times) - 1)
        self.space, self.evidence, self.joints, self.index = space, evidence, joints, index
        self.times = evidence.times[index]
        p, self.R = space.poses(x)
        offsets = np.asarray(evidence.constant["offsets"]).T
        self.p = kinematics.positions(space.skeleton.parents, offsets, p[:, 0], self.R)
        constant = evidence.constant
        self.landmarks = self.attached(joints.landmarks, joints.free * constant["places"].T)
        self.sensors = self.attached(joints.sensors, constant["levers"].T)
        self.R_measured = so3.from_quat_wxyz(evidence.rows["quat_sensor"][index])
        self.a_world = evidence.a_world[index][1:-1]

    def attached(self, joints: Sequence[int], places: Array) -> Array:
        """(N, K, 3) of points (K, 3) in the frames of segments."""
        own = list(joints)
        return np.asarray(self.p[:, own] + np.einsum("nkij,kj->nki", self.R[:, own], places))

    @cached_property
    def image_by_point(self) -> tuple[Array, Array]:
        """Projections (N, L, 2), px, and their derivatives (N, L, 2, 3) by the landmarks' places."""
        known = self.evidence.constant
        camera = self.landmarks @ known["R_camera_world"].T + known["t_camera_world"]
        h = camera @ known["K"].T
        uv, depth = h[..., :2] / h[..., 2:], h[..., 2]
        by_world = known["K"] @ known["R_camera_world"]
        J = (by_world[:2] - uv[..., None] * by_world[2]) / depth[..., None, None]
        return uv, J

    @cached_property
    def _axes(self) -> tuple[Array, Array]:
        """(N, D - 3, 3) the axes in world of the rotations' tangent coordinates, and points on them."""
        owners, axes = [], []
        for a, j in enumerate(self.space.joints):
            for axis in self.space.axes(a).T:
                owners.append(j)
                axes.append(axis)
        turned = np.einsum("ndij,dj->ndi", self.R[:, owners], np.array(axes))
        return turned, self.p[:, owners]

    @cached_property
    def _moves(self) -> NDArray[np.bool_]:
        """(J, D - 3) whether a rotation's tangent coordinate turns a segment."""
        space, J = self.space, len(self.space.skeleton.parents)
        beyond = np.eye(J, dtype=bool)
        for j, parent in enumerate(space.skeleton.parents):
            if parent >= 0:
                beyond[j] |= beyond[parent]
        owners = [j for a, j in enumerate(space.joints) for _ in range(space.axes(a).shape[1])]
        return beyond[:, owners]

    @property
    def a_sensors(self) -> Array:
        """(N - 2, S, 3) acceleration of the sensors as the states have it, m/s^2."""
        return np.asarray(np.diff(self.sensors, n=2, axis=0) * self.evidence.rate_hz**2)

    @property
    def root_jerk(self) -> Array:
        """(N - 3, 3) of the states, m/s^3."""
        return np.asarray(np.diff(self.p[:, 0], n=3, axis=0) * self.evidence.rate_hz**3)

    def points_by_state(self, joints: Sequence[int], points: Array) -> Array:
        """(N, K, 3, D) of points (N, K, 3) that sit on segments."""
        axes, places = self._axes
        arm = points[:, :, None] - places[:, None]
        turning = np.cross(axes[:, None], arm) * self._moves[list(joints)][None, :, :, None]
        shifting = np.broadcast_to(np.eye(3), (*points.shape[:2], 3, 3))
        return np.concatenate([shifting, np.swapaxes(turning, 2, 3)], axis=3)

    # --- residuals -------------------------------------------------------------------------------

    def pixels(self, weight: Array, knee: Array) -> Residuals:
        """Of reprojection, px, with weights (N, L) and where the loss turns linear (N,)."""
        uv, J = self.image_by_point
        r = uv - self.evidence.rows["uv_px"][self.index]
        by_state = J @ self.points_by_state(self.joints.landmarks, self.landmarks)
        return Residuals(r, by_state, _robust(weight, r, knee[:, None]))

    def turns(self, weight: Array, robust: float) -> tuple[Residuals, Array]:
        """Of the sensors' orientations, whitened; and by a small turn of what was measured
        (N, S, 3, 3).
        """
        own = list(self.joints.sensors)
        whitening = self.evidence.constant["whitening"].T.reshape(-1, 3, 3)
        W = np.swapaxes(whitening, 1, 2)  # stored by columns
        measured = self.evidence.rows["quat_sensor"][self.index]
        error = quat.multiply(quat.conjugate(measured), so3.to_quat_wxyz(self.R[:, own]))
        error = np.where(error[..., :1] < 0, -error, error)
        v, cosine = error[..., 1:], error[..., :1, None] * np.eye(3)
        r = np.einsum("sij,nsj->nsi", 2 * W, v)
        axes = self._axes[0][:, None] * self._moves[own][None, :, :, None]
        turned = np.swapaxes(axes @ self.R[:, own], 2, 3)  # in the segment's axes
        by_state = np.zeros((*r.shape, self.space.size))
        by_state[..., 3:] = W @ (cosine + so3.skew(v)) @ turned
        return Residuals(r, by_state, _robust(weight, r, robust)), W @ (so3.skew(v) - cosine)

    def accelerations(self, weight: Array, robust: float) -> Residuals:
        """Of the sensors' accelerations (N - 2, S, 3), m/s^2; `by_state` is that of the sensors' places
        (N, S, 3, D), m.
        """
        r = self.a_sensors - self.a_world
        by_state = self.points_by_state(self.joints.sensors, self.sensors)
        return Residuals(r, by_state, _robust(weight, r, robust))

    def jerk(self, weight: Array, sigma: Array) -> Residuals:
        """Of the root's place (N - 3, 1, 3), m/s^3, with weights (N - 3,) and sigma (3,); `by_state` is
        that of the root (N, 1, 3, D), m.
        """
        by_state = np.zeros((len(self.p), 1, 3, self.space.size))
        by_state[..., :3] = np.eye(3)
        return Residuals(self.root_jerk[:, None], by_state, (weight / sigma[0] ** 2)[:, None])

    def feet(self, weight: Array, cutoff: float) -> Residuals:
        """Heights of the ankles over where they are when standing, m, with weights (N, F)."""
        own = list(self.joints.feet)
        r = self.p[:, own, 2:] - self.evidence.constant["floor"]
        by_state = self.points_by_state(own, self.p[:, own])[:, :, 2:]
        slope = 1 / (1 + r[..., 0] ** 2 / cutoff**2)
        return Residuals(r, by_state, weight * slope)


def _robust(weight: Array, r: Array, delta: Array | float) -> Array:
    """Weights with the slope of the pseudo-Huber loss."""
    return np.asarray(weight / np.sqrt(1 + weight * np.sum(r**2, axis=-1) / delta**2))
