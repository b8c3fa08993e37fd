"""What the angles, the gait and the torques of a motion come to: findings of an analysis."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.data.confidence import BAND_95
from rtof_kin.report.audit_results import Finding

SECOND_PELVIS = "pelvis_opensim"
"""Angles of the pelvis in OpenSim's own sequence, for comparison: a report shows one pelvis."""
WIDEST = (10.0, 30.0)
"""Degrees to either side at which the 95 % band of an angle warns and fails."""
_USER = "a convention of this report"


def outcomes(analysis: MotionAnalysis) -> tuple[Finding, ...]:
    """Findings of the sections angles, gait and torques."""
    return (*_angles(analysis), *_gait(analysis), *_torques(analysis))


def _angles(analysis: MotionAnalysis) -> Iterator[Finding]:
    angles = analysis.angles
    for a, row in enumerate(angles.rows):
        known = angles.known[:, a]
        if not known.any() or row.name.startswith(SECOND_PELVIS):
            continue
        yield Finding(
            "angles", "share of frames in which nobody saw it", row.label, 100 * float(1 - known.mean()),
            "%", 10.0, 75.0, _USER, "gaps are left open; ranges are of the rest",
        )  # fmt: skip
    yield from _bands(analysis)
    for note in analysis.notes["angles"]:
        yield Finding.untold("angles", "angles", note)


def _bands(analysis: MotionAnalysis) -> Iterator[Finding]:
    sigma = analysis.angles.sigma
    if sigma is None:
        why = "the mode that made this motion does not say how certain it is"
        yield Finding.untold("angles", "95 % bands", why)
        return
    for a, row in enumerate(analysis.angles.rows):
        known = np.isfinite(sigma[:, a]) & analysis.angles.known[:, a]
        if known.any() and not row.name.startswith(SECOND_PELVIS):
            half = float(BAND_95 * np.degrees(np.median(sigma[known, a])))
            yield Finding(
                "angles", "half width of the 95 % band, median", row.label, half, "deg", *WIDEST, _USER,
                "known loosely; a sensor on each of its two segments would tell more",
            )  # fmt: skip


def _gait(analysis: MotionAnalysis) -> Iterator[Finding]:
    gait = analysis.gait
    if not gait.strides:
        why = "; ".join(gait.notes) or "no two strikes of a foot with a toe off between were found"
        yield Finding.untold("gait", "strides", why)
        return
    for side, measures in gait.summary.items():
        count = measures["stride_time"][2]
        yield Finding(
            "gait", "strides fewer than three", side, float(max(0, 3 - count)), "", 0.0,
            source=_USER, note=f"{count} complete: a mean of so few says little about usual walking",
        )  # fmt: skip
    for note in gait.notes:
        yield Finding.doubt("gait", "gait", note)


def _torques(analysis: MotionAnalysis) -> Iterator[Finding]:
    torques = analysis.torques
    if torques is None:
        why = "not computed: no weight is given, and torques are proportional to it"
        yield Finding.untold("torques", "torques", why)
        return
    known = float(np.isfinite(torques.torques).mean())
    yield Finding(
        "torques", "share of torques that could not be told", "joints", 100 * (1 - known), "%",
        50.0, 99.9, _USER, "no force was measured; which foot carries is not always known",
    )  # fmt: skip
    for note in torques.notes:
        yield Finding.untold("torques", "torques", note)
