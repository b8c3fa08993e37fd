"""What a report draws: curves and a skeleton, quantised and packed as 16-bit numbers."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.observability import observed_bones
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait import PHASES
from rtof_kin.core.signals import runs
from rtof_kin.data.confidence import BAND_95
from rtof_kin.report.clinical_findings import SECOND_PELVIS

Array = NDArray[np.float64]
Data = dict[str, Any]
SHOWN_HZ = 30.0
"""Frames a second that are drawn at most; every figure is of all frames."""
MOST_SHOWN = 6000
"""Frames that are drawn at most, as long as that leaves 10 a second."""
MISSING = -32768
"""What stands for NaN among packed numbers."""


def side_and_name(name: str) -> tuple[str, str]:
    """'right', 'left' or '', and an angle's name without it."""
    side = next((side for side in SIDES if name.startswith(f"{side}_")), "")
    return side, name.removeprefix(f"{side}_") if side else name


def shown_frames(times: Array) -> slice:
    """The frames that are drawn."""
    rate = 1 / float(np.median(np.diff(times))) if len(times) > 1 else SHOWN_HZ
    step = max(1, round(rate / SHOWN_HZ))
    slowest = max(step, int(rate / 10))
    return slice(None, None, int(np.clip(np.ceil(len(times) / MOST_SHOWN), step, slowest)))


def angle_curves(analysis: MotionAnalysis, shown: slice) -> Data:
    """Curves over time, both sides of an angle together."""
    angles = analysis.angles
    groups: dict[str, Data] = {}
    for a, row in enumerate(angles.rows):
        if not angles.known[:, a].any() or row.name.startswith(SECOND_PELVIS):
            continue
        side, name = side_and_name(row.name)
        own = groups.setdefault(
            name, {"name": name.replace("_", " "), "positive": row.positive, "series": []}
        )
        series = {"side": side, "y": packed(np.degrees(angles.values[shown, a]), 10)}
        if angles.sigma is not None:
            series["half"] = packed(BAND_95 * np.degrees(angles.sigma[shown, a]), 10)
        own["series"].append(series)
    return {"times": _times(angles.times[shown]), "groups": list(groups.values())}


def cycle_drawings(analysis: MotionAnalysis) -> Data:
    """Mean and standard deviation over the gait cycle, right against left."""
    groups: dict[str, Data] = {}
    for curve in analysis.curves:
        name = side_and_name(curve.name)[1]
        if name.startswith(SECOND_PELVIS):
            continue
        own = groups.setdefault(name, {"name": name.replace("_", " "), "series": []})
        own["series"].append(
            {"side": curve.side, "n": len(curve.curves), "y": packed(np.degrees(curve.mean), 10),
             "half": packed(np.degrees(curve.sd), 10)}
        )  # fmt: skip
    stance = {side: float(m["stance_share"][0]) for side, m in analysis.gait.summary.items()}
    return {"phase": [round(100 * float(p), 2) for p in PHASES], "stance": stance,
            "groups": list(groups.values())}  # fmt: skip


def player_data(motion: MotionSequence, shown: slice, floor: Any) -> Data:
    """The skeleton's positions, from the middle of its way; of each joint, frames [first, stop) in which
    nobody saw the bone that leads to it.
    """
    poses, skeleton = motion.poses, motion.skeleton
    p = poses.p_world_joint[shown]
    known = np.isfinite(p).all(axis=(1, 2))
    middle = np.zeros(3)
    if known.any():
        root = p[known, 0]
        middle[:2] = (root[:, :2].min(axis=0) + root[:, :2].max(axis=0)) / 2
        lowest = float(np.percentile(p[known][..., 2].min(axis=1), 5)) - 0.08
        middle[2] = floor if isinstance(floor, int | float) else lowest
    return {
        "times": _times(motion.times[shown]),
        "joints": list(skeleton.names),
        "parents": [int(parent) for parent in skeleton.parents],
        "p": packed(p - middle, 1000),
        "valid": packed(poses.valid[shown].mean(axis=1), 100),
        "unseen": [runs(~seen) for seen in observed_bones(motion)[shown].T],
        "height": float(skeleton.height),
    }


def _times(times: Array) -> list[float]:
    return [round(float(t), 4) for t in times]


def packed(values: Array, scale: int) -> str:
    """Numbers times `scale`, rounded, as base64 of little-endian 16-bit integers; NaN is `MISSING`.

    What lies outside is `MISSING` too: it could not be drawn beside the rest.
    """
    with np.errstate(invalid="ignore"):
        whole = np.round(np.asarray(values, dtype=float) * scale)
        inside = np.abs(whole) <= -MISSING - 1
    numbers = np.where(inside, np.nan_to_num(np.where(inside, whole, 0.0)), MISSING).astype("<i2")
    return base64.b64encode(numbers.tobytes()).decode("ascii")


def unpacked(text: str, scale: int, shape: Sequence[int] = (-1,)) -> Array:
    """What `packed` packed, to its precision."""
    numbers = np.frombuffer(base64.b64decode(text), dtype="<i2").astype(float)
    return np.asarray(np.where(numbers == MISSING, np.nan, numbers / scale).reshape(shape))
