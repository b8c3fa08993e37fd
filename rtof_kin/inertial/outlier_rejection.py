"""Rejection of sensor samples that are stuck or saturated, or that disagree with the solved motion.

Stuck and saturated samples show in a sensor's own data. A sensor that slipped, or whose heading was turned by
a magnet, is only found by comparison with the motion that image and all sensors determine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.imu import STANDARD_GRAVITY, BoneImuSequence, ImuSequence
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
    """Set stuck samples and saturated accelerations to NaN.

    Returns:
        The sensors, unchanged if there are none, and the faults by sensor.
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
    """Yield intervals without samples within a span; one for all sensors where all have it in common.

    Args:
        start, stop: s.
    """
    known = np.asarray(np.isfinite(imus.f_sensor + imus.R_inertial_sensor[..., 0]).all(axis=-1))
    by_sensor = [_without(imus.times[own], start, stop) for own in known.T]
    shared = set(by_sensor[0]).intersection(*by_sensor[1:])
    yield from (StreamFault(FaultKind.ENDED, "all sensors", *span) for span in sorted(shared))
    for name, spans in zip(imus.names, by_sensor, strict=True):
        yield from (StreamFault(FaultKind.ENDED, name, *span) for span in spans if span not in shared)


def _without(times: Array, start: float, stop: float) -> list[tuple[float, float]]:
    """Gaps longer than `_GONE` between samples within a span."""
    inside = times[(times > start) & (times < stop)]
    edges = np.array([start, *inside, stop])
    return [(float(edges[i]), float(edges[i + 1])) for i in np.flatnonzero(np.diff(edges) > _GONE)]


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
    """Find intervals in which a sensor's orientation differs from the solved motion.

    Rotation about a bone without branches is ignored (soft tissue), as are frames without keypoints.

    Args:
        skeleton: the subject's.

    Returns:
        Faults by segment.
    """
    faults: list[StreamFault] = []
    for s, joint in enumerate(bone_imus.joints):
        known = np.isfinite(bone_imus.R_world_bone[:, s]).all(axis=(1, 2)) & poses.valid.any(axis=1)
        if not known.any():
            continue
        j = skeleton.names.index(joint)
        off = so3.log(np.swapaxes(poses.R_world_bone[known, j], -1, -2) @ bone_imus.R_world_bone[known, s])
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) == 1:
            bone = so3.unit(skeleton.joint_offsets[children[0]])
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
    """Merge faults of one kind and sensor that overlap or nearly touch.

    Args:
        faults: in any order.
    """
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
