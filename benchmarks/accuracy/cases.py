"""Cases to compare: faults, sensors, and the solver without one of its terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.accuracy.faults import FAULTS, NOMINAL
from benchmarks.harness import KEYPOINTS, SENSOR_SETS
from rtof_kin.solve.settings import JointSpaceSettings

_HUGE = 1e4
_USUAL = JointSpaceSettings()
_BETWEEN = float(np.sqrt(_USUAL.sigma_swing * _USUAL.sigma_twist))
_BLIND = "sensors in the lifter"
_AS_GIVEN = "calibration from the recording itself"
_ABLATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    NOMINAL: ("8", {}),
    "orientation of the sensors": ("8", {"sigma_swing": _HUGE, "sigma_twist": _HUGE}),
    "acceleration": ("8", {"sigma_acceleration": _HUGE}),
    "acceleration's low-pass": ("8", {"acceleration_cutoff_hz": None}),
    "swing and twist apart: twist as swing": ("8", {"sigma_twist": _USUAL.sigma_swing}),
    "swing and twist apart: both between": ("8", {"sigma_swing": _BETWEEN, "sigma_twist": _BETWEEN}),
    _AS_GIVEN: ("8", {}),
    "robust 2D": ("8", {"robust_reprojection": 1e3}),
    "refitting the root": ("8", {"refit_root": False}),
    "robust orientation": ("8", {"robust_orientation": 1e3}),
    "robust acceleration": ("8", {"robust_acceleration": 1e3}),
    "pose prior": ("8", {"prior_inflation": 1e3}),
    "jerk": ("8", {"jerk": _HUGE}),
    "torso anchor": ("8", {"sigma_torso": None}),
    _BLIND: ("8", {}),
    "limits": ("8", {"limits": False}),
    "hinges": ("8", {"hinges": False}),
    "smoothed start": ("8", {"smooth_start_hz": _HUGE}),
    "annealing: sigma given, 5 px": ("8", {"sigma_reprojection": 5.0}),
    "annealing: sigma given, 10 px": ("8", {"sigma_reprojection": 10.0}),
    "correlation in time": ("8", {"largest_correlation_factor": 1.0}),
    f"{NOMINAL}, 4 sensors": ("4", {}),
    f"{NOMINAL}, no sensors": ("0", {}),
    "limb anchor, no sensors": ("0", {"sigma_bone": None}),
    "root anchor, no sensors": ("0", {"sigma_root": None}),
}
"""Ingredient -> sensors, and the settings that leave it out. Any sensor leaves nothing to the
anchors of limbs and root."""


@dataclass(frozen=True)
class Case:
    """One way to record and to solve."""

    name: str
    keypoints: str
    sensors: str
    fault: str = NOMINAL
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the solver that are not the default."""
    as_given: bool = False
    """Use the recording's calibration without self-calibration."""

    @property
    def settings(self) -> JointSpaceSettings:
        """Settings of the solver."""
        calibrated = self.sensors != "0" and not self.as_given
        usual = _USUAL if calibrated else JointSpaceSettings()
        return replace(usual, **self.changes)

    @property
    def lift_with_sensors(self) -> bool:
        """Return whether the lifter takes the sensors."""
        return self.name != _BLIND


def cases(table: str) -> list[Case]:
    """All cases of a table; those that share a recording stand together."""
    if table == "sensors":
        return [
            Case(f"{count} sensors" + ", as given" * as_given, kind, count, as_given=as_given)
            for kind in KEYPOINTS
            for count in sorted({*SENSOR_SETS, "0"}, key=int)
            for as_given in ([False, True] if count != "0" else [False])
        ]
    if table == "robustness":
        return [Case(name, "white", "8", name) for name in FAULTS]
    return [
        Case(name, kind, sensors, changes=changes, as_given=name == _AS_GIVEN)
        for kind in ("white", "realistic")
        for name, (sensors, changes) in _ABLATIONS.items()
    ]
