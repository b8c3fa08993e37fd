"""Unknowns of an uncalibrated camera: their corrections, estimate and covariance.

::

    focal length  f = (1 + y_0) assumed                                      1
    pitch, roll   R_camera_world = exp(y_1, 0, y_2) assumed, about the centre rad, in the camera's axes
    height        z of the centre in world = assumed + y_3                   m
    distortion    k1 = assumed + y_4                                         1

The heading about the world's vertical and the horizontal position are a choice of the world's axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import freeze
from rtof_kin.core.errors import ViewError
from rtof_kin.data.camera import Camera, CameraUncertainty

UNKNOWNS: Final = ("focal length", "pitch", "roll", "height over the floor", "distortion k1")
COLUMNS: Final = ("camera", "assumed", "found", "sd remaining", "verdict")
"""Headings of `CameraEstimate.table`."""
FOUND, NOT_FOUND = "found", "hardly found"
FOCAL, PITCH, ROLL, HEIGHT, DISTORTION = range(5)
_DEGREES: Final = (float(np.degrees(1.0)), "deg")
_SHARE_FOUND: Final = 0.7
"""Remaining share of a standard deviation from which an unknown counts as not found."""
_STEP: Final = 0.5
"""[prior sigma] of finite differences."""
_LARGEST: Final = 1.5
"""[prior sigma] Largest step of one round."""
_ROUNDS: Final = 4
_SLOPES: Final = 2
"""Rounds that compute the derivatives again."""
_ENOUGH: Final = 0.15
"""[sigma] Step below which the estimate has converged."""
_HALVINGS: Final = 3
_PITCHES: Final = (-1.0, 0.0, 1.0, 2.0)
"""[prior sigma] Pitches that are tried as a start."""
_FURTHEST: Final = 3.0
"""[prior sigma] Largest height that is tried with them."""


@dataclass(frozen=True)
class Evidence:
    """Quantities that have a known value with the true camera; NaN where the recording has none."""

    value: Array
    """(n,) less the value with the true camera."""
    sigma: Array
    """(n,) standard deviation with the true camera."""

    @property
    def known(self) -> Mask:
        """(n,) whether the recording has it."""
        return np.asarray(np.isfinite(self.value + self.sigma), dtype=bool)


@dataclass(frozen=True)
class CameraEstimate:
    """An uncalibrated camera's unknowns, found from the recording."""

    assumed: Camera
    """As declared, with its uncertainty."""
    value: Array
    """(5,) corrections of `UNKNOWNS`, SI units."""
    covariance: Array
    """(5, 5) what remains."""

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
        """Return cameras, each one standard deviation from `found` along a principal axis of what remains.

        Sums of squares of what differs with them are its covariance.
        """
        scale = np.maximum(prior_sigma(self.assumed), 1e-12)
        values, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        steps = [scale * axis * np.sqrt(v) for v, axis in zip(values, axes.T, strict=True) if v > 1e-3]
        return [corrected(self.assumed, self.value + step) for step in steps]

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
    """Return the standard deviations (5,) of `UNKNOWNS` that a camera declares; 0 for what is known.

    Args:
        camera: with or without an uncertainty.
    """
    own = camera.uncertainty or CameraUncertainty()
    roll = own.tilt if own.roll is None else own.roll
    return np.array([own.focal, own.tilt, roll, own.height, own.k1], dtype=np.float64)


def corrected(camera: Camera, y: Array) -> Camera:
    """Return a camera corrected by its unknowns.

    Args:
        y: (5,) of `UNKNOWNS`.
    """
    K, distortion = camera.K.copy(), camera.distortion.copy()
    K[:2, :2] *= 1 + y[FOCAL]
    distortion[0] += y[DISTORTION]
    R = so3.exp(np.array([y[PITCH], 0.0, y[ROLL]])) @ camera.R_camera_world
    centre = camera.center_world + np.array([0.0, 0.0, y[HEIGHT]])
    return replace(camera, K=K, distortion=distortion, R_camera_world=R, t_camera_world=-R @ centre)


