"""Sensors that stick, are at the end of their range, or disagree with everything else.

The first two are seen in a sensor's own samples. A sensor that slipped, or whose heading a magnet turned,
is at peace with itself; only the motion that image and all sensors agree on most tells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.data.imu import STANDARD_GRAVITY, BoneImuSequence, ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.data.stream_faults import FaultKind, StreamFault

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
STUCK = 0.25
"""s over which a sensor that is alive never gives the same sample."""
_SAME = 1e-9
LEAST_RANGE = 1.5 * STANDARD_GRAVITY
"""m/s^2, below which no accelerometer's range ends."""
_FEWEST_AT_END = 4
"""Samples at the largest value of an axis that make it the end of its range."""
_AROUND = 0.06
"""s before and after a saturated sample that are left out with it: an average over them would be too
small, and so would be what a gap is bridged with."""
DISAGREES, _STILL_DISAGREES = np.radians(12.0), np.radians(6.0)
"""rad by which a sensor may differ from the solved motion for long, and to which it must come back."""
_LASTING = 0.5
"""s of the running median of that difference."""


def reject_imu_outliers(imus: ImuSequence) -> tuple[ImuSequence, tuple[StreamFault, ...]]:
    """Sensors without samples that only repeat one, or whose acceleration is at the end of its range.

    Returns:
        What is left out is NaN; sensors that nothing is wrong with come back as they are. And what was
        found, by the sensors' names.
    """
    stuck = _stuck(imus)
    f = np.where(stuck[..., None], np.nan, imus.f_sensor)
    saturated = _saturated(f, imus.times)
    faults = [*_told(FaultKind.STUCK, stuck, imus), *_told(FaultKind.SATURATED, saturated, imus)]
    if not faults:
        return imus, ()
    R = np.where(stuck[..., None, None], np.nan, imus.R_inertial_sensor)
    f = np.where(saturated[..., None], np.nan, f)
    return replace(imus, R_inertial_sensor=R, f_sensor=f), tuple(faults)


def _stuck(imus: ImuSequence) -> Mask:
    """(T, S) which samples repeat the one before, in runs of at least `STUCK`.

    A sensor that never says anything else did not begin to: it is made up, of a body that is still there.
    """
    T, S = imus.f_sensor.shape[:2]
    values = np.concatenate([imus.R_inertial_sensor.reshape(T, S, 9), imus.f_sensor], axis=2)
    with np.errstate(invalid="ignore"):
        same = np.asarray(np.all(np.abs(np.diff(values, axis=0)) < _SAME, axis=2))
    stuck = np.zeros((T, S), dtype=np.bool_)
    for s in np.flatnonzero(~same.all(axis=0)):
        for start, stop in signals.runs(same[:, s]):
            if imus.times[stop] - imus.times[start] >= STUCK:
                stuck[start + 1 : stop + 1, s] = True
    return stuck


def _saturated(f_sensor: Array, times: Array) -> Mask:
    """(T, S) samples at the end of an accelerometer's range or next to one: where an axis stays at its
    largest value, which a signal that is not cut off hardly reaches twice.
    """
    size = np.abs(np.nan_to_num(f_sensor))
    largest = size.max(axis=0)
    at_end = (size >= largest * (1 - _SAME)) & (largest > LEAST_RANGE)
    stays = (at_end[1:] & at_end[:-1]).any(axis=0)
    at_end &= stays & (at_end.sum(axis=0) >= _FEWEST_AT_END)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    wide = 2 * int(np.ceil(_AROUND / step)) + 1
    return np.asarray(binary_dilation(at_end.any(axis=2), np.ones((wide, 1), dtype=np.bool_)))


def _told(kind: FaultKind, where: Mask, imus: ImuSequence) -> Iterator[StreamFault]:
    """Faults at samples (T, S), those less than `_LASTING` apart as one."""
    for s, name in enumerate(imus.names):
        yield from _spans(kind, name, where[:, s], imus.times)


def _spans(kind: FaultKind, what: str, where: Mask, times: Array) -> Iterator[StreamFault]:
    span: tuple[float, float] | None = None
    for start, stop in signals.runs(where):
        first, last = float(times[start]), float(times[stop - 1])
        if span is not None and first - span[1] > _LASTING:
            yield StreamFault(kind, what, *span)
            span = None
        span = (first if span is None else span[0], last)
    if span is not None:
        yield StreamFault(kind, what, *span)


def find_disagreements(
    poses: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel
) -> tuple[StreamFault, ...]:
    """When sensors' orientations differ from a motion that was solved with all of them.

    A robust solver follows a wrong sensor only so far. Of a bone the turn about it counts for nothing:
    there soft tissue rolls. Where nobody was seen there is nothing to judge a sensor by.

    Args:
        poses: solved with these sensors, at their times.

    Returns:
        By the sensors' segments.
    """
    faults: list[StreamFault] = []
    for s, joint in enumerate(bone_imus.joints):
        known = np.isfinite(bone_imus.R_world_bone[:, s]).all(axis=(1, 2)) & poses.valid.any(axis=1)
        if not known.any():
            continue
        j = skeleton.names.index(joint)
        R = bone_imus.R_world_bone[known, s]
        off = so3.log(np.swapaxes(poses.R_world_bone[known, j], -1, -2) @ R)
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) == 1:
            bone = so3.unit(skeleton.joint_offsets[children[0]])
            off = off - (off @ bone)[:, None] * bone
        usual = _running_median(np.linalg.norm(off, axis=1), round(_LASTING * poses.rate_hz))
        wrong = np.zeros(len(usual), dtype=np.bool_)
        for start, stop in signals.runs(usual > _STILL_DISAGREES):
            wrong[start:stop] = usual[start:stop].max() > DISAGREES
        faults += _spans(FaultKind.DISAGREES, joint, wrong, poses.times[known])
    return tuple(faults)


def _running_median(values: Array, width: int) -> Array:
    """(T,) medians over `width` samples around each, the ends repeated."""
    before = width // 2
    padded = np.pad(values, (before, max(width, 1) - 1 - before), mode="edge")
    return np.asarray(np.median(sliding_window_view(padded, max(width, 1)), axis=1))


def merge_faults(faults: Iterable[StreamFault]) -> tuple[StreamFault, ...]:
    """Faults of one kind and segment that overlap or nearly touch, as one."""
    out: list[StreamFault] = []
    for fault in sorted(faults, key=lambda f: (f.what, f.kind.name, f.start)):
        before = out[-1] if out else None
        same = before is not None and (before.what, before.kind) == (fault.what, fault.kind)
        if before is not None and same and fault.start < before.stop + _LASTING:
            out[-1] = replace(before, stop=max(before.stop, fault.stop))
        else:
            out.append(fault)
    return tuple(out)


def mask_faults(bone_imus: BoneImuSequence, faults: Iterable[StreamFault]) -> BoneImuSequence:
    """The sensors without what they said during faults, which name their segments."""
    R, a = bone_imus.R_world_bone.copy(), bone_imus.a_world.copy()
    for fault in faults:
        during = (bone_imus.times >= fault.start) & (bone_imus.times <= fault.stop)
        s = bone_imus.joints.index(fault.what)
        R[during, s], a[during, s] = np.nan, np.nan
    return replace(bone_imus, R_world_bone=R, a_world=a)
