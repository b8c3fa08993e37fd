"""Validation of joint angles on a public data set that the user has downloaded.

Videos are detected first, each once. A job is then one take: it is set up as ``rtof-kin run --only recording`` does,
reconstructed, and its clinical angles are compared with the set's reference at the same instants. Work that
is done is not done again; a take that fails is named with its reason and tried again by the next run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_errors import AngleDifferences, angle_differences, angle_errors, error_rows
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles, opensim_angles
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, some
from rtof_kin.core.choices import MODES, Mode
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, RtofError
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.jobs import JobResult, Outcome, Progress, open_runs, run_jobs
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.datasets.marker_sets import Movi, OpenCapValidation
from rtof_kin.datasets.public_sets import MOVEMENTS, PublicSet, Take, TakeInputs, Truth
from rtof_kin.datasets.sensor_sets import Gaitex, Vidimu
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.sensors.tables import write_opensense_sto
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.protocols.angles import HARDLY, angle_document, clock_shift, plain_rows
from rtof_kin.protocols.measures import plain_settings, save_motion
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.sensor_files import imus_of_log
from rtof_kin.reporting import document
from rtof_kin.reporting.document import Document
from rtof_kin.setup.init import find_people, write_recording
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import FORMATS, read_detector_file
from rtof_kin.vision.video import detect_video, write_detections
from rtof_kin.vision.video_metadata import read_video_metadata

SETS: Final = {one.name: one for one in (OpenCapValidation, Vidimu, Movi, Gaitex)}
CAMERAS: Final = ("set", "unknown")  #: The set's calibration, or none, as of a phone that was put anywhere
TAKES: Final = "angle_errors_by_take.csv"
_WITH_SENSORS: Final = ("sf2", "rtof", "imu")
_PARTS: Final = ("difference", "sigma", "reference")  #: Arrays of a result, before the name of the angle


@dataclass(frozen=True)
class ValidationProtocol:
    """Settings of a validation."""

    root: Path  #: Folder of the data set
    dataset: str  #: One of `SETS`
    takes: tuple[str, ...] = ("*",)  #: Patterns of the names of takes, with * and ?
    mode: Mode | None = None  #: Of reconstruction; None for what the set has inputs for
    lifter: Path | None = None  #: A file, or the name of a shipped one; the shipped default where not given
    camera: str = CAMERAS[0]  #: One of `CAMERAS`
    keypoints: Path | None = None
    """Folder of detections by the name of the take or of its video, instead of the detector."""
    models: Path | None = None  #: Folder of the detector's models; None for what is at hand
    heights: Mapping[str, float] | None = None  #: Subject -> standing height, m, where the set has none
    calibrate: bool = False  #: Whether each take is calibrated from its own motion first
    align: bool = True  #: Whether the difference of the clocks is estimated; otherwise they are taken as equal
    seconds: float | None = None  #: [s] of each take that are used; None for all
    size_px: tuple[int, int] | None = None
    """Width and height of the image, for detections without a video or a calibration."""

    def __post_init__(self) -> None:
        indices_of("data set", [self.dataset], list(SETS))
        indices_of("camera", [self.camera], CAMERAS)
        if self.mode:
            indices_of("mode", [self.mode], MODES)
        if self.keypoints is not None and not self.keypoints.is_dir():
            raise FileFormatError(self.keypoints, "there is no such folder of detections")
        if self.seconds is not None and not self.seconds > 0:
            raise InvalidInputError(f"--seconds {self.seconds:g}: is no duration")

    @property
    def own_mode(self) -> Mode:
        """Mode of reconstruction."""
        return self.mode or SETS[self.dataset].mode

    def settings(self) -> dict[str, Any]:
        """Return everything that the results depend on, as plain values."""
        return plain_settings(self, "takes") | {"mode": self.own_mode}

    @cached_property
    def chosen(self) -> tuple[Take, ...]:
        """The takes that are wanted. `FileFormatError`: there is no such set; `InvalidInputError`: no take has such a
        name.
        """
        every = SETS[self.dataset](self.root).takes()
        found = tuple(one for one in every if any(fnmatchcase(one.key, pattern) for pattern in self.takes))
        if not found:
            some = ", ".join(one.key for one in every[:4])
            raise InvalidInputError(f"--takes {','.join(self.takes)}: none of {len(every)}, such as {some}")
        return found

    def run(
        self, folder: Path, *, overwrite: bool = False, workers: int | None = None, progress: Progress | None = None
    ) -> Outcome:
        """Measure the takes that have no result yet, see `rtof_kin.protocols.run`."""
        runs = open_runs(folder, self.settings(), overwrite, None, {})
        videos = {take.key: found for take in self.chosen if (found := _video_of(self, take)) is not None}
        names = {video: f"{number:04d}_{video.stem}" for number, video in enumerate(sorted(set(videos.values())))}
        detected = Outcome(folder, {}, {})
        if names:
            settings = {"videos": [str(video) for video in names], "models": self.settings()["models"]}
            into = open_runs(folder / "detections", settings, overwrite, None, {})
            arguments = {name: (video, self.models) for video, name in names.items()}
            detected = run_jobs(detect, arguments, into, workers, progress)
        jobs = {}
        for take in self.chosen:
            name = names[videos[take.key]] if take.key in videos else ""
            done = detected.folder / f"{name}.npz" if name in detected.done else None
            jobs[take.key] = ValidationJob(self, take, folder / "takes" / take.key, done, detected.failed.get(name, ""))
        return run_jobs(measure, jobs, runs, workers, progress)

    def document(self, outcome: Outcome) -> Document:
        """Return all tables, with the most important problems in the headline."""
        adapter, found = SETS[self.dataset], differences(outcome)
        references = sorted({facts["reference"] for facts in outcome.done.values()})
        notes = [f"Reference: {'; '.join(references)}."] if references else []
        notes += [f"Of this set: {adapter.caution}."] if adapter.caution else []
        errors = [plain_rows([angle_errors([one], one.angle, one.movement)])[0] for one in found]
        rows = [[one.take, *row.values()] for one, row in zip(found, errors, strict=True)]
        headline = first_line(self, outcome)
        return angle_document(
            error_rows(found, MOVEMENTS),
            f"Joint angles on {adapter.title}, mode {self.own_mode}",
            headline,
            notes,
            further=[takes_table(self.chosen, outcome)],
            facts={"settings": self.settings(), "takes": outcome.done, "failed": outcome.failed},
            files={TAKES: document.Table(["take", *(errors[0] if errors else ())], rows)},
            alarm=bool(outcome.failed) or "NOT ACC" in headline or "IN DOUBT" in headline,
        )


@dataclass(frozen=True)
class ValidationJob:
    """One take, and the detections in its video."""

    protocol: ValidationProtocol
    take: Take
    folder: Path  #: For the recording, the files that it is made from, and the motion
    detections: Path | None = None  #: In the whole video
    problem: str = ""  #: Why there are no detections


def differences(outcome: Outcome) -> tuple[AngleDifferences, ...]:
    """Return the differences of all takes that were measured."""
    found = []
    for key, facts in outcome.done.items():
        arrays = outcome.arrays(key)
        for name, difference in arrays.items():
            part, _, angle = name.partition(" ")
            if part == "difference":
                more = {other: arrays.get(f"{other} {angle}") for other in _PARTS[1:]}
                found.append(AngleDifferences(angle, facts["kind"], key, difference, **more, person=facts["subject"]))
    return tuple(found)


def _video_of(protocol: ValidationProtocol, take: Take) -> Path | None:
    """Video in which people are still to be detected; None where there is none or its take cannot be read."""
    if protocol.own_mode == "imu":
        return None
    try:
        inputs = _opened(protocol.dataset, protocol.root).inputs(take)
    except RtofError:
        return None  # its job says why
    return None if _given_keypoints(protocol.keypoints, take, inputs) is not None else inputs.video


@lru_cache(maxsize=1)
def _opened(dataset: str, root: Path) -> PublicSet:
    return SETS[dataset](root)


def detect(job: tuple[Path, Path | None]) -> JobResult:
    """Detect the people in a video with the detector's models."""
    video, models = job
    found = detect_video(video, models)
    assert found.times is not None
    arrays = {"uv_px": found.uv_px, "confidence": found.confidence, "times": found.times}
    return JobResult({"video": str(video), "frames": len(found), "methods": {}}, arrays)


