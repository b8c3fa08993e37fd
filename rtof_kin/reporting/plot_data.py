"""Plot data of a report: curves and skeleton positions, packed as 16-bit numbers."""

from __future__ import annotations

import base64
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import observed_bones
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import AngleRow
from rtof_kin.clinical.gait import PHASES
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.signals import runs
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reporting.angle_names import MAIN, angle_name, side_and_name

Data = dict[str, Any]
SHOWN_HZ: Final = 30.0  # highest frame rate of plots; all figures are computed from all frames
MOST_SHOWN: Final = 12000  # largest number of played frames: 10 per second of 20 minutes
MOST_SAMPLES: Final = 3000  # largest number of samples of a curve
MISSING: Final = -32768  # NaN among packed numbers


def shown_frames(times: Array) -> slice:
    """Return the frames to play and to plot; times: (T,) s."""
    rate = 1 / float(np.median(np.diff(times))) if len(times) > 1 else SHOWN_HZ
    return slice(None, None, max(1, round(rate / SHOWN_HZ), math.ceil(len(times) / MOST_SHOWN)))


def angle_curves(analysis: MotionAnalysis, shown: slice) -> Data:
    """Return angles over time in groups of both sides.

    Up to `MOST_SAMPLES` plotted frames are given one by one. Longer curves have the lowest and the highest
    reliable value of equal intervals of 'interval' seconds, with the widest band, so that no peak is lost.
    'doubtful' has the samples [first, stop) that are not reliable.
    """
    angles = analysis.angles
    frames = len(angles.times[shown])
    step = math.ceil(2 * len(angles.times) / MOST_SAMPLES) if frames > MOST_SAMPLES else 0
    groups: dict[str, Data] = {}
    for a, row in enumerate(angles.rows):
        if not np.isfinite(angles.values[:, a]).any():
            continue
        half = None if angles.sigma is None else BAND_95 * np.degrees(angles.sigma[:, a])
        trusted = np.isfinite(angles.trusted_angle(a))
        series = _series(np.degrees(angles.values[:, a]), half, trusted, shown, step)
        _group(groups, row)["series"].append({"side": side_and_name(row.name)[0], **series})
    times = interval_times(angles.times, step) if step else angles.times[shown]
    interval = step / angles.rate_hz if step else 0.0
    return {"times": _times(times), "interval": round(interval, 3), "groups": list(groups.values())}


def _series(values: Array, half: Array | None, trusted: Mask, shown: slice, step: int) -> Data:
    """Curve of an angle (T,), deg: the frames that are shown, or intervals of `step` frames (0: none)."""
    usable, chosen = np.where(trusted, values, np.nan), np.arange(len(values))[shown]
    if step:  # extremes of the reliable values; of all where an interval has no reliable one
        reliable = envelope_frames(usable, step)
        chosen = np.where(np.isfinite(usable[reliable]), reliable, envelope_frames(values, step))
    doubtful = np.isfinite(values[chosen]) & ~trusted[chosen]
    out: Data = {"y": packed(values[chosen], 10)}
    if half is not None and step:
        of_all, of_reliable = (widest_bands(half, own, step) for own in (values, usable))
        out["half"] = packed(np.where(doubtful, of_all, of_reliable), 10)
    elif half is not None:
        out["half"] = packed(half[chosen], 10)
    return out | ({"doubtful": runs(doubtful)} if doubtful.any() else {})


def envelope_frames(values: Array, step: int) -> NDArray[np.int64]:
    """Return the frames with the lowest and the highest value of equal intervals, in order, two for each; values: (T,),
    NaN where unknown; step: frames of an interval; the last one may be shorter.
    """
    rows = _intervals(values, step)
    known = np.isfinite(rows)
    low = np.where(known, rows, np.inf).argmin(axis=1)
    high = np.where(known, rows, -np.inf).argmax(axis=1)
    first = step * np.arange(len(rows))[:, None]
    return np.asarray((first + np.sort(np.stack([low, high], axis=1), axis=1)).ravel())


def widest_bands(half: Array, values: Array, step: int) -> Array:
    """Return the largest half width of each interval of `envelope_frames`, twice; half, values: (T,) half width of the
    band and its value, NaN where unknown.
    """
    bands = _intervals(np.where(np.isfinite(values), half, np.nan), step)
    widest = np.where(np.isfinite(bands), bands, -np.inf).max(axis=1)
    return np.repeat(np.where(np.isfinite(widest), widest, np.nan), 2)


