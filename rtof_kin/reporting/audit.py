"""Audit of a reconstruction: figures against limits that show how far to trust it.

Residuals are those of the exported motion, not of the solver's state: reprojection error of each landmark, orientation
residual of each sensor (across its bone and about it), acceleration residual, joint limits; further the observed
share, faults of the streams, and the outcome of calibration and solver. Each limit is given with its source.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from rtof_kin.body.metrics import hinges
from rtof_kin.calibration.camera_estimate import FOUND, UNKNOWNS, CameraEstimate, prior_sigma
from rtof_kin.calibration.result import SelfCalibration, Verdict
from rtof_kin.clinical.angle_table import clinical_name
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu_stream import FaultKind
from rtof_kin.inertial.outlier_rejection import DISAGREES
from rtof_kin.reconstruction.certificate import impossible
from rtof_kin.reconstruction.checks.camera import ROOM_CHECKS
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reporting import certificate
from rtof_kin.reporting.audit_results import (
    CERTIFICATE,
    FAILED_FRAGMENTS,
    FAULT,
    ROOM,
    ROOM_BAND,
    UNOBSERVED_FRAGMENTS,
    AuditResult,
)
from rtof_kin.reporting.statistics import ReconstructionStatistics
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.solution import SolverStatus

_MODEL: Final = JointSpaceSettings()
_LANDMARK: Final = (0.065, 0.13)
_ALL_LANDMARKS: Final = (0.035, 0.07)
"""Median reprojection errors, as shares of the body's height in the image, that warn and fail."""
_DETECTORS: Final = (
    "of the body's height in the image; the first is what recordings of held-out subjects with a real "
    "detector's usual errors reach (benchmarks/results/planted.md), the second twice that"
)
_USER: Final = "a convention of this report"
_UNSEEN: Final = dict.fromkeys(("Nose", "LeftEar", "RightEar"), (90.0, 100.0))
"""Limits of the share of unseen frames, of points that are out of sight in most views from side or back."""
_MANY: Final = 8  #: Sensors beyond which more are no remedy
_WIDE_M: Final = 0.5
_SHORT_S: Final = 0.15  #: [s] of a fault that was mended and hardly matters
_POSITION: Final = "position in the room"
_CORRECTION: Final = "correction in standard deviations of the prior"
_SIGMAS: Final = "3 and 6 standard deviations"
_EXPECTED: Final = "error expected by the stated standard deviations, RMS"


def audit(found: Reconstruction | ReconstructionStatistics) -> tuple[AuditResult, ...]:
    """Return all checks of a reconstruction that need no reference, section by section.

    Args:
        found: result of `reconstruct`, or the statistics of its parts.

    Returns:
        Results of the sections inputs to room; then the errors if the recording has a reference, else what would
        prove the angles.
    """
    statistics = ReconstructionStatistics.of(found)
    last = (_solver, _confidence, _room, _certificate, _truth)
    before = (_inputs, _streams, _image, _sensors, _body)
    return (
        *(found for section in before for found in section(statistics)),
        *calibration_results(statistics.first.calibration),
        *camera_results(statistics.first.camera),
        *(found for section in last for found in section(statistics)),
    )