def pitch_and_roll(camera: Camera) -> tuple[float, float]:
    """Return how far a camera looks down, and how far its right side is down, rad.

    Args:
        camera: in a world with z up.
    """
    right, _, forward = camera.R_camera_world
    return float(-np.arcsin(np.clip(forward[2], -1, 1))), float(-np.arcsin(np.clip(right[2], -1, 1)))


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

    Gauss-Newton steps with finite differences, from the likeliest of some pitches at which the feet stay on
    the floor; the covariance is the inverse of the Hessian.

    Args:
        evidence: of the recording, reconstructed with a camera; always of the same length, the height of the floor
            first.
        progress: called with (steps done, steps in all).

    Raises:
        ViewError: with the declared camera the person is behind it.
    """
    prior = prior_sigma(camera)
    moving = [i for i in (HEIGHT, FOCAL, PITCH, ROLL) if prior[i] > 0]
    report = progress or (lambda *_: None)
    y, precision = np.zeros(5), np.diag(1 / np.where(prior > 0, prior, 1.0) ** 2)[np.ix_(moving, moving)]
    searched = len(_PITCHES) if {PITCH, HEIGHT} <= {*moving} else 0
    total, hessian = _SLOPES * (len(moving) + 1) + searched + 1, precision
    now, J = evidence(camera), np.zeros((0, 0))
    for done in range(_ROUNDS if moving and now.known.any() else 0):
        if done < _SLOPES:
            report(done * (len(moving) + 1 + searched), total)
            J = _slopes(camera, evidence, now, y, moving, _STEP * prior, J)
        if done == 0 and searched:
            y, now = _best_pitch(camera, evidence, now, moving, prior, J)
        r, weight = _weighted(now)
        hessian = (J.T * weight) @ J + precision
        if done == 0 and y.any():
            continue  # the slopes are those of another place
        step = np.asarray(-np.linalg.solve(hessian, J.T @ (weight * r) + precision @ y[moving]), dtype=float)
        step *= min(1.0, _LARGEST / max(float(np.abs(step / prior[moving]).max()), 1e-9))
        y, now = _moved(camera, evidence, now, y, moving, step)
        if np.all(np.abs(step) < _ENOUGH / np.sqrt(np.diag(hessian))):
            break
    report(total, total)
    covariance = np.diag(prior**2)
    covariance[np.ix_(moving, moving)] = np.linalg.inv(hessian)
    return CameraEstimate(camera, y, covariance)


def _weighted(now: Evidence) -> tuple[Array, Array]:
    """The evidence (n,) and its weights, 0 where the recording has none."""
    weight = np.where(now.known, 1 / np.where(now.known, now.sigma, 1.0) ** 2, 0.0)
    return np.where(now.known, now.value, 0.0), weight


def _level(J: Array, moving: Sequence[int]) -> float:
    """[m/rad] Height per pitch that leaves the floor where it is: its height is the first evidence."""
    if not J.size or not {PITCH, HEIGHT} <= {*moving} or abs(J[0, moving.index(HEIGHT)]) < 1e-6:
        return 0.0
    return float(-J[0, moving.index(PITCH)] / J[0, moving.index(HEIGHT)])


def _slopes(
    camera: Camera,
    evidence: Callable[[Camera], Evidence],
    now: Evidence,
    y: Array,
    moving: Sequence[int],
    steps: Array,
    before: Array,
) -> Array:
    """Derivatives (n, m) of the evidence by the m moving unknowns, of which the height is the first.

    Where the floor sinks away from the feet, lifted bodies lean: pitch is varied together with the height, by
    the derivatives known before.
    """
    J, rise = np.zeros((len(now.value), len(moving))), _level(before, moving)
    for k, i in enumerate(moving):
        with_height = rise if i == PITCH else 0.0
        direction = 1.0 * (np.arange(5) == i)
        direction[HEIGHT] += with_height
        J[:, k] = np.nan_to_num(_slope(camera, evidence, now, y, direction, steps[i]))
        if with_height:
            J[:, k] -= with_height * J[:, 0]
    return J


def _best_pitch(
    camera: Camera, evidence: Callable[[Camera], Evidence], now: Evidence, moving: Sequence[int], prior: Array, J: Array
) -> tuple[Array, Evidence]:
    """The likeliest of some pitches, each at the height at which the feet stand on the floor."""
    rise, slope = _level(J, moving), J[0, moving.index(HEIGHT)] if J.size else 0.0
    best = _unlikely(now, np.zeros(5), prior), np.zeros(5), now
    if not rise or not now.known[0]:
        return best[1:]
    for share in _PITCHES:
        y = np.zeros(5)
        y[PITCH] = share * prior[PITCH]
        y[HEIGHT] = rise * y[PITCH] - now.value[0] / slope
        if not abs(y[HEIGHT]) < _FURTHEST * prior[HEIGHT]:
            continue
        try:
            other = evidence(corrected(camera, y))
        except ViewError:
            continue
        best = min(best, (_unlikely(other, y, prior), y, other), key=lambda found: found[0])
    return best[1:]


def _unlikely(now: Evidence, y: Array, prior: Array) -> float:
    """Twice the negative logarithm of the posterior."""
    r, weight = _weighted(now)
    return float(weight @ r**2 + np.sum((y / np.where(prior > 0, prior, 1.0)) ** 2))


def _slope(
    camera: Camera, evidence: Callable[[Camera], Evidence], now: Evidence, y: Array, direction: Array, step: float
) -> Array:
    """Derivative (n,) of the evidence along a direction, to that side on which the person is in view."""
    for signed in (step, -step):
        try:
            other = evidence(corrected(camera, y + signed * direction))
        except ViewError:
            continue
        return np.asarray((other.value - now.value) / signed)
    return np.zeros_like(now.value)


def _moved(
    camera: Camera, evidence: Callable[[Camera], Evidence], now: Evidence, y: Array, moving: Sequence[int], step: Array
) -> tuple[Array, Evidence]:
    """The unknowns after a step, shortened until the person is in view, and their evidence."""
    for _ in range(_HALVINGS):
        other = y.copy()
        other[moving] += step
        try:
            return other, evidence(corrected(camera, other))
        except ViewError:
            step = step / 2
    return y, now
