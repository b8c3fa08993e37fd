"""What a reconstruction leaves unexplained, as figures against limits: how far to trust it.

Residuals are those of the motion that is written, not of a solver's state: the reprojection error of
every landmark, what is left of a sensor's orientation (across its bone and about it) and acceleration,
angles beyond anatomical limits; who saw the joints, what was wrong with the streams, what calibration and
solver say of themselves. A limit is a number that somebody can check: its source stands beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.metrics import hinges
from rtof_kin.calibration.result import SelfCalibration, Verdict
from rtof_kin.data.poses import Provenance
from rtof_kin.inertial.outlier_rejection import DISAGREES
from rtof_kin.report.audit_results import FAILED_FRAGMENTS, UNOBSERVED_FRAGMENTS, Finding
from rtof_kin.report.residuals import acceleration_residuals, orientation_residuals, reprojection_errors
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.solution import SolverStatus

if TYPE_CHECKING:
    from rtof_kin.reconstruction.result import Reconstruction

Array = NDArray[np.float64]
_MODEL = JointSpaceSettings()
_LANDMARK, _PICTURE = (0.065, 0.13), (0.035, 0.07)
"""Shares of the body's height in the image at which the median error of a landmark, and of all of them,
warns and fails."""
_DETECTORS = (
    "of the body's height in the image; the first is what recordings of validation subjects with a real "
    "detector's usual errors reach (benchmarks/results/audit.md), the second twice that"
)
_USER = "a convention of this report"
_EXPECTED = "error expected by the stated standard deviations, RMS"


def audit(result: Reconstruction) -> tuple[Finding, ...]:
    """Everything that can be told of a reconstruction without knowing the truth, section by section.

    Args:
        result: as `reconstruct` returns it.

    Returns:
        Findings of the sections inputs to confidence; and the errors where the recording has a truth.
    """
    before = (_inputs, _streams, _image, _sensors, _body)
    return (
        *(finding for part in before for finding in part(result)),
        *calibration_findings(result.calibration),
        *(finding for part in (_solver, _confidence, _truth) for finding in part(result)),
    )


# --- inputs --------------------------------------------------------------------------------------


def _inputs(result: Reconstruction) -> Iterator[Finding]:
    if not result.checks:
        why = "nothing declared of camera, body and sensors was compared with the streams"
        yield Finding.untold("inputs", "recording", why)
    for check in result.checks:
        if math.isnan(check.value):
            yield Finding.untold("inputs", check.subject, check.advice, check.name)
            continue
        cause = check.cause if check.failed else ""
        note = ": ".join(part for part in (cause, check.advice) if part)
        yield Finding(
            "inputs", check.name, check.subject, check.value, check.unit, check.limit, check.limit,
            "limit of the check", note,
        )  # fmt: skip


# --- streams -------------------------------------------------------------------------------------


def _streams(result: Reconstruction) -> Iterator[Finding]:
    poses = result.motion.poses
    yield Finding(
        "streams", "share of joints and frames without a valid position", "motion",
        100 * float(1 - poses.valid.mean()), "%", 2.0, 30.0, _USER, "nobody saw where they were",
    )  # fmt: skip
    unseen = poses.provenance <= Provenance.BRIDGED
    yield Finding(
        "streams", "share of joints and frames that nobody saw", "motion",
        100 * float(unseen.mean()), "%", 25.0, 75.0, _USER, "they are bridged, or as a prior has them",
    )  # fmt: skip
    yield from _keypoints_missing(result)
    if result.bone_imus is not None:
        missing = np.isnan(result.bone_imus.R_world_bone[..., 0, 0])
        for s, joint in enumerate(result.bone_imus.joints):
            yield Finding(
                "streams", "share of samples missing", f"sensor on {joint}",
                100 * float(missing[:, s].mean()), "%", 5.0, 50.0, _USER, "lost, or left out for a fault",
            )  # fmt: skip
    for fault in result.faults:
        yield Finding(
            "streams", "fault, duration", fault.what, fault.stop - fault.start, "s", -1.0,
            source="any fault warns", note=fault.kind.value, at=fault.start,
        )  # fmt: skip
    for warning in result.warnings:
        yield Finding.doubt("streams", "motion", warning)
    if result.root_sigma is not None and math.isfinite(drift := float(result.root_sigma[-1])):
        text = f"its place drifts, with a standard deviation of {drift:.2f} m per axis at the end"
        yield Finding.remark("streams", "root", text)


def _keypoints_missing(result: Reconstruction) -> Iterator[Finding]:
    if result.keypoints is None:
        yield Finding.untold("streams", "keypoints", "the sensors alone made this motion")
        return
    seen = result.keypoints.seen
    for landmark, share in zip(result.keypoints.names, seen.mean(axis=0), strict=True):
        yield Finding(
            "streams", "share of frames unseen", landmark, 100 * float(1 - share), "%", 10.0, 90.0,
            _USER, "hidden, out of the picture, or not found by the detector",
        )  # fmt: skip


# --- image ---------------------------------------------------------------------------------------


def _image(result: Reconstruction) -> Iterator[Finding]:
    if result.keypoints is None:
        yield Finding.untold("image", "camera", "no keypoints were used")
        return
    error, height = reprojection_errors(result)
    yield _reprojection("all landmarks", error, error, height, _PICTURE, result)
    for landmark, own in zip(result.keypoints.names, error.T, strict=True):
        yield _reprojection(landmark, own, own[:, None], height, _LANDMARK, result)


def _reprojection(
    subject: str, errors: Array, over_time: Array, height: float, limits: tuple[float, float],
    result: Reconstruction,
) -> Finding:  # fmt: skip
    """The median of errors (any shape), whose frames are the first axis of `over_time` (T, n), px."""
    name = "reprojection error, median"
    if not np.isfinite(errors).any():
        return Finding.untold("image", subject, "never seen together with a valid position", name)
    worst = int(np.nan_to_num(over_time).max(axis=1).argmax())
    warn, fail = (share * height for share in limits)
    return Finding(
        "image", name, subject, float(np.nanmedian(errors)), "px", warn, fail,
        f"{100 * limits[0]:g} and {100 * limits[1]:g} % {_DETECTORS}",
        "the detector, bone lengths, the camera or clocks are off", float(result.motion.times[worst]),
    )  # fmt: skip


# --- sensors -------------------------------------------------------------------------------------


def _sensors(result: Reconstruction) -> Iterator[Finding]:
    if result.bone_imus is None:
        yield Finding.untold("sensors", "IMUs", "no sensor was used")
        return
    swing, twist = orientation_residuals(result)
    acceleration = acceleration_residuals(result)
    figures = (
        ("orientation residual across the bone", np.degrees(swing), "deg",
         np.degrees(_MODEL.sigma_swing), np.degrees(DISAGREES),
         "the solver's standard deviation; 12 deg, from where a sensor disagrees with everything else",
         "mounting, heading, soft tissue, or a slipped sensor"),
        ("orientation residual about the bone", np.degrees(twist), "deg",
         np.degrees(_MODEL.sigma_twist), 2 * np.degrees(_MODEL.sigma_twist),
         "once and twice the solver's standard deviation", "soft tissue rolls there; mounting"),
        ("acceleration residual", acceleration, "m/s2",
         2 * _MODEL.sigma_acceleration, 4 * _MODEL.sigma_acceleration,
         "twice and four times the solver's standard deviation per axis",
         "clocks, impacts, lever arm, or a sensor that wobbles"),
    )  # fmt: skip
    for s, joint in enumerate(result.bone_imus.joints):
        for name, residual, unit, warn, fail, source, note in figures:
            own = residual[:, s]
            known = np.isfinite(own)
            rms = float(np.sqrt(np.mean(own[known] ** 2))) if known.any() else np.nan
            at = float(result.bone_imus.times[int(np.nanargmax(own))]) if known.any() else np.nan
            why = note if known.any() else "the sensor said nothing"
            yield Finding("sensors", f"{name}, RMS", joint, rms, unit, warn, fail, source, why, at)


# --- body, calibration, solver, truth ------------------------------------------------------------


def _body(result: Reconstruction) -> Iterator[Finding]:
    skeleton, report = result.motion.skeleton, result.motion.report
    height, own = result.recording.height, skeleton.height
    if height is None:
        why = f"no height was given to check it against; it stands {own:.2f} m tall"
        yield Finding.untold("body", "skeleton", why)
    else:
        yield Finding(
            "body", "difference from the height given", "skeleton", 100 * abs(own - height), "cm",
            3.0, 10.0, _USER, f"given {height:.2f} m, the skeleton stands {own:.2f} m tall",
        )  # fmt: skip
    worst = np.degrees(np.nan_to_num(report.limit_excess))
    clinical = {d.urdf: d.clinical.lstrip("-") for joint in skeleton.table.joints for d in joint.dofs}
    hinged = {skeleton.names[j] for j in hinges(skeleton)}
    for d, dof in enumerate(report.dof_names):
        if worst[:, d].max() > 0:
            frame = int(worst[:, d].argmax())
            # People leave the bounds on a ball joint's Euler angles; nobody bends a knee backwards.
            fail = 30.0 if dof.rsplit("_", 1)[0] in hinged else math.inf
            yield Finding(
                "body", "beyond its anatomical limit, largest", clinical[dof] or dof,
                float(worst[frame, d]), "deg", 10.0, fail, f"limits of the skeleton table; {_USER}",
                "a wrong angle, or an unusual body; nothing is clipped",
                float(result.motion.times[frame]),
            )  # fmt: skip
    if not worst.any():
        yield Finding("body", "beyond its anatomical limit, largest", "any angle", 0.0, "deg", 10.0,
                      30.0, "limits of the skeleton table")  # fmt: skip


def calibration_findings(found: SelfCalibration | None) -> Iterator[Finding]:
    """The section calibration.

    Args:
        found: what a recording said of itself; None where it was not asked.
    """
    if found is None:
        why = "nothing was estimated: delay, mounting and bones are taken as they were given"
        yield Finding.untold("calibration", "recording", why)
        return
    if not found.converged:
        yield Finding.doubt("calibration", "recording", "it did not converge: take it for a guess")
    verdicts = [quantity.verdict for quantity in found.quantities]
    counts = {verdict.value: verdicts.count(verdict) for verdict in Verdict}
    text = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    weak = verdicts.count(Verdict.OBSERVED) < len(verdicts)
    yield Finding.remark("calibration", f"{len(verdicts)} quantities", text, weak)
    for quantity in found.quantities:
        size = float(np.sqrt(np.mean((quantity.value / quantity.sigma_prior) ** 2)))
        if quantity.verdict is Verdict.PRIOR:
            size = 0.0  # nothing was applied
        yield Finding(
            "calibration", f"{quantity.kind}, correction in standard deviations of what was expected",
            quantity.item, size, "", 3.0, 6.0, "3 and 6 standard deviations", quantity.verdict.value,
            weak=quantity.verdict is not Verdict.OBSERVED,
        )  # fmt: skip


def _solver(result: Reconstruction) -> Iterator[Finding]:
    solution = result.solution
    if solution is None:
        yield Finding.untold("solver", "fragments", f"mode {result.mode} optimises nothing")
        return
    yield Finding.remark("solver", "fragments", solution.outcome)
    limits = {
        SolverStatus.ACCEPTABLE: ("share of fragments at a looser tolerance", 20.0, 100.0),
        SolverStatus.ITERATION_LIMIT: ("share of fragments out of iterations", 20.0, 100.0),
        SolverStatus.UNOBSERVED: (UNOBSERVED_FRAGMENTS, 0.0, 50.0),
        SolverStatus.FAILED: (FAILED_FRAGMENTS, 0.0, 10.0),
    }
    for status, (name, warn, fail) in limits.items():
        share = 100 * solution.count(status) / len(solution.fragments)
        yield Finding("solver", name, "all", share, "%", warn, fail, _USER, status.value)
    if result.keypoints is not None:
        sigma = float(np.median([fragment.sigma_reprojection for fragment in solution.fragments]))
        top = _MODEL.sigma_reprojection_range[1]
        yield Finding(
            "solver", "size of the 2D errors, estimated", "median of fragments", sigma, "px",
            0.96 * top, source=f"{top:g} px is the most that the solver allows",
            note="the keypoints hardly say anything, or the person is large in the picture",
        )  # fmt: skip


def _confidence(result: Reconstruction) -> Iterator[Finding]:
    told = result.motion.confidence
    if told is None:
        why = f"mode {result.mode} states no standard deviations in this space"
        yield Finding.untold("confidence", "motion", why)
        return
    figures = (
        ("joints relative to the root", 1000 * told.relative_sigma[:, 1:], "mm", 60.0, 120.0),
        ("joints in world", 1000 * told.position_sigma, "mm", 200.0, 500.0),
        ("orientation of segments", np.degrees(told.orientation_sigma), "deg", 20.0, 40.0),
    )
    for subject, per_axis, unit, warn, fail in figures:
        expected = math.sqrt(3) * per_axis
        if not np.isfinite(expected).any():
            yield Finding.untold("confidence", subject, "nobody saw enough to tell", _EXPECTED)
            continue
        worst = int(np.nan_to_num(np.nansum(expected, axis=1)).argmax())
        yield Finding(
            "confidence", _EXPECTED, subject, float(np.sqrt(np.nanmean(expected**2))), unit, warn, fail,
            _USER, "the camera alone, or what was recorded, tells no more; more sensors would",
            float(result.motion.times[worst]),
        )  # fmt: skip


def _truth(result: Reconstruction) -> Iterator[Finding]:
    labels = {
        "mpjpe_rr_mm": ("mean joint error, root-relative", "mm"),
        "mpjpe_mm": ("mean joint error, absolute", "mm"),
        "flexion_deg": ("mean error of knee and elbow flexion", "deg"),
    }
    for name, (label, unit) in labels.items():
        if result.metrics is not None and np.isfinite(result.metrics[name]):
            yield Finding("truth", label, "motion", result.metrics[name], unit, source="for information")
