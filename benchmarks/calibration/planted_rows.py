"""Results of one recording with planted errors: estimates, planted values, errors of the motion."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks import harness
from benchmarks.calibration import planting
from benchmarks.calibration.planting import ERRORS, USUAL, Wrong
from benchmarks.calibration.sessions import joined
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

Row = dict[str, Any]
FIGURES = ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")
SESSIONS = {
    "test": {
        "walking": [f"16_{n}" for n in ("15", "16", "21", "22", "31", "32", "47", "58")],
        "standing": ["02_06", "02_10", "02_05"],
        "varied": ["14_14", "14_08"],
    },
    "validation": {
        "walking": [f"08_{n:02d}" for n in (1, 2, 3, 4, 5, 6, 8, 9, 10, 11)],
        "standing": ["131_01", "131_02", "131_03"],
    },
}
"""Subset -> what is done -> motions of one person; 'standing' works on the spot."""
LENGTHS = (4.0, 10.0, 20.0, 40.0)
"""[s] of recordings, where it is asked how long they must be."""
KNOWN, PLAIN, ALL = "known", "usual", "all"
GOOD, SEEN = "good", "good, detector biased"
"""Sensors that were calibrated well; with a detector without bias, and with one as detectors have."""
BUT = "all but "
"""Before the names of errors, with commas between: those are measured, all others are wrong."""


@dataclass(frozen=True)
class Job:
    """One recording, wrong in one way."""

    study: str
    session: str
    case: str
    """`KNOWN`: nothing is wrong. `PLAIN`: what usually is. One of `ERRORS`: that besides. `ALL`: all of
    them; `BUT`...: all others. `GOOD`: sensors mounted 2 degrees wrongly, nothing else; `SEEN`: and a
    biased detector."""
    scale: float = 1.0
    """Factor on the planted sizes."""
    seconds: float = 20.0
    floor: bool = False
    """Whether the flat floor is known."""
    keypoints: str = "independent"
    sensors: str = "8"
    camera: int = 0

    @property
    def key(self) -> str:
        """Everything, as a line."""
        floor = "floor" if self.floor else "no floor"
        return (
            f"{self.session} {self.seconds:g} s camera {self.camera} {floor} {self.keypoints} "
            f"{self.sensors} sensors: {self.case} x{self.scale:g}"
        )

    @property
    def sizes(self) -> dict[str, float]:
        """Error -> its standard deviation."""
        if self.case == KNOWN:
            return {}
        if self.case in (GOOD, SEEN):
            wrong = ("mounting",) if self.case == GOOD else ("mounting", "image bias")
            return {name: USUAL[name] for name in wrong}
        wrong = USUAL | {name: self.scale * ERRORS[name].size for name in self.opened}
        return {name: size for name, size in wrong.items() if name not in self.measured}

    @property
    def measured(self) -> list[str]:
        """Errors that are not there, and closed in the calibration."""
        return self.case.removeprefix(BUT).split(", ") if self.case.startswith(BUT) else []

    @property
    def opened(self) -> list[str]:
        """Errors that are planted besides what is usually wrong."""
        if self.case in ERRORS:
            return [self.case]
        everything = self.case == ALL or self.case.startswith(BUT)
        return [name for name in ERRORS if everything and name not in self.measured]

    @property
    def priors(self) -> CalibrationPriors:
        """Default priors, with those of the planted errors widened."""
        priors = CalibrationPriors()
        closed = {"mounting": "sigma_swing", "image bias": "sigma_image_bias"}
        priors = replace(priors, **{closed[n]: None for n in self.measured if n in closed})
        for name in self.opened:
            priors = ERRORS[name].opened(priors, self.scale * ERRORS[name].size)
        return priors


@cache
def _whole_clips(corpus: Path, subset: str) -> dict[str, MocapClip]:
    names = [name for motions in SESSIONS[subset].values() for name in motions]
    return {c.name: c for c in harness.whole_clips(corpus, harness.split()[subset], names)}


def session(corpus: Path, subset: str, name: str, seconds: float) -> MocapClip:
    """Motions of one person, one after the other, of so many seconds or what there is."""
    clips = _whole_clips(corpus, subset)
    return joined([clips[n] for n in SESSIONS[subset][name]], seconds, name)


def right(clip: MocapClip, job: Job) -> Recording:
    """Simulate a recording without calibration errors."""
    settings = harness.KEYPOINTS[job.keypoints]()
    settings = replace(
        settings,
        sensors=harness.SENSOR_SETS[job.sensors],
        keypoints=replace(settings.keypoints, bias_px=0.0),
        imu=replace(settings.imu, misalignment_deg=0.0),
        video_lag_frames=(0.0, 0.0),
    )
    recording = harness.filmed(clip, zlib.crc32(clip.name.encode()), job.camera, settings)
    return replace(recording, floor_height=0.0 if job.floor else None)


def recorded(clip: MocapClip, job: Job) -> tuple[Recording, Wrong, Recording]:
    """Return the exact recording, the planted unknowns, and the recording with the errors."""
    recording = right(clip, job)
    wrong = planting.drawn(recording, job.sizes, zlib.crc32(clip.name.encode()) + job.camera)
    return recording, wrong, planting.planted(recording, wrong)


def row(clip: MocapClip, job: Job, lifter: str | None = None) -> Row:
    """Plant, reconstruct, calibrate and reconstruct again; of errors planted alone without a floor,
    calibrate only."""
    recording, wrong, given = recorded(clip, job)
    out: Row = {**vars(job), "frames": len(recording.video)}
    if job.case == KNOWN:  # as one that was calibrated, with nothing left to correct
        known = reconstruct(given, lifter=harness.lifter(lifter), calibration=SelfCalibration(()))
        return {**out, "before": _figures(known.metrics)}
    calibration = calibrate_recording(given, None, job.priors, lifter=harness.lifter(lifter))
    out |= {"converged": calibration.converged, "found": found(calibration, truths(recording, wrong))}
    if job.case not in ERRORS or job.floor:
        for stage, found_before in {"before": None, "after": calibration}.items():
            made = reconstruct(given, lifter=harness.lifter(lifter), calibrate=False, calibration=found_before)
            out[stage] = _figures(made.metrics)
    return out


def _figures(metrics: Mapping[str, Any] | None) -> dict[str, float]:
    assert metrics is not None
    return {name: round(float(metrics[name]), 3) for name in FIGURES}


def truths(recording: Recording, wrong: Wrong) -> dict[tuple[str, str], Array]:
    """Return the exact calibration, with the mean slip of sensors, of what is planted in a recording without errors."""
    known = planting.unknowns(recording, wrong)
    for joint, slip in planting.slips(recording).items():
        known["mounting", joint] = so3.log(so3.exp(known["mounting", joint]) @ so3.exp(slip))
    return known


def found(calibration: SelfCalibration, known: Mapping[tuple[str, str], Array]) -> Row:
    """Error -> columns of item, truth, value, sigma, prior, one number a row, and the verdict; of what
    there is a truth of."""
    out: Row = {}
    for q in calibration.quantities:
        if (q.kind, q.item) not in known:
            continue
        truth = known[q.kind, q.item]
        for i in range(len(q.value)):
            error = q.kind if q.kind != "bones" else "size" if q.item == "all" else "proportions"
            columns = out.setdefault(error, {n: [] for n in ("item", "truth", "value", "sigma", "prior", "verdict")})
            numbers = (truth[i], q.value[i], q.sigma[i], q.sigma_prior[i])
            for name, number in zip(("truth", "value", "sigma", "prior"), numbers, strict=True):
                columns[name].append(float(f"{number:.4g}"))
            columns["item"].append(q.item)
            columns["verdict"].append(q.verdict.value)
    return out
