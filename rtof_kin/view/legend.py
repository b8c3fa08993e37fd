"""Colours, words and sentences by which pictures tell how a joint was observed and what is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment
from markupsafe import Markup
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import load_json
from rtof_kin.data.poses import COLOURS, Provenance, Rgb
from rtof_kin.reporting.summary_file import SUMMARY

PALETTE: Final[NDArray[np.uint8]] = np.array([COLOURS[kind] for kind in sorted(Provenance)], dtype=np.uint8)
"""(kinds, 3) the same, by the number of the provenance."""
WORDS: Final[dict[Provenance, str]] = {
    Provenance.CAMERA_AND_IMU: "camera and IMU",
    Provenance.CAMERA: "camera",
    Provenance.IMU: "IMU",
    Provenance.BRIDGED: "bridged",
    Provenance.PRIOR: "prior",
    Provenance.NOBODY: "not observed",
}
"""Legend by provenance."""


DETECTED: Final[Rgb] = (213, 94, 0)  #: Detected points in the 3D scene
REPROJECTED: Final[Rgb] = (0, 114, 178)  #: Joints of the motion in the image
TRUTH: Final[Rgb] = (70, 70, 78)
SECOND: Final[Rgb] = (170, 60, 190)  #: A second motion beside the first
GRADES: Final = {"pass": (0, 120, 70), "plausible": (45, 100, 130), "warn": (180, 95, 0), "fail": (200, 0, 30)}
"""RGB by verdict."""
_UNKNOWN: Final = (90, 90, 90)
_MACROS: Final = Path(__file__).parent / "assets" / "legend.html"


@dataclass(frozen=True)
class Verdict:
    """What the summary says about a motion."""

    grade: str  #: 'pass', 'plausible', 'warn' or 'fail'; empty where there is no verdict
    text: str  #: Sentence with the reason
    recording: str  #: Name of the recording; empty if unknown

    @property
    def line(self) -> str:
        """Grade and reason in one line."""
        return f"{self.grade or 'no verdict'}: {self.text}"


def read_verdict(folder: Path) -> Verdict:
    """Return the verdict of a motion's summary. `FileFormatError`: the summary is no JSON."""
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
    return Verdict(grade if grade in GRADES else "", text, str(data.get("recording", "")))


@cache
def _macros() -> Any:
    source = _MACROS.read_text(encoding="utf-8")
    return Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(source).module


def verdict_html(verdict: Verdict) -> str:
    """Return the verdict as a paragraph."""
    colour = GRADES.get(verdict.grade, _UNKNOWN)
    grade, _, reason = verdict.line.partition(": ")
    return str(_macros().verdict(verdict.recording, grade.upper(), reason, colour))


def legend_html(*, cameras: bool = False, truth: bool = False, second: bool = False) -> str:
    """Return the meaning of the colours."""
    merged: dict[Rgb, list[str]] = {}
    for kind in sorted(Provenance, reverse=True):
        merged.setdefault(COLOURS[kind], []).append(WORDS[kind])
    rows = [(colour, ", ".join(words)) for colour, words in merged.items()]
    if cameras:
        rows += [(DETECTED, "detected point in the image"), (REPROJECTED, "joint of the motion in the image")]
    rows += [(TRUTH, "truth (transparent)")] if truth else []
    rows += [(SECOND, "second motion (transparent)")] if second else []
    return str(_macros().legend(rows))


def curves_html(curves: Sequence[tuple[Rgb, str]], in_parts: bool) -> str:
    """Return the names of curves in their colours.

    `curves`: colour and name of each. in_parts: whether the angles are computed by parts of the motion.
    """
    note = "light dots: 95 % band; no dots: not observed"
    if in_parts:
        note += "; computed by parts of 60 s"
    return str(_macros().curves(curves, note))


def sentences_html(sentences: Sequence[str]) -> str:
    """Return sentences as lines."""
    return str(_macros().sentences(sentences))


def corner_html(verdict: Verdict, part: str, legend: str) -> str:
    """Return verdict, part of the motion and legend in a corner of the scene. `legend`: of `legend_html`."""
    return str(_macros().corner(Markup(verdict_html(verdict)), part, Markup(legend)))
