"""Names of the angles in a report under each of its conventions, of which the reader chooses one.

============  ==========================================================================================
convention    angles
============  ==========================================================================================
`ISB`         clinical names; pelvis after Baker 2001, shoulder Y-X-Y after Wu et al. 2005; the default
`XZY`         the same with the shoulder in abduction, flexion and rotation, sequence X-Z-Y
`OPENSIM`     names and signs of OpenSim's coordinates, with its pelvis; angles without one keep their own
============  ==========================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rtof_kin.clinical.angle_table import SIDES, AngleRow
from rtof_kin.report.clinical_findings import SECOND_PELVIS

ISB: Final = "isb"
XZY: Final = "xzy"
OPENSIM: Final = "opensim"
SECOND_SHOULDER: Final = "shoulder_xzy_"
"""Begins the names of the shoulder angles in the sequence for hanging arms, after their side."""


@dataclass(frozen=True)
class AngleName:
    """Name of an angle, the same for both sides."""

    clinical: str
    """E.g. 'knee flexion'."""
    opensim: str
    """OpenSim coordinates without sign, e.g. 'knee_angle_r, _l'; '' if there are none."""
    opposite: bool
    """Whether OpenSim's coordinate has the opposite sign."""
    positive: str
    """The movement that is positive."""
    shown: str
    """Conventions in which the angle is shown, separated by spaces."""

    @property
    def opensim_title(self) -> str:
        """Name in the OpenSim convention, which says so where there is no coordinate."""
        return self.opensim or f"{self.clinical} (no OpenSim coordinate)"


def label(name: str) -> str:
    """Return the name of an angle in words.

    Args:
        name: as in files.
    """
    return name.replace("_", " ")


def side_and_name(name: str) -> tuple[str, str]:
    """Split the name of an angle into 'right', 'left' or '', and the rest.

    Args:
        name: of the angle.
    """
    side = next((side for side in SIDES if name.startswith(f"{side}_")), "")
    return side, name.removeprefix(f"{side}_")


def angle_name(row: AngleRow) -> AngleName:
    """Return the name of an angle under all conventions.

    Args:
        row: of the table of angles.
    """
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
