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
from typing import Any, Final

import numpy as np

from rtof_kin.calibration.clocks import find_video_offset
from rtof_kin.calibration.result import read_self_calibration_toml
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.environment import environment
from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.core.files.folder import check_replaceable
from rtof_kin.core.files.manifest import file_digest, fingerprint, made_from, read_contents, write_manifest
from rtof_kin.core.files.text import write_text
from rtof_kin.core.resources import lifter_path
from rtof_kin.data.camera import Camera
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.parts import reconstruct_in_parts
from rtof_kin.reconstruction.prepare import Progress
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording, RecordingReader
from rtof_kin.reporting.analysis import AnalysisSettings, write_analysis
from rtof_kin.reporting.export import MARKER, export
from rtof_kin.reporting.page import PAGE, report
from rtof_kin.reporting.statistics import ReconstructionStatistics
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary
from rtof_kin.setup.init import Detect, Findings, SetupSettings, make_recording
from rtof_kin.setup.second_camera import find_second_camera

RECORDING, SECOND, JOINED, MOTION, ANGLES = "recording", "second", "joined", "motion", "angles"
"""Folders that `run` writes, beside the report; the second and third where there are two cameras."""


@dataclass(frozen=True)
class ReconstructionTask:
    """How the recording of a folder is reconstructed, beside the settings of its stages."""

    mode: Mode | None = None
    """lift: network only; sf2: + IMU orientations, frame by frame; rto: optimised, vision only; rtof: everything;
    imu: sensors only, without a camera; default: the one that uses all that was recorded."""
    model: Path | None = None
    """Lifter and pose prior: a file written by rtof-kin train, or a shipped one by name: detections (the default),
    perfect."""
    calibrate: bool = False
    """Calibrate the recording from its own motion first, against gross errors of delay, mounting and bones."""
    calibration: Path | None = None
    """Calibration of another recording of the same person: bones, ankles and landmark offsets are taken from it; with
    calibrate delay, mounting and biases are estimated for this one."""
    figures: bool = True
    """Draw figures, where matplotlib is installed."""

    def lifter(self) -> LifterLike | None:
        """Load the model that is named; None for the shipped one."""
        if self.model is None:
            return None
        from lifting.predict import Lifter

        return Lifter.load(self.model)


@dataclass(frozen=True)
class SecondCamera:
    """Files of a second camera that saw the same."""

    second: tuple[Path, ...] = ()
    """Video or keypoints of a second camera (or both) that saw the same; its location is found."""
    second_person: int | None = None
    """Number of the person in second/frames.png."""
    second_camera: str | None = None
    """Name of the second camera, in the calibration among the files."""
    synchronised: bool = False
    """Both cameras have one clock; default: it is found."""


