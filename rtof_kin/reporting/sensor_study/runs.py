"""Runs of a sensor study: one reconstruction each, saved as soon as it ends.

A run is named by its set, one digit for each sensor of the recording: ``11111111`` is the full set, and
``01111111`` omits the first sensor. The order of the runs does not matter to their results.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angle_table import AngleRow, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.core.choices import Mode
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.core.jobs import JobResult, Outcome, run_jobs
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import cleaned
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import Grade, Headline, SectionVerdict, headline
from rtof_kin.reporting.sensor_study.accuracy import SensorSet, measure_set, true_angles

Progress = Callable[[int, int, str], None]  #: Called with (runs done, runs in all, what is running)
_START: Final = 8.0  # [s] that new processes need to import and to build the solver
_ANGLES: Final = ("values", "provenance", "singular")  # arrays of angles that comparing needs
_OF_THE_IMAGE: Final = ("sides", "person")  # outlier rejection that does not depend on the sensors


@dataclass(frozen=True)
class Run:
    """One reconstruction, the argument of `measure` and `measure_full`."""

    recording: Recording  #: With all sensors
    sensors: tuple[str, ...]  #: Those that are used
    lifter: LifterLike | None
    settings: ReconstructionSettings
    full: ClinicalAngles | None = None  #: Angles with all sensors; None where they are measured now
    truth: ClinicalAngles | None = None  #: Those of the reference, if there is one

    def reconstructed(self) -> Reconstruction:
        """Reconstruct with these sensors only."""
        mode: Mode = "rto"
        if self.sensors and self.recording.imus is not None:
            recording = replace(self.recording, imus=self.recording.imus.select(self.sensors))
            mode = "rtof" if recording.keypoints is not None else "imu"
        else:
            recording = replace(self.recording, imus=None, calibration=None)
        return reconstruct(recording, mode=mode, lifter=self.lifter, settings=self.settings, calibrate=False)


@dataclass(frozen=True)
class FullSet:
    """What the reconstruction with all sensors gave."""

    accuracy: SensorSet
    angles: ClinicalAngles  #: Those that are observed
    truth: ClinicalAngles | None
    verdict: Headline  #: Headline of the audit
    choices: dict[str, Any]  #: How it was made, see `Choices.plain`


def measure_full(run: Run) -> JobResult:
    """Reconstruct with all sensors, with every check, and return accuracy and angles."""
    begun = time.process_time()
    with without_warnings():
        result = run.reconstructed()
    angles = clinical_angles(result.motion)
    angles = angles.select([name for name, known in zip(angles.names, angles.known.T, strict=True) if known.any()])
    truth = true_angles(run.recording, angles)
    found = measure_set(run.sensors, angles, angles, truth)
    verdict = headline(audit(result))
    sections = [[v.section, v.grade.value, list(v.reasons)] for v in verdict.sections]
    facts = found.facts | {
        "angles": list(angles.names),
        "choices": result.choices.plain(),
        "grade": verdict.grade.value,
        "headline": verdict.text,
        "sections": sections,
        "seconds": time.process_time() - begun,
    }
    arrays = found.arrays | {"times": angles.times} | _arrays_of("full", angles)
    return JobResult(facts, arrays | ({} if truth is None else _arrays_of("true", truth)))


def measure(run: Run) -> JobResult:
    """Reconstruct with some of the sensors and return their accuracy."""
    assert run.full is not None
    begun = time.process_time()
    with without_warnings():
        angles = clinical_angles(run.reconstructed().motion).select(run.full.names)
    found = measure_set(run.sensors, angles, run.full, run.truth)
    return JobResult(found.facts | {"seconds": time.process_time() - begun}, found.arrays)


def _arrays_of(name: str, angles: ClinicalAngles) -> dict[str, Any]:
    return {f"{name}_{field}": getattr(angles, field) for field in _ANGLES}


def _angles_of(name: str, arrays: Mapping[str, Any], rows: tuple[AngleRow, ...]) -> ClinicalAngles:
    fields = {field: arrays[f"{name}_{field}"] for field in _ANGLES}
    return ClinicalAngles(arrays["times"], rows=rows, **fields)


class Runs:
    """All runs of one study, those that are done and those to come."""

    def __init__(
        self,
        recording: Recording,
        lifter: LifterLike | None,
        settings: ReconstructionSettings,
        total: int,
        folder: Path,
        workers: int | None,
        progress: Progress | None,
    ) -> None:
        """Take what all runs have in common; for `workers` see `run_jobs`, for `progress` see `Progress`."""
        assert recording.imus is not None
        self.names, self.total, self.folder, self.workers = recording.imus.names, total, folder, workers
        self._progress, self._done = progress, 0
        self._common = Run(recording, self.names, lifter, settings)
        self._seconds = 0.0

    def full(self) -> FullSet:
        """Measure the full set, which all others are compared with."""
        key, run = self._key(self.names), self._common
        outcome = self._outcome(measure_full, {key: run}, "all sensors", 1)
        facts, arrays = outcome.done[key], outcome.arrays(key)
        rows = {row.name: row for row in angle_table(run.recording.skeleton.table).rows}
        chosen = tuple(rows[name] for name in facts["angles"])
        angles = _angles_of("full", arrays, chosen)
        truth = _angles_of("true", arrays, chosen) if "true_values" in arrays else None
        sections = tuple(SectionVerdict(name, Grade(g), tuple(why)) for name, g, why in facts["sections"])
        verdict = Headline(Grade(facts["grade"]), facts["headline"], sections)
        self._common = _lighter(replace(run, full=angles, truth=truth))
        return FullSet(SensorSet.read(facts, arrays), angles, self._common.truth, verdict, facts["choices"])

    def measured(self, sets: Sequence[tuple[str, ...]], what: str) -> tuple[SensorSet, ...]:
        """Measure sets independent of each other, after `full`. `RtofError`: a run failed; the others are saved."""
        if not sets:
            return ()
        jobs = {self._key(sensors): replace(self._common, sensors=sensors) for sensors in sets}
        outcome = self._outcome(measure, jobs, what, self._processes(len(jobs)))
        return tuple(SensorSet.read(outcome.done[key], outcome.arrays(key)) for key in jobs)

    def expect(self, number: int) -> None:
        """State how many runs are to come at most."""
        self.total = self._done + number

    def _key(self, sensors: Sequence[str]) -> str:
        return "".join("1" if name in sensors else "0" for name in self.names)

    def _processes(self, jobs: int) -> int | None:
        """Number of processes: one where starting others takes longer than they save."""
        most = min(self.workers or os.cpu_count() or 1, jobs)
        alone, together = jobs * self._seconds, _START + np.ceil(jobs / most) * self._seconds
        return 1 if most == 1 or alone <= together else self.workers

    def _outcome(
        self, function: Callable[[Run], JobResult], jobs: Mapping[str, Run], what: str, workers: int | None
    ) -> Outcome:
        report = self._progress or (lambda done, total, text: None)
        outcome = run_jobs(
            function,
            jobs,
            self.folder,
            workers,
            lambda done, total, text: report(self._done + done, self.total, f"{what} ({done} of {total})"),
        )
        self._done += len(jobs)
        if outcome.failed:
            key, problem = next(iter(outcome.failed.items()))
            others = f"; so did {len(outcome.failed) - 1} others" if len(outcome.failed) > 1 else ""
            named = ", ".join(jobs[key].sensors) or "none"
            raise RtofError(f"the reconstruction with sensors {named} failed: {problem}{others}")
        self._seconds = float(np.median([facts["seconds"] for facts in outcome.done.values()]))
        return outcome


def _lighter(run: Run) -> Run:
    """What all runs share is done once: the keypoints are cleaned, and checks and scores are left out."""
    settings = run.settings
    shared = replace(settings, guards=tuple(g for g in settings.guards if g in _OF_THE_IMAGE))
    own = tuple(guard for guard in settings.guards if guard not in _OF_THE_IMAGE)
    recording = replace(cleaned(run.recording, shared)[0], truth=None)
    return replace(run, recording=recording, settings=replace(settings, guards=own, checks=False))
