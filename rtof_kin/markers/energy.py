"""Energy of markers on the skeleton: residuals, pose prior, smoothness, with Gauss-Newton Hessians.

::

    E = 1/2 sum rho(|p_j + R_j m_k - observed_k|^2 / skin_k^2) + 1/2 phi^T P phi + 1/2 sum |acceleration|^2 / sigma^2

rho is the pseudo-Huber loss at three standard deviations, phi the rotation vectors of the joints. The prior holds what
markers on the skin do not show: a trunk bends evenly along its four joints, knees and elbows are nearly hinges. It is
wide along every movement and narrow across (`_SPREAD_DEG`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.numerics.banded import Factor, factorise
from rtof_kin.solve.joint_space.state import StateSpace

_SPREAD_DEG: Final = {
    "Spine": (8, 10, 8),
    "Neck": (15, 20, 25),
    "Head": (12, 15, 20),
    "Shoulder": (15, 5, 15),
    "Arm": (90, 60, 90),
    "ForeArm": (5, 40, 90),
    "Hand": (40, 5, 20),
    "UpLeg": (35, 70, 30),
    "Leg": (4, 90, 8),
    "Foot": (15, 30, 15),
}
"""Standard deviation of each joint's rotation vector from the T-pose about x, y and z, degrees."""
_MOVES: Final = 8  #: [deg] Standard deviation from which an axis is one of movement
_EVEN: Final = {("Spine", "Spine1", "Spine2", "Spine3"): np.radians(2.5), ("Neck", "Head"): np.radians(8.0)}
"""Chains that bend evenly: standard deviation of the difference of neighbours, rad."""
_ROBUST: Final = 3.0  #: [sigma] Threshold of the pseudo-Huber loss
_ACCELERATION: Final = (15.0, 100.0)  #: Standard deviation of the root's acceleration, m/s^2, and of joints', rad/s^2


def pose_precision(space: StateSpace, widened: float = 1.0) -> Array:
    """Return the precision (3A - 3, 3A - 3), 1/rad^2, of the rotation vectors of the joints other than the root.

    Args:
        widened: factor on the standard deviations along movements (those of `_MOVES` and more). A body is fitted with
            a wide prior: many frames with a narrow one would prefer bodies on which joints turn less.
    """
    bare = [name.removeprefix("Left").removeprefix("Right").rstrip("0123456789") for name in space.names[1:]]
    spreads = [[s * widened if s >= _MOVES else s for s in _SPREAD_DEG[name]] for name in bare]
    precision = block_diag(*(np.diag(np.radians(spread) ** -2.0) for spread in spreads))
    for chain, sigma in _EVEN.items():
        for a, b in pairwise(space.names.index(name) - 1 for name in chain if name in space.names):
            difference = np.zeros((3, len(precision)))
            difference[:, 3 * a : 3 * a + 3], difference[:, 3 * b : 3 * b + 3] = -np.eye(3), np.eye(3)
            precision += difference.T @ difference / sigma**2
    return np.asarray(precision)


@dataclass(frozen=True)
class Linear:
    """Markers and pose prior of T frames at their states: value, gradient, Gauss-Newton Hessian."""

    energy: float
    gradient: Array  #: (T, D)
    hessian: Array  #: (T, D, D)
    residual: Array  #: (T, K, 3) model minus observed, m; 0 where missing
    weight: Array  #: (T, K) 1 / sigma^2 with the robust factor, 1/m^2; 0 where missing
    rates: Array  #: (T, K, 3, D) derivatives of the markers by the states
    R_world_bone: Array  #: (T, J, 3, 3)


