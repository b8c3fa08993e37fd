"""One reconstruction beside its truth: errors, stated standard deviations and verdicts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.verdicts.recordings import Job
from rtof_kin.body.metrics import at_times
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import RtofError
from rtof_kin.data.confidence import WORLD
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import shipped_lifter
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import Grade, section_verdict

Row = dict[str, Any]
EVERY = 6
"""Step between the frames evaluated; neighbours are correlated."""
SECTIONS = ("inputs", "streams", "image", "sensors", "body", "calibration", "solver", "confidence")
_COST = {Grade.FAIL: 2, Grade.WARN: 1}
BEYOND = np.radians(10.0)
"""[rad] beyond an anatomical limit from which the audit warns."""


@dataclass(frozen=True)
class Stated:
    """Errors of the entries of one quantity, and what is stated of them; NaN where not known."""

    names: tuple[str, ...]
    """n entries: joints, segments or angles."""
    error: Array
    """(T, n) size of the error: mm or deg."""
    sigma: Array
    """(T, n) root of the error's expected square, in the same unit."""
    freedom: Array
    """(T, n) degrees of freedom, 1 to 3, of the chi-square distribution that the squared size of a normal
    error with the stated covariance nearly has (Satterthwaite)."""
    flags: Array
    """(T, n) how many verdicts there are on it in this frame: beyond an anatomical limit, singular, in a
    fault of the streams."""


def measured(job: Job) -> Row:
    """Numbers of one recording, or the error that ended it."""
    try:
        recording = job.recording()
        inertial = recording.imus is not None
        result = reconstruct(recording, mode="rtof" if inertial else "rto", lifter=shipped_lifter(), calibrate=inertial)
    except RtofError as error:  # reported in the table, instead of losing the other recordings
        return _about(job) | {"failed": str(error)}
    return row_of(job, result)


def _about(job: Job) -> Row:
    return {
        "group": job.group,
        "person": job.clip.subject,
        "motion": job.clip.name,
        "keypoints": job.keypoints,
        "sensors": job.sensors,
        "fault": job.fault,
    }


def row_of(job: Job, result: Reconstruction) -> Row:
    """Numbers of one reconstruction."""
    row = _about(job) | {"verdict": verdict(result)}
    for quantity, own in stated(result).items():
        row[quantity] = {
            "names": own.names,
            **{
                field: [_short(column) for column in getattr(own, field).T]
                for field in ("error", "sigma", "freedom", "flags")
            },
        }
    return row


def stated(result: Reconstruction) -> dict[str, Stated]:
    """Errors by quantity: positions in world and relative to the root (mm), orientations of segments and
    clinical angles (deg)."""
    motion = result.motion[::EVERY]
    assert result.recording.truth is not None
    truth = at_times(result.recording.truth, motion.times)
    stated, estimate = motion.confidence, motion.poses
    assert stated is not None
    doubted = _flags(result)[::EVERY]
    p, p_true = estimate.p_world_joint, truth.p_world_joint
    relative = (p - p[:, :1]) - (p_true - p_true[:, :1])
    turned = [j for j, name in enumerate(stated.names) if (WORLD, name) in stated.pairs]
    names = tuple(stated.names[j] for j in turned)
    turns = np.stack([stated.turn(WORLD, name) for name in names], axis=1)
    found = {
        "position": _of_vectors(stated.names, 1000 * (p - p_true), 1e6 * stated.position_covariance, doubted),
        "relative": _of_vectors(
            stated.names[1:], 1000 * relative[:, 1:], 1e6 * stated.relative_covariance[:, 1:], doubted[:, 1:]
        ),
        "orientation": _of_vectors(
            names, np.degrees(_turns(estimate, truth)[:, turned]), np.degrees(np.degrees(turns)), doubted[:, turned]
        ),
    }
    angles = clinical_angles(motion)
    true = clinical_angles(all_observed(truth), motion.skeleton)
    assert angles.sigma is not None
    off = np.abs((angles.values - true.values + np.pi) % (2 * np.pi) - np.pi)
    joints = angle_table(motion.skeleton.table).joints
    of = motion.skeleton.index(*(joint.child for joint in joints for _ in joint.angles))
    found["angle"] = Stated(
        angles.names, np.degrees(off), np.degrees(angles.sigma), np.ones(off.shape), doubted[:, of] + angles.singular
    )
    return found


def _of_vectors(names: tuple[str, ...], error: Array, covariance: Array, flags: Array) -> Stated:
    """Error lengths and sigmas from error vectors (T, n, 3) with covariances (T, n, 3, 3)."""
    mean = np.trace(covariance, axis1=-2, axis2=-1)
    spread = np.sum(covariance**2, axis=(-2, -1))
    return Stated(names, np.linalg.norm(error, axis=-1), np.sqrt(mean), mean**2 / np.maximum(spread, 1e-12), flags)


def _turns(estimate: PoseSequence, truth: PoseSequence) -> Array:
    """(T, J, 3) rad by which orientations are off; NaN where either is not known."""
    R = np.swapaxes(truth.R_world_bone, -1, -2) @ estimate.R_world_bone
    known = np.isfinite(R).all(axis=(2, 3))
    out = np.full(R.shape[:3], np.nan)
    out[known] = so3.log(R[known])
    return out


def _flags(result: Reconstruction) -> Array:
    """(T, J) verdicts on every joint and frame: beyond its limits, and in a fault of the streams."""
    motion, report = result.motion, result.motion.report
    beyond = np.zeros(motion.poses.p_world_joint.shape[:2])
    for j, joint in enumerate(motion.skeleton.table.joints):
        own = [report.dof_names.index(dof.urdf) for dof in joint.dofs]
        beyond[:, j] = (np.nan_to_num(report.limit_excess[:, own]) > BEYOND).any(axis=1)
    for fault in result.faults:
        inside = (motion.times >= fault.start) & (motion.times <= fault.stop)
        beyond[inside] += 1.0
    return beyond


def verdict(result: Reconstruction) -> dict[str, float]:
    """Scores of the audit, larger is worse: its sections' verdicts (0 pass, 1 warn, 2
    fail) added up, and how far its figures are above the limits at which they warn."""
    findings = audit(replace(result, stage_metrics={}))
    grades = [section_verdict(section, findings).grade for section in SECTIONS]
    above = [
        min(finding.value / finding.warn, 10.0) - 1
        for finding in findings
        if finding.grade in _COST and finding.warn > 0
    ]
    return {"grades": float(sum(_COST.get(grade, 0) for grade in grades)), "excess": float(sum(above))}


def _short(column: Array) -> list[float | None]:
    """Convert to JSON values: four digits, null where unknown."""
    return [float(f"{v:.4g}") if np.isfinite(v) else None for v in column]
