"""One recording with one fault: its first line, its errors, and what its bands cover."""

from __future__ import annotations

import re
import traceback
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from benchmarks.planted.faults import (
    FAULTS,
    RIGHT,
    Draws,
    Fault,
    Size,
    gap,
    height_alone,
    legs_unseen,
    matching,
    of_another_take,
)
from benchmarks.planted.gross import GROSS
from benchmarks.planted.recordings import Scene
from benchmarks.scoring import EVERY
from rtof_kin.body.metrics import at_times, evaluate
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import headline
from rtof_kin.reporting.statistics import ReconstructionStatistics, reprojection_errors

Row = dict[str, Any]
BANDS = ("world", "relative", "angles")
_FIGURE_LAST, _ROOM = re.compile(r", above [^()]*\)$"), "position in the room "
_PARTS = re.compile(rf"; (?=more \w+ in |checked, |not checked: |{_ROOM})")
ERRORS = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "flexion_deg": "flexion deg"}


def cases(names: list[str]) -> Iterator[tuple[str, Size]]:
    """Faults and sizes by name; of `RIGHT` those without one."""
    for name in names:
        for size in (RIGHT[name],) if name in RIGHT else (FAULTS | GROSS)[name].sizes:
            yield name, size


def measured(scene: Scene, names: list[str], others: dict[str, Scene], calibrate: bool) -> list[Row]:
    """Rows of one recording, without a fault and with each that it can have.

    Args:
        scene: the recording. names: of faults, or of `RIGHT`. others: other takes with the same sensors by
            whose they are. calibrate: whether recordings are calibrated from themselves.
    """
    right, rows = scene.recording(), list[Row]()
    other = cache(lambda whose: others[whose].recording())
    for name, size in cases(names):
        fault = (FAULTS | GROSS).get(name)
        if fault is not None and not _possible(fault, right, scene.floor, size, others):
            continue
        rng = np.random.default_rng(zlib.crc32(f"{scene.seed} {scene.key} {name}".encode()))
        draws = Draws(rng, other)
        declared = replace(right, floor_height=0.0 if _floor(fault, scene.floor) else None)
        try:
            if fault is not None:
                planted = fault.plant(declared, size, draws)
            else:
                planted = height_alone(declared, float(size), draws) if size else declared
            row = judged(planted, right, fault, size, draws, calibrate)
        except RtofError as error:
            row = _said(f"error: {error}", fault, draws)
        except Exception:  # no answer at all, which is worse than a wrong one
            row = _said("crash: " + traceback.format_exc().splitlines()[-1], None, draws)
        rows.append(_about(scene, name, size) | row)
    return rows


def _floor(fault: Fault | None, declared: bool) -> bool:
    return declared if fault is None or fault.floor is None else fault.floor


def _possible(fault: Fault, right: Recording, floor: bool, size: Size, others: dict[str, Scene]) -> bool:
    sensors = right.imus is not None
    if fault.plant in (gap, legs_unseen) and float(size) > right.times[-1] - right.times[0] - 2.0:
        return False
    return fault.sensors in (None, sensors) and (fault.plant is not of_another_take or size in others)


def _about(scene: Scene, name: str, size: Size) -> Row:
    return {
        "motion": scene.clip.name,
        "person": scene.clip.subject,
        "sensors": scene.sensors,
        "fault": name,
        "size": size if isinstance(size, str) else f"{size:g}",
    }


def judged(planted: Recording, right: Recording, fault: Fault | None, size: Size, draws: Draws, calibrate: bool) -> Row:
    """What is said of a recording, and how right its motion is.

    Args:
        planted: the recording. right: without the fault. fault: that it has. size: of the fault.
        draws: of the fault. calibrate: whether it is calibrated from itself.
    """
    truth = planted.truth
    assert truth is not None
    mode = planted.usual_mode
    with without_warnings():
        result = reconstruct(replace(planted, truth=None), mode=mode, calibrate=calibrate and mode == "rtof")
    row = _said(headline(audit(result)).line, fault, draws)
    if fault is None:
        row["image"] = _reprojection(result)
        if result.motion.confidence is not None:  # rather large bands always cover
            variance = np.trace(result.motion.confidence.position_covariance, axis1=-2, axis2=-1)
            row["world_sigma_mm"] = 1000 * float(np.sqrt(np.nanmean(variance)))
    clocks = [truth]
    if fault is not None and fault.sensor_clock is not None:
        clocks.append(replace(truth, times=fault.sensor_clock(truth.times, size)))
    elif right.truth is not truth:
        assert right.truth is not None
        clocks.append(right.truth)
    skeleton = right.skeleton
    scores = [(dict(evaluate(result.motion.poses, one, skeleton)), one) for one in clocks]
    errors, truth = min(scores, key=lambda score: score[0]["mpjpe_mm"])
    return row | {name: errors[name] for name in ERRORS} | {"inside": inside(result, truth, right, draws)}