class MarkerModel:
    """Markers on a body: positions, residuals and derivatives for states of `StateSpace`.

    Attributes:
        space: states with all joints. segments: (K,) segment of each marker. places: (K, 3) in the segments' frames, m.
        offsets: (J, 3) of the joints, m. sigma: (K,) m.
    """

    def __init__(
        self, skeleton: SkeletonModel, segments: tuple[str, ...], places: Array, sigma: Array, widened: float
    ) -> None:
        """Take the body and its markers. `widened`: see `pose_precision`."""
        self.space = StateSpace(skeleton, skeleton.names, hinged=False)
        self.segments = skeleton.index(*segments)
        self.places, self.offsets, self.sigma = places, np.array(skeleton.joint_offsets), sigma
        lines = [kinematics.line_to_root(skeleton.parents, segment) for segment in self.segments]
        self._moved = np.array([(k, j) for k, line in enumerate(lines) for j in line]).T
        self.precision = pose_precision(self.space, widened)

    def poses(self, x: Array) -> tuple[Array, Array]:
        """Return joints (T, J, 3), m, and orientations (T, J, 3, 3) of states."""
        parents = self.space.skeleton.parents
        R = kinematics.world_rotations(parents, so3.from_quat_wxyz(self.space.rotations(x)))
        return kinematics.positions(parents, self.offsets, x[:, :3], R), R

    def points(self, p: Array, R: Array) -> Array:
        """Return the markers (T, K, 3), m."""
        return np.asarray(p[:, self.segments] + np.einsum("tkij,kj->tki", R[:, self.segments], self.places))

    def energies(self, x: Array, observed: Array) -> Array:
        """Return the energy (T,) of markers and pose prior. observed: (T, K, 3) m, NaN where missing."""
        residual = self._residual(self.points(*self.poses(x)), observed)
        return self._loss(residual) + self._unlikely(x)

    def _residual(self, points: Array, observed: Array) -> Array:
        return np.where(np.isfinite(observed), points - observed, 0.0)

    def _loss(self, residual: Array) -> Array:
        squared = np.sum(residual**2, axis=-1) / self.sigma**2 / _ROBUST**2
        return np.asarray(np.sum(_ROBUST**2 * (np.sqrt(1 + squared) - 1), axis=-1))

    def _unlikely(self, x: Array) -> Array:
        phi = quat.log(self.space.rotations(x)[:, 1:]).reshape(len(x), -1)
        return np.asarray(0.5 * np.sum(phi @ self.precision * phi, axis=-1))

    def linearise(self, x: Array, observed: Array) -> Linear:
        """Return value and derivatives of markers and pose prior."""
        p, R = self.poses(x)
        points = self.points(p, R)
        residual = self._residual(points, observed)
        rates = self._rates(p, R, points)
        squared = np.sum(residual**2, axis=-1) / self.sigma**2 / _ROBUST**2
        weight = np.isfinite(observed).all(axis=-1) / self.sigma**2 / np.sqrt(1 + squared)
        rows = rates.reshape(len(x), -1, self.space.size)
        weighed = np.repeat(weight, 3, axis=1)[..., None] * rows
        hessian = np.swapaxes(rows, 1, 2) @ weighed
        gradient = np.einsum("trd,tr->td", weighed, residual.reshape(len(x), -1))
        energy = float(np.sum(self._loss(residual) + self._unlikely(x)))
        self._add_prior(x, gradient, hessian)
        return Linear(energy, gradient, hessian, residual, weight, rates, R)

    def _rates(self, p: Array, R: Array, points: Array) -> Array:
        """Return derivatives (T, K, 3, D) of the markers by root position and rotations of the joints above them."""
        k, j = self._moved
        arm, axes = points[:, k] - p[:, j], np.swapaxes(R[:, j], -1, -2)  # (T, P, 3), (T, P, axis, 3)
        turned = so3.cross(axes, np.broadcast_to(arm[:, :, None], axes.shape))
        out = np.zeros((len(p), len(self.segments), 3, len(self.space.names) + 1, 3))
        out[..., 0, :] = np.eye(3)
        out[:, k, :, j + 1] = np.moveaxis(turned, (1, 3), (0, 2))
        return out.reshape(*out.shape[:3], -1)

    def _add_prior(self, x: Array, gradient: Array, hessian: Array) -> None:
        phi = quat.log(self.space.rotations(x)[:, 1:])
        T, joints = phi.shape[:2]
        inverse = quat.right_jacobian_inverse(phi)  # (T, A - 1, 3, 3)
        force = (phi.reshape(T, -1) @ self.precision).reshape(T, joints, 3)
        gradient[:, 6:] += np.einsum("tajk,taj->tak", inverse, force).reshape(T, -1)
        blocks = self.precision.reshape(joints, 3, joints, 3)
        turned = np.einsum("tajk,ajbl,tblm->takbm", inverse, blocks, inverse, optimize=True)
        hessian[:, 6:, 6:] += turned.reshape(T, 3 * joints, 3 * joints)


