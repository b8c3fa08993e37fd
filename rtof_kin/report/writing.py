"""Report of a reconstruction as one HTML page."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Final

from rtof_kin.clinical.analysis import analyse_motion
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.recording.session import Session
from rtof_kin.report.page import page
from rtof_kin.report.summary_file import SUMMARY, read_summary

PAGE: Final = "report.html"


def report(
    folder: str | Path,
    session: Session | None = None,
    weight_kg: float | None = None,
    sex: str | None = None,
    made: date | None = None,
) -> str:
    """Return the self-contained HTML page of a reconstruction.

    Args:
        folder: written by `export`. session: labels that replace those of the recording.
        weight_kg, sex: of the subject, if not in the recording; there are no torques without a weight.
        made: date of the report; today by default.

    Raises:
        FileFormatError: the folder's files are missing or damaged.
        InvalidInputError: an implausible weight.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    motion = read_motion_npz(folder / "motion.npz").motion()
    weight_kg = weight_kg or summary.subject.get("mass_kg")
    sex = sex or summary.subject.get("sex")
    analysis = analyse_motion(motion, weight_kg=weight_kg, sex=sex if weight_kg else None)
    labels = summary.session.updated(session or Session())
    subject = {**summary.subject, "mass_kg": weight_kg, "sex": sex}
    summary = replace(summary, inputs=summary.inputs | {"subject": subject})
    return page(motion, analysis, summary, labels, (made or date.today()).isoformat())
