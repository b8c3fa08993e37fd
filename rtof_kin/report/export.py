"""Export of a reconstruction to a folder.

============================  ==================================================================
motion.npz                    the motion with validity and provenance (`formats.motion_npz`)
measurements.npz              what it was computed from, and the reference (`formats.measurements_npz`)
skeleton.urdf                 the subject's skeleton
files.json                    convention and names of all files (`formats.motion_files`)
joint_trajectory.csv, .json   configurations with named columns, and their units
motion.csv                    the same with landmarks, validity and provenance
ros_joint_trajectory.json     trajectory_msgs/JointTrajectory
ros_base_trajectory.json      trajectory_msgs/MultiDOFJointTrajectory of the free base
summary.json                  mode, verdict, settings, solver, limit violations, errors against the
                              reference, inputs and audit
figures/*.png                 see `rtof_kin.report.figures`
============================  ==================================================================

OpenSim, C3D, BVH and Parquet files are written on request, see `rtof_kin.formats.motion_files`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.files.folder import new_folder
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.measurements_npz import MEASUREMENTS
from rtof_kin.formats.measurements_writer import write_measurements_npz
from rtof_kin.formats.motion_files import DEFAULT, check_formats, write_motion_files
from rtof_kin.formats.motion_npz import MOTION
from rtof_kin.formats.motion_views import dofs_from_prior
from rtof_kin.formats.motion_writer import write_motion_npz
from rtof_kin.reconstruction.measured import measurements_of
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.report.audit import audit
from rtof_kin.report.headline import headline
from rtof_kin.report.provenance import input_provenance

MARKER: Final = MOTION


def export(
    result: Reconstruction,
    folder: str | Path,
    overwrite: bool = False,
    figures: bool = True,
    formats: Sequence[str] = DEFAULT,
    inputs: Mapping[str, str] | None = None,
) -> Path:
    """Write a reconstruction; after an error there is no folder.

    Args:
        result: of `reconstruct`. folder: a new folder. overwrite: replace an earlier export there.
        figures: draw figures too, which takes most of the time.
        formats: of the motion's files beside motion.npz, see `rtof_kin.formats.motion_files`.
        inputs: fingerprints for the folder's manifest, see `rtof_kin.core.files.folder.new_folder`.

    Returns:
        The folder.

    Raises:
        OutputExistsError: the folder exists and may not be replaced.
        UnknownNameError: an unknown format. InvalidInputError: a format cannot represent the motion.
    """
    check_formats(formats)
    folder = Path(folder)
    with new_folder(folder, MARKER, overwrite, inputs) as temporary:
        first_frame = result.recording.first_frame
        write_motion_npz(temporary / MARKER, result.motion, first_frame=first_frame, mode=result.mode)
        write_measurements_npz(temporary / MEASUREMENTS, measurements_of(result))
        write_motion_files(temporary, result.motion, formats)
        text = json.dumps(summary(result), indent=2)
        (temporary / "summary.json").write_text(text + "\n", encoding="utf-8")
        if figures:
            from rtof_kin.report.figures import write_figures

            write_figures(result, temporary / "figures")
    return folder


def provenance_shares(poses: PoseSequence) -> dict[str, float]:
    """Return the share of all joints and frames by `Provenance`, in lower case -> 0 to 1.

    Args:
        poses: of a motion.
    """
    return {p.name.lower(): float(np.mean(poses.provenance == p)) for p in Provenance}


def summary(result: Reconstruction) -> dict[str, Any]:
    """Return the contents of ``summary.json``.

    Args:
        result: of `reconstruct`.
    """
    poses, report = result.motion.poses, result.motion.report
    results = audit(result)
    out: dict[str, Any] = {
        "recording": result.recording.name,
        "mode": result.mode,
        "verdict": headline(results).plain(),
        "acknowledgement": result.recording.acknowledgement,
        "frames": len(poses),
        "rate_hz": poses.rate_hz,
        "skeleton": result.motion.skeleton.name,
        "height_m": result.motion.skeleton.height,
        "sensors": list(result.bone_imus.joints) if result.bone_imus else [],
        "provenance": provenance_shares(poses),
        "valid_share": float(poses.valid.mean()),
        "dofs_from_prior": dofs_from_prior(result.motion),
        "limit_violations_deg": {k: float(np.degrees(v)) for k, v in report.violations.items()},
        "singular_share": float(report.singular.mean()),
        "settings": result.choices.plain(),
        "inputs": input_provenance(result),
        "audit": [found.plain() for found in results],
    }
    if result.faults:
        out["stream_faults"] = [str(fault) for fault in result.faults]
    if result.warnings:
        out["warnings"] = list(result.warnings)
    if result.root_sigma is not None:
        out["root_drift_sigma_m"] = _plain({"last_frame": float(result.root_sigma[-1])})
    if (solution := result.solution) is not None:
        out["solver"] = {
            "status": solution.status.name,
            "meaning": solution.status.value,
            "outcome": solution.outcome,
            "fragments": len(solution.fragments),
            "iterations": solution.iterations,
            "seconds": solution.seconds,
            "optimality_per_m": solution.optimality,
            "energy": solution.energy,
        }
    if result.stage_metrics:
        out["metrics"] = {stage: _plain(metrics) for stage, metrics in result.stage_metrics.items()}
        out["metrics_per_joint"] = result.stage_metrics[result.mode].per_joint
    return out


def _plain(metrics: Mapping[str, float]) -> dict[str, float | None]:
    """None, which is null in JSON, for NaN."""
    return {name: value if np.isfinite(value) else None for name, value in metrics.items()}
