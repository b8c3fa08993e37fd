"""Plot data of a report: curves and skeleton positions, packed as 16-bit numbers."""

from __future__ import annotations

import base64
from typing import Any, Final

import numpy as np

from rtof_kin.body.observability import observed_bones
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait import PHASES
from rtof_kin.core.array_types import Array
from rtof_kin.core.signals import runs
from rtof_kin.data.confidence import BAND_95
from rtof_kin.report.clinical_findings import SECOND_PELVIS

Data = dict[str, Any]
SHOWN_HZ: Final = 30.0  # highest frame rate of plots; all figures are computed from all frames
MOST_SHOWN: Final = 6000  # largest number of plotted frames, unless that is fewer than 10 per second
MISSING: Final = -32768  # NaN among packed numbers


def side_and_name(name: str) -> tuple[str, str]:
    """Split the name of an angle into 'right', 'left' or '', and the rest.

    Args:
        name: of the angle.
    """
    side = next((side for side in SIDES if name.startswith(f"{side}_")), "")
    return side, name.removeprefix(f"{side}_")


def shown_frames(times: Array) -> slice:
    """Return the frames to plot.

    Args:
        times: (T,) s.
    """
    rate = 1 / float(np.median(np.diff(times))) if len(times) > 1 else SHOWN_HZ
    step = max(1, round(rate / SHOWN_HZ))
    slowest = max(step, int(rate / 10))
    return slice(None, None, int(np.clip(np.ceil(len(times) / MOST_SHOWN), step, slowest)))


def angle_curves(analysis: MotionAnalysis, shown: slice) -> Data:
    """Return angles over time in groups of both sides.

    Args:
        analysis: of the motion. shown: frames to plot.
    """
    angles = analysis.angles
    groups: dict[str, Data] = {}
    for a, row in enumerate(angles.rows):
        if not angles.known[:, a].any() or row.name.startswith(SECOND_PELVIS):
            continue
        side, name = side_and_name(row.name)
        group = {"name": name.replace("_", " "), "positive": row.positive, "series": []}
        series = {"side": side, "y": packed(np.degrees(angles.values[shown, a]), 10)}
        if angles.sigma is not None:
            series["half"] = packed(BAND_95 * np.degrees(angles.sigma[shown, a]), 10)
        groups.setdefault(name, group)["series"].append(series)
    return {"times": _times(angles.times[shown]), "groups": list(groups.values())}


def cycle_curves_data(analysis: MotionAnalysis) -> Data:
    """Return mean and standard deviation of angles over the gait cycle, in groups of both sides.

    Args:
        analysis: of the motion.
    """
    groups: dict[str, Data] = {}
    for curve in analysis.curves:
        name = side_and_name(curve.name)[1]
        if not name.startswith(SECOND_PELVIS):
            group = groups.setdefault(name, {"name": name.replace("_", " "), "series": []})
            group["series"].append(
                {"side": curve.side, "n": len(curve.curves), "y": packed(np.degrees(curve.mean), 10),
                 "half": packed(np.degrees(curve.sd), 10)}
            )  # fmt: skip
    stance = {side: float(m["stance_share"][0]) for side, m in analysis.gait.summary.items()}
    phase = [round(100 * float(p), 2) for p in PHASES]
    return {"phase": phase, "stance": stance, "groups": list(groups.values())}


def player_data(motion: MotionSequence, shown: slice, floor: Any) -> Data:
    """Return joint positions relative to the middle of the root's path, and frames [first, stop) in which
    the bone that leads to a joint is unobserved.

    Args:
        motion: to plot. shown: frames to plot. floor: its height, m; None if unknown.
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
    """Return numbers as base64 of little-endian 16-bit integers; NaN and overflow are `MISSING`.

    Args:
        values: any shape. scale: multiplied before rounding.
    """
    with np.errstate(invalid="ignore"):
        whole = np.round(np.asarray(values, dtype=float) * scale)
        inside = np.abs(whole) <= -MISSING - 1
    numbers = np.where(inside, whole, MISSING).astype("<i2")
    return base64.b64encode(numbers.tobytes()).decode("ascii")
