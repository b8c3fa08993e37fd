"""Clinical findings: audit results on the angles, the gait and the torques of a motion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.torques import NO_WEIGHT
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reporting.audit_results import AuditResult

SECOND_PELVIS: Final = "pelvis_opensim"  #: Prefix of the pelvis angles in OpenSim's sequence, which a report omits
WIDEST: Final = (10.0, 30.0)  # [deg] half widths of the 95 % band of an angle that warn and fail
NO_BANDS: Final = "this mode of reconstruction provides no standard deviations"
_USER: Final = "a convention of this report"


def clinical_findings(analysis: MotionAnalysis) -> tuple[AuditResult, ...]:
    """Return audit results of the sections angles, gait and torques."""
    return (*_angles(analysis), *_gait(analysis), *_torques(analysis))


def _angles(analysis: MotionAnalysis) -> Iterator[AuditResult]:
    angles = analysis.angles
    shown = [a for a, row in enumerate(angles.rows) if not row.name.startswith(SECOND_PELVIS)]
    for a in shown:
        known = np.isfinite(angles.values[:, a])
        if known.any():
            figure = (
                "share of frames without an observation",
                angles.rows[a].label,
                100 * float(1 - known.mean()),
                "%",
            )
            note = "gaps are not filled; ranges are of the observed frames"
            yield AuditResult("angles", *figure, 10.0, 75.0, _USER, note)
    if angles.sigma is None:
        yield AuditResult.not_checked("angles", "95 % bands", NO_BANDS)
    else:
        for a in shown:
            sigma = angles.sigma[np.isfinite(angles.values[:, a]), a]
            if np.isfinite(sigma).any():
                half = float(BAND_95 * np.degrees(np.nanmedian(sigma)))
                figure = ("half width of the 95 % band, median", angles.rows[a].label, half, "deg")
                note = "low accuracy; a sensor on each of its two segments would improve it"
                yield AuditResult("angles", *figure, *WIDEST, _USER, note)
    for note in analysis.notes["angles"]:
        yield AuditResult.not_checked("angles", "angles", note)


def _gait(analysis: MotionAnalysis) -> Iterator[AuditResult]:
    gait = analysis.gait
    if not gait.strides:
        why = "; ".join(gait.notes) or "no two strikes of a foot with a toe off between were found"
        yield AuditResult.not_checked("gait", "strides", why)
        return
    if not gait.is_gait:
        yield AuditResult.not_checked("gait", "gait", gait.why_not)
        return
    strides = f"recognised: {len(gait.verdict.walking)} of {len(gait.strides)} strides are those of walking"
    yield AuditResult.remark("gait", "walking", strides)
    for side, measures in gait.summary.items():
        count = measures["stride_time"][2]
        note = f"{count} complete: a mean of so few may not represent usual walking"
        missing = float(max(0, 3 - count))
        yield AuditResult("gait", "strides fewer than three", side, missing, "", 0.0, source=_USER, note=note)
    for note in gait.notes:
        yield AuditResult.warning("gait", "gait", note)


def _torques(analysis: MotionAnalysis) -> Iterator[AuditResult]:
    torques = analysis.torques
    if torques is None:
        yield AuditResult.not_checked("torques", "torques", NO_WEIGHT)
        return
    known = float(np.isfinite(torques.torques).mean())
    figure = ("share of torques that could not be computed", "joints", 100 * (1 - known), "%")
    note = "no force was measured; which foot bears load is not always known"
    yield AuditResult("torques", *figure, 50.0, 99.9, _USER, note)
    reaction = analysis.ground_reaction
    for note in (*torques.notes, *(() if reaction is None else reaction.notes)):
        yield AuditResult.not_checked("torques", "torques", note)