def _reprojection(result: Reconstruction) -> list[float]:
    """Median reprojection error of all landmarks, and that of the worst one, in % of the body's height."""
    errors, statistics = reprojection_errors(result), ReconstructionStatistics(result)
    height = float(statistics["body height px"].median_of_all)
    each = [np.median(one[np.isfinite(one)]) for one in errors.T if np.isfinite(one).any()]
    return [100 * float(np.nanmedian(errors)) / height, 100 * float(max(each)) / height]


def _said(line: str, fault: Fault | None, draws: Draws) -> Row:
    """The first line, and whether it names the fault."""
    words = cause(line)
    accused = not draws.culprits or any(one.lower() in line.lower() for one in draws.culprits)
    return {
        "line": line,
        "grade": re.split(":| for ", line)[0],
        "causes": matching(words),
        "culprits": draws.culprits,
        "named": fault is not None and fault.names(words) and accused,
    }


def cause(line: str) -> str:
    """What a first line says is wrong, without grade, advice and lists of what may be behind a figure;
    nothing where it neither warns nor fails. Of the position in the room, only what fails."""
    grade, _, text = line.replace(" for the angles; ", ": ").partition(": ")
    found = []
    for part in _PARTS.split(text):
        words, wrong = part, grade in ("warn", "fail", "error", "crash")
        if part.startswith(_ROOM):
            state, _, words = part.removeprefix(_ROOM).partition(": ")
            wrong = state == "fails"
        if wrong and not part.startswith("more "):
            # "cause: advice (figure, above its limit)", or "subject: figure (above its limit): causes".
            found.append(words.partition(": " if _FIGURE_LAST.search(words) else " (above ")[0])
    return "; ".join(found)


def inside(result: Reconstruction, truth: PoseSequence, right: Recording, draws: Draws) -> dict[str, float]:
    """Share of errors in the 95 % band, axis by axis, where and when the fault is; NaN without a band."""
    motion = result.motion[::EVERY]
    stated = motion.confidence
    if stated is None:
        return dict.fromkeys(BANDS, float("nan"))
    when = (motion.times >= draws.start) & (motion.times <= draws.stop)
    if not when.any():
        when[:] = True
    of = list(motion.skeleton.index(*draws.joints)) if draws.joints else list(range(1, len(truth.names)))
    true = at_times(truth, motion.times)
    p, p_true = motion.poses.p_world_joint, true.p_world_joint
    relative = (p - p[:, :1]) - (p_true - p_true[:, :1])
    angle, sigma = _angles(motion, true)
    return {
        "world": _share((p - p_true)[when][:, of], _axes(stated.position_covariance)[when][:, of]),
        "relative": _share(relative[when][:, of], _axes(stated.relative_covariance)[when][:, of]),
        "angles": _share(angle[when], sigma[when]),
    }


def _axes(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))


def _angles(motion: Motion, truth: PoseSequence) -> tuple[Array, Array]:
    """Errors of the clinical angles and their standard deviations, rad."""
    found, true = clinical_angles(motion), clinical_angles(all_observed(truth), motion.skeleton)
    assert found.sigma is not None
    return np.asarray((found.values - true.values + np.pi) % (2 * np.pi) - np.pi), found.sigma


def _share(error: Array, sigma: Array) -> float:
    known = np.isfinite(error) & np.isfinite(sigma)
    return float(np.mean(np.abs(error[known]) <= BAND_95 * sigma[known])) if known.any() else float("nan")
