"""Words of a report: names of angles under each convention, and sentences of the audit for clinicians.

A reader chooses one convention of the names:

============  ==========================================================================================
convention    angles
============  ==========================================================================================
`ISB`         clinical names; pelvis after Baker 2001, shoulder Y-X-Y after Wu et al. 2005; the default
`XZY`         the same with the shoulder in abduction, flexion and rotation, sequence X-Z-Y
`OPENSIM`     names and signs of OpenSim's coordinates, with its pelvis; angles without one keep their own
============  ==========================================================================================
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from rtof_kin.clinical.angle_table import SIDES, AngleRow, AngleTable
from rtof_kin.reporting.clinical_findings import SECOND_PELVIS

ISB: Final = "isb"
XZY: Final = "xzy"
OPENSIM: Final = "opensim"
MAIN: Final = frozenset(
    {"spine flexion", "hip flexion", "knee flexion", "ankle dorsiflexion"}
    | {"shoulder elevation", "shoulder flexion", "elbow flexion"}
)
"""Angles that a narrow screen shows at first, without their side."""
SECOND_SHOULDER: Final = "shoulder_xzy_"
"""Begins the names of the shoulder angles in the sequence for hanging arms, after their side."""

SIDE_COLORS: Final = {"right": "#0072b2", "left": "#c0392b", "": "0.25"}
"""Colours of figures."""

_PLAIN: Final = {
    r" \(\w+_[xyz]\)|; more (fails|warns) in [^;]*| \([^()]*\babove [^()]*\)": "",
    r"^position in the room: half width of the 95 % band [\d.]+ m: ": "",
    r"^(motion|recording): ": "",
    r"\bat z = -([\d.]+ m)": r"\1 below height 0",
    r"\bat z = ([\d.]+ m)": r"\1 above height 0",
    r"\bz = 0\b": "height 0",
    r" deg(?![a-z])": "°",
    r"\berror expected by the stated standard deviations, RMS\b": "expected error",
    r"\bjoints relative to the root\b": "posture",
    r"\bjoints in world\b": "position in the room",
    r"\breprojection error\b": "distance of the body model from the image",
    r"\bhalf width of the 95 % band, median\b": "95 % band, mostly ±",
    r"\bcorrection in standard deviations of the prior\b": "correction, in multiples of what is usual",
    r"\b(interpolated, or from|taken from) the prior\b": "assumed, not measured",
    r"\b(its )?prior standard deviation\b": r"\1usual deviation",
    r"\bthe prior\b": "the usual posture",
    r"\bprovenance\b": "source",
    r"\ball landmarks\b": "all points of the body",
    r"\blandmark(s?)\b": r"point\1 of the body",
    r"\bkeypoints\b": "points found in the image",
    r"\bfragments\b": "parts of the recording",
    r"\b(the )?root\b": r"\1pelvis",
}
"""Pattern in a sentence of the audit -> plain words; the audit's own table keeps its terms."""
_NAME: Final = re.compile(r"\b(Left|Right)[A-Z]\w*|(?<![^ (])(Head|Neck)\b")
_CAPITAL: Final = re.compile("(?<=[a-z])(?=[A-Z])")


def plain_words(text: str, table: AngleTable) -> str:
    """Return a sentence of the audit without names of the model and terms of the method; text: e.g. 'left hip
    flexion/extension (LeftUpLeg_y): beyond its anatomical limit, largest 37 deg'.
    """
    for pattern, words in _PLAIN.items():
        text = re.sub(pattern, words, text)
    for term, joint in table.segments.items():
        text = re.sub(rf"\b{joint}\b", term.replace("_", " "), text)
    return _NAME.sub(lambda name: _CAPITAL.sub(" ", name.group()).lower(), text)


@dataclass(frozen=True)
class AngleName:
    """Name of an angle, the same for both sides."""

    clinical: str  #: E.g. 'knee flexion'.
    opensim: str  #: OpenSim coordinates without sign, e.g. 'knee_angle_r, _l'; '' if there are none.
    opposite: bool  #: Whether OpenSim's coordinate has the opposite sign
    positive: str  #: The movement that is positive
    shown: str  #: Conventions in which the angle is shown, separated by spaces

    @property
    def opensim_title(self) -> str:
        """Name in the OpenSim convention, which says so where there is no coordinate."""
        return self.opensim or f"{self.clinical} (no OpenSim coordinate)"


def label(name: str) -> str:
    """Return the name of an angle in words."""
    return name.replace("_", " ")


def side_and_name(name: str) -> tuple[str, str]:
    """Split the name of an angle into 'right', 'left' or '', and the rest."""
    side = next((side for side in SIDES if name.startswith(f"{side}_")), "")
    return side, name.removeprefix(f"{side}_")


def angle_name(row: AngleRow) -> AngleName:
    """Return the name of an angle under all conventions."""
    side, name = side_and_name(row.name)
    coordinate = row.opensim.removeprefix("-")
    if side and coordinate:
        coordinate = coordinate.removesuffix(f"_{side[0]}") + "_r, _l"
    conventions: tuple[str, ...] = (ISB, XZY, OPENSIM)
    if name.startswith(SECOND_PELVIS):
        name, conventions = name.replace(SECOND_PELVIS, "pelvis"), (OPENSIM,)
    elif name.startswith("pelvis_"):
        conventions = (ISB, XZY)
    elif name.startswith(SECOND_SHOULDER):
        name, conventions = name.replace(SECOND_SHOULDER, "shoulder_"), (XZY,)
    elif name.startswith("shoulder_"):
        conventions = (ISB, OPENSIM)
    return AngleName(
        name.replace("_", " "), coordinate, row.opensim.startswith("-"), row.positive, " ".join(conventions)
    )
