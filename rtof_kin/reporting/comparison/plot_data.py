"""Plot data of a comparison: each angle of A over B, and their difference, with 95 % bands."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.comparison import AngleComparison, Comparison
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.plot_data import MOST_SAMPLES, Data, packed, shown_frames

DIFFERENCE: Final = "difference"
"""Kind of a difference curve, and its class in the style sheet."""
_SCALE: Final = 10  # packed numbers are tenths of a degree


def comparison_data(found: Comparison) -> Data:
    """Return the charts of a comparison; none without a common axis."""
    if found.axis is None:
        return {"x": [], "groups": [], "by": found.by}
    shown = slice(None)
    if found.by == "time":
        step = max(shown_frames(found.axis).step, math.ceil(len(found.axis) / MOST_SAMPLES))
        shown = slice(None, None, step)
    groups = [chart for one in found.angles for chart in _charts(one, shown)]
    scale = 1.0 if found.by == "time" else 100.0
    return {"x": [round(scale * float(x), 4) for x in found.axis[shown]], "groups": groups, "by": found.by}


def _charts(one: AngleComparison, shown: slice) -> list[Data]:
    """The curves of A and B, and their difference."""
    assert one.curves is not None
    a, b = one.curves
    sigma_a, sigma_b = one.sigmas
    counts = one.repeats if max(one.repeats) > 1 else (0, 0)
    curves = [_series("A", a[shown], sigma_a, shown, counts[0]), _series("B", b[shown], sigma_b, shown, counts[1])]
    name = label(one.name)
    return [
        {"name": name, "positive": one.positive, "series": curves},
        {"name": f"{name}: B - A", "series": [_series(DIFFERENCE, (b - a)[shown], one.difference_sigma, shown, 0)]},
    ]


def _series(kind: str, values: Array, sigma: Array | None, shown: slice, count: int) -> Data:
    out: dict[str, Any] = {"side": kind, "y": packed(np.degrees(values), _SCALE)}
    if sigma is not None:
        out["half"] = packed(BAND_95 * np.degrees(sigma[shown]), _SCALE)
    return out | ({"n": count} if count else {})
