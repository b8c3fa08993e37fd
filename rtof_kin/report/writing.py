"""`report`: the page of a folder that a reconstruction was written to."""

from __future__ import annotations

from datetime import date
from pathlib import Path

from rtof_kin.clinical.analysis import analyse_motion
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.recording.session import Session
from rtof_kin.report.html import page_html
from rtof_kin.report.page import page_data
from rtof_kin.report.summary_file import SUMMARY, read_summary

PAGE = "report.html"


def report(
    folder: str | Path,
    session: Session | None = None,
    weight_kg: float | None = None,
    sex: str | None = None,
    made: date | None = None,
) -> str:
    """One HTML page of a reconstruction, which needs nothing beside itself.

    Args:
        folder: what `export` wrote. session: labels that stand over the recording's own. weight_kg, sex:
            of the subject, where the recording does not know them; without a weight there are no torques.
        made: the day on the page; today where not given.

    Returns:
        The text of the page.

    Raises:
        FileFormatError: the folder's files are missing or damaged.
        ShapeError: a weight that is no person's.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    motion = read_motion_npz(folder / "motion.npz").motion()
    subject = summary.subject
    weight_kg = weight_kg or subject.get("mass_kg")
    sex = sex or subject.get("sex")
    analysis = analyse_motion(motion, weight_kg=weight_kg, sex=sex if weight_kg else None)
    labels = summary.session.updated(session or Session())
    inputs = summary.inputs | {"subject": {**subject, "mass_kg": weight_kg, "sex": sex}}
    data = page_data(
        motion, analysis, summary.with_inputs(inputs), labels, (made or date.today()).isoformat()
    )
    return page_html(data)
