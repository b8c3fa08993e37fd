"""Rejection of sensor samples that are stuck or saturated, or that disagree with the solved motion.

Stuck and saturated samples show in a sensor's own data. A sensor that slipped, or whose heading was turned by
a magnet, is only found by comparison with the motion that image and all sensors determine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import Check
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY, BoneImuSequence, ImuSequence
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.poses import PoseSequence

_STUCK = 0.25  # [s] over which a working sensor never repeats a sample
_GONE = 0.6  # [s] without samples from which that is a fault
_SAME = 1e-9
_LEAST_RANGE = 1.5 * STANDARD_GRAVITY  # [m/s^2] smallest range of an accelerometer
_FEWEST_AT_END = 4  # samples at an axis' largest value that make it the end of the range
_AROUND = 0.06  # [s] around a saturated sample that is rejected: averages over it are too small
DISAGREES, _STILL_DISAGREES = np.radians(12.0), np.radians(6.0)
"""Angle [rad] between sensor and motion at which a disagreement is found, and at which it begins and ends."""
_WINDOW = 0.5  # [s] of the running median of that angle; faults closer than this are merged


def reject_imu_outliers(imus: ImuSequence) -> tuple[ImuSequence, tuple[StreamFault, ...]]:
    """Set stuck samples and saturated accelerations to NaN; return the sensors, unchanged if there are none, and the
    faults by sensor.
    """
    stuck = _stuck(imus)
    f = np.where(stuck[..., None], np.nan, imus.f_sensor)
    saturated = _saturated(f, imus.times)
    faults = [
        fault
        for kind, where in ((FaultKind.STUCK, stuck), (FaultKind.SATURATED, saturated))
        for name, own in zip(imus.names, where.T, strict=True)
        for fault in _faults(kind, name, own, imus.times)
    ]
    if not faults:
        return imus, ()
    R = np.where(stuck[..., None, None], np.nan, imus.R_inertial_sensor)
    f = np.where(saturated[..., None], np.nan, f)
    return replace(imus, R_inertial_sensor=R, f_sensor=f), tuple(faults)


def missing_samples(imus: ImuSequence, start: float, stop: float) -> Iterator[StreamFault]:
    """Yield intervals without samples within a span, s; one for all sensors where all have it in common."""
    known = np.asarray(np.isfinite(imus.f_sensor + imus.R_inertial_sensor[..., 0]).all(axis=-1))
    by_sensor = []
    for own in known.T:
        times = imus.times[own]
        edges = np.array([start, *times[(times > start) & (times < stop)], stop])
        by_sensor.append([(float(edges[i]), float(edges[i + 1])) for i in np.flatnonzero(np.diff(edges) > _GONE)])
    shared = set(by_sensor[0]).intersection(*by_sensor[1:])
    yield from (StreamFault(FaultKind.ENDED, "all sensors", *span) for span in sorted(shared))
    for name, spans in zip(imus.names, by_sensor, strict=True):
        yield from (StreamFault(FaultKind.ENDED, name, *span) for span in spans if span not in shared)


def repeated_samples(imus: ImuSequence) -> Mask:
    """Return the mask (T - 1, S) of samples, from the second on, that repeat the one before."""
    T, S = imus.f_sensor.shape[:2]
    values = np.concatenate([imus.R_inertial_sensor.reshape(T, S, 9), imus.f_sensor], axis=2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all(np.abs(np.diff(values, axis=0)) < _SAME, axis=2))


def _stuck(imus: ImuSequence) -> Mask:
    """Return (T, S) samples that repeat one for at least `_STUCK`; constant sensors are simulated at rest."""
    same = repeated_samples(imus)
    stuck = np.zeros(imus.f_sensor.shape[:2], dtype=np.bool_)
    for s in np.flatnonzero(~same.all(axis=0)):
        for start, stop in signals.runs(same[:, s]):
            if imus.times[stop] - imus.times[start] >= _STUCK:
                stuck[start + 1 : stop + 1, s] = True
    return stuck


def _saturated(f_sensor: Array, times: Array) -> Mask:
    """Return (T, S) samples near those where an axis stays at its largest value, the end of the range."""
    size = np.abs(np.nan_to_num(f_sensor))
    largest = size.max(axis=0)
    at_end = (size >= largest * (1 - _SAME)) & (largest > _LEAST_RANGE)
    stays = (at_end[1:] & at_end[:-1]).any(axis=0)
    at_end &= stays & (at_end.sum(axis=0) >= _FEWEST_AT_END)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    wide = 2 * int(np.ceil(_AROUND / step)) + 1
    return np.asarray(binary_dilation(at_end.any(axis=2), np.ones((wide, 1), dtype=np.bool_)))


def _faults(kind: FaultKind, what: str, where: Mask, times: Array) -> Iterator[StreamFault]:
    spans: list[tuple[float, float]] = []
    for start, stop in signals.runs(where):
        first, last = float(times[start]), float(times[stop - 1])
        if spans and first - spans[-1][1] <= _WINDOW:
            spans[-1] = (spans[-1][0], last)
        else:
            spans.append((first, last))
    return (StreamFault(kind, what, *span) for span in spans)


def find_disagreements(
    poses: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel
) -> tuple[StreamFault, ...]:
    """Find intervals, by segment, in which a sensor's orientation differs from the solved motion. Rotation about a bone
    without branches is ignored (soft tissue), as are frames without keypoints.
    """
    faults: list[StreamFault] = []
    for s, joint in enumerate(bone_imus.joints):
        known = np.isfinite(bone_imus.R_world_bone[:, s]).all(axis=(1, 2)) & poses.valid.any(axis=1)
        if not known.any():
            continue
        j = skeleton.names.index(joint)
        off = so3.log(np.swapaxes(poses.R_world_bone[known, j], -1, -2) @ bone_imus.R_world_bone[known, s])
        bone = skeleton.bone_axis(joint)
        off = off - (off @ bone)[:, None] * bone
        width = max(round(_WINDOW * poses.rate_hz), 1)
        padded = np.pad(np.linalg.norm(off, axis=1), (width // 2, width - 1 - width // 2), mode="edge")
        angle = np.median(sliding_window_view(padded, width), axis=1)
        wrong = np.zeros(len(angle), dtype=np.bool_)
        for start, stop in signals.runs(angle > _STILL_DISAGREES):
            wrong[start:stop] = angle[start:stop].max() > DISAGREES
        faults += _faults(FaultKind.DISAGREES, joint, wrong, poses.times[known])
    return tuple(faults)


def merge_faults(faults: Iterable[StreamFault]) -> tuple[StreamFault, ...]:
    """Merge faults of one kind and sensor that overlap or nearly touch."""
    out: list[StreamFault] = []
    for fault in sorted(faults, key=lambda f: (f.what, f.kind.name, f.start)):
        last = out[-1] if out else None
        if last and (last.what, last.kind) == (fault.what, fault.kind) and fault.start < last.stop + _WINDOW:
            out[-1] = replace(last, stop=max(last.stop, fault.stop))
        else:
            out.append(fault)
    return tuple(out)


def mask_faults(bone_imus: BoneImuSequence, faults: Iterable[StreamFault]) -> BoneImuSequence:
    """Return the sensors with NaN during faults."""
    R, a = bone_imus.R_world_bone.copy(), bone_imus.a_world.copy()
    for fault in faults:
        during = (bone_imus.times >= fault.start) & (bone_imus.times <= fault.stop)
        s = bone_imus.joints.index(fault.what)
        R[during, s], a[during, s] = np.nan, np.nan
    return replace(bone_imus, R_world_bone=R, a_world=a)


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
    """Check that sensors are alive and that their samples have the form of a recording, by R_world_inertial (S, 3, 3)
    of their calibration: one check of repeated samples and one of gravity; a failed one names the sensors and the
    cause.

    Orientations map sensor axes to their reference (from quaternions w, x, y, z), and specific force is raw: so the
    mean of ``R_world_inertial R_inertial_sensor f_sensor`` points up with the size of gravity, but for the change of
    velocity over the time. Each usual mistake is undone on the same numbers; the one under which this holds is named.
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
    little = value < _UNEXPLAINED * most  # then a mistake of one sensor fits by chance: all must have it
    explains = [k for k, holds in enumerate(undone) if np.mean(holds[judged if little else wrong]) >= _EXPLAINED]
    names = _listed(imus.names, wrong)
    if not explains and little:
        why = f"{names}: {value:.2g} m/s2, more than usual; no mistake explains it, a brisk movement may"
        return Check.unknown(GRAVITY, "sensors", "m/s2", why)
    if not explains:
        advice = (
            "No usual mistake explains it (sign, gravity removed, quaternion order or inverse). Are axes "
            "swapped or mirrored, is R_world_inertial of these sensors, is the reference's z axis up? "
            "`rtof-kin inspect` looks at each sensor"
        )
        cause = f"{UNEXPLAINED} {names} do not belong together"
        return Check(GRAVITY, names, value, most, "m/s2", advice, cause=cause)
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


def _listed(names: Sequence[str], chosen: Mask) -> str:
    if chosen.all() and len(names) > 1:
        return "all sensors"
    return ", ".join(name for name, own in zip(names, chosen, strict=True) if own)
