"""Settings of an analysis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rtof_kin.core.choices import Repeated


@dataclass(frozen=True)
class AnalysisSettings:
    """What is analysed."""

    weight_kg: float | None = None
    """Body mass, kg, for joint torques; default: that of the recording."""
    sex: Literal["male", "female"] | None = None
    """Sex of the subject, of the tables of body mass."""
    height: float | None = None
    """Standing height, m, that the size of the skeleton is checked with."""
    repetitions: Repeated | None = None
    """Movement that is counted."""
    from_standing: bool = False
    """Angles of trunk and legs relative to half a second or more of the person's quiet standing."""
    figures: bool = True  #: Draw figures, where matplotlib is installed