def _inputs(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    if not statistics.checks:
        why = "the declared camera, body and sensors were not compared with the recorded data"
        yield AuditResult.not_checked("inputs", "recording", why)
    for check in statistics.checks:
        section = ROOM if check.name.startswith(ROOM_CHECKS) else "inputs"
        if math.isnan(check.value):
            yield AuditResult.not_checked(section, check.subject, check.advice, check.name)
            continue
        note = ": ".join(part for part in (check.cause if check.failed else "", check.advice) if part)
        figure = (check.name, check.subject, check.value, check.unit, check.limit, check.limit)
        yield AuditResult(section, *figure, "limit of the check", note)


def _streams(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    first = statistics.first
    shares = [
        (f"share of joints and frames without {what}", "motion", statistics[name].mean_of_all, warn, fail, note)
        for what, name, warn, fail, note in (
            ("a valid position", "invalid", 2.0, 30.0, "their position is unobserved"),
            ("an observation", "unobserved", 25.0, 75.0, "interpolated, or from the prior"),
        )
    ]
    if first.keypoints is None:
        yield AuditResult.not_checked(
            "streams",
            "keypoints",
            "the motion is from sensors" + (" and points" if any(not one.doubt for one in first.lifts) else " only"),
        )
        shares = shares[1:]  # only joints between sensors are valid there
    else:
        note = "occluded, out of the image, or not detected"
        names = first.keypoints.landmarks.names
        shares += [
            ("share of frames unseen", landmark, share, *_UNSEEN.get(landmark, (10.0, 90.0)), note)
            for landmark, share in zip(names, statistics["unseen"].mean, strict=True)
        ]
    if first.bone_imus is not None:
        shares += [
            ("share of samples missing", f"sensor on {joint}", share, 5.0, 50.0, "dropout, or excluded fault")
            for joint, share in zip(first.bone_imus.joints, statistics["missing"].mean, strict=True)
        ]
    for name, subject, share, warn, fail, note in shares:
        yield AuditResult("streams", name, subject, 100 * float(share), "%", warn, fail, _USER, note)
    seconds = statistics.frames / first.motion.poses.rate_hz
    most = {FaultKind.UNSEEN: 0.3 * seconds, FaultKind.ENDED: 0.4 * seconds}  # as the shares above
    for fault in statistics.faults:
        fail = max(most.get(fault.kind, math.inf), _SHORT_S)
        figure = (FAULT, fault.what, fault.stop - fault.start, "s", _SHORT_S, fail)
        yield AuditResult("streams", *figure, _USER, fault.kind.value, fault.start)
    of_camera = () if first.camera is None else first.camera.sentences
    for warning in statistics.warnings:
        if warning in of_camera:  # its effect is in the stated uncertainty
            yield AuditResult.remark(ROOM, "camera that is not calibrated", warning)
        else:
            yield AuditResult.warning("streams", "motion", warning)
    if math.isfinite(drift := statistics.root_sigma):
        how = "follows points" if any(not one.doubt for one in statistics.first.lifts) else "drifts"
        text = f"its position {how}, with a standard deviation of {drift:.2f} m per axis at the end"
        yield AuditResult.remark("streams", "root", text)


def _image(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    keypoints = statistics.first.keypoints
    if keypoints is None:
        yield AuditResult.not_checked("image", "camera", "no keypoints were used")
        return
    error, height = statistics["reprojection"], float(statistics["body height px"].median[0])
    worst = int(np.nan_to_num(error.largest, nan=-1.0).argmax())
    figures = [("all landmarks", error.median_of_all, error.largest_at[worst], _ALL_LANDMARKS)]
    each = zip(keypoints.landmarks.names, error.median, error.largest_at, strict=True)
    figures += [(landmark, median, at, _LANDMARK) for landmark, median, at in each]
    name = "reprojection error, median"
    for subject, median, at, limits in figures:
        if math.isnan(median):
            why = "never observed together with a valid position"
            yield AuditResult.not_checked("image", subject, why, name)
            continue
        warn, fail = (limit * height for limit in limits)
        source = f"{100 * limits[0]:g} and {100 * limits[1]:g} % {_DETECTORS}"
        note = "errors of detector, bone lengths, camera or synchronisation"
        yield AuditResult("image", name, subject, float(median), "px", warn, fail, source, note, float(at))


def _sensors(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    imus = statistics.first.bone_imus
    if imus is None:
        yield AuditResult.not_checked("sensors", "IMUs", "no sensor was used")
        return
    degree = np.degrees(1.0)
    swing, twist = np.degrees((_MODEL.sigma_swing, _MODEL.sigma_twist)).tolist()
    acceleration = _MODEL.sigma_acceleration
    figures = {
        ("orientation residual across the bone", "swing", degree, "deg", swing, np.degrees(DISAGREES)): (
            "the solver's standard deviation; 12 deg, the limit of a misaligned sensor",
            "mounting, heading, soft tissue, or a slipped sensor",
        ),
        ("orientation residual about the bone", "twist", degree, "deg", twist, 2 * twist): (
            "once (forearms: 1.5 times) and twice the solver's standard deviation",
            "soft tissue artefact or mounting",
        ),
        ("acceleration residual", "acceleration", 1.0, "m/s2", 2 * acceleration, 8 * acceleration): (
            "twice and eight times the solver's standard deviation per axis; fast motions reach seven",
            "synchronisation, impacts, lever arm, or a loose sensor",
        ),
    }
    for s, joint in enumerate(imus.joints):
        for (name, residual, factor, unit, warn, fail), (source, note) in figures.items():
            rms, at = factor * float(statistics[residual].rms[s]), float(statistics[residual].largest_at[s])
            note = "the sensor has no data" if math.isnan(rms) else note
            if residual == "twist" and joint.endswith("ForeArm"):  # they turn in themselves
                warn *= 1.5
            yield AuditResult("sensors", f"{name}, RMS", joint, rms, unit, warn, fail, source, note, at)


def _body(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    motion = statistics.first.motion
    skeleton, height, own = motion.skeleton, statistics.first.recording.height, motion.skeleton.height
    if height is None:
        why = f"no height was given for comparison; it is {own:.2f} m tall"
        yield AuditResult.not_checked("body", "skeleton", why)
    else:
        name, note = "difference from the height given", f"given {height:.2f} m, the skeleton is {own:.2f} m tall"
        yield AuditResult("body", name, "skeleton", 100 * abs(own - height), "cm", 3.0, 10.0, _USER, note)
    name, source = "beyond its anatomical limit, largest", "limits of the skeleton table"
    excess = statistics["limit excess"]
    hinged = {skeleton.names[j] for j in hinges(skeleton)}
    for dof, largest, at in zip(motion.report.dof_names, excess.largest, excess.largest_at, strict=True):
        if largest > 0:
            # Euler angles of a ball joint may leave their limits in a real posture, a hinge may not.
            fail = 30.0 if dof.rsplit("_", 1)[0] in hinged else math.inf
            note = "a wrong angle, or unusual anatomy; angles are not clipped"
            size, subject = float(np.degrees(largest)), clinical_name(skeleton.table, dof)
            yield AuditResult("body", name, subject, size, "deg", 10.0, fail, f"{source}; {_USER}", note, float(at))
    if not np.any(excess.largest > 0):
        yield AuditResult("body", name, "any angle", 0.0, "deg", 10.0, 30.0, source)


def calibration_results(found: SelfCalibration | None) -> Iterator[AuditResult]:
    """Yield the section calibration of a self-calibration; None if it was not requested."""
    if found is None:
        why = "nothing was estimated: delay, mounting and bone lengths are used as given"
        yield AuditResult.not_checked("calibration", "recording", why)
        return
    if not found.converged:
        yield AuditResult.warning("calibration", "recording", "it did not converge and is unreliable")
    verdicts = [quantity.verdict for quantity in found.quantities]
    counts = {verdict.value: verdicts.count(verdict) for verdict in Verdict}
    text = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    weak = verdicts.count(Verdict.OBSERVED) < len(verdicts)
    yield AuditResult.remark("calibration", f"{len(verdicts)} quantities", text, weak)
    for quantity in found.quantities:
        size = float(np.sqrt(np.mean((quantity.value / quantity.sigma_prior) ** 2)))
        if quantity.verdict is Verdict.PRIOR:
            size = 0.0  # no correction is applied
        weak = quantity.verdict is not Verdict.OBSERVED  # convicts nothing
        name, fail = f"{quantity.kind}, {_CORRECTION}", math.inf if weak else 6.0
        figure = (name, quantity.item, size, "", 3.0, fail, _SIGMAS)
        yield AuditResult("calibration", *figure, quantity.verdict.value, weak=weak)


def camera_results(found: CameraEstimate | None) -> Iterator[AuditResult]:
    """Yield the unknowns of a camera that is not calibrated; none for a calibrated one."""
    if found is None:
        return
    sizes = dict(zip(UNKNOWNS, np.abs(found.value), strict=True))
    priors = dict(zip(UNKNOWNS, prior_sigma(found.assumed), strict=True))
    for name, assumed, now, left, verdict in found.table():
        section = "calibration" if name in ("pitch", "roll") else ROOM
        figure = (f"{name}, {_CORRECTION}", "camera", float(sizes[name] / priors[name]), "", 3.0, 6.0, _SIGMAS)
        note = f"{assumed} assumed, {now} found ({left} of the standard deviation remain)"
        yield AuditResult(section, *figure, note, weak=verdict != FOUND)


def _solver(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    solution = statistics.solution
    if solution is None:
        why = f"mode {statistics.first.mode} has no optimisation"
        yield AuditResult.not_checked("solver", "fragments", why)
        return
    yield AuditResult.remark("solver", "fragments", solution.outcome)
    limits = {
        SolverStatus.ACCEPTABLE: ("share of fragments at a looser tolerance", 20.0, 100.0),
        SolverStatus.ITERATION_LIMIT: ("share of fragments out of iterations", 20.0, 100.0),
        SolverStatus.UNOBSERVED: (UNOBSERVED_FRAGMENTS, 0.0, 50.0),
        SolverStatus.FAILED: (FAILED_FRAGMENTS, 0.0, 10.0),
    }
    for status, (name, warn, fail) in limits.items():
        share = 100 * solution.count(status) / len(solution.fragments)
        yield AuditResult("solver", name, "all", share, "%", warn, fail, _USER, status.value)
    if statistics.first.keypoints is not None:
        sigma = float(np.median([fragment.sigma_reprojection for fragment in solution.fragments]))
        top = _MODEL.sigma_reprojection_range[1]
        figure = ("standard deviation of keypoints, estimated", "median of fragments", sigma, "px", 0.96 * top)
        note = "the keypoints carry little information, or the person is large in the image"
        yield AuditResult("solver", *figure, source=f"{top:g} px is the solver's upper bound", note=note)


def _confidence(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    if statistics.first.motion.confidence is None:
        why = f"mode {statistics.first.mode} has no standard deviations in this space"
        yield AuditResult.not_checked("confidence", "motion", why)
        return
    sensors = 0 if (imus := statistics.first.bone_imus) is None else len(imus.joints)
    note = "the recorded data give no better accuracy; add sensors"
    if sensors >= _MANY:
        note = note.removesuffix("; add sensors")
    figures = (
        ("joints relative to the root", "relative sigma", 1000.0, "mm", 60.0, 120.0),
        ("orientation of segments", "orientation sigma", np.degrees(1.0), "deg", 20.0, 40.0),
    )
    for subject, name, factor, unit, warn, fail in figures:
        per_axis = statistics[name]
        if not per_axis.known.any():
            yield AuditResult.not_checked("confidence", subject, "too few observations", _EXPECTED)
            continue
        worst = int(np.nan_to_num(per_axis.largest).argmax())
        size, at = math.sqrt(3) * factor * per_axis.rms_of_all, float(per_axis.largest_at[worst])
        yield AuditResult("confidence", _EXPECTED, subject, size, unit, warn, fail, _USER, note, at)


def _room(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    """How far off positions in world may be, and what of that nothing in the recording verifies."""
    first = statistics.first
    if first.keypoints is None:
        yield AuditResult.not_checked(ROOM, _POSITION, "it drifts without a camera")
    elif "position sigma" not in statistics or not statistics["position sigma"].known.any():
        yield AuditResult.not_checked(ROOM, _POSITION, f"mode {first.mode} has no standard deviations")
    else:
        half = BAND_95 * math.sqrt(3) * statistics["position sigma"].rms_of_all
        open_ = "" if first.position_errors is None else first.position_errors.unverified
        limit = math.inf if open_ else _WIDE_M
        yield AuditResult(ROOM, ROOM_BAND, _POSITION, half, "m", limit, source=_USER, note=open_, weak=bool(open_))


def _certificate(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    """What left-out sensors say; without them what would prove the angles, but nothing beside a reference."""
    if statistics.certificate is not None:
        yield from certificate.results(statistics.certificate, statistics.first.motion.skeleton)
        return
    if any(_truth(statistics)):
        return
    first = statistics.first
    calibration, imus = first.recording.calibration, first.recording.imus
    joints = () if imus is None or calibration is None else calibration.select(imus.names).joints
    why = impossible(first.mode, joints, statistics.seconds) or (certificate.UNSTATED if first.mode == "imu" else "")
    why = why or "no sensor was left out: reconstruct with --certificate"
    yield AuditResult.not_checked(CERTIFICATE, "motion", why)


def _truth(statistics: ReconstructionStatistics) -> Iterator[AuditResult]:
    labels = {
        "mpjpe_rr_mm": ("mean joint error, root-relative", "mm"),
        "mpjpe_mm": ("mean joint error, absolute", "mm"),
        "flexion_deg": ("mean error of knee and elbow flexion", "deg"),
    }
    metrics = statistics.metrics
    for name, (label, unit) in labels.items():
        if metrics is not None and np.isfinite(metrics[name]):
            yield AuditResult("truth", label, "motion", metrics[name], unit, source="for information")
