"""Check of the form of a recording's sensor samples, and the likely mistake if it is wrong.

A recording has orientations that map sensor axes to their reference (from quaternions w, x, y, z) and raw
specific force. Then the mean of ``R_world_inertial R_inertial_sensor f_sensor`` points up with the size of
gravity, but for the change of velocity over the time. Each usual mistake is undone on the same numbers; the
one under which the law holds is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import Check
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY, ImuSequence
from rtof_kin.inertial.outlier_rejection import repeated_samples

FROZEN, GRAVITY = "longest time of one repeated sample", "mean specific force in world, off gravity"
UNEXPLAINED = "accelerations and orientations of"
_LONGEST_REPEAT = 1.0  # [s] lost radio packets repeat a sample for less
_LEAST_SECONDS = 2.0  # [s] over which a motion's own acceleration averages out
_OFF = 1.0  # [m/s^2] of the mean off gravity; real sensors have up to 0.15 (docs/real_recordings.md)
_VELOCITY = 4.0  # [m/s] of a limb from start to end; the forearm of a simulated dance of 4 s exceeds both
_UNEXPLAINED = 2.0  # multiple of the limit from which samples fail without a known mistake
_EXPLAINED = 0.9  # fraction of the failing sensors that a mistake must explain
_MOST_SAMPLES = 2000


class _Mistake(NamedTuple):
    """A wrong form of samples and its correction."""

    cause: str
    remedy: str
    rotations: Callable[[Array], Array] = lambda R: R
    sign: float = 1.0
    removed: bool = False  # whether gravity was removed from the accelerations


def _from_xyzw(R: Array) -> Array:
    """Return the rotations of quaternions x, y, z, w that were read as w, x, y, z."""
    return so3.from_quat_wxyz(np.roll(so3.to_quat_wxyz(R), 1, axis=-1))


def _inverse(R: Array) -> Array:
    return np.swapaxes(R, -1, -2)


_FLIPPED = "the accelerations have their sign flipped"
_INVERTED = "the orientations are inverted (conjugated quaternions)"
_XYZW = "the quaternions are in the order x, y, z, w instead of w, x, y, z"
_REMOVED = "gravity was removed from the accelerations"
_NEGATE = "multiply f_sensor by -1: it reads +9.81 upwards at rest"
_INVERT = "give R_inertial_sensor, which maps sensor axes to the reference: conjugate the quaternions"
_REORDER = "give the quaternions as w, x, y, z"
_RAW = "give the raw accelerometer, which reads 9.81 upwards at rest"
_MISTAKES = (
    _Mistake(_FLIPPED, _NEGATE, sign=-1.0),
    _Mistake(_REMOVED, _RAW, removed=True),
    _Mistake(_XYZW, _REORDER, _from_xyzw),
    _Mistake(_INVERTED, _INVERT, _inverse),
    _Mistake(f"{_XYZW}, and inverted", f"{_REORDER}, conjugated", lambda R: _inverse(_from_xyzw(R))),
    _Mistake(f"{_FLIPPED}, and {_XYZW}", f"{_NEGATE}; {_REORDER}", _from_xyzw, -1.0),
    _Mistake(f"{_FLIPPED}, and {_INVERTED}", f"{_NEGATE}; {_INVERT}", _inverse, -1.0),
)


def check_form(imus: ImuSequence, R_world_inertial: Array) -> tuple[Check, ...]:
    """Check that sensors are alive and that their samples have the form of a recording.

    Args:
        R_world_inertial: (S, 3, 3) of their calibration.

    Returns:
        One check of repeated samples and one of gravity; a failed one names the sensors and the cause.
    """
    repeats = np.pad(repeated_samples(imus), ((1, 0), (0, 0)))
    return _check_frozen(imus, repeats), _check_gravity(imus, R_world_inertial, repeats)


def _check_frozen(imus: ImuSequence, repeats: Mask) -> Check:
    """Check for repeated samples; a sensor with constant, noiseless gravity is simulated at rest."""
    times, still = imus.times, repeats[1:].all(axis=0)
    simulated = still & (np.abs(np.linalg.norm(imus.f_sensor[0], axis=-1) - STANDARD_GRAVITY) < 1e-6)
    longest = np.array(
        [
            max((times[stop - 1] - times[start - 1] for start, stop in signals.runs(own)), default=0.0)
            for own in np.where(simulated, False, repeats).T
        ]
    )
    frozen, value = longest > _LONGEST_REPEAT, float(longest.max())
    if not frozen.any():
        return Check(FROZEN, "sensors", value, _LONGEST_REPEAT, "s")
    names = _listed(imus.names, frozen)
    advice = "A working sensor never measures the same twice; record again, or leave it out"
    cause = f"{names} {'is' if frozen.sum() == 1 else 'are'} frozen: one sample is repeated for long"
    return Check(FROZEN, names, value, _LONGEST_REPEAT, "s", advice, cause=cause)


def _check_gravity(imus: ImuSequence, R_world_inertial: Array, repeats: Mask) -> Check:
    every = max(1, len(imus.times) // _MOST_SAMPLES)
    f = np.where(repeats[..., None], np.nan, imus.f_sensor)[::every]
    R = imus.R_inertial_sensor[::every]
    known = np.asarray(np.isfinite(f).all(axis=-1) & np.isfinite(R).all(axis=(-2, -1)))
    step = float(np.median(np.diff(imus.times))) * every if len(imus.times) > 1 else 0.0
    seconds = np.asarray(step * known.sum(axis=0))
    judged = np.asarray(seconds >= _LEAST_SECONDS)
    if not judged.any():
        why = f"there are less than {_LEAST_SECONDS:g} s of samples that change"
        return Check.unknown(GRAVITY, "sensors", "m/s2", why)
    f, R = np.where(known[..., None], f, 0.0), np.where(known[..., None, None], R, np.eye(3))
    count = np.maximum(known.sum(axis=0), 1)[:, None]
    limit = np.asarray(_OFF + _VELOCITY / np.maximum(seconds, _LEAST_SECONDS), dtype=np.float64)

    def off(mistake: _Mistake) -> Array:
        """Return (S,) deviation from gravity, m/s^2, with a mistake undone."""
        W_R = R_world_inertial @ mistake.rotations(R)
        mean = mistake.sign * np.einsum("tsij,tsj->si", W_R, f, optimize=True) / count
        return np.asarray(np.linalg.norm(mean if mistake.removed else mean + GRAVITY_WORLD, axis=-1))

    given = off(_Mistake("", ""))
    wrong = np.asarray(judged & (given > limit))
    worst = int(np.argmax(np.where(wrong if wrong.any() else judged, given / limit, -1)))
    value, most = float(given[worst]), float(limit[worst])
    if not wrong.any():
        return Check(GRAVITY, "sensors", value, most, "m/s2")
    undone = np.array([off(mistake) <= limit for mistake in _MISTAKES])
    explains = [k for k, holds in enumerate(undone) if np.mean(holds[wrong]) >= _EXPLAINED]
    names = _listed(imus.names, wrong)
    if not explains:
        return _unexplained(names, value, most)
    first = undone[explains[0]]
    # Inverting the orientation of a sensor that hardly turns may not show: then all have the mistake.
    names = "all sensors" if first[judged].all() else names
    mistake, *others = (_MISTAKES[k] for k in explains)
    advice = f"Undone, gravity points up for {100 * np.mean(first[wrong]):.0f} % of them. "
    advice += mistake.remedy[0].upper() + mistake.remedy[1:]
    if explains[0] == 0:
        advice += ". Or the reference's z axis points down, and R_world_inertial does not turn it up"
    if others:
        advice += f". Or else {' or '.join(other.cause for other in others)}"
    return Check(GRAVITY, names, value, most, "m/s2", advice, cause=mistake.cause)


def _unexplained(names: str, value: float, most: float) -> Check:
    if value < _UNEXPLAINED * most:
        why = f"{names}: {value:.2g} m/s2, more than usual; no mistake explains it, a brisk movement may"
        return Check.unknown(GRAVITY, "sensors", "m/s2", why)
    advice = (
        "No usual mistake explains it (sign, gravity removed, quaternion order or inverse). Are axes "
        "swapped or mirrored, is R_world_inertial of these sensors, is the reference's z axis up? "
        "`rtof-kin inspect` looks at each sensor"
    )
    cause = f"{UNEXPLAINED} {names} do not belong together"
    return Check(GRAVITY, names, value, most, "m/s2", advice, cause=cause)


def _listed(names: Sequence[str], chosen: Mask) -> str:
    if chosen.all() and len(names) > 1:
        return "all sensors"
    return ", ".join(name for name, own in zip(names, chosen, strict=True) if own)
