"""What gait laboratories have in a C3D file beside markers: gait events, results as points, parameters, the subject.

Groups and names are those of Vicon Nexus: EVENT, points that POINT:ANGLES, FORCES and MOMENTS list, ANALYSIS, SUBJECTS
and PROCESSING (user guide at c3d.org). Events have minutes and seconds on the clock that is 0 at the frame numbered 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.core.array_types import Array
from rtof_kin.formats.measurements_file import MeasurementsReader

UNITS: Final = {"ANGLES": ("ANGLE_UNITS", "deg"), "FORCES": ("FORCE_UNITS", "N"), "MOMENTS": ("MOMENT_UNITS", "Nmm")}
"""Parameter of POINT that lists results of a kind -> parameter with their unit, and the unit."""
MOST_EVENTS: Final = 2040  #: The first events that are written: parameters have 130 kB in all
_DIMENSION: Final = 255  #: Largest dimension of a parameter; LABELS2, LABELS3, ... continue it
_LABELS: Final = {"foot_strike": ("Foot Strike", 1), "foot_off": ("Foot Off", 2)}  #: Label and icon


@dataclass(frozen=True)
class TrialResults:
    """What is written beside the markers of a trial."""

    events: tuple[tuple[float, str, str], ...] = ()
    """By time: s, left or right, foot_strike or foot_off."""
    points: Mapping[str, Mapping[str, NDArray[np.float32]]] = field(default_factory=dict)
    """ANGLES, FORCES, MOMENTS -> name -> three components (T, 3), deg, N and N mm; NaN where unknown."""
    parameters: tuple[tuple[str, str, str, float], ...] = ()
    """Means by side: name in Vicon's files, e.g. 'Walking Speed'; left or right; unit; value."""
    subject: str = ""  #: Name or code; '' where there is none
    mass_kg: float | None = None
    height_m: float | None = None

    @property
    def flat(self) -> dict[str, NDArray[np.float32]]:
        """All points by name, (T, 3)."""
        return {name: values for own in self.points.values() for name, values in own.items()}

    def add_to(self, file: Any, zero_s: float) -> None:
        """Add the parameters to an ``ezc3d.c3d``; zero_s: time at which the clock of the file shows 0."""
        subject = self.subject[:32] or "Subject"  # events and parameters find their subject by its name
        for kind, own in self.points.items():
            unit_name, unit = UNITS[kind]
            add_parameters(file, "POINT", **{kind: list(own), unit_name: [unit]})
        events = self.events[:MOST_EVENTS]
        for number, first in enumerate(range(0, len(events), _DIMENSION), 1):
            times, sides, kinds = zip(*events[first : first + _DIMENSION], strict=True)
            columns = {
                "CONTEXTS": [side.title() for side in sides],
                "LABELS": [_LABELS[kind][0] for kind in kinds],
                "SUBJECTS": [subject] * len(times),
                "TIMES": np.array([divmod(time - zero_s, 60.0) for time in times]).T,
                "ICON_IDS": [_LABELS[kind][1] for kind in kinds],
                "GENERIC_FLAGS": [0] * len(times),
            }
            more = str(number) if number > 1 else ""
            add_parameters(file, "EVENT", USED=[len(events)], **{name + more: own for name, own in columns.items()})
        add_parameters(file, "EVENT_CONTEXT", USED=[3], LABELS=["General", "Left", "Right"], ICON_IDS=[0, 1, 2])
        if self.parameters:
            keys, count = ("NAMES", "CONTEXTS", "UNITS", "VALUES"), len(self.parameters)
            means = dict(zip(keys, map(list, zip(*self.parameters, strict=True)), strict=True))
            means["CONTEXTS"] = [side.title() for side in means["CONTEXTS"]]
            add_parameters(file, "ANALYSIS", USED=[count], SUBJECTS=[subject] * count, **means)
        add_parameters(file, "SUBJECTS", USED=[1], IS_STATIC=[0], USES_PREFIXES=[0], NAMES=[subject])
        for name, size in (("Bodymass", self.mass_kg), ("Height", self.height_m and 1000 * self.height_m)):
            if size is not None:
                add_parameters(file, "PROCESSING", **{name: [float(size)]})


AngleBlock = tuple[tuple[str, ...], Array, Array, Array]
"""Clinical angles of consecutive frames: A names, times (T,), s, values and standard deviations (T, A), deg."""


@dataclass(frozen=True)
class Beside:
    """What some formats have beside the motion; by default nothing."""

    results: Callable[[MotionSource], TrialResults] | None = None  #: Makes what c3d has beside the landmarks
    angles: Callable[[MotionSource], Iterator[AngleBlock]] | None = None  #: Makes the curves of rrd
    measurements: MeasurementsReader | None = None  #: Of the same frames: cameras and detected points for rrd
    video: Callable[[], Iterator[tuple[float, bytes]]] | None = None
    """Begins to read the frames of the first camera's video: time, s, and an access unit of H.264 in Annex B."""


def add_parameters(file: Any, group: str, **values: Any) -> None:
    """Add parameters to an ``ezc3d.c3d``, integers with 16 bits, of which its own method makes fractional numbers."""
    for name, own in values.items():
        file.add_parameter(group, name, own)
        if np.asarray(own).dtype.kind == "i":
            kind = file["parameters"]["POINT"]["USED"]["type"]
            file["parameters"][group][name] |= {"type": kind, "value": np.array(own)}
