"""`Verdict`: what the summary beside a motion says about it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import load_json
from rtof_kin.reporting.summary_file import SUMMARY

_GRADES: Final = ("pass", "warn", "fail")


@dataclass(frozen=True)
class Verdict:
    """What the summary says about a motion."""

    grade: str
    """'pass', 'warn' or 'fail'; empty where there is no verdict."""
    text: str
    """Sentence with the reason."""
    recording: str
    """Name of the recording; empty if unknown."""

    @property
    def line(self) -> str:
        """Grade and reason in one line."""
        return f"{self.grade or 'no verdict'}: {self.text}"


def read_verdict(folder: Path) -> Verdict:
    """Return the verdict of a motion's summary.

    Raises:
        FileFormatError: the summary is no JSON.
    """
    path = folder / SUMMARY
    if not path.is_file():
        return Verdict("", f"there is no {SUMMARY} beside the motion; reconstruct again", "")
    data = load_json(path)
    if not isinstance(data, dict):
        raise FileFormatError(path, "not the summary of a reconstruction")
    found = data.get("verdict")
    found = found if isinstance(found, dict) else {}
    grade = str(found.get("grade", ""))
    text = str(found.get("headline", "the summary has none; reconstruct again"))
    return Verdict(grade if grade in _GRADES else "", text, str(data.get("recording", "")))
