"""Observations of a recording that unknowns correct, and residuals with their derivatives.

`CalibrationObservations` are those of `Observations`, corrected by unknowns (`unknowns`).
`CalibrationResiduals` are the residuals of one fragment that an unknown can change, with derivatives by
the states and by what the unknown changes. They are those of `solve.joint_space`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.ndimage import minimum_filter1d

from rtof_kin.body import kinematics
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.over_time import Sampled
from rtof_kin.solve.joint_space.fragment import FragmentData
from rtof_kin.solve.joint_space.observations import Attached, fragment_of
from rtof_kin.solve.joint_space.state import StateSpace

_CUTOFF_HZ = 2.0  # [Hz] Low-pass of accelerations before differentiation


@dataclass(frozen=True)
class CalibrationObservations(Sampled):
    """Observations of T frames and constants; see `Observations`."""

    times: Array  # (T,) stamps of the video, s
    rows: Mapping[str, Array]  # Name -> (T, ...), with the names of `FrameLayout.observation`
    constant: Mapping[str, Array]  # Name -> value, with the names of `FrameLayout.constant`
    a_world: Array  # (T, S, 3) acceleration of the sensors, m/s^2
    w_acceleration: Array  # (T, S) 1 / sigma^2 of each
    length_scale: float = 1.0  # [1] Factor on the body's size
    weight_of_motion: float = 1.0  # [1] Factor on the weights of accelerations and jerk

    @cached_property
    def jerk_world(self) -> Array:
        """(T, S, 3) derivative of low-passed accelerations, m/s^3; 0 next to missing ones. Where times jump,
        the frames before and after are apart.
        """
        breaks = np.flatnonzero(np.diff(self.times) > 1.5 / self.rate_hz) + 1
        parts = zip(np.split(self.a_world, breaks), np.split(self.w_acceleration, breaks), strict=True)
        return np.concatenate([_jerk(a, w > 0, self.rate_hz) for a, w in parts])

    def changed(self, **rows: Array) -> Self:
        """Return them with other rows."""
        return replace(self, rows={**self.rows, **rows})

    def known(self, **constants: Array) -> Self:
        """Return them with other constants."""
        return replace(self, constant={**self.constant, **constants})

    def fragment(self, first: int, frames: int) -> FragmentData:
        """Return N `frames` from `first`; weights are 0 in the padding."""
        data = fragment_of(self.rows, self.constant, self.a_world, self.w_acceleration, self.rate_hz, first, frames)[2]
        weight = self.weight_of_motion
        return replace(
            data,
            length_scale=self.length_scale,
            w_acceleration=weight * data.w_acceleration,
            w_jerk=weight * data.w_jerk,
        )


@dataclass(frozen=True)
class Changes:
    """Derivatives by unknowns (..., k) of what they change in a fragment; None for nothing."""

    points: Array | None = None  # (N, L, 3, k) landmarks in world, m
    image: Array | None = None  # (N, L, 2, k) observed landmarks, px
    turns: Array | None = None  # (N, S, 3, k) measured orientations: rotation vectors in the segment's axes, rad
    accelerations: Array | None = None  # (N - 2, S, 3, k) measured accelerations, m/s^2
    sensors: Array | None = None  # (N, S, 3, k) positions of the sensors in world, m
    feet: Array | None = None  # (N, F, 1, k) height of the ankles, m
    jerk: Array | None = None  # (N - 3, 1, 3, k) jerk of the root, m/s^3, relative to the length scale


@dataclass(frozen=True)
class Residuals:
    """A kind of residual in a fragment with its derivatives."""

    value: Array  # (N, R, i)
    by_state: Array  # (N, R, i, D) in tangent coordinates of the frame itself
    weight: Array  # (N, R) of the residual's square, with its robust loss


class CalibrationResiduals:
    """Residuals of one fragment at the body's states.

    Attributes:
        p, R: (N, J, 3) and (N, J, 3, 3) joints and segments in world.
        landmarks, sensors: (N, L, 3), (N, S, 3) their positions in world.
        R_measured: (N, S, 3, 3) measured orientations of segments. a_world: (N - 2, S, 3) measured, m/s^2.
        index: (N,) frames of the recording. x: (N, 3 + 4A) states.
    """

    def __init__(
        self, space: StateSpace, joints: Attached, given: CalibrationObservations, first: int, x: Array
    ) -> None:
        """Pose the body at states x (N, 3 + 4A)."""
        index = np.clip(np.arange(first, first + len(x)), 0, len(given.times) - 1)
        self.space, self.given, self.joints, self.index, self.x = space, given, joints, index, x
        p, self.R = space.poses(x)
        offsets = np.asarray(given.constant["offsets"]).T
        self.p = kinematics.positions(space.skeleton.parents, offsets, p[:, 0], self.R)
        constant = given.constant
        self.landmarks = self._attached(joints.landmarks, joints.free * constant["places"].T)
        self.sensors = self._attached(joints.sensors, constant["levers"].T)
        self.R_measured = so3.from_quat_wxyz(given.rows["quat_sensor"][index])
        self.a_world = given.a_world[index][1:-1]

    def _attached(self, joints: Sequence[int], places: Array) -> Array:
        """Positions (N, K, 3) of points (K, 3) in the frames of segments."""
        own = list(joints)
        return np.asarray(self.p[:, own] + np.einsum("nkij,kj->nki", self.R[:, own], places))

    @cached_property
    def image_by_point(self) -> tuple[Array, Array]:
        """Projections (N, L, 2), px, and their derivatives (N, L, 2, 3) by the landmarks' positions."""
        known = self.given.constant
        camera = self.landmarks @ known["R_camera_world"].T + known["t_camera_world"]
        h = camera @ known["K"].T
        uv, depth = h[..., :2] / h[..., 2:], h[..., 2]
        by_world = known["K"] @ known["R_camera_world"]
        J = (by_world[:2] - uv[..., None] * by_world[2]) / depth[..., None, None]
        return uv, J

    @cached_property
    def _turn_rates(self) -> Array:
        return self.space.turn_rates(self.R)

    @property
    def a_sensors(self) -> Array:
        """(N - 2, S, 3) acceleration of the sensors by the states, m/s^2."""
        return np.asarray(np.diff(self.sensors, n=2, axis=0) * self.given.rate_hz**2)

    @property
    def root_jerk(self) -> Array:
        """(N - 3, 3) jerk of the root by the states, m/s^3."""
        return np.asarray(np.diff(self.p[:, 0], n=3, axis=0) * self.given.rate_hz**3)

    def _points_by_state(self, joints: Sequence[int], points: Array) -> Array:
        """Derivatives (N, K, 3, D) of points (N, K, 3) on segments."""
        return self.space.point_rates(self.p, self.R, joints, points)

    def pixels(self, weight: Array, knee: Array) -> Residuals:
        """Return those of reprojection, px, for weights (N, L) and the threshold of the loss (N,)."""
        uv, J = self.image_by_point
        r = uv - self.given.rows["uv_px"][self.index]
        by_state = J @ self._points_by_state(self.joints.landmarks, self.landmarks)
        return Residuals(r, by_state, _robust(weight, r, knee[:, None]))

    def turns(self, weight: Array, robust: float) -> tuple[Residuals, Array]:
        """Return those of orientations, whitened, for weights (N, S) and the threshold of the loss; and
        their derivatives (N, S, 3, 3) by a small rotation of the measured ones.
        """
        own = list(self.joints.sensors)
        whitening = self.given.constant["whitening"].T.reshape(-1, 3, 3)
        W = np.swapaxes(whitening, 1, 2)  # stored by columns
        measured = self.given.rows["quat_sensor"][self.index]
        error = quat.multiply(quat.conjugate(measured), so3.to_quat_wxyz(self.R[:, own]))
        error = np.where(error[..., :1] < 0, -error, error)
        v, cosine = error[..., 1:], error[..., :1, None] * np.eye(3)
        r = np.einsum("sij,nsj->nsi", 2 * W, v)
        turned = np.swapaxes(self._turn_rates[:, own] @ self.R[:, own], 2, 3)  # in the segment's axes
        by_state = np.zeros((*r.shape, self.space.size))
        by_state[..., 3:] = W @ (cosine + so3.skew(v)) @ turned
        return Residuals(r, by_state, _robust(weight, r, robust)), W @ (so3.skew(v) - cosine)

    def accelerations(self, weight: Array, robust: float) -> Residuals:
        """Return those of accelerations (N - 2, S, 3), m/s^2, for weights (N - 2, S); `by_state`
        (N, S, 3, D) is that of the sensors' positions, m.
        """
        r = self.a_sensors - self.a_world
        by_state = self._points_by_state(self.joints.sensors, self.sensors)
        return Residuals(r, by_state, _robust(weight, r, robust))

    def jerk(self, weight: Array, sigma: Array) -> Residuals:
        """Return those of the root's jerk (N - 3, 1, 3), m/s^3, for weights (N - 3,) and sigma (3,);
        `by_state` (N, 1, 3, D) is that of the root's position, m.
        """
        by_state = np.zeros((len(self.p), 1, 3, self.space.size))
        by_state[..., :3] = np.eye(3)
        return Residuals(self.root_jerk[:, None], by_state, (weight / sigma[0] ** 2)[:, None])

    def feet(self, weight: Array, cutoff: float) -> Residuals:
        """Return those of the ankles' heights, m, for weights (N, F) and the scale of the loss, m."""
        own = list(self.joints.feet)
        r = self.p[:, own, 2:] - self.given.constant["floor"]
        by_state = self._points_by_state(own, self.p[:, own])[:, :, 2:]
        slope = 1 / (1 + r[..., 0] ** 2 / cutoff**2)
        return Residuals(r, by_state, weight * slope)


def _robust(weight: Array, r: Array, delta: Array | float) -> Array:
    """Weights times the slope of the pseudo-Huber loss."""
    return np.asarray(weight / np.sqrt(1 + weight * np.sum(r**2, axis=-1) / delta**2))


def _jerk(a_world: Array, known: Mask, rate_hz: float) -> Array:
    """(T, S, 3) of accelerations at even times."""
    if len(a_world) < 4:
        return np.zeros_like(a_world)
    smooth = signals.low_pass(a_world, rate_hz, min(_CUTOFF_HZ, 0.4 * rate_hz))
    near = round(rate_hz / (2 * _CUTOFF_HZ))
    around = minimum_filter1d(known.astype(float), 2 * near + 1, axis=0)
    return np.asarray(np.gradient(smooth, axis=0) * rate_hz * around[..., None])
