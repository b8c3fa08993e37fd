"""Export of a sensor study as files.

``study.csv`` has a row for each set of sensors and angle, with empty cells for missing values;
``study.json`` has the verdict and settings of the full set, the sets in order and the sentences.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.text import write_text
from rtof_kin.reporting.sensor_study.accuracy import SensorSet
from rtof_kin.reporting.sensor_study.sentences import NO_ERROR, sentences
from rtof_kin.reporting.sensor_study.study import CLEARLY, LEAST_SEEN, TOLERANCE, SensorStudy, omitted

TABLE: Final = "study.csv"
SUMMARY: Final = "study.json"
_FIGURES: Final = ("figures/sensors.png", "figures/number.png")
_SETTINGS: Final = "settings.json"  # written by `rtof_kin.core.jobs.open_runs`
COLUMNS: Final = (
    "set",
    "sensors",
    "number",
    "angle",
    "difference_deg",
    "seen_share",
    "error_deg",
    "half_band_deg",
    "kept",
)


def write_study(study: SensorStudy, folder: str | Path) -> list[Path]:
    """Write ``study.csv`` and then ``study.json``, and return their paths; earlier ones are replaced."""
    folder = Path(folder)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_rows(study))
    write_text(folder / TABLE, stream.getvalue(), overwrite=True)
    write_text(folder / SUMMARY, json.dumps(study_data(study), indent=2) + "\n", overwrite=True)
    return [folder / TABLE, folder / SUMMARY]


def remove_results(folder: str | Path) -> None:
    """Remove the results of an earlier study of a folder, so that none remain of a study that is not done."""
    for name in (TABLE, SUMMARY, *_FIGURES):
        (Path(folder) / name).unlink(missing_ok=True)


@contextmanager
def unused_removed(folder: Path) -> Iterator[None]:
    """Remove the new folder of a study that fails before its first run is done."""
    try:
        yield
    except RtofError:
        runs = folder / "runs"
        if not any(runs.iterdir()):
            runs.rmdir()
            (folder / _SETTINGS).unlink()
            with suppress(OSError):  # results of an earlier study
                folder.rmdir()
        raise


def study_data(study: SensorStudy) -> dict[str, Any]:
    """Return a study as plain data, with units in the names."""
    part = study.part
    return {
        "recording": study.recording,
        "part_s": [part.start, part.stop],
        "whole_s": part.whole,
        "verdict": study.verdict.plain(),
        "settings": study.choices,
        "runs": study.runs,
        "compared_with": "the truth" if study.has_truth else "the full set of sensors",
        "note": "errors are against the truth; differences against the full set" if study.has_truth else NO_ERROR,
        "tolerance_deg": float(np.degrees(TOLERANCE)),
        "least_seen_share": LEAST_SEEN,
        "segments": study.segments,
        "without": [_set_data(study, found) | {"left_out": _left_out(study, found)} for found in study.without],
        "path": [_set_data(study, found) for found in study.path],
        "tried": [[_set_data(study, found) for found in step] for step in study.steps],
        "removed_as_well": [list(study.as_good(step)) for step in range(len(study.steps))],
        "standard_deviation_deg": {
            name: _finite(np.degrees(value)) for name, value in zip(study.angles, study.moved, strict=True)
        },
        "sentences": sentences(study),
    }


def _left_out(study: SensorStudy, found: SensorSet) -> str:
    return omitted(found, study.full.sensors)


def _set_data(study: SensorStudy, found: SensorSet) -> dict[str, Any]:
    scatter = CLEARLY * np.degrees(found.scatter(study.full))
    return {
        "sensors": list(found.sensors),
        "loss_deg": float(np.degrees(found.loss)),
        "loss_change_scatter_deg": _finite(scatter),
        "angles_kept": int(study.kept(found).sum()),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _rows(study: SensorStudy) -> Iterator[list[str]]:
    """Rows of the full set, of each sensor omitted alone, and of the path below the full set."""
    sets = [("full", study.full)]
    sets += [(f"without {_left_out(study, found)}", found) for found in study.without]
    sets += [(f"path {len(found.sensors)}", found) for found in study.path[1:]]
    for name, found in sets:
        kept = study.kept(found)
        for a, angle in enumerate(study.angles):
            figures = (
                np.degrees(found.difference[a]),
                found.seen[a],
                np.degrees(found.error[a]),
                np.degrees(found.half_band[a]),
            )
            cells = [f"{value:.4f}" if np.isfinite(value) else "" for value in figures]
            sensors = " ".join(found.sensors)
            yield [name, sensors, str(len(found.sensors)), angle, *cells, "yes" if kept[a] else "no"]
