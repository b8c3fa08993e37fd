"""Sections of a report with the way of the person, gait and joint torques."""

from __future__ import annotations

import math
import re
from html import escape
from typing import Final

import numpy as np

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.angle_table import SIDES, clinical_name
from rtof_kin.clinical.gait import MEASURES, GaitAnalysis
from rtof_kin.clinical.torques import NO_WEIGHT, JointTorques
from rtof_kin.clinical.travel import Travel
from rtof_kin.reporting.html import bullets, folded, table

OBSERVED: Final = 0.995
"""Share of the frames from which on something counts as always observed."""
_GAIT_UNITS: Final = {
    "stride_time": ("s", 2),
    "cadence": ("steps/min", 1),
    "stride_length": ("m", 2),
    "speed": ("m/s", 2),
    "stance_share": ("of the stride", 2),
}
"""Measure -> unit, decimals."""
_URDF: Final = re.compile(r" \(\w+\)$")  # the name of a degree of freedom in the URDF, behind the clinical one


def way_line(travel: Travel) -> str:
    """Return how far the person went and turned, as a paragraph."""
    if not math.isfinite(travel.path_length):
        way = "not observed"
    else:
        way = f"{travel.path_length:.1f} m along its path"
        if travel.path_length:
            way += f", {travel.displacement:.1f} m {travel.way}".rstrip() + " from its first to its last position"
    known = math.isfinite(travel.turned_left)
    turned = travel.turns or ("turns within their error" if known else "turns not observed")
    seen = travel.observed_share
    share = f"; position observed in {100 * seen:.0f} % of the frames" if seen < OBSERVED else ""
    notes = "".join(f"; {note}" for note in travel.notes)
    return f"<p><b>Way of the pelvis:</b> {escape(f'{way}; {turned}{share}{notes}.')}</p>"


def gait_section(gait: GaitAnalysis) -> str:
    """Return the gait measures of both sides, or one sentence on why the motion is no gait."""
    if not gait.is_gait:
        return f"<p>{escape(gait.why_not)}</p>"

    def cell(side: str, name: str) -> str:
        if side not in gait.summary:
            return ""
        mean, sd, strides = gait.summary[side][name]
        digits = _GAIT_UNITS[name][1]
        spread = f" &plusmn; {sd:.{digits}f}" if math.isfinite(sd) else ""
        return f"{mean:.{digits}f}{spread} ({strides})"

    rows = []
    for name in MEASURES:
        symmetry = 100 * gait.symmetry.get(name, math.nan)
        text = f"{symmetry:+.1f} %" if math.isfinite(symmetry) else ""
        label = f"{name.replace('_', ' ')} [{_GAIT_UNITS[name][0]}]"
        rows.append((label, cell("right", name), cell("left", name), text))
    header = ("mean, standard deviation (strides)", "right", "left", "(right - left) / mean")
    return table(header, rows, "gait", row_headers=True) + bullets(gait.notes)


def torques_section(torques: JointTorques | None, skeleton: SkeletonTable) -> str:
    """Return the peak torques, right against left.

    Args:
        torques: of the motion; None without a body mass. skeleton: whose degrees of freedom they act on.
    """
    if torques is None:
        return f"<p>{NO_WEIGHT.capitalize()}.</p>"
    found: dict[str, dict[str, tuple[str, str, str]]] = {}
    for dof, column in zip(torques.dof_names, torques.torques.T, strict=True):
        known = np.isfinite(column)
        if known.any():
            peak = float(np.abs(column[known]).max())
            cells = (f"{peak:.3g}", f"{peak / torques.weight_kg:.2g}", f"{100 * known.mean():.0f} %")
            name = _URDF.sub("", clinical_name(skeleton, dof))
            side = next((side for side in SIDES if name.startswith(f"{side} ")), "")
            found.setdefault(name.removeprefix(f"{side} "), {})[side] = cells
    empty = ("", "", "")
    both = [
        (escape(name), *(cell for side in SIDES for cell in own.get(side, empty)))
        for name, own in found.items()
        if "" not in own
    ]
    single = [(escape(name), *own[""]) for name, own in found.items() if "" in own]
    parts = ("N m", "N m/kg", "known")
    columns = ("movement", *(f"{side}: {part}" for side in SIDES for part in parts))
    tables = table(columns, both, "torques", "Peak torques, right and left", row_headers=True)
    middle = "Peak torques of spine, neck and head"
    tables += table(("movement", *parts), single, "torques single", middle, row_headers=True)
    return folded("peak of each joint", tables)
