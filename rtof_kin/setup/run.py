"""From a video (or keypoints) and sensors to a report: `run`, step by step.

A step is not done again while its inputs are the same, so that a run that was stopped goes on, and the recording's
``recording.toml`` may be corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rtof_kin.calibration.result import read_self_calibration_toml
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError
from rtof_kin.core.files.folder import check_replaceable
from rtof_kin.core.files.manifest import file_digest, fingerprint, made_from, read_contents, write_manifest
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs import work_shared
from rtof_kin.core.resources import lifter_path
from rtof_kin.formats.gait_events import read_event_corrections
from rtof_kin.reconstruction.parts import is_long, reconstruct_in_parts
from rtof_kin.reconstruction.person import Person, update_subject
from rtof_kin.reconstruction.prepare import Progress
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording, RecordingReader, RecordingSource
from rtof_kin.reporting.analysis import write_analysis
from rtof_kin.reporting.export import MARKER, export
from rtof_kin.reporting.page import PAGE, report
from rtof_kin.reporting.settings import AnalysisSettings
from rtof_kin.reporting.statistics import ReconstructionStatistics
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary
from rtof_kin.setup.init import Detect, Findings, make_recording
from rtof_kin.setup.join import ABOUT, join_recordings
from rtof_kin.setup.settings import ReconstructionTask, SecondCamera, SetupSettings
from rtof_kin.vision.lift_points import split_convention

RECORDING, SECOND, JOINED, MOTION, ANGLES = "recording", "second", "joined", "motion", "angles"
"""Folders that `run` writes, beside the report; the second and third where there are two cameras."""


@dataclass(frozen=True)
class Run:
    """What `run` did."""

    folder: Path
    findings: Findings  #: What was given, found, assumed and is in doubt of the recording
    joined: tuple[str, ...]  #: What was found of the second camera, 'kind: sentence'
    summary: Summary  #: Of the motion

    @property
    def page(self) -> Path:
        """The report."""
        return self.folder / PAGE


def run(
    files: Iterable[str | Path],
    folder: str | Path,
    setup: SetupSettings | None = None,
    settings: ReconstructionSettings | None = None,
    *,
    height: float | None = None,
    mode: Mode | None = None,
    task: ReconstructionTask | None = None,
    second: SecondCamera | None = None,
    analysis: AnalysisSettings | None = None,
    detect: Detect | None = None,
    overwrite: bool = False,
    kept: Callable[[str], None] | None = None,
    learned: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Run:
    """Go from a video (or keypoints) and sensors to a report, in one folder.

    Detects the person, makes the recording, reconstructs the motion, analyses it and writes the report. What is not
    given is found from the motion or assumed, and said. A step is not done again while its inputs are the same.

    >>> from rtof_kin import run
    >>> files = ["take/keypoints.csv", "take/camera.toml"]  # or a video; and files of sensors
    >>> done = run(files, "out/walk", height=1.72, mode="lift")
    >>> done.page.name, done.summary.mode
    ('report.html', 'lift')

    Args:
        files: see `make_recording`. setup: of the recording. settings: of the reconstruction's stages.
        height: standing height of the person, m, here or in `setup`.
        mode: of the reconstruction, here or in `task`. task: model and calibration too; default: the recording is
            calibrated from its own motion.
        detect: detects the people in a video; default: the detector of `setup`.
        overwrite: replace results of other files. kept: called with the name of each step that is kept.
        learned: called with each change of the person's file, and what was refused.

    Raises:
        InvalidInputError: no height. OutputExistsError: see `make_recording`. Errors of the steps.
    """
    second = second or SecondCamera()
    folder, task, kept = Path(folder), task or ReconstructionTask(calibrate=True), kept or (lambda _: None)
    settings, analysis = settings or ReconstructionSettings(certificate=True), analysis or AnalysisSettings()
    setup, task = setup or SetupSettings(), replace(task, mode=mode or task.mode)
    given = [*(split_convention(file)[0] for file in task.lift), *([] if task.events is None else [task.events])]
    if missing := [file for file in given if not file.is_file()]:
        raise FileFormatError(missing[0], "there is no such file")
    setup = setup if height is None else replace(setup, height=height)
    setup, own, person = replace(setup, lifter=task.lifter()), folder / RECORDING, task.person()
    how: dict[str, Any] = {"detect": detect, "overwrite": overwrite, "kept": kept, "progress": progress}

    def step(name: str, make: Callable[[Path, bool, Mapping[str, str]], object], *inputs: object) -> None:
        """Make a folder, unless it is there and its inputs are the same."""
        wanted, before = fingerprint(*inputs), made_from(folder / name)
        if before.get(name) == wanted:
            kept(name)
        else:
            make(folder / name, overwrite or name in before, {name: wanted})

    def join(output: Path, overwrite: bool, inputs: Mapping[str, str]) -> None:
        check_replaceable(output, INDEX, overwrite)
        first, other = Recording.load(folder / RECORDING), Recording.load(folder / SECOND)
        joined = join_recordings(first, other, setup.lifter, synchronised=second.synchronised)
        joined.save(output, overwrite, inputs)

    def analyse(output: Path, overwrite: bool, inputs: Mapping[str, str]) -> None:
        write_analysis(folder / MOTION, output, analysis, overwrite, inputs)

    with work_shared(task.threads, reconstruct_in_parts):
        findings = make_recordings(files, folder, setup, task, second, **how)
        if second.second:
            step(JOINED, join, own, folder / SECOND, str(task.model), second.synchronised)
            own = folder / JOINED
        with RecordingReader.open(own) as recording:
            task, notes = replace(task, mode=task.mode or recording.usual_mode), recording.facts.notes
        solved = partial(reconstruct_folder, own, task=task, settings=settings, learned=learned, progress=progress)
        known = {} if person is None else {path: (one.value, one.sd) for path, one in person.known.items()}
        step(MOTION, solved, own, str(task), str(settings), str(known), *given)
        step(ANGLES, analyse, folder / MOTION, str(analysis))
        _write_page(folder, analysis, kept)
    said = tuple(note for note in notes.splitlines() if note.partition(": ")[2].startswith(ABOUT))
    return Run(folder, findings, said, read_summary(folder / MOTION / SUMMARY))


def make_recordings(
    files: Iterable[str | Path],
    folder: str | Path,
    setup: SetupSettings,
    task: ReconstructionTask,
    second: SecondCamera,
    *,
    detect: Detect | None = None,
    overwrite: bool = False,
    kept: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Findings:
    """Do the first steps of `run`, the recording of each camera, and return what was found of the first one.

    Arguments and errors as of `run`.
    """
    folder, person = Path(folder), task.person()
    if setup.height is None and person is not None and person.height_m is not None:
        setup = replace(setup, height=person.height_m.value)
    if setup.height is None:
        raise InvalidInputError(
            "the person's height is not given, and every length follows it: add e.g. --height 1.72 (m)"
        )
    name, how = folder.resolve().name, dict[str, Any](detect=detect, made_with=task.model, overwrite=overwrite)
    how |= {"kept": kept, "progress": progress}
    findings = make_recording(files, folder / RECORDING, setup, name=name, **how)
    if second.second:
        others = replace(setup, person=second.second_person, camera_name=second.second_camera, phone_log=None)
        make_recording(second.second, folder / SECOND, others, name=f"{name}, second camera", **how)
    return findings


def reconstruct_folder(
    recording: str | Path | Recording,
    output: str | Path,
    overwrite: bool = False,
    inputs: Mapping[str, str] | None = None,
    *,
    task: ReconstructionTask,
    settings: ReconstructionSettings,
    learned: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> ReconstructionStatistics:
    """Reconstruct the recording of a folder, a long one in parts, and export the motion.

    `output`: folder to write; one that may not be replaced is refused before the work. `inputs`: fingerprints for its
    manifest. `learned`: called with each change of the person's file, and what was refused.
    """
    check_replaceable(output, MARKER, overwrite)
    with ExitStack() as stack:
        source: RecordingSource = (
            recording if isinstance(recording, Recording) else stack.enter_context(RecordingReader.open(recording))
        )
        seen = source.between(source.start_s, source.start_s).keypoints
        searched = seen is not None and seen.camera.uncertainty is not None
        dear = settings.certificate or searched or is_long(source)  # worth processes of their own
        stack.enter_context(work_shared(task.threads if dear else 1, reconstruct_in_parts))
        mode, known, digest = task.mode or source.usual_mode, task.calibration, source.digest()
        source = task.with_lifts(source)
        if task.events is not None:
            events = read_event_corrections(task.events, source.times)
            source = source.with_facts(corrections=(*source.facts.corrections, *events))
        lifter = task.lifter()
        person = Person.of(task.person(), source).seen(source, mode, lifter, settings)
        informed = person.informed(source)
        names = ("frames", "space", "guards", "lift_with_sensors", "certificate")
        options = {"mode": mode, "calibrate": task.calibrate, "paper": settings.fragment is not None}
        record = {
            "options": options | {name: getattr(settings, name) for name in names},
            "recording_sha256": digest,
            "model_sha256": file_digest(lifter_path(task.model)),
            "calibration_sha256": None if known is None else file_digest(known),
            "events_sha256": None if task.events is None else file_digest(task.events),
            "lift_sha256": [file_digest(split_convention(file)[0]) for file in task.lift],
            "subject_sha256": None if task.subject is None else file_digest(task.subject),
        }
        if used := person.used(informed.facts):
            record["person"] = used
        how: Any = {"lifter": lifter, "settings": settings, "calibrate": task.calibrate, "progress": progress}
        how["known"] = person.calibration if known is None else read_self_calibration_toml(known)
        body, label = informed.facts.skeleton, f"recording {digest[:8]}"
        parts = person.learning(reconstruct_in_parts(informed, None, mode, **how), source.facts, body, label)
        found = export(parts, output, overwrite, inputs=inputs, run=record)
    if task.update_subject and task.subject is not None:
        for sentence in update_subject(task.subject, person.news, body.name, person.doubt):
            (learned or (lambda _: None))(sentence)
    return found


def _write_page(folder: Path, analysis: AnalysisSettings, kept: Callable[[str], None]) -> None:
    """Write the report into the folder of `run`, whose manifest has nothing else."""
    page, inputs = folder / PAGE, {PAGE: fingerprint(folder / MOTION, analysis.weight_kg, analysis.sex)}
    if made_from(folder) == inputs:
        kept(PAGE)
        return
    own = page in read_contents(folder).own
    if page.exists() and not own:
        raise OutputExistsError(f"{page}: this package did not write it, or it was changed; move it elsewhere")
    write_text(page, report(folder / MOTION, None, analysis.weight_kg, analysis.sex), overwrite=own)
    write_manifest(folder, PAGE, inputs, [page])
