"""What free motion says about poses: the mean and full covariance of joint rotations, and their jerk.

``models/pose_prior.npz`` is made by ``models/build_pose_prior.py`` from the training subjects alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian on the rotation vectors of all joints about their mean rotations."""

    joints: tuple[str, ...]
    """J joint names, root first."""
    mean_quat_wxyz: Array
    """(J - 1, 4) mean rotation of every joint but the root relative to its parent."""
    covariance: Array
    """(3 (J - 1), 3 (J - 1)) of log(mean^-1 rotation), rad^2."""
    sigma_jerk: Array
    """(J,) standard deviation of the rotational jerk of each joint (root: in world), rad/s^3."""
    sigma_root_jerk: float
    """Of the root's position, m/s^3."""

    def __post_init__(self) -> None:
        J = len(self.joints)
        set_ = object.__setattr__
        set_(self, "mean_quat_wxyz", readonly("prior mean", self.mean_quat_wxyz, (J - 1, 4)))
        size = 3 * (J - 1)
        set_(self, "covariance", readonly("prior covariance", self.covariance, (size, size)))
        set_(self, "sigma_jerk", readonly("prior sigma_jerk", self.sigma_jerk, (J,)))
        if not np.allclose(np.linalg.norm(self.mean_quat_wxyz, axis=-1), 1.0, atol=1e-6):
            raise ShapeError("prior mean: not unit quaternions")
        symmetric = np.allclose(self.covariance, self.covariance.T, rtol=0, atol=1e-9)
        if not symmetric or np.linalg.eigvalsh(self.covariance)[0] < -1e-9:
            raise ShapeError("prior covariance: not symmetric and positive semidefinite")
        sigmas = np.append(self.sigma_jerk, self.sigma_root_jerk)
        if not np.all((sigmas > 0) & (sigmas < np.inf)):
            raise ShapeError("prior: the standard deviations of jerk must be positive and finite")

    @classmethod
    def load(cls, joints: Sequence[str], path: str | Path | None = None) -> PosePrior:
        """The shipped prior of the skeleton with these joints, or one from a file.

        Raises:
            FileFormatError: the file is no prior, or one of other joints.
        """
        path = Path(path or model_path("pose_prior.npz"))
        arrays = read_npz(path)
        try:
            prior = cls(
                tuple(joints),
                arrays["mean_quat_wxyz"],
                arrays["covariance"],
                arrays["sigma_jerk"],
                float(readonly("prior sigma_root_jerk", arrays["sigma_root_jerk"], ())),
            )
        except (KeyError, InvalidInputError) as error:
            raise FileFormatError(path, f"no pose prior of {len(joints)} joints ({error})") from error
        return prior

    def precision(self, joints: Sequence[str], inflation: float, least: float) -> Array:
        """Inverse covariance (3A, 3A) of some joints' rotations.

        Args:
            joints: A names, without the root. inflation: factor on the standard deviations.
            least: standard deviation added to each in squares, rad.
        """
        index = [i - 1 for i in indices_of("joint of the pose prior", joints, self.joints)]
        rows = (3 * np.repeat(index, 3) + np.tile(range(3), len(index))).astype(int)
        covariance = self.covariance[np.ix_(rows, rows)] * inflation**2
        return np.asarray(np.linalg.inv(covariance + np.eye(len(rows)) * least**2))


def has_prior(skeleton: str) -> bool:
    """Whether a prior is shipped for the skeleton of this name."""
    return skeleton == "total_capture"


@cache
def shipped_prior(joints: tuple[str, ...]) -> PosePrior:
    """The shipped prior, read once."""
    return PosePrior.load(joints)
