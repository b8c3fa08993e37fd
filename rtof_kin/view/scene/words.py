"""Texts of the viewer as HTML; whatever comes from files is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Final

from rtof_kin.data.poses import Provenance
from rtof_kin.view.provenance_colours import COLOURS, WORDS, Rgb
from rtof_kin.view.scene.camera_layer import DETECTED, REPROJECTED
from rtof_kin.view.scene.people import SECOND, TRUTH
from rtof_kin.view.verdict import Verdict

GRADES: Final = {"pass": (0, 120, 70), "warn": (180, 95, 0), "fail": (200, 0, 30)}
"""RGB by verdict."""
_UNKNOWN: Final = (90, 90, 90)


def verdict_html(verdict: Verdict) -> str:
    """Return the verdict as a paragraph."""
    colour = GRADES.get(verdict.grade, _UNKNOWN)
    grade, _, reason = verdict.line.partition(": ")
    name = f"<b>{escape(verdict.recording)}</b><br>" if verdict.recording else ""
    return _block(f'<b style="color:rgb{colour}">{escape(grade.upper())}</b>: {escape(reason)}', before=name)


def legend_html(*, cameras: bool = False, truth: bool = False, second: bool = False, axes: bool = True) -> str:
    """Return the meaning of the colours."""
    merged: dict[Rgb, list[str]] = {}
    for kind in sorted(Provenance, reverse=True):
        merged.setdefault(COLOURS[kind], []).append(WORDS[kind])
    rows = [(colour, ", ".join(words)) for colour, words in merged.items()]
    if cameras:
        rows += [(DETECTED, "detected point in the image"), (REPROJECTED, "joint of the motion in the image")]
    rows += [(TRUTH, "truth (transparent)")] if truth else []
    rows += [(SECOND, "second motion (transparent)")] if second else []
    lines = [f"{_swatch(colour)} {escape(text)}" for colour, text in rows]
    notes = ["Segment observed by; its weaker end counts. Faint: not reliable."]
    if axes:
        notes.append("Axes: x red, y green, z blue. Short: turn about the bone not observed.")
    return _block("<br>".join(lines) + "".join(f'<br><span style="color:#555">{n}</span>' for n in notes))


def curves_html(curves: Sequence[tuple[Rgb, str]], in_parts: bool) -> str:
    """Return the names of curves in their colours.

    Args:
        curves: colour and name of each. in_parts: whether the angles are computed by parts of the motion.
    """
    names = " &nbsp; ".join(f"{_swatch(colour)} {escape(name)}" for colour, name in curves)
    note = "light dots: 95 % band; no dots: not observed"
    if in_parts:
        note += "; computed by parts of 60 s"
    return _block(f'{names}<br><span style="color:#555">{note}</span>')


def sentences_html(sentences: Sequence[str]) -> str:
    """Return sentences as lines."""
    return _block("<br>".join(map(escape, sentences)))


def _swatch(colour: Rgb) -> str:
    return (
        '<span style="display:inline-block;width:0.9em;height:0.9em;border-radius:2px;vertical-align:-0.1em;'
        f'background:rgb{colour}"></span>'
    )


def _block(inner: str, before: str = "") -> str:
    return f'<div style="font-size:0.8em;line-height:1.45;padding:0.3em 0.8em">{before}{inner}</div>'
