"""Validation of joint angles on a public data set that the user has downloaded.

Videos are detected first, each once. A job is then one take: it is set up as ``rtof-kin run --only recording`` does,
reconstructed, and its clinical angles are compared with the set's reference at the same instants. Work that
is done is not done again; a take that fails is named with its reason and tried again by the next run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angle_errors import AngleDifferences, angle_differences
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.comparison_alignment import align
from rtof_kin.clinical.comparison_opensim import opensim_angles
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.choices import MODES, Mode
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.core.jobs import JobResult, Outcome, Progress, open_runs, run_jobs
from rtof_kin.datasets.gaitex import Gaitex
from rtof_kin.datasets.movi import Movi
from rtof_kin.datasets.opencap_validation import OpenCapValidation
from rtof_kin.datasets.public_sets import PublicSet, Take, Truth
from rtof_kin.datasets.vidimu import Vidimu
from rtof_kin.protocols.measures import provenance, save_motion
from rtof_kin.protocols.validation_setup import SetUp, keypoints_of, recording_of
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.vision.video import detect_video

SETS: Final = {one.name: one for one in (OpenCapValidation, Vidimu, Movi, Gaitex)}
CAMERAS: Final = ("set", "unknown")
"""The set's calibration, or none, as of a phone that was put anywhere."""
HARDLY: Final = "the movements hardly agree at any shift"
"""Of a take whose clock was not found."""
_DIFFERENCE, _SIGMA = "difference ", "sigma "
"""Arrays of a result, before the name of the angle."""


@dataclass(frozen=True)
class ValidationProtocol:
    """Settings of a validation."""

    dataset: str
    """One of `SETS`."""
    root: Path
    """Folder of the data set."""
    takes: tuple[str, ...] = ("*",)
    """Patterns of the names of takes."""
    mode: Mode | None = None
    """Of reconstruction; None for the set's own."""
    lifter: Path | None = None
    """A file, or the name of a shipped one; the shipped default where not given."""
    camera: str = CAMERAS[0]
    keypoints: Path | None = None
    """Folder of detections by the name of the take or of its video, instead of the detector."""
    models: Path | None = None
    """Folder of the detector's models; None for what is at hand."""
    heights: Mapping[str, float] | None = None
    """Subject -> standing height, m, where the set has none."""
    calibrate: bool = False
    """Whether each take is calibrated from its own motion first."""
    align: bool = True
    """Whether the difference of the clocks is estimated; otherwise they are taken as equal."""
    seconds: float | None = None
    """[s] of each take that are used; None for all."""
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

    def opened(self) -> PublicSet:
        """Return the adapter; raises FileFormatError where there is no such folder."""
        return SETS[self.dataset](self.root)

    def settings(self) -> dict[str, Any]:
        """Return everything that the results depend on, as plain values."""
        return provenance(self.lifter) | {
            "dataset": self.dataset,
            "root": str(self.root.resolve()),
            "mode": self.own_mode,
            "camera": self.camera,
            "keypoints": str(self.keypoints.resolve()) if self.keypoints else "detected",
            "models": str(self.models.resolve()) if self.models else "at hand",
            "heights": dict(self.heights or {}),
            "calibrate": self.calibrate,
            "align": self.align,
            "seconds": self.seconds,
            "size_px": list(self.size_px) if self.size_px else None,
        }

    def chosen(self) -> tuple[Take, ...]:
        """Return the takes that are wanted.

        Raises:
            FileFormatError: there is no such set. InvalidInputError: no take has such a name.
        """
        every = self.opened().takes()
        found = tuple(one for one in every if any(fnmatchcase(one.key, pattern) for pattern in self.takes))
        if not found:
            some = ", ".join(one.key for one in every[:4])
            raise InvalidInputError(f"--takes {','.join(self.takes)}: none of {len(every)}, such as {some}")
        return found


@dataclass(frozen=True)
class ValidationJob:
    """One take, and the detections in its video."""

    protocol: ValidationProtocol
    take: Take
    folder: Path
    """For the recording and the motion."""
    detections: Path | None = None
    problem: str = ""
    """Why there are no detections."""


@dataclass(frozen=True)
class Validation:
    """Results of a validation."""

    takes: tuple[Take, ...]
    outcome: Outcome

    def differences(self) -> tuple[AngleDifferences, ...]:
        """Return the differences of all takes that were measured."""
        found = []
        for key, facts in self.outcome.done.items():
            arrays = self.outcome.arrays(key)
            for name, difference in arrays.items():
                if name.startswith(_DIFFERENCE):
                    angle = name.removeprefix(_DIFFERENCE)
                    sigma = arrays.get(_SIGMA + angle)
                    found.append(AngleDifferences(angle, facts["kind"], key, difference, sigma))
        return tuple(found)


