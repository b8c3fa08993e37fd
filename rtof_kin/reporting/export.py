"""Export of a reconstruction to a folder.

============================  ==================================================================
motion.h5                    the motion with validity and provenance (`body.motion_file`)
measurements.h5              what it was computed from, and the reference (`formats.measurements_file`)
skeleton.urdf                 the subject's skeleton
files.json                    convention and names of all files (`formats.motion_files`)
joint_trajectory.csv, .json   configurations with named columns, and their units
motion.csv                    the same with landmarks, validity and provenance
ros_joint_trajectory.json     trajectory_msgs/JointTrajectory
ros_base_trajectory.json      trajectory_msgs/MultiDOFJointTrajectory of the free base
summary.json                  mode, verdict, settings, solver, limit violations, errors against the
                              reference, inputs and audit
certificate.csv               errors of left-out sensors, frame by frame, where they were asked for
============================  ==================================================================

OpenSim, C3D, BVH and Parquet files are written on request, see `rtof_kin.formats.motion_files`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_file import MOTION, MotionReader, MotionWriter
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.angles import angle_blocks
from rtof_kin.clinical.laboratory import trial_results
from rtof_kin.core.choices import MARKERS
from rtof_kin.core.environment import environment
from rtof_kin.core.files.folder import new_folder
from rtof_kin.formats.measurements_file import MEASUREMENTS, MeasurementsReader, MeasurementsWriter, measurements_path
from rtof_kin.formats.motion_files import DEFAULT, check_formats, write_motion_files
from rtof_kin.formats.trial_results import Beside, TrialResults
from rtof_kin.markers.trials import MarkerResult, marker_facts
from rtof_kin.reconstruction.result import Reconstruction, measurements_of
from rtof_kin.reporting import certificate as certified
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import AuditResult, headline
from rtof_kin.reporting.provenance import input_provenance
from rtof_kin.reporting.statistics import ReconstructionStatistics
from rtof_kin.reporting.summary_file import SIGMAS, read_summary
from rtof_kin.vision.video import h264_frames

MARKER: Final = MOTION
MOST_SECONDS: Final = 600.0
"""[s] Longest motion that is also written as text, which takes five times the space of motion.h5."""


def export(
    found: Reconstruction | Iterable[Reconstruction],
    folder: str | Path,
    overwrite: bool = False,
    formats: Sequence[str] | None = None,
    inputs: Mapping[str, str] | None = None,
    run: Mapping[str, Any] | None = None,
) -> ReconstructionStatistics:
    """Write a reconstruction; after an error there is no folder.

    >>> from rtof_kin import Recording, export, reconstruct
    >>> result = reconstruct(Recording.load("recording"), mode="sf2")
    >>> found = export(result, "out/motion")
    >>> found.frames
    60

    Args:
        found: of `reconstruct`, or the parts of `reconstruct_in_parts`, none of which is kept.
        overwrite: replace an earlier export there.
        formats: of the motion's files beside motion.h5, see `rtof_kin.formats.motion_files`. Default: CSV and ROS of
            motions up to `MOST_SECONDS`, none of longer ones.
        inputs: fingerprints for the folder's manifest, see `rtof_kin.core.files.folder.new_folder`.
        run: what the run can be repeated by, for the summary, which also gets the environment.

    Returns:
        Statistics of the whole.

    Raises:
        OutputExistsError: the folder exists and may not be replaced. UnknownNameError: an unknown format.
        InvalidInputError: a format cannot represent the motion. Those raised while parts are made.
    """
    parts = (found.parts or (found,)) if isinstance(found, Reconstruction) else found
    check_formats(formats or ())
    statistics: ReconstructionStatistics | None = None
    with new_folder(Path(folder), MARKER, overwrite, inputs) as temporary:
        with ExitStack() as files:
            for part in parts:
                if statistics is None:
                    statistics = ReconstructionStatistics(part)
                    about: dict[str, Any] = {"mode": part.mode, "first_frame": part.recording.first_frame}
                    motion = files.enter_context(MotionWriter(temporary / MARKER, part.motion.skeleton, **about))
                    measurements = files.enter_context(MeasurementsWriter(temporary / MEASUREMENTS))
                else:
                    statistics.add(part)
                motion.append(part.motion)
                measurements.append(measurements_of(part))
                del part  # before the next one is made
        assert statistics is not None  # there is at least one part
        if formats is None:
            formats = DEFAULT if statistics.seconds <= MOST_SECONDS else ()
        contents = summary(statistics)
        if run is not None:
            contents["run"] = {**run, "environment": environment() | {"energy": statistics.first.evaluated}}
        (temporary / "summary.json").write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")
        with MotionReader(temporary / MARKER) as reader, beside_of(temporary) as beside:
            write_motion_files(temporary, reader, formats, beside)
        if statistics.certificate is not None and statistics.certificate.left_out:
            certified.write_frames(statistics.certificate, temporary)
    return statistics


def summary(found: Reconstruction | ReconstructionStatistics) -> dict[str, Any]:
    """Return the contents of ``summary.json``; found: result of `reconstruct`, or the statistics of its parts."""
    statistics = ReconstructionStatistics.of(found)
    first = statistics.first
    results, sigmas = audit(statistics), statistics.mean_sigmas
    out: dict[str, Any] = {
        "recording": first.recording.name,
        "mode": first.mode,
        "verdict": headline(results).plain(),
        "acknowledgement": first.recording.acknowledgement,
        "frames": statistics.frames,
        "rate_hz": first.motion.poses.rate_hz,
        "parts": statistics.parts,
        "skeleton": first.motion.skeleton.name,
        "height_m": first.motion.skeleton.height,
        "sensors": list(first.bone_imus.joints) if first.bone_imus else [],
        "provenance": statistics.provenance_shares,
        "valid_share": 1 - statistics["invalid"].mean_of_all,
        "dofs_from_prior": statistics.from_prior,
        "limit_violations_deg": {k: float(np.degrees(v)) for k, v in statistics.limit_violations.items()},
        "singular_share": statistics["singular"].mean_of_all,
        "mean_sigma_m": None if sigmas is None else _plain(dict(zip(SIGMAS, sigmas, strict=True))),
        "settings": first.choices.plain(),
        "inputs": input_provenance(statistics),
        "audit": [result.plain() for result in results],
    }
    if statistics.faults:
        out["stream_faults"] = [str(fault) for fault in statistics.faults]
    if statistics.warnings:
        out["warnings"] = list(statistics.warnings)
    if first.root_sigma is not None:
        out["root_drift_sigma_m"] = _plain({"last_frame": statistics.root_sigma})
    if (certificate := statistics.certificate) is not None:
        out["certificate"] = certified.facts(certificate, first.motion.skeleton)
    if (solution := statistics.solution) is not None:
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
    if scores := statistics.stage_metrics:
        out["metrics"] = {stage: _plain(metrics) for stage, metrics in scores.items()}
        out["metrics_per_joint"] = scores[first.mode].per_joint
    return out


def marker_audit(found: MarkerResult) -> tuple[AuditResult, ...]:
    """Return the checks of a marker trial: its fit, markers that contradict it, frames with too few."""
    left_out = (
        AuditResult.warning(
            "streams", name, f"lies {1000 * rms:.0f} mm from where the others say, not used: exchanged or fallen off?"
        )
        for name, rms in found.body.left_out.items()
    )
    why = "are names, unit and rate right, and all trials of one person?"
    unseen = "share of frames with too few markers"
    return (
        AuditResult("body", "residual of the markers, RMS", "body", 1000 * found.rms, "mm", 15.0, 30.0, note=why),
        AuditResult("streams", unseen, "markers", found.unseen, "", 0.05, 0.5, note="fill the gaps"),
        *left_out,
    )


def export_markers(
    found: MarkerResult, folder: str | Path, overwrite: bool = False, formats: Sequence[str] = DEFAULT
) -> tuple[AuditResult, ...]:
    """Write the motion of a marker trial as that of a recording, with ``markers.json``; return its checks.
    `OutputExistsError`: the folder exists and may not be replaced; `WritingError`: it cannot be written.
    """
    results, facts, poses = marker_audit(found), marker_facts(found), found.motion.poses
    about = {
        "recording": found.name,
        "mode": MARKERS,
        "verdict": headline(results).plain(),
        "acknowledgement": "",
        "frames": len(poses),
        "rate_hz": poses.rate_hz,
        "height_m": facts["height_m"],
        "audit": [result.plain() for result in results],
    }
    with new_folder(Path(folder), MARKER, overwrite) as temporary:
        with MotionWriter(temporary / MARKER, found.body.skeleton, mode=MARKERS) as writer:
            writer.append(found.motion)
        write_motion_files(temporary, found.motion, formats, Beside(trial_results, angle_blocks))
        for name, contents in (("summary.json", about), ("markers.json", facts)):
            (temporary / name).write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")
    return results


@contextmanager
def beside_of(folder: Path, video: Path | None = None) -> Iterator[Beside]:
    """Yield what formats have beside the motion in the output folder of a reconstruction; errors of readers.

    Args:
        video: of the first camera, uncropped.
    """
    with ExitStack() as files:
        path = measurements_path(folder)
        measured = files.enter_context(MeasurementsReader(path)) if path.is_file() else None

        def frames() -> Iterator[tuple[float, bytes]]:
            view = next(iter(measured.read(0, 1).views), None) if measured is not None else None
            size = None if view is None else (view.camera.width_px, view.camera.height_px)
            later = 0.0 if view is None else float(view.times[0] - view.video_times[0])
            return ((time + later, data) for time, data in h264_frames(video or "", size))

        yield Beside(partial(results_of, folder=folder), angle_blocks, measured, frames if video is not None else None)


def results_of(motion: MotionSource, folder: Path) -> TrialResults:
    """Return the results for a C3D file; a summary in the folder says subject and body mass; errors as its reader."""
    if not (file := folder / "summary.json").is_file():
        return trial_results(motion)
    said = read_summary(file)
    return trial_results(motion, said.session.subject, said.subject.get("mass_kg"), said.subject.get("sex"))


def _plain(metrics: Mapping[str, float]) -> dict[str, float | None]:
    """None, which is null in JSON, for NaN."""
    return {name: value if np.isfinite(value) else None for name, value in metrics.items()}
