"""The command evaluate: a reconstructed motion against its truth, and public data sets by their names."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Group, Parameter

from rtof_kin.cli.options import Fields, Output, Overwrite, Threads, command, written
from rtof_kin.cli.terminal import job_progress, out, print_scores, progress, say, with_zero_motion
from rtof_kin.core.choices import Space
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.markers.settings import TRIALS, MarkerSettings

if TYPE_CHECKING:
    from rtof_kin.formats.motion_views import AnyMotion
    from rtof_kin.recording.recording import RecordingSource

Movement = Literal["walk", "squat", "sit-to-stand", "arms", "floor", "other"]
Root = Annotated[Path, Parameter(metavar="DIR", help="folder of the data set")]
Json = Annotated[Path | None, Parameter(metavar="FILE", help="write all figures there as well")]

evaluate = App(name="evaluate", group_commands=Group("Public data sets"))


@evaluate.default
@command
def evaluate_motion(
    motion: Path,
    /,
    *,
    truth: Annotated[Path, Parameter(metavar="TRUTH")],
    clinical: bool = False,
    movement: Movement = "other",
    markers: Annotated[
        MarkerSettings, Fields("trials marker_set marker_table marker_person up", group="Marker trials")
    ],
    output: Annotated[Path | None, written("write the table of angles there too")] = None,
) -> None:
    """Errors of a reconstructed motion against its truth, or of the package on a public data set.

    Prints position, acceleration, jerk and angle errors, pooled and per joint, beside a predictor that never moves;
    --clinical: of clinical joint angles, as published for other systems. A public set, which is on the user's disk,
    has options of its own: rtof-kin evaluate total-capture --help

    Args:
        motion: output folder of reconstruct or run, or its motion.h5
        truth: folder of a recording with the truth; or, for clinical angles alone, an OpenSim .mot or .sto, or a marker
            trial .c3d, .trc or .npz (docs/markers.md)
        clinical: also RMSE, mean and median absolute error of clinical joint angles, beside published values
        movement: class of the movement, for that table
    """
    from rtof_kin.body.metrics import aligned_worlds, comparable
    from rtof_kin.body.metrics import evaluate as measure
    from rtof_kin.body.motion_file import MotionReader
    from rtof_kin.formats.opensim import SUFFIXES
    from rtof_kin.recording.recording import RecordingReader

    with ExitStack() as closing:
        found = closing.enter_context(MotionReader(motion))
        if truth.suffix.lower() in (*SUFFIXES, *TRIALS):
            _evaluate_angles(found, truth, movement, output, markers)
            return
        recording = closing.enter_context(RecordingReader.open(truth))
        if (known := recording.streams.truth) is None:
            raise InvalidInputError(f"{truth}: the recording has no truth to compare with")
        poses = comparable(found.poses, known, found.mode)
        moved, turn, shift = aligned_worlds(poses, known)
        skeleton = recording.facts.skeleton
        metrics, aligned = (replace(measure(p, known, skeleton), over_time={}) for p in (poses, moved))
        name = found.mode or "motion"
        print_scores(with_zero_motion(recording) | {name: metrics, f"{name}, worlds\naligned": aligned})
        say(
            f"worlds aligned: the motion is turned by {math.degrees(turn):.1f} deg about the vertical and moved "
            f"by {math.hypot(*shift):.2f} m, once for all frames; without that, its world counts as the truth's. "
            "By joint below: not aligned."
        )
        print_scores(metrics.per_joint, "joint")
        if clinical or output:
            _evaluate_angles(found, recording, movement, output, markers)


def _evaluate_angles(
    motion: AnyMotion, truth: Path | RecordingSource, movement: Movement, output: Path | None, markers: MarkerSettings
) -> None:
    """Print the errors of clinical angles, and write them if asked."""
    from rtof_kin.markers.trials import motion_of_markers
    from rtof_kin.protocols.angles import against_markers, against_opensim, against_recording
    from rtof_kin.protocols.tables import write_results
    from rtof_kin.reporting.document import show

    if isinstance(truth, Path) and truth.suffix.lower() in TRIALS:
        with progress() as update:
            trial = motion_of_markers(truth, markers, progress=partial(update, "fitting the body"))
        found = against_markers(motion, truth, trial, movement)
    elif isinstance(truth, Path):
        found = against_opensim(motion, truth, movement)
    else:
        found = against_recording(motion, truth, movement)
    show(found, out)
    if output:
        say("wrote " + ", ".join(map(str, write_results(found, output))))


def _measure(name: str, root: Path, folder: Path, json: Path | None = None, **how: Any) -> int:
    """Measure on a data set and print the tables; 1 where a take failed. `RtofError`: nothing could be measured."""
    from rtof_kin.protocols import run
    from rtof_kin.reporting.document import show

    with job_progress() as update:
        found = run(name, root, folder, progress=update, json_file=json, **how)
    show(found.document, out)
    say("wrote " + ", ".join(map(str, found.written)))
    if found.problem:
        raise RtofError(found.problem)
    return int(bool(found.outcome.failed))


@evaluate.command(name="total-capture")
@command
def total_capture(
    *,
    root: Root,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "subjects takes cameras keypoints layout noise_px sensors modes calibrate posture studies seed save",
            lifter="model",
            of="rtof_kin.protocols.total_capture:TotalCaptureProtocol",
        ),
    ],
    space: Space = "joint",
    output: Output = Path("out/total_capture"),
    json: Json = None,
    threads: Threads = None,
    overwrite: Overwrite = False,
) -> None:
    """The paper's protocol and tables on Total Capture.

    DIR is the dataset as its authors hand it out, unpacked in any layout. Every take is scored on each camera by
    itself; tables stand beside the paper's, with the rows that calibrate its acceleration and jerk errors. The same
    command resumes after an interruption.

    Args:
        space: variables of the solver; fragment length and k_V are varied in cartesian space, where they are defined
    """
    studies = space == "cartesian" and settings.get("studies", True)
    how = {**settings, "space": space, "studies": studies}
    _measure("total-capture", root, output, json, overwrite=overwrite, workers=threads, **how)


@evaluate.command
@command
def human36m(
    *,
    root: Root,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "cameras_file keypoints subjects actions cameras modes save",
            lifter="model",
            of="rtof_kin.protocols.human36m:Human36MProtocol",
        ),
    ],
    output: Output = Path("out/human36m"),
    json: Json = None,
    threads: Threads = None,
    overwrite: Overwrite = False,
) -> None:
    """The paper's protocol and table on Human3.6M.

    DIR holds the archives that VideoPose3D makes of the dataset (data_3d_h36m.npz and data_2d_h36m_gt.npz or a
    detector's). Vision alone: lift and rto, 17 joints, S9 and S11. The same command resumes after an interruption.
    """
    _measure("human36m", root, output, json, overwrite=overwrite, workers=threads, **settings)


@evaluate.command(name="validation")
@command
def own_validation(
    folder: Path,
    /,
    *,
    output: Output = Path("out/own_validation"),
    template: bool = False,
    markers: Annotated[MarkerSettings, Fields("marker_set marker_table marker_person up", group="Marker trials")],
) -> int:
    """Validation on people of your own, beside a reference.

    FOLDER has trials.csv: person, session, rater, trial, our result and its reference. OUT gets errors by joint angle
    with limits of agreement, reliability (ICC, SEM, MDC), figures and methods. Exit code 1: a trial failed.

    Args:
        folder: of the study
        template: write the protocol to print and a trials.csv to fill into FOLDER, and stop
    """
    from rtof_kin.protocols.own_study import measure, report, write_protocol
    from rtof_kin.protocols.tables import write_results
    from rtof_kin.reporting.document import show

    if template:
        say("wrote " + ", ".join(map(str, write_protocol(folder))))
        return 0
    with progress() as update:
        study = measure(folder, markers, partial(update, "comparing"))
    found = report(study)
    show(replace(found, printed=[*found.printed[:2], found.printed[-1]]), out)
    say("wrote " + ", ".join(map(str, write_results(found, output))))
    return int(bool(study.failed))


def _angles_of(dataset: str) -> Callable[..., int]:
    """Return the command that evaluates one set with a reference of joint angles."""

    @command
    def measured(
        *,
        root: Root,
        settings: Annotated[
            dict[str, Any],
            Fields(
                "takes mode keypoints calibrate align seconds",
                lifter="model",
                models="model-dir",
                size_px="size",
                of="rtof_kin.protocols.validation:ValidationProtocol",
            ),
        ],
        uncalibrated: bool = False,
        heights: Annotated[Path | None, Parameter(metavar="CSV")] = None,
        only_list: Annotated[bool, Parameter(name="--list")] = False,
        output: Output = Path("out/validation"),
        threads: Threads = None,
        overwrite: Overwrite = False,
    ) -> int:
        """Errors of joint angles on a public data set.

        The set is unpacked below DIR (layouts: docs/validate.md). Every take is set up, reconstructed and compared
        with the set's own reference; the table has RMSE, mean and median absolute error and RMSE without offset by
        joint angle and movement, beside published values of the same metric. Goes on where it was stopped. Exit code
        1: a take failed.

        Args:
            uncalibrated: without the set's calibration of the cameras, as of a phone that was put anywhere
            heights: columns subject,height_m, where the set has no heights
            only_list: print the takes and their classes, and stop
        """
        from rtof_kin.protocols.validation import CAMERAS, ValidationProtocol

        settings |= {"camera": CAMERAS[uncalibrated]} | ({"heights": _heights(heights)} if heights else {})
        if only_list:
            for take in ValidationProtocol(root, dataset, **settings).chosen:
                out.print(f"{take.key}  {take.kind}", soft_wrap=True, highlight=False)
            return 0
        return _measure(dataset, root, output, overwrite=overwrite, workers=threads, **settings)

    return measured


def _heights(path: Path) -> dict[str, float]:
    """Return the height, m, of each subject."""
    from rtof_kin.core.files.text import csv_rows

    rows = csv_rows(path, "a CSV with the columns subject,height_m", ("subject", "height_m"))
    try:
        found = {row["subject"]: float(row["height_m"]) for _, row in rows}
    except ValueError as error:
        raise FileFormatError(path, "expected the columns subject,height_m and a number in each row") from error
    for subject, height in found.items():
        if not 0.4 < height < 2.6:
            raise FileFormatError(path, f"{subject}: {height:g} is no human height in metres")
    return found


for _name in ("opencap", "vidimu", "movi", "gaitex"):
    evaluate.command(_angles_of(_name), name=_name)
