"""Export of a sensor study as sentences and files.

``study.csv`` has a row for each set of sensors and angle, with empty cells for missing values;
``study.json`` has the verdict and settings of the full set, the sets in order and the sentences.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.report.angle_names import side_and_name
from rtof_kin.report.headline import Headline
from rtof_kin.report.sensor_study.study import LEAST_SEEN, TOLERANCE, SensorSet, SensorStudy

MARKER: Final = "study.csv"
COLUMNS: Final = ("set", "sensors", "number", "angle", "difference_deg", "seen_share", "error_deg",
           "half_band_deg", "kept")  # fmt: skip
NO_ERROR: Final = (
    "a difference from the full set is not an error: errors that both sets share are not included"
)


def write_study(study: SensorStudy, folder: str | Path, verdict: Headline | None = None) -> None:
    """Write ``study.csv`` and ``study.json``.

    Args:
        study: to write. folder: that exists. verdict: on the reconstruction with the full set.
    """
    folder = Path(folder)
    with (folder / MARKER).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        writer.writerows(_rows(study))
    text = json.dumps(study_data(study, verdict), indent=2)
    (folder / "study.json").write_text(text + "\n", encoding="utf-8")


def study_data(study: SensorStudy, verdict: Headline | None = None) -> dict[str, Any]:
    """Return a study as plain data, with units in the names.

    Args:
        study: to write. verdict: on the reconstruction with the full set.
    """
    return {
        "recording": study.recording,
        "verdict": None if verdict is None else verdict.plain(),
        "settings": study.reconstruction.choices.plain(),
        "compared_with": "the truth" if study.has_truth else "the full set of sensors",
        "note": "errors are against the truth; differences against the full set" if study.has_truth
        else NO_ERROR,
        "tolerance_deg": float(np.degrees(TOLERANCE)),
        "least_seen_share": LEAST_SEEN,
        "segments": study.segments,
        "without": [_set_data(found) | {"left_out": _left_out(study, found)} for found in study.without],
        "path": [_set_data(found) for found in study.path],
        "sentences": sentences(study),
    }  # fmt: skip


def sentences(study: SensorStudy, tolerance: float = TOLERANCE) -> list[str]:
    """Return sentences on the sensors that the angles of each joint need along the path; both sides together
    unless only one is ever within the tolerance.

    Args:
        study: of a recording. tolerance: RMS, rad.
    """
    joints: dict[str, list[str]] = {}
    for angle in dict.fromkeys(side_and_name(name)[1] for name in study.angles):
        if not angle.startswith("pelvis_opensim"):
            joint, _, movement = angle.partition("_")
            need = _need(study, angle, tolerance)
            joints.setdefault(joint, []).append(f"{movement.replace('_', ' ')} {need}")
    what = "the truth" if study.has_truth else "the full set of sensors"
    limit = f"{np.degrees(tolerance):.0f} deg (RMS)"
    opening = f"Within {limit} of {what}, when the least important sensor is removed first:"
    return [opening, *(f"{joint}: {'; '.join(needs)}." for joint, needs in joints.items())]


def _need(study: SensorStudy, angle: str, tolerance: float) -> str:
    """Sensors that one angle needs, on both sides if it has two."""
    sets = {name: study.fewest(name, tolerance) for name in study.angles if side_and_name(name)[1] == angle}
    within = {name: found for name, found in sets.items() if found is not None}
    beyond = [name for name in sets if name not in within]
    if not beyond:
        return _needed(study, within.values())
    worst = max(float(study.measure(study.full)[study.angles.index(name)]) for name in beyond)
    text = f"is not within it even with all {len(study.full.sensors)} ({np.degrees(worst):.1f} deg)"
    if not within:
        return text
    outside, inside = side_and_name(beyond[0])[0], side_and_name(next(iter(within)))[0]
    return f"on the {outside} {text}, on the {inside} {_needed(study, within.values())}"


def _needed(study: SensorStudy, sets: Iterable[SensorSet]) -> str:
    """Description of the largest of some sets."""
    most = max(sets, key=lambda found: len(found.sensors))
    if not most.sensors:
        return "needs no sensor"
    if len(most.sensors) == len(study.full.sensors):
        return f"needs all {len(most.sensors)} sensors"
    return f"needs {len(most.sensors)}: {', '.join(study.segments[name] for name in most.sensors)}"


def _left_out(study: SensorStudy, found: SensorSet) -> str:
    return next(name for name in study.full.sensors if name not in found.sensors)


def _set_data(found: SensorSet) -> dict[str, Any]:
    return {"sensors": list(found.sensors), "loss_deg": float(np.degrees(found.loss))}


def _rows(study: SensorStudy) -> Iterator[list[str]]:
    """Rows of the full set, of each sensor omitted alone, and of the path below the full set."""
    sets = [("full", study.full)]
    sets += [(f"without {_left_out(study, found)}", found) for found in study.without]
    sets += [(f"path {len(found.sensors)}", found) for found in study.path[1:]]
    for name, found in sets:
        kept = study.kept(found)
        for a, angle in enumerate(study.angles):
            figures = (np.degrees(found.difference[a]), found.seen[a], np.degrees(found.error[a]),
                       np.degrees(found.half_band[a]))  # fmt: skip
            cells = [f"{value:.4f}" if np.isfinite(value) else "" for value in figures]
            sensors = " ".join(found.sensors)
            yield [name, sensors, str(len(found.sensors)), angle, *cells, "yes" if kept[a] else "no"]
