"""Unknown errors of camera, detector and floor; see `unknowns`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes
from rtof_kin.calibration.unknowns import Isotropic, Unknown, each
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

_LEAST_SHARE: Final = 0.25
"""Constant part of the errors, per sigma of a bias's prior, below which there is no bias."""
_CLOSED_PX: Final = 1e-3
"""[px] Prior of a bias where there is none."""


@dataclass(frozen=True)
class ImageBias(Unknown):
    """Constant error of a detector's landmarks in the image."""

    items: tuple[str, ...]
    sigma_px: Array
    """(L,) px per axis."""
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
        return Changes(image=-each(np.broadcast_to(np.eye(2), (len(at.times), len(self.items), 2, 2))))


@dataclass(frozen=True)
class Places(Isotropic):
    """Error of the position of each landmark in its segment, linearised at the initial guess."""

    items: tuple[str, ...]
    sigma: float
    """[m] per axis."""
    slopes: Array
    """(T, L, 2, 3) px per m along the segments' axes (`ImagePoints.slopes`)."""
    name = "place"
    width = 3

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Move the landmarks in the image."""
        shift = np.einsum("tlij,lj->tli", self.slopes, y.reshape(-1, 3))
        return given.changed(uv_px=given.rows["uv_px"] - shift)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives along the segments' axes."""
        return Changes(image=-each(self.slopes[at.index]))


@dataclass(frozen=True)
class Focal(Isotropic):
    """Relative error of the focal length."""

    sigma: float
    """[1]"""
    name = "focal length"
    items = ("camera",)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Scale the focal length."""
        K = np.array(given.constant["K"])
        K[:2, :2] *= 1 + y[0]
        return given.known(K=K)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives away from the principal point."""
        from_centre = at.image_by_point[0] - at.given.constant["K"][:2, 2]
        return Changes(image=-from_centre[..., None] / (1 + y[0]))


@dataclass(frozen=True)
class Tilt(Isotropic):
    """Error of the camera's orientation, about its centre."""

    sigma: float
    """[rad] about each axis."""
    name = "camera tilt"
    items = ("camera",)
    width = 3

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate the camera."""
        turn, known = so3.exp(y), given.constant
        return given.known(R_camera_world=turn @ known["R_camera_world"], t_camera_world=turn @ known["t_camera_world"])

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives of the landmarks rotating the other way about the camera."""
        R = at.given.constant["R_camera_world"]
        camera = at.landmarks @ R.T + at.given.constant["t_camera_world"]
        return Changes(points=-R.T @ so3.skew(camera) @ quat.right_jacobian(-y))


@dataclass(frozen=True)
class Ankles(Isotropic):
    """Error of the ankles' height over the floor; people and shoes differ, and heels leave the floor."""

    sigma: float
    """[m]"""
    name = "ankle height"
    nuisance = True
    items = ("feet",)

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Raise the floor."""
        return given.known(floor=given.constant["floor"] + y)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives, equal for both feet in all frames."""
        return Changes(feet=-np.ones((len(at.times), len(at.joints.feet), 1, 1)))
