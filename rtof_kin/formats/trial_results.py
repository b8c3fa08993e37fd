"""What gait laboratories have in a C3D file beside markers: gait events, results as points, parameters, the subject.

Groups and names are those that Vicon Nexus writes and other programs read: EVENT and EVENT_CONTEXT, points that
POINT:ANGLES, POINT:FORCES and POINT:MOMENTS list, ANALYSIS, SUBJECTS and PROCESSING (user guide at c3d.org). Times of
events are minutes and seconds on the clock whose zero is the frame numbered 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from rtof_kin.core.array_types import Array

UNITS: Final = {"ANGLES": ("ANGLE_UNITS", "deg"), "FORCES": ("FORCE_UNITS", "N"), "MOMENTS": ("MOMENT_UNITS", "Nmm")}
"""Parameter of POINT that lists results of a kind -> parameter with their unit, and the unit."""
LABELS: Final = {"foot_strike": "Foot Strike", "foot_off": "Foot Off"}
CONTEXTS: Final = {"left": "Left", "right": "Right"}
MOST_EVENTS: Final = 2040
"""The first events that are written: parameters have 130 kB in all."""
_DIMENSION: Final = 255  #: Largest dimension of a parameter; LABELS2, LABELS3, ... continue it
_ICONS: Final = {"foot_strike": 1, "foot_off": 2}
_NOBODY: Final = "Subject"  #: In place of the name of an unnamed subject, by which events find their subject


class GaitEvent(NamedTuple):
    """An event of a foot."""

    time: float  #: s
    side: str  #: left or right
    kind: str  #: foot_strike or foot_off


class GaitParameter(NamedTuple):
    """A mean over the strides of one side."""

    name: str  #: As in Vicon's files, e.g. 'Walking Speed'
    side: str  #: left or right
    unit: str
    value: float


@dataclass(frozen=True)
class TrialResults:
    """What is written beside the markers of a trial."""

    events: tuple[GaitEvent, ...] = ()  #: By time
    points: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    """ANGLES, FORCES, MOMENTS -> name -> three components (T, 3), deg, N and N mm; NaN where unknown."""
    parameters: tuple[GaitParameter, ...] = ()
    subject: str = ""  #: Name or code; '' where there is none
    mass_kg: float | None = None
    height_m: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the points."""
        return tuple(name for own in self.points.values() for name in own)

    def rows(self, frames: slice) -> Array:
        """Return frames of the points (n, P, 3)."""
        found = [values[frames] for own in self.points.values() for values in own.values()]
        return np.stack(found, axis=1) if found else np.zeros((frames.stop - frames.start, 0, 3))

    def add_to(self, file: Any, zero_s: float) -> None:
        """Add the parameters to an ``ezc3d.c3d``; zero_s: time at which the clock of the file shows 0."""
        subject, add = self.subject[:32] or _NOBODY, file.add_parameter
        for kind, own in self.points.items():
            unit_name, unit = UNITS[kind]
            add("POINT", kind, list(own))
            add("POINT", unit_name, [unit])
        if self.events:
            _add_events(file, self.events[:MOST_EVENTS], subject, zero_s)
        if means := self.parameters:
            add_integers(file, "ANALYSIS", "USED", [len(means)])
            columns = {
                "NAMES": [one.name for one in means],
                "CONTEXTS": [CONTEXTS[one.side] for one in means],
                "SUBJECTS": [subject] * len(means),
                "UNITS": [one.unit for one in means],
                "VALUES": [one.value for one in means],
            }
            for name, column in columns.items():
                add("ANALYSIS", name, column)
        for name, number in (("USED", 1), ("IS_STATIC", 0), ("USES_PREFIXES", 0)):
            add_integers(file, "SUBJECTS", name, [number])
        add("SUBJECTS", "NAMES", [subject])
        for name, size in (("Bodymass", self.mass_kg), ("Height", self.height_m and 1000 * self.height_m)):
            if size is not None:
                add("PROCESSING", name, [float(size)])


def add_integers(file: Any, group: str, name: str, values: list[int]) -> None:
    """Add a parameter of 16 bits to an ``ezc3d.c3d``, whose own method makes floating-point numbers of a list."""
    file.add_parameter(group, name, values)
    kind = file["parameters"]["POINT"]["USED"]["type"]
    file["parameters"][group][name] |= {"type": kind, "value": np.array(values)}


def _add_events(file: Any, events: tuple[GaitEvent, ...], subject: str, zero_s: float) -> None:
    add_integers(file, "EVENT", "USED", [len(events)])
    for number, first in enumerate(range(0, len(events), _DIMENSION), 1):
        some, more = events[first : first + _DIMENSION], str(number) if number > 1 else ""
        file.add_parameter("EVENT", f"CONTEXTS{more}", [CONTEXTS[one.side] for one in some])
        file.add_parameter("EVENT", f"LABELS{more}", [LABELS[one.kind] for one in some])
        file.add_parameter("EVENT", f"SUBJECTS{more}", [subject] * len(some))
        times = np.array([divmod(one.time - zero_s, 60.0) for one in some]).T
        file.add_parameter("EVENT", f"TIMES{more}", times)
        add_integers(file, "EVENT", f"ICON_IDS{more}", [_ICONS[one.kind] for one in some])
        add_integers(file, "EVENT", f"GENERIC_FLAGS{more}", [0] * len(some))
    add_integers(file, "EVENT_CONTEXT", "USED", [3])
    file.add_parameter("EVENT_CONTEXT", "LABELS", ["General", "Left", "Right"])
    add_integers(file, "EVENT_CONTEXT", "ICON_IDS", [0, 1, 2])