class MarkerTrial:
    """Energy of consecutive frames of a trial, for `LevenbergMarquardt`."""

    def __init__(self, model: MarkerModel, observed: Array, rate_hz: float) -> None:
        """Take N frames. observed: (N, K, 3) m, NaN where missing."""
        self.model, self.observed = model, observed
        D = model.space.size
        sigma = np.repeat(_ACCELERATION, (3, D - 3))
        self._smooth = rate_hz**4 / sigma**2
        self._band = np.zeros((0, 0))
        self._identity: Index = np.arange(D)

    def retract(self, x: Array, step: Array) -> Array:
        """Return the states after a step (N, D)."""
        return self.model.space.retract(x, step)

    def total(self, x: Array) -> float:
        """Return the energy."""
        bend = np.diff(self._steps(x), axis=0)
        return float(self.model.energies(x, self.observed).sum()) + 0.5 * float(np.sum(self._smooth * bend**2))

    def _steps(self, x: Array) -> Array:
        """Return the steps (N - 1, D) from each state to the next."""
        space = self.model.space
        return space.difference(x[:-1], x[1:]) if len(x) > 1 else np.zeros((0, space.size))

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N, D)."""
        return self.linearise(x)[1]

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient, and store the Hessian."""
        at, (N, D) = self.model.linearise(x, self.observed), (len(x), self.model.space.size)
        gradient, blocks, band = at.gradient, at.hessian, np.zeros((N, D, 2 * D + 1))
        steps = self._steps(x)
        bend = np.diff(steps, axis=0)
        force = np.zeros_like(steps)
        force[1:] += self._smooth * bend
        force[:-1] -= self._smooth * bend
        gradient[1:] += _pulled(steps, force)
        gradient[:-1] -= _pulled(-steps, force)
        for k, factor in enumerate((1.0, -2.0, 1.0)):  # steps of a frame are small: their derivatives are one
            blocks[k : N - 2 + k, self._identity, self._identity] += factor**2 * self._smooth
        for c in range(D):
            band[:, c, : D - c] = blocks[:, c:, c]
        band[: N - 2, :, D] += -2 * self._smooth
        band[1 : N - 1, :, D] += -2 * self._smooth
        band[: N - 2, :, 2 * D] += self._smooth
        self._band = band.reshape(N * D, -1)
        energy = at.energy + 0.5 * float(np.sum(self._smooth * bend**2))
        return energy, gradient

    def factorise(self, damping: float) -> Factor:
        """Factorise the stored Hessian."""
        band = self._band.copy()
        band[:, 0] += damping
        return factorise(band)


def _pulled(steps: Array, force: Array) -> Array:
    """Return the gradient by the later state of forces (N, D) on steps (N, D) from each state to the next."""
    shape = len(steps), (steps.shape[1] - 3) // 3, 3
    inverse = quat.right_jacobian_inverse(steps[:, 3:].reshape(shape))
    turned = np.einsum("tajk,taj->tak", inverse, force[:, 3:].reshape(shape))
    return np.concatenate([force[:, :3], turned.reshape(len(steps), shape[1] * 3)], axis=1)