def measure(job: ValidationJob) -> JobResult:
    """Reconstruct one take and compare its angles with the reference."""
    from lifting.predict import Lifter

    protocol, take = job.protocol, job.take
    adapter = _opened(protocol.dataset, protocol.root)
    inputs, truth = adapter.inputs(take), adapter.truth(take)
    if inputs.height is None and protocol.heights:
        inputs = replace(inputs, height=protocol.heights.get(take.subject))
    if inputs.size_px is None and inputs.video is None:
        inputs = replace(inputs, size_px=protocol.size_px)
    if protocol.camera == "unknown":
        inputs = replace(inputs, camera=None)
    if job.problem:
        raise InvalidInputError(job.problem)
    mode, network = protocol.own_mode, Lifter.load(protocol.lifter)
    recording, notes = recording_of(job, inputs, network)
    if protocol.seconds is not None and recording.times[-1] - recording.times[0] > protocol.seconds:
        whole = recording.times[-1] - recording.times[0]
        recording = recording.between(recording.times[0], recording.times[0] + protocol.seconds)
        notes.append(f"the first {protocol.seconds:g} of {whole:.0f} s are used")
    result = reconstruct(recording, mode=mode, lifter=network, calibrate=protocol.calibrate)
    save_motion(result, mode, job.folder / "motion.h5")
    facts, arrays = compared_with(clinical_angles(result.motion), truth, take, protocol.align)
    about = {"subject": take.subject, "take": take.movement, "kind": take.kind, "camera": take.camera or None}
    return JobResult(about | {"notes": [*notes, *sorted(set(result.warnings))]} | facts, arrays)


