"""Provenance of a reconstruction: its inputs as plain data, a part of ``summary.json``.

**Checklist.** What is known of the items that a study with inertial sensors should report; the page of the report
has the items (``checklist.html``), whose selection, grouping and wording are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from rtof_kin.calibration.camera_estimate import COLUMNS
from rtof_kin.core.array_types import Array
from rtof_kin.reporting.statistics import ReconstructionStatistics

Data = dict[str, Any]


def input_provenance(statistics: ReconstructionStatistics) -> Data:
    """Return session, subject, camera, keypoints, sensors and calibration of a reconstruction.

    Returns:
        Plain data with units in the names; None or an empty list for missing inputs.
    """
    result = statistics.first
    recording = result.recording
    try:
        software = version("rtof_kin")
    except PackageNotFoundError:  # a clone that was not installed
        software = "(not installed)"
    bones = "proportions of the skeleton table"
    if recording.bone_lengths:
        bones = f"{len(recording.bone_lengths)} measured bone lengths, the others by the table"
    elif recording.height is not None:
        bones += ", scaled by the height"
    return {
        "software": f"rtof_kin {software}",
        "session": recording.session.plain(),
        "notes": recording.notes,
        "corrections": [str(one) for one in recording.corrections],
        "first_frame": recording.first_frame,
        "subject": {"height_m": recording.height, "skeleton_height_m": recording.skeleton.height}
        | {"mass_kg": recording.mass_kg, "sex": recording.sex, "bones": bones},
        "floor_height_m": recording.floor_height,
        "camera": _camera(statistics),
        "cameras": 0 if result.keypoints is None else 1 + len(recording.views),
        "lifts": [one.name for one in result.lifts if not one.doubt],
        "found_of_lifts": [str(one) for one in result.lifts],
        "camera_estimate": None
        if result.camera is None
        else {"columns": list(COLUMNS), "rows": [list(row) for row in result.camera.table()]},
        "sensors": _sensors(statistics),
        "delay": None
        if (delay := result.delay) is None
        else {
            "offset_s": float(delay.value[0]),
            "sigma_s": float(delay.sigma[0]),
            "drift_share": float(delay.value[1]) if len(delay.value) > 1 else 0.0,
            "doubt": delay.doubt,
        },
        "calibration": None
        if result.calibration is None
        else {
            "converged": result.calibration.converged,
            "columns": ["quantity", "of", "value", "sd", "sd expected", "verdict"],
            "rows": [list(row) for row in result.calibration.table()],
        },
    }


def _camera(statistics: ReconstructionStatistics) -> Data | None:
    """Camera and keypoints that were used, or None."""
    keypoints = statistics.first.keypoints
    if keypoints is None:
        return None
    camera, depth = keypoints.camera, statistics["depth"].median_of_all
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "focal_px": float(camera.K[1, 1]),
        "distorted": bool(np.any(camera.distortion)),
        "height_m": float(camera.center_world[2]),
        "distance_m": depth if np.isfinite(depth) else None,
        "rate_hz": _rate(keypoints.times),
        "landmarks": list(keypoints.names),
        "seen_share": 1 - statistics["points unseen"].mean_of_all,
    }


def _sensors(statistics: ReconstructionStatistics) -> list[Data]:
    """All recorded sensors; those without a calibration have no segment."""
    imus, calibration = statistics.first.recording.imus, statistics.first.recording.calibration
    out = []
    for s, name in enumerate(imus.names if imus is not None else ()):
        assert imus is not None
        force = float(statistics["specific force"].largest[s])
        segment, lever = None, None
        if calibration is not None and name in calibration.sensors:
            own = calibration.sensors.index(name)
            segment = calibration.joints[own]
            lever = [round(float(v), 4) for v in calibration.p_bone_sensor[own]]
        out.append(
            {
                "name": name,
                "segment": segment,
                "lever_arm_m": lever,
                "rate_hz": _rate(imus.times),
                "known_share": 1 - float(statistics["sensor unknown"].mean[s]),
                "largest_specific_force_m_s2": force if np.isfinite(force) else None,
            }
        )
    return out


def _rate(times: Array) -> float | None:
    """Sampling rate, Hz, from the median step; None for a single sample."""
    return float(1 / np.median(np.diff(times))) if len(times) > 1 else None


def checklist(inputs: Mapping[str, Any], mode: str, bands: bool, gaps: str) -> dict[str, Any]:
    """Return what the checklist says of a recording, None or empty where the user must provide it; what ends with a
    colon is to be continued.

    Args:
        inputs: of `input_provenance`. bands: whether angles have 95 % bands. gaps: description of missing data.
    """
    subject, session = inputs.get("subject") or {}, inputs.get("session") or {}
    units = {"height_m": "m tall", "mass_kg": "kg"}
    body = [f"{subject[name]:g} {unit}" for name, unit in units.items() if subject.get(name)]
    sensors = inputs.get("sensors") or []
    rates = sorted({f"{s['rate_hz']:.4g} Hz" for s in sensors if s.get("rate_hz")})
    largest = [s["largest_specific_force_m_s2"] for s in sensors if s.get("largest_specific_force_m_s2")]
    return {
        "body": ", ".join([*body, *([subject["sex"]] if subject.get("sex") else [])]),
        "session": session,
        "force": f"the largest specific force was {max(largest):.0f} m/s2; the range itself:" if largest else None,
        "rates": ", ".join(rates),
        "sensors": "; ".join(map(_place, sensors)),
        "calibrated": bool(inputs.get("calibration")),
        "mode": mode,
        "bones": subject.get("bones", "bones not stated"),
        "gaps": gaps,
        "bands": bands,
        "software": inputs.get("software"),
    }


def _place(sensor: Mapping[str, Any]) -> str:
    lever = sensor.get("lever_arm_m")
    where = f" at ({', '.join(f'{1000 * v:.0f}' for v in lever)}) mm in its frame" if lever else ""
    return f"{sensor.get('name', '')} on {sensor.get('segment') or 'segment not stated'}{where}"