def _intervals(values: Array, step: int) -> Array:
    """Values in rows of `step` frames, filled up with NaN."""
    return np.pad(values, (0, -len(values) % step), constant_values=np.nan).reshape(-1, step)


def interval_times(times: Array, step: int) -> Array:
    """Return two times in each interval of `envelope_frames`, s; times: (T,) s."""
    frames = np.arange(0, len(times), step)[:, None] + step * np.array([0.25, 0.75])
    return np.asarray(np.interp(frames.ravel(), np.arange(len(times)), times))


def _group(groups: dict[str, Data], row: AngleRow) -> Data:
    """Group of both sides of an angle."""
    name = angle_name(row)
    group = {
        "name": name.clinical,
        "positive": name.positive,
        "shown": name.shown,
        "opensim": name.opensim_title,
        "opposite": name.opposite,
        "further": name.clinical not in MAIN,
        "series": [],
    }
    return groups.setdefault(side_and_name(row.name)[1], group)


def cycle_curves_data(analysis: MotionAnalysis) -> Data:
    """Return mean and standard deviation of angles over the gait cycle, in groups of both sides; none without gait."""
    groups: dict[str, Data] = {}
    if not analysis.gait.is_gait:
        return {"phase": [], "stance": {}, "groups": []}
    rows = {row.name: row for row in analysis.angles.rows}
    for curve in analysis.curves:
        mean, half = (packed(np.degrees(values), 10) for values in (curve.mean, curve.sd))
        series = {"side": curve.side, "n": len(curve.curves), "y": mean, "half": half}
        _group(groups, rows[curve.name])["series"].append(series)
    stance = {side: float(m["stance_share"][0]) for side, m in analysis.gait.summary.items()}
    phase = [round(100 * float(p), 2) for p in PHASES]
    return {"phase": phase, "stance": stance, "groups": list(groups.values())}


def player_data(motion: Motion | MotionSource, shown: slice, floor: Any) -> Data:
    """Return joint positions relative to the middle of the root's path, and frames [first, stop) in which the bone that
    leads to a joint is unobserved; shown: frames to plot, from the first on; floor: its height, m; None if unknown.
    """
    source, step = MotionSource.of(motion), shown.step or 1
    skeleton, masks = source.skeleton, source.masks
    p = np.concatenate([b.motion.poses.p_world_joint[b.own][-b.start % step :: step].copy() for b in source.blocks()])
    known = np.isfinite(p).all(axis=(1, 2))
    middle = np.zeros(3)
    if known.any():
        root = p[known, 0]
        middle[:2] = (root[:, :2].min(axis=0) + root[:, :2].max(axis=0)) / 2
        lowest = float(np.percentile(p[known][..., 2].min(axis=1), 5)) - 0.08
        middle[2] = floor if isinstance(floor, int | float) else lowest
    largest = float(np.nanmax(np.abs(p - middle), initial=0.0))
    seen = observed_bones(masks)[shown]
    there = np.where(known & masks.valid[shown].any(axis=1), seen.mean(axis=1), -1.0)
    scale = min(1000.0, (-MISSING - 1) / largest) if largest else 1000.0  # mm, coarser for longer paths
    return {
        "times": _times(source.times[shown]),
        "scale": scale,
        "joints": list(skeleton.names),
        "parents": [int(parent) for parent in skeleton.parents],
        "p": packed(p - middle, scale),
        "valid": packed(masks.valid[shown].mean(axis=1), 100),
        "unseen": [runs(~own) for own in seen.T],
        "first": int(np.argmax(there >= 0.9 * there.max(initial=0.0))),
        "height": float(skeleton.height),
    }


def _times(times: Array) -> list[float]:
    return [round(float(t), 4) for t in times]


def packed(values: Array, scale: float) -> str:
    """Return numbers of any shape as base64 of little-endian 16-bit integers; NaN and overflow are `MISSING`."""
    with np.errstate(invalid="ignore"):
        whole = np.round(np.asarray(values, dtype=float) * scale)
        inside = np.abs(whole) <= -MISSING - 1
    numbers = np.where(inside, whole, MISSING).astype("<i2")
    return base64.b64encode(numbers.tobytes()).decode("ascii")