def compared_with(
    estimate: ClinicalAngles, truth: Truth, take: Take, aligned: bool = True
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Compare the angles of a take with its reference: plain facts, and the arrays of `differences`.
    `InvalidInputError`: no angle is in both at the same instants.
    """
    reference, _ = opensim_angles(truth.table)
    measured = set(truth.coordinates) & set(truth.table.names)
    names = [row.name for row in reference.rows if row.opensim.removeprefix("-") in measured]
    if not names:
        raise InvalidInputError(
            f"the reference has none of the measured coordinates, {', '.join(truth.coordinates[:3])} "
            "and so on: is it of another version of the set?"
        )
    clock: dict[str, Any] = {"shift_s": 0.0, "how": "as recorded"}
    if aligned:
        clock = clock_shift(estimate, reference, names, truth.reach)
    found, left_out = angle_differences(estimate, reference, take.kind, take.key, names, clock["shift_s"])
    if not found:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
        raise InvalidInputError(f"{take.key}: no angle is in the motion and the reference at the same time ({why})")
    arrays = {f"{part} {one.angle}": own for one in found for part in _PARTS if (own := getattr(one, part)) is not None}
    facts = {"reference": truth.source, "of_sensors": truth.of_sensors, "clock": clock, "left_out": left_out}
    return facts | {"methods": {"angles": {one.angle: len(one.difference) for one in found}}}, arrays


# --- from the inputs of a take to its recording, by the same steps as ``rtof-kin run`` ------------


def recording_of(job: ValidationJob, inputs: TakeInputs, lifter: LifterLike) -> tuple[Recording, list[str]]:
    """Return the recording of a take, and what was found, assumed or in doubt. `InvalidInputError`: the take lacks what
    the mode needs. Errors of `write_recording`, `calibrate_by_pose`.
    """
    mode, sensors = job.protocol.own_mode, inputs.sensors
    if mode in _WITH_SENSORS and sensors is None:
        raise InvalidInputError(f"it has no sensors, which mode {mode} needs; use --mode rto")
    if mode != "imu" or sensors is None:
        return _of_images(job, inputs, lifter)
    if not inputs.pose:
        raise CalibrationError(
            "no pose is documented by which its sensors could be calibrated; use a mode with the camera"
        )
    skeleton = SkeletonModel.default()
    skeleton = skeleton if inputs.height is None else skeleton.with_height(inputs.height)
    log = sensors.select(list(inputs.places))
    joints = {sensor: known_segment(place, skeleton) for sensor, place in inputs.places.items()}
    found = calibrate_by_pose(log, joints, inputs.pose, skeleton, still=inputs.still)
    recording = Recording(job.take.key, imus=imus_of_log(log), calibration=found.calibration, height=inputs.height)
    return recording, list(found.warnings)


def _of_images(job: ValidationJob, inputs: TakeInputs, lifter: LifterLike) -> tuple[Recording, list[str]]:
    make_folders(job.folder)
    size, rate = inputs.size_px, inputs.rate_hz
    if inputs.video is not None:
        video = read_video_metadata(inputs.video)
        size, rate = size or (video.width_px, video.height_px), video.rate_hz or rate
    if size is None and inputs.camera is None:
        raise InvalidInputError(
            "detections alone do not say how large the image is: put the video where the set has it, or give "
            "--size 1920x1080"
        )
    settings = SetupSettings(height=inputs.height, rate_hz=rate, size_px=size, lifter=lifter)
    camera, sensors = inputs.camera, list[Path]()
    if isinstance(camera, Camera):
        write_camera_toml(job.folder / "camera.toml", {"camera": camera}, overwrite=True)
        camera = job.folder / "camera.toml"
    if job.protocol.own_mode in _WITH_SENSORS:
        assert inputs.sensors is not None
        sensors = [job.folder / "sensors.sto"]  # under the names of the segments, which say the locations
        log = inputs.sensors.select(list(inputs.places)).renamed(inputs.places)
        write_opensense_sto(sensors[0], SensorLog.of_imus(imus_of_log(log), sensors[0]))
    sources = Sources(keypoints=_keypoints(job, inputs, settings), camera=camera, sensors=tuple(sensors))
    find_people(sources, settings, job.folder / "recording", _no_detector)
    said = write_recording(sources, settings, job.folder / "recording", name=job.take.key)
    notes = [*said.assumed, *said.doubtful]
    if inputs.height is None:  # init's remedy is an option of its own
        notes = [note for note in notes if "--height" not in note]
        notes.append(f"the height of {job.take.subject} is not known; give it by --heights")
    return Recording.load(job.folder / "recording"), notes


def _no_detector(video: Path) -> Detections:
    raise InvalidInputError(f"{video}: was not detected")


def _given_keypoints(folder: Path | None, take: Take, inputs: TakeInputs) -> Path | None:
    """Return the user's detections, which have the name of the take or of its video; None where there are none."""
    if folder is None:
        return None
    stems = [take.key, *([inputs.video.stem] if inputs.video else [])]
    files = (folder / f"{stem}{suffix}" for stem in stems for suffix in (*FORMATS, ""))
    return next((file for file in files if file.exists()), None)


def _keypoints(job: ValidationJob, inputs: TakeInputs, settings: SetupSettings) -> Path:
    """Return the detections of the take alone: those of a whole video are cut."""
    take = job.take
    given = _given_keypoints(job.protocol.keypoints, take, inputs)
    found = given or job.detections
    if found is None:
        where = f"put {take.key}.npz into the folder of --keypoints, or the video into {take.folder}"
        raise InvalidInputError(f"there is no video and no detection of it; {where}")
    if inputs.span is None or (given is not None and given.stem == take.key):
        return found
    every = read_detector_file(found, *(settings.size_px or ()))
    times = np.arange(len(every)) / (settings.rate_hz or 30.0) if every.times is None else every.times
    start, stop = inputs.span
    own = (times >= start - 1e-6) & (times <= stop + 1e-6)
    if own.sum() < 2:
        raise InvalidInputError(f"{found}: ends before {take.key}, which is from {start:.1f} to {stop:.1f} s")
    cut = replace(every, uv_px=every.uv_px[own], confidence=every.confidence[own], times=times[own] - start)
    write_detections(job.folder / "keypoints.npz", cut, overwrite=True)
    return job.folder / "keypoints.npz"


# --- words and tables ----------------------------------------------------------------------------


def first_line(protocol: ValidationProtocol, outcome: Outcome) -> str:
    """Return the headline: how many takes were measured, and which failed."""
    done, failed, mode = outcome.done, outcome.failed, protocol.own_mode
    text = f"{SETS[protocol.dataset].title}, mode {mode}: {len(done)} of {len(done) + len(failed)} takes measured"
    if failed:
        named = some([f"{key}: {reason}" for key, reason in failed.items()], 3, "; ")
        text += f", {len(failed)} FAILED and are in no error below ({named})"
    circular = sum(bool(facts["of_sensors"]) for facts in done.values())
    if circular and mode in _WITH_SENSORS:
        text += (
            f". NOT ACCURACY: the reference of {circular} takes was computed from the same sensors that "
            f"this mode uses; use --mode rto, or a reference of markers"
        )
    if apart := [key for key, facts in done.items() if HARDLY in facts["clock"]["how"]]:
        text += (
            f". IN DOUBT: in {len(apart)} takes {HARDLY}, so that their errors may be those of the clock, or "
            f"of another movement: {some(apart, 5)}; leave them out by --takes"
        )
    return text + "."


def takes_table(takes: tuple[Take, ...], outcome: Outcome) -> Table:
    """Return one row for each take: what its clock was shifted by, or why it failed."""
    cells: list[tuple[str | float | None, ...]] = []
    for take in takes:
        facts = outcome.done.get(take.key)
        if facts is None:
            reason = outcome.failed.get(take.key, "not run")
            cells.append((take.key, take.kind, None, None, f"FAILED: {reason}"))
            continue
        clock, reasons = facts["clock"], dict[str, list[str]]()
        for name, reason in facts["left_out"].items():
            reasons.setdefault(reason, []).append(name)
        left_out = [f"left out ({reason}): {', '.join(names)}" for reason, names in reasons.items()]
        said = "; ".join((clock["how"], *left_out, *facts["notes"]))
        cells.append((take.key, take.kind, clock["shift_s"], clock.get("agreement"), said))
    columns = ("take", "movement", "shift [s]", "agreement", "clock, and what was left out or is in doubt")
    note = "Shift: added to the times of the reference; takes and references start together by the set's own account."
    return Table("takes", "Takes", columns, (0, 0, 3, 2, 0), cells, (note,))
