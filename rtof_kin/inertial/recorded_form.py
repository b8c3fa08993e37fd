"""Whether samples are in the form that a recording takes, and which mistake they are of where not.

A recording takes orientations that map sensor axes to their reference (of a quaternion w, x, y, z) and
raw specific force. Then the mean of ``R_world_inertial R_inertial_sensor f_sensor`` points up and is one
gravity long, but for the change of velocity over the time. Each usual mistake is undone in turn on the
same numbers; the one under which the law holds is what the file means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY, ImuSequence

Array = NDArray[np.float64]
FROZEN, GRAVITY = "longest time of one repeated sample", "mean specific force in world, off gravity"
LONGEST_REPEAT = 1.0
"""[s] A radio that loses packets repeats a sample for less."""
LEAST_SECONDS = 2.0
"""[s] of samples, in which a motion's own acceleration averages out."""
OFF, VELOCITY = 1.0, 4.0
"""[m/s^2] by which the mean may be off gravity, and [m/s] of a limb from the start to the end. Real
sensors have up to 0.15 m/s^2 (docs/real_recordings.md), the forearm of a simulated dance of 4 s more
than both."""
_UNEXPLAINED = 2.0
"""Times the limit from which samples are accused that no usual mistake explains."""
_EXPLAINED = 0.9
"""Share of the concerned sensors for which a mistake must explain the samples."""
_MOST_SAMPLES = 2000
_SAME = 1e-9


@dataclass(frozen=True)
class _Mistake:
    """What samples may be instead of what a recording takes, and how to undo it."""

    cause: str
    """What is wrong with the 'accelerations' or 'orientations' of the sensors that it is said of."""
    remedy: str
    rotations: Callable[[Array], Array] = lambda R: R
    sign: float = 1.0
    removed: bool = False


def _from_xyzw(R: Array) -> Array:
    """The rotations of quaternions x, y, z, w that were read as w, x, y, z."""
    return so3.from_quat_wxyz(np.roll(so3.to_quat_wxyz(R), 1, axis=-1))


def _inverse(R: Array) -> Array:
    return np.swapaxes(R, -1, -2)


_FLIPPED = "the accelerations have their sign flipped"
_INVERTED = "the orientations are inverted (conjugated quaternions)"
_XYZW = "the quaternions are in the order x, y, z, w instead of w, x, y, z"
_NEGATE = "multiply f_sensor by -1: it reads +9.81 upwards at rest"
_INVERT = "give R_inertial_sensor, which maps sensor axes to the reference: conjugate the quaternions"
_REORDER = "give the quaternions as w, x, y, z"
_MISTAKES = (
    _Mistake(_FLIPPED, _NEGATE, sign=-1.0),
    _Mistake(
        "gravity was removed from the accelerations",
        "give the raw accelerometer, which reads 9.81 upwards at rest", removed=True,
    ),
    _Mistake(_XYZW, _REORDER, _from_xyzw),
    _Mistake(_INVERTED, _INVERT, _inverse),
    _Mistake(f"{_XYZW}, and inverted", f"{_REORDER}, conjugated", lambda R: _inverse(_from_xyzw(R))),
    _Mistake(f"{_FLIPPED}, and {_XYZW}", f"{_NEGATE}; {_REORDER}", _from_xyzw, -1.0),
    _Mistake(f"{_FLIPPED}, and {_INVERTED}", f"{_NEGATE}; {_INVERT}", _inverse, -1.0),
)  # fmt: skip


def check_form(imus: ImuSequence, R_world_inertial: Array) -> tuple[Check, ...]:
    """Checks that sensors are alive, and that what they measure is what a recording takes.

    Args:
        imus: S sensors, as recorded.
        R_world_inertial: (S, 3, 3) of their calibration.

    Returns:
        One check of each sensor's repeats and one of gravity for all; sensors with the same mistake
        share one that leads with its cause.
    """
    repeats = _repeats(imus)
    return (_check_frozen(imus, repeats), *_check_gravity(imus, R_world_inertial, repeats))


# --- frozen --------------------------------------------------------------------------------------


def _repeats(imus: ImuSequence) -> NDArray[np.bool_]:
    """(T, S) whether a sample repeats the one before."""
    T, S = imus.f_sensor.shape[:2]
    values = np.concatenate([imus.R_inertial_sensor.reshape(T, S, 9), imus.f_sensor], axis=2)
    with np.errstate(invalid="ignore"):
        same = np.asarray((np.abs(np.diff(values, axis=0)) < _SAME).all(axis=2))
    return np.concatenate([np.zeros((1, S), dtype=np.bool_), same])