def run(
    protocol: ValidationProtocol,
    folder: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Measure the takes that have no result yet.

    Args:
        folder: for the results; a run of the same settings is resumed.
        overwrite: whether results of other settings may be replaced. workers, progress: see `run_jobs`.

    Raises:
        FileFormatError: there is no such set. InvalidInputError: no such take. OutputExistsError: see
            `open_runs`.
    """
    takes = protocol.chosen()
    runs = open_runs(folder, protocol.settings(), overwrite, None, {})
    jobs = _jobs(protocol, takes, folder, overwrite, workers, progress)
    return Validation(takes, run_jobs(measure, jobs, runs, workers, progress))


def _jobs(
    protocol: ValidationProtocol,
    takes: tuple[Take, ...],
    folder: Path,
    overwrite: bool,
    workers: int | None,
    progress: Progress | None,
) -> dict[str, ValidationJob]:
    """Detect the people in all videos that need it, and return the job of each take."""
    videos = {take.key: found for take in takes if (found := _video_of(protocol, take)) is not None}
    names = {video: f"{number:04d}_{video.stem}" for number, video in enumerate(sorted(set(videos.values())))}
    detected = Outcome(folder, {}, {})
    if names:
        settings = {"videos": [str(video) for video in names], "models": protocol.settings()["models"]}
        runs = open_runs(folder / "detections", settings, overwrite, None, {})
        arguments = {name: (video, protocol.models) for video, name in names.items()}
        detected = run_jobs(detect, arguments, runs, workers, progress)
    jobs = {}
    for take in takes:
        name = names.get(videos[take.key]) if take.key in videos else None
        done = detected.folder / f"{name}.npz" if name in detected.done else None
        problem = detected.failed.get(name, "") if name else ""
        jobs[take.key] = ValidationJob(protocol, take, folder / "takes" / take.key, done, problem)
    return jobs


def _video_of(protocol: ValidationProtocol, take: Take) -> Path | None:
    """Video in which people are still to be detected; None where there is none or its take cannot be read."""
    if protocol.own_mode == "imu":
        return None
    try:
        inputs = _opened(protocol.dataset, protocol.root).inputs(take)
    except RtofError:
        return None  # its job says why
    if inputs.video is None or keypoints_of(protocol.keypoints, take, inputs) is not None:
        return None
    return inputs.video


@lru_cache(maxsize=1)
def _opened(dataset: str, root: Path) -> PublicSet:
    return SETS[dataset](root)


def detect(job: tuple[Path, Path | None]) -> JobResult:
    """Detect the people in a video.

    Args:
        job: the video, and the detector's models.
    """
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
    setup = SetUp(job.folder, mode, protocol.keypoints, job.detections, network)
    recording, notes = recording_of(take, inputs, setup)
    if protocol.seconds is not None and recording.times[-1] - recording.times[0] > protocol.seconds:
        whole = recording.times[-1] - recording.times[0]
        recording = recording.between(recording.times[0], recording.times[0] + protocol.seconds)
        notes.append(f"the first {protocol.seconds:g} of {whole:.0f} s are used")
    result = reconstruct(recording, mode=mode, lifter=network, calibrate=protocol.calibrate)
    save_motion(result, mode, job.folder / "motion.npz")
    facts, arrays = compared_with(clinical_angles(result.motion), truth, take, protocol.align)
    about = {
        "subject": take.subject,
        "take": take.movement,
        "kind": take.kind,
        "camera": take.camera or None,
        "notes": [*notes, *sorted(set(result.warnings))],
    }
    return JobResult(about | facts, arrays)


def compared_with(
    estimate: ClinicalAngles, truth: Truth, take: Take, aligned: bool = True
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Compare the angles of a take with its reference.

    Returns:
        Plain facts, and the arrays of `Validation.differences`.

    Raises:
        InvalidInputError: no angle is in both at the same instants.
    """
    reference, _ = opensim_angles(truth.table)
    names = [
        row.name
        for row in reference.rows
        if row.opensim.removeprefix("-") in set(truth.coordinates) & set(truth.table.names)
    ]
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
    arrays = {_DIFFERENCE + one.angle: one.difference for one in found}
    arrays |= {_SIGMA + one.angle: one.sigma for one in found if one.sigma is not None}
    facts = {
        "reference": truth.source,
        "of_sensors": truth.of_sensors,
        "clock": clock,
        "left_out": left_out,
        "methods": {"angles": {one.angle: len(one.difference) for one in found}},
    }
    return facts, arrays


def clock_shift(
    estimate: ClinicalAngles, reference: ClinicalAngles, names: Sequence[str], reach: float
) -> dict[str, Any]:
    """Return the shift of the reference's clock, ``shift_s``, ``how`` it was found, and what it rests on.

    Args:
        reach: s, largest shift that is searched.
    """
    common = [
        name
        for name in names
        if name in estimate.names and np.isfinite(estimate[name]).any() and np.isfinite(reference[name]).any()
    ]
    try:
        found = align(estimate, reference, common, reach)
    except InvalidInputError as error:
        return {"shift_s": 0.0, "how": f"as recorded: no shift was found ({error})"}
    facts = {
        "found_s": found.shift,
        "sigma_s": found.sigma,
        "agreement": found.agreement,
        "agreement_as_recorded": found.unshifted,
    }
    if found.poor:
        return facts | {"shift_s": 0.0, "how": f"as recorded: {HARDLY}"}
    how = f"estimated within {reach:g} s"
    if abs(found.shift) > 0.95 * reach:
        how += ", at the edge of what was searched"
    if found.ambiguous:
        how += f"; {found.rival:+.2f} s agrees nearly as well"
    return facts | {"shift_s": found.shift, "how": how}
