"""Settings of marker trials, apart from what reads them: commands load these for their help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

TRIALS: Final = (".c3d", ".trc", ".npz")  #: Endings of marker trials


@dataclass(frozen=True)
class MarkerSettings:
    """What the body is fitted to, and how the markers are named."""

    trials: tuple[Path, ...] = ()  #: Further trials of the person, for the body: a standing one, one of every joint
    marker_set: str | None = None  #: Name of the marker set; by default the one with most markers in the trial
    marker_table: Path | None = None  #: Table of marker sets of your own, see docs/markers.md
    marker_person: str | None = None  #: Name in front of the markers, where a trial has several people
    up: str | None = None  #: Axis of the files that points up; by default the one that a C3D declares, y of a TRC
