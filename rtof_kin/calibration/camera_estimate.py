"""What may be wrong about a declared camera, for errors of positions too, and the estimate of an uncalibrated one.

::

    focal length     f = (1 + y) declared                                1
    pitch, roll      R_camera_world = exp(y_1, 0, y_2) declared, about the centre: about the camera's x and z axes, rad
    height           z of the centre in world = declared + y             m
    distortion       k1 = declared + y                                   1
    size of the body, principal point to the right and down, heading     1, rad, rad, rad

The first five are estimated where a camera is not calibrated. Heading about the world's vertical and horizontal
position are a choice of the world's axes then; with sensors a declared heading may be wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import freeze
from rtof_kin.core.errors import ViewError
from rtof_kin.core.jobs import side_by_side
from rtof_kin.data.camera import Camera, CameraUncertainty

FOCAL, PITCH, ROLL, HEIGHT, DISTORTION, SIZE, RIGHT, DOWN, HEADING = range(9)
_DEG: Final = float(np.radians(1.0))
STATED: Final = "state the accuracy of its calibration"
_MEASURED: Final = "measure the camera's height and give the floor's"


@dataclass(frozen=True)
class CameraUnknown:
    """One quantity that may be wrong."""

    name: str  # In sentences
    declared: float  # Standard deviation of what is declared without its accuracy
    remedy: str = STATED  # What makes it known; `STATED` is another one where the camera is not calibrated
    estimated: str = ""  # Name where it is estimated; empty for what is not


CAMERA_UNKNOWNS: Final = (
    # Between a calibration and an unknown phone (0.15), as videos are cropped, zoomed and stabilised.
    CameraUnknown(
        "the focal length",
        0.12,
        f"{STATED}, or walk two metres towards the camera with sensors on thighs and shanks",
        "focal length",
    ),
    CameraUnknown("the camera's tilt", 2 * _DEG, _MEASURED, "pitch"),
    CameraUnknown("the camera's roll", 2 * _DEG, _MEASURED, "roll"),
    CameraUnknown("the height of camera or floor", 0.05, _MEASURED, "height over the floor"),
    CameraUnknown("the distortion", 0.0, estimated="distortion k1"),
    CameraUnknown("the size of the body", 0.04, "give the person's height"),
    CameraUnknown("the principal point", 0.02),
    CameraUnknown("the principal point", 0.02),
    CameraUnknown("the camera's heading", 3 * _DEG, _MEASURED),
)
UNKNOWNS: Final = tuple(unknown.estimated for unknown in CAMERA_UNKNOWNS if unknown.estimated)
"""The five that are estimated."""


def sigma_of(own: CameraUncertainty | None) -> Array:
    """Return standard deviations (9,) by the order above; 0 for what they do not say, or is known."""
    own, sigma = own or CameraUncertainty(), np.zeros(len(CAMERA_UNKNOWNS))
    roll = own.tilt if own.roll is None else own.roll
    sigma[: len(UNKNOWNS)] = own.focal, own.tilt, roll, own.height, own.k1
    return sigma


def refocused(camera: Camera, y: float) -> Camera:
    """Return a camera whose focal length is 1 + y times as long."""
    K = camera.K.copy()
    K[:2, :2] *= 1 + y
    return replace(camera, K=K)


def turned(camera: Camera, y: Array, rise: float = 0.0) -> Camera:
    """Return a camera turned about its centre by y (3,), rad, in its own axes, and raised by `rise` along z, m."""
    R, centre = so3.exp(y) @ camera.R_camera_world, camera.center_world + np.array([0.0, 0.0, rise])
    return replace(camera, R_camera_world=R, t_camera_world=-R @ centre)


def corrected(camera: Camera, y: Array) -> Camera:
    """Return a camera corrected by y (5,), its `UNKNOWNS`."""
    distortion = camera.distortion.copy()
    distortion[0] += y[DISTORTION]
    camera = refocused(replace(camera, distortion=distortion), y[FOCAL])
    return turned(camera, np.array([y[PITCH], 0.0, y[ROLL]]), y[HEIGHT])


def pitch_and_roll(camera: Camera) -> tuple[float, float]:
    """Return how far a camera, in a world with z up, looks down, and how far its right side is down, rad."""
    right, _, forward = camera.R_camera_world
    return float(-np.arcsin(np.clip(forward[2], -1, 1))), float(-np.arcsin(np.clip(right[2], -1, 1)))


def displacements(camera: Camera, p_world: Array) -> Array:
    """Return by how much points (..., 3), m, are off per unit of each unknown (..., 3, 9), m; 0 for the distortion."""
    right, down, forward = camera.R_camera_world
    away = p_world - camera.center_world
    depth, up = (away @ forward)[..., None], np.array([0.0, 0.0, 1.0])
    out = np.zeros((*away.shape, len(CAMERA_UNKNOWNS)))
    out[..., FOCAL], out[..., SIZE] = -depth * forward, -away
    out[..., RIGHT], out[..., DOWN] = depth * right, depth * down
    for unknown, axis in ((PITCH, right), (HEADING, up), (ROLL, forward)):
        out[..., unknown] = np.cross(axis, away)
    out[..., HEIGHT] = -up
    return out


COLUMNS: Final = ("camera", "assumed", "found", "sd remaining", "verdict")  # Headings of `CameraEstimate.table`
FOUND, NOT_FOUND = "found", "hardly found"
_DEGREES: Final = (float(np.degrees(1.0)), "deg")
_SHARE_FOUND = 0.7  # Remaining share of a standard deviation from which an unknown counts as not found
_STEP = 0.5  # [prior sigma] of finite differences
_LARGEST = 1.5  # [prior sigma] Largest step of one round
_ROUNDS: Final = 4
_SLOPES = 2  # Rounds that compute the derivatives again
_ENOUGH = 0.15  # [sigma] Step below which the estimate has converged
_HALVINGS: Final = 3
_PITCHES = (-1.0, 0.0, 1.0, 2.0)  # [prior sigma] Pitches that are tried as a start
_FURTHEST = 3.0  # [prior sigma] Largest height that is tried with them


@dataclass(frozen=True)
class Evidence:
    """Quantities that have a known value with the true camera; NaN where the recording has none."""

    value: Array  # (n,) less the value with the true camera
    sigma: Array  # (n,) standard deviation with the true camera

    @property
    def known(self) -> Mask:
        """(n,) whether the recording has it."""
        return np.asarray(np.isfinite(self.value + self.sigma), dtype=bool)

    @property
    def weighted(self) -> tuple[Array, Array]:
        """The values (n,) and their weights, 0 where the recording has none."""
        weight = np.where(self.known, 1 / np.where(self.known, self.sigma, 1.0) ** 2, 0.0)
        return np.where(self.known, self.value, 0.0), weight


@dataclass(frozen=True)
class CameraEstimate:
    """An uncalibrated camera's unknowns, found from the recording."""

    assumed: Camera  # As declared, with its uncertainty
    value: Array  # (5,) corrections of `UNKNOWNS`, SI units
    covariance: Array  # (5, 5) what remains

    def __post_init__(self) -> None:
        freeze(self, "camera estimate", value=(5,), covariance=(5, 5))

    @property
    def sigma(self) -> Array:
        """(5,) standard deviations of what remains."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def found(self) -> Camera:
        """The corrected camera, with what remains as its uncertainty."""
        f, pitch, roll, height, k1 = self.sigma
        left = CameraUncertainty(float(f), float(pitch), float(height), float(k1), float(roll), of_motion=True)
        return replace(corrected(self.assumed, self.value), uncertainty=left)

    def deviations(self) -> list[Camera]:
        """Return cameras, each one standard deviation from `found` along a principal axis of what remains, none lower.

        Sums of squares of what differs with them are its covariance. Of the two directions of an axis the one up is
        taken: one standard deviation down may be below the floor.
        """
        scale = np.maximum(prior_sigma(self.assumed), 1e-12)
        values, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        steps = [scale * axis * np.sqrt(v) for v, axis in zip(values, axes.T, strict=True) if v > 1e-3]
        return [corrected(self.assumed, self.value + (-step if step[HEIGHT] < 0 else step)) for step in steps]

    def table(self) -> list[tuple[str, str, str, str, str]]:
        """Return rows of `COLUMNS`: unknown, assumed and found with their standard deviations, verdict."""
        prior, left, rows = prior_sigma(self.assumed), self.sigma, list[tuple[str, str, str, str, str]]()
        units: tuple[tuple[float, str], ...]
        units = (self.assumed.K[0, 0], "px"), _DEGREES, _DEGREES, (1.0, "m"), (1.0, "")
        before, after = _values(self.assumed), _values(self.found)
        for i, (unit, word) in enumerate(units):
            if prior[i] > 0:
                pairs = (before[i], unit * prior[i]), (after[i], unit * left[i])
                texts = tuple(f"{value:.4g} ± {_short(sigma)} {word}".strip() for value, sigma in pairs)
                share = left[i] / prior[i]
                verdict = FOUND if share < _SHARE_FOUND else NOT_FOUND
                rows.append((UNKNOWNS[i], texts[0], texts[1], f"{100 * share:.0f} %", verdict))
        return rows

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was assumed, what was found, and what the person can do about the rest."""
        found = "; ".join(f"{name} {was} assumed, {now} found" for name, was, now, *_ in self.table())
        text = f"the camera is not calibrated ({found}); what remains is in the stated uncertainty"
        out: tuple[str, ...] = (text,)
        prior = prior_sigma(self.assumed)
        off = np.abs(self.value) > 3 * np.where(prior > 0, prior, np.inf)
        for i in np.flatnonzero(off):
            out += (
                f"camera: the {UNKNOWNS[i]} found is more than three standard deviations from the one "
                "assumed; check the video's size, the floor and the person's height",
            )
        if prior[FOCAL] > 0 and self.sigma[FOCAL] > _SHARE_FOUND * prior[FOCAL]:
            out += (
                f"the focal length is not found from this recording, and distances from the camera are "
                f"uncertain by {100 * self.sigma[FOCAL]:.0f} %: walk two metres towards the camera and back"
                " with sensors on thighs and shanks, or calibrate it once with a chessboard",
            )
        return out