def _check_frozen(imus: ImuSequence, repeats: NDArray[np.bool_]) -> Check:
    """A sensor that never measures anything but gravity, without any noise, is made up of a body that is
    still there.
    """
    times, still = imus.times, repeats[1:].all(axis=0)
    made_up = still & (np.abs(np.linalg.norm(imus.f_sensor[0], axis=-1) - STANDARD_GRAVITY) < 1e-6)
    longest = np.array([
        max((times[stop - 1] - times[start - 1] for start, stop in signals.runs(own)), default=0.0)
        for own in np.where(made_up, False, repeats).T
    ])  # fmt: skip
    frozen = longest > LONGEST_REPEAT
    value = float(longest.max())
    if not frozen.any():
        return Check(FROZEN, "sensors", value, LONGEST_REPEAT, "s")
    names = _listed(imus.names, frozen)
    be = "is" if frozen.sum() == 1 else "are"
    return Check(
        FROZEN, names, value, LONGEST_REPEAT, "s",
        "A sensor that is alive never measures the same twice; record again, or leave it out",
        cause=f"{names} {be} frozen: one sample is repeated for long",
    )  # fmt: skip


# --- gravity -------------------------------------------------------------------------------------


def _check_gravity(imus: ImuSequence, R_world_inertial: Array, repeats: NDArray[np.bool_]) -> list[Check]:
    every = max(1, len(imus.times) // _MOST_SAMPLES)
    f = np.where(repeats[..., None], np.nan, imus.f_sensor)[::every]
    R = imus.R_inertial_sensor[::every]
    known = np.asarray(np.isfinite(f).all(axis=-1) & np.isfinite(R).all(axis=(-2, -1)))
    step = float(np.median(np.diff(imus.times))) * every if len(imus.times) > 1 else 0.0
    seconds = np.asarray(step * known.sum(axis=0))
    judged = np.asarray(seconds >= LEAST_SECONDS)
    if not judged.any():
        why = f"there are less than {LEAST_SECONDS:g} s of samples that change"
        return [Check.unknown(GRAVITY, "sensors", "m/s2", why)]
    f, R = np.where(known[..., None], f, 0.0), np.where(known[..., None, None], R, np.eye(3))
    count = np.maximum(known.sum(axis=0), 1)[:, None]
    limit = np.asarray(OFF + VELOCITY / np.maximum(seconds, LEAST_SECONDS), dtype=np.float64)

    def off(mistake: _Mistake) -> Array:
        """(S,) m/s^2 by which the mean is off where that mistake is undone."""
        W_R = R_world_inertial @ mistake.rotations(R)
        mean = mistake.sign * np.einsum("tsij,tsj->si", W_R, f, optimize=True) / count
        return np.asarray(np.linalg.norm(mean if mistake.removed else mean + GRAVITY_WORLD, axis=-1))

    given = off(_Mistake("", ""))
    wrong = np.asarray(judged & (given > limit))
    if not wrong.any():
        worst = int(np.argmax(np.where(judged, given / limit, -1)))
        return [Check(GRAVITY, "sensors", float(given[worst]), float(limit[worst]), "m/s2")]
    undone = np.array([off(mistake) <= limit for mistake in _MISTAKES])
    return [_named(imus.names, wrong, judged, given, limit, undone)]


def _named(
    names: Sequence[str], wrong: NDArray[np.bool_], judged: NDArray[np.bool_], given: Array,
    limit: Array, undone: NDArray[np.bool_],
) -> Check:  # fmt: skip
    """The failed check of the sensors that are wrong, with the mistake that explains most of them.

    Args:
        undone: (M, S) whether the law holds with each mistake undone.
    """
    worst = int(np.argmax(np.where(wrong, given / limit, -1)))
    value, most = float(given[worst]), float(limit[worst])
    explains = [k for k, holds in enumerate(undone) if np.mean(holds[wrong]) >= _EXPLAINED]
    if not explains:
        of = _listed(names, wrong)
        if value < _UNEXPLAINED * most:
            why = f"{of}: {value:.2g} m/s2, more than usual; no mistake explains it, a brisk movement may"
            return Check.unknown(GRAVITY, "sensors", "m/s2", why)
        return Check(
            GRAVITY, of, value, most, "m/s2",
            "No usual mistake explains it (sign, gravity removed, quaternion order or inverse). Are axes "
            "swapped or mirrored, is R_world_inertial of these sensors, is the reference's z axis up? "
            "`rtof-kin inspect` looks at each sensor",
            cause=f"accelerations and orientations of {of} do not belong together",
        )  # fmt: skip
    first, *others = explains
    # What inversion does to a sensor that hardly turns need not show: then all have the mistake.
    all_of_them = bool(undone[first][judged].all())
    advice = f"Undone, gravity points up for {100 * np.mean(undone[first][wrong]):.0f} % of them. "
    advice += _MISTAKES[first].remedy[0].upper() + _MISTAKES[first].remedy[1:]
    if first == 0:
        advice += ". Or the reference's z axis points down, and R_world_inertial does not turn it up"
    if others:
        advice += f". Or else {' or '.join(_MISTAKES[k].cause for k in others)}"
    of = "all sensors" if all_of_them else _listed(names, wrong)
    return Check(GRAVITY, of, value, most, "m/s2", advice, cause=_MISTAKES[first].cause)


def _listed(names: Sequence[str], chosen: NDArray[np.bool_]) -> str:
    if chosen.all() and len(names) > 1:
        return "all sensors"
    return ", ".join(name for name, own in zip(names, chosen, strict=True) if own)