@dataclass(frozen=True)
class Run:
    """What `run` did."""

    folder: Path
    findings: Findings
    """What was given, found, assumed and is in doubt of the recording."""
    joined: tuple[str, ...]
    """What was found of the second camera, 'kind: sentence'."""
    summary: Summary
    """Of the motion."""

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

    Raises:
        InvalidInputError: no height. OutputExistsError: see `make_recording`. Errors of the steps.
    """
    import lifting  # noqa: F401  # says before the work if torch is missing

    second = second or SecondCamera()
    folder, task, kept = Path(folder), task or ReconstructionTask(calibrate=True), kept or (lambda _: None)
    settings, analysis = settings or ReconstructionSettings(), analysis or AnalysisSettings()
    setup, task = setup or SetupSettings(), replace(task, mode=mode or task.mode)
    setup = setup if height is None else replace(setup, height=height)
    if setup.height is None:
        raise InvalidInputError(
            "the person's height is not given, and every length follows it: add e.g. --height 1.72 (m)"
        )
    how: dict[str, Any] = {"detect": detect, "made_with": task.model, "overwrite": overwrite, "kept": kept}
    name, own, setup = folder.resolve().name, folder / RECORDING, replace(setup, lifter=task.lifter())
    findings = make_recording(files, own, setup, name=name, progress=progress, **how)

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
        joined.recording.save(output, overwrite, inputs)

    if second.second:
        others = replace(setup, person=second.second_person, camera_name=second.second_camera, phone_log=None)
        title = f"{name}, second camera"
        make_recording(second.second, folder / SECOND, others, name=title, progress=progress, **how)
        step(JOINED, join, own, folder / SECOND, str(task.model), second.synchronised)
        own = folder / JOINED
    recording = Recording.load(own)
    task, notes = replace(task, mode=task.mode or recording.usual_mode), recording.notes
    del recording  # a long one is read in parts
    solved = partial(reconstruct_folder, own, task=task, settings=settings, progress=progress)
    step(MOTION, solved, own, str(task), str(settings))
    step(
        ANGLES,
        lambda *made: write_analysis(folder / MOTION, made[0], analysis, task.figures, *made[1:]),
        folder / MOTION,
        str(analysis),
        task.figures,
    )
    _write_page(folder, analysis, kept)
    said = tuple(note for note in notes.splitlines() if note.partition(": ")[2].startswith(ABOUT))
    return Run(folder, findings, said, read_summary(folder / MOTION / SUMMARY))


def reconstruct_folder(
    recording: str | Path | Recording,
    output: str | Path,
    overwrite: bool = False,
    inputs: Mapping[str, str] | None = None,
    *,
    task: ReconstructionTask,
    settings: ReconstructionSettings,
    progress: Progress | None = None,
) -> ReconstructionStatistics:
    """Reconstruct the recording of a folder, a long one in parts, and export the motion.

    Args:
        output: folder to write; one that may not be replaced is refused before the work.
        inputs: fingerprints for its manifest.
    """
    check_replaceable(output, MARKER, overwrite)
    with ExitStack() as stack:
        source: Recording | RecordingReader = (
            recording if isinstance(recording, Recording) else stack.enter_context(RecordingReader.open(recording))
        )
        mode, known = task.mode or source.usual_mode, task.calibration
        record = {
            "options": {"mode": mode, "calibrate": task.calibrate} | settings_record(settings),
            "recording_sha256": source.digest(),
            "model_sha256": file_digest(lifter_path(task.model)),
            "calibration_sha256": None if known is None else file_digest(known),
        }
        how: Any = {
            "mode": mode,
            "lifter": task.lifter(),
            "settings": settings,
            "calibrate": task.calibrate,
            "known": None if known is None else read_self_calibration_toml(known),
            "progress": progress,
        }
        return export(
            reconstruct_in_parts(source, **how),
            output,
            overwrite,
            task.figures,
            inputs=inputs,
            run=lambda: record | {"environment": environment()},
        )


def settings_record(settings: ReconstructionSettings) -> dict[str, Any]:
    """Return the choices that numbers depend on, for ``summary.json``."""
    fragment = settings.fragment
    return {
        "frames": settings.frames,
        "space": settings.space,
        "backend": settings.backend if fragment is None else fragment.backend,
        "paper": fragment is not None,
        "guards": settings.guards,
        "lift_with_sensors": settings.lift_with_sensors,
    }


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


ABOUT: Final = "second camera"
"""What sentences on it begin with."""


@dataclass(frozen=True)
class Joined:
    """A recording with a second view."""

    recording: Recording
    """The first one, with the second camera's keypoints on its clock and that camera in its world."""
    found: str
    """What was estimated, in a sentence with standard deviations."""
    doubt: str
    """Why it may be wrong; empty where sure."""


def join_recordings(
    first: Recording, second: Recording, lifter: LifterLike | None = None, *, synchronised: bool = False
) -> Joined:
    """Join the videos of two cameras that saw the same person at the same time.

    Clocks are found from the movement. Two calibrated cameras are in one world already; of others the second
    one's pose, and both focal lengths, are found too (`find_second_camera`).

    Args:
        first: with sensors or without; its camera defines the world. lifter: default: the shipped one.

    Raises:
        InvalidInputError: the second one has sensors, or no keypoints, or the clocks have too little in
            common. CalibrationError: the cameras do not see the person together for long enough.
    """
    if second.imus is not None:
        raise InvalidInputError(f"recording {second.name}: has sensors; give the one with sensors as the first")
    if _is_calibrated(first.video.camera) and _is_calibrated(second.video.camera):
        offset, sigma, doubt = 0.0, 0.0, ""
        if not synchronised:
            poses, others = (lift(k, first.skeleton, lifter).poses for k in (first.video, second.video))
            clock = find_video_offset(poses, others)
            offset, sigma, doubt = clock.offset, clock.sigma, clock.doubt
        view = second.video.on_clock(second.video.times + offset)
        joined, pose = replace(first, views=(*first.views, view)), "as calibrated"
    else:
        camera = find_second_camera(first, second.video, lifter, around=0.0 if synchronised else None)
        offset, sigma, doubt = camera.offset, camera.sigma_offset, camera.doubt
        joined = camera.apply(first)
        pose = (
            f"{_apart(camera.first, camera.view.camera)}, position ± {_rms(camera.sigma_position):.2f} m, "
            f"orientation ± {np.degrees(_rms(camera.sigma_turn)):.1f} degrees"
        )
    found = f"{ABOUT}: {pose}; the times of its video were moved by {offset:+.3f} ± {sigma:.3f} s"
    notes = [f"doubtful: {ABOUT}: {doubt}"] if doubt else []
    notes += [first.notes] if first.notes else []
    return Joined(replace(joined, notes="\n".join([*notes, f"found: {found}"])), found, doubt)


def _is_calibrated(camera: Camera) -> bool:
    return camera.uncertainty is None and not camera.assumed


def _apart(first: Camera, second: Camera) -> str:
    metres = float(np.linalg.norm(second.center_world - first.center_world))
    cosine = float(np.clip(first.R_camera_world[2] @ second.R_camera_world[2], -1.0, 1.0))
    return f"{metres:.1f} m from the first one, looking {np.degrees(np.arccos(cosine)):.0f} degrees apart"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