def prior_sigma(camera: Camera) -> Array:
    """Return the standard deviations (5,) of `UNKNOWNS` that a camera declares; 0 for what is known."""
    return sigma_of(camera.uncertainty)[: len(UNKNOWNS)]


def _values(camera: Camera) -> tuple[float, ...]:
    """Values of `UNKNOWNS`: px, degrees, m, 1."""
    pitch, roll = np.degrees(pitch_and_roll(camera))
    return camera.K[0, 0], pitch, roll, camera.center_world[2], camera.distortion[0]


def _short(sigma: float) -> str:
    """Two digits, or whole numbers from 100 on."""
    return f"{sigma:.2g}" if sigma < 99.5 else f"{sigma:.0f}"


def estimate_camera(
    camera: Camera, evidence: Callable[[Camera], Evidence], progress: Callable[[int, int], None] | None = None
) -> CameraEstimate:
    """Find the unknowns at which the evidence and the declared camera agree best.

    Gauss-Newton steps with finite differences, from the likeliest of some pitches at which the feet stay on the floor;
    the covariance is the inverse of the Hessian. `ViewError`: with the declared camera the person is behind it.

    Args:
        evidence: of the recording, reconstructed with a camera; always of the same length, the height of the floor
            first.
        progress: called with (steps done, steps in all).
    """
    at, report = _Search(camera, evidence), progress or (lambda *_: None)
    moving, prior = at.moving, at.prior
    precision = np.diag(1 / np.where(prior > 0, prior, 1.0) ** 2)[np.ix_(moving, moving)]
    searched = len(_PITCHES) if {PITCH, HEIGHT} <= {*moving} else 0
    total, hessian = _SLOPES * (len(moving) + 1) + searched + 1, precision
    for done in range(_ROUNDS if moving and at.now.known.any() else 0):
        if done < _SLOPES:
            report(done * (len(moving) + 1 + searched), total)
            at.differentiate()
        if done == 0 and searched:
            at.try_pitches()
        r, weight = at.now.weighted
        hessian = (at.J.T * weight) @ at.J + precision
        if done == 0 and at.y.any():
            continue  # the slopes are those of another camera
        step = np.asarray(-np.linalg.solve(hessian, at.J.T @ (weight * r) + precision @ at.y[moving]), dtype=float)
        step *= min(1.0, _LARGEST / max(float(np.abs(step / prior[moving]).max()), 1e-9))
        at.move(step)
        if np.all(np.abs(step) < _ENOUGH / np.sqrt(np.diag(hessian))):
            break
    report(total, total)
    covariance = np.diag(prior**2)
    covariance[np.ix_(moving, moving)] = np.linalg.inv(hessian)
    return CameraEstimate(camera, at.y, covariance)


