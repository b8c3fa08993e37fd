"""Unknown neutral posture of the person; see `unknowns`.

It moves the means of the pose prior, as `PosePrior.about` a known posture does
(`PosePrior.moved`), and keeps their covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rtof_kin.body.neutral_posture import JOINTS
from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes
from rtof_kin.calibration.unknowns import Isotropic
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array


@dataclass(frozen=True)
class Posture(Isotropic):
    """Rotation of the prior's mean of each joint in its parent's axes."""

    items: tuple[str, ...]
    places: tuple[int, ...]
    """Of these joints among those of the pose prior in the problem."""
    sigma: float
    """[rad] per axis."""
    name = "posture"
    width = 3

    @classmethod
    def of(cls, turning: Sequence[str], sigma: float) -> Self:
        """Return the posture of the joints of a `NeutralPosture` that turn.

        Args:
            turning: joints of the problem, root first (`StateSpace.names`). sigma: rad per axis.
        """
        items = tuple(joint for joint in JOINTS if joint in turning[1:])
        return cls(items, tuple(turning.index(joint) - 1 for joint in items), sigma)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate the means."""
        mean = np.array(given.constant["quat_mean"])
        own = list(self.places)
        mean[:, own] = quat.multiply(quat.exp(y.reshape(-1, 3)), mean[:, own].T).T
        return given.known(quat_mean=mean)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives of the joints' rotation vectors from the means; the means are at y."""
        own, y = list(self.places), y.reshape(-1, 3)
        R_mean = so3.from_quat_wxyz(at.given.constant["quat_mean"].T[own])
        left = quat.right_jacobian(-y)  # exp(y + d) is exp(left d) exp(y)
        r = at.from_means[:, own]
        turned = -quat.right_jacobian_inverse(-r) @ np.swapaxes(R_mean, -1, -2) @ left
        out = np.zeros((len(r), at.from_means.shape[1], 3, len(own), 3))
        items = np.arange(len(own))
        out[:, own, :, items] = np.moveaxis(turned, 1, 0)
        return Changes(posture=out.reshape(len(r), 1, 3 * at.from_means.shape[1], -1))
