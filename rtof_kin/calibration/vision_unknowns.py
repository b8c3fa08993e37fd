"""What may be wrong with camera, detector and floor all through a recording; see `unknowns`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.calibration.residuals import Changes, Evidence, Situation
from rtof_kin.calibration.unknowns import Unlimited, each
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
_LEAST_SHARE = 0.25
"""Of a bias' prior, that errors which last must have for one to be looked for."""
_CLOSED_PX = 1e-3
"""Prior of a bias where there is none to look for."""


@dataclass(frozen=True)
class ImageBias:
    """By how much a detector sees each landmark beside where it is, always in the same direction."""

    items: tuple[str, ...]
    sigma_px: Array
    """(L,) px per axis."""
    name = "image bias"
    searched = False
    shrinks = True
    nuisance = False

    def limited(self, lasting_px: float) -> Self:
        """With biases of at most the errors that last: white errors leave no room for any, nor do those
        that a body model leaves of a perfect detector.
        """
        lasts = lasting_px > _LEAST_SHARE * self.sigma_px
        return replace(self, sigma_px=np.where(lasts, np.minimum(self.sigma_px, lasting_px), _CLOSED_PX))

    @property
    def covariance(self) -> Array:
        """Of u and v, landmark after landmark."""
        return np.diag(np.repeat(self.sigma_px, 2) ** 2)

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Landmarks moved back."""
        return evidence.changed(uv_px=evidence.rows["uv_px"] - y.reshape(-1, 2))

    def changes(self, at: Situation, y: Array) -> Changes:
        """Each its own."""
        return Changes(image=-each(np.broadcast_to(np.eye(2), (len(at.times), len(self.items), 2, 2))))


@dataclass(frozen=True)
class Places(Unlimited):
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
        return Changes(image=-each(self.slopes[at.index]))


@dataclass(frozen=True)
class Focal(Unlimited):
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
class Tilt(Unlimited):
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


@dataclass(frozen=True)
class Ankles(Unlimited):
    """How much higher than they are held to be ankles are over a floor that they stand on: people and
    shoes differ, and heels leave the floor before the foot does.
    """

    sigma: float
    """[m]"""
    name = "ankle height"
    searched = False
    nuisance = True
    items = ("feet",)

    @property
    def covariance(self) -> Array:
        """(1, 1)"""
        return np.full((1, 1), self.sigma**2)

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """As if the floor were as much higher."""
        return evidence.known(floor=evidence.constant["floor"] + y)

    def changes(self, at: Situation, y: Array) -> Changes:
        """The same for both feet in all frames."""
        return Changes(feet=-np.ones((len(at.times), len(at.joints.feet), 1, 1)))