class _Search:
    """The evidence of a recording around the present unknowns.

    Attributes:
        prior: (5,) standard deviations. moving: the m unknowns that are estimated, the height first.
        y: (5,) present unknowns. now: their evidence. J: (n, m) its derivatives by the moving ones.
    """

    def __init__(self, camera: Camera, evidence: Callable[[Camera], Evidence]) -> None:
        self.camera, self.evidence, self.prior = camera, evidence, prior_sigma(camera)
        self.moving = [i for i in (HEIGHT, FOCAL, PITCH, ROLL) if self.prior[i] > 0]
        self.y, self.now, self.J = np.zeros(len(UNKNOWNS)), evidence(camera), np.zeros((0, 0))

    def at(self, y: Array) -> Evidence | None:
        """Return the evidence of other unknowns; None where the person is out of view."""
        try:
            return self.evidence(corrected(self.camera, y))
        except ViewError:
            return None

    @property
    def rise(self) -> float:
        """[m/rad] Height per pitch that leaves the floor where it is: its height is the first evidence."""
        J, moving = self.J, self.moving
        if not J.size or not {PITCH, HEIGHT} <= {*moving} or abs(J[0, moving.index(HEIGHT)]) < 1e-6:
            return 0.0
        return float(-J[0, moving.index(PITCH)] / J[0, moving.index(HEIGHT)])

    def differentiate(self) -> None:
        """Set the derivatives by finite differences.

        Where the floor sinks away from the feet, lifted bodies lean: pitch is varied together with the height, by
        the derivatives known before.
        """
        rise = self.rise
        self.J = np.stack(list(side_by_side(self.slope, self.moving)), axis=1)
        if rise:
            self.J[:, self.moving.index(PITCH)] -= rise * self.J[:, 0]

    def slope(self, i: int) -> Array:
        """Return derivatives (n,) by an unknown, by a step to that side on which the person is in view."""
        direction = 1.0 * (np.arange(len(self.y)) == i)
        direction[HEIGHT] += self.rise * (i == PITCH)
        for step in (_STEP * self.prior[i], -_STEP * self.prior[i]):
            if (other := self.at(self.y + step * direction)) is not None:
                return np.asarray(np.nan_to_num((other.value - self.now.value) / step))
        return np.zeros(len(self.now.value))

    def try_pitches(self) -> None:
        """Move to the likeliest of some pitches, each at the height at which the feet stand on the floor."""
        rise, prior = self.rise, self.prior
        if not rise or not self.now.known[0]:
            return
        slope = self.J[0, self.moving.index(HEIGHT)]
        ys = np.zeros((len(_PITCHES), len(self.y)))
        ys[:, PITCH] = np.array(_PITCHES) * prior[PITCH]
        ys[:, HEIGHT] = rise * ys[:, PITCH] - self.now.value[0] / slope
        ys = ys[np.abs(ys[:, HEIGHT]) < _FURTHEST * prior[HEIGHT]]
        found = [(self.y, self.now), *zip(ys, side_by_side(self.at, ys), strict=True)]
        seen = [(self._unlikely(other, y), y, other) for y, other in found if other is not None]
        _, self.y, self.now = min(seen, key=lambda one: one[0])

    def _unlikely(self, now: Evidence, y: Array) -> float:
        r, weight = now.weighted
        return float(weight @ r**2 + np.sum((y / np.where(self.prior > 0, self.prior, 1.0)) ** 2))

    def move(self, step: Array) -> None:
        """Take a step (m,), shortened until the person is in view."""
        for _ in range(_HALVINGS):
            y = self.y.copy()
            y[self.moving] += step
            if (other := self.at(y)) is not None:
                self.y, self.now = y, other
                return
            step = step / 2
