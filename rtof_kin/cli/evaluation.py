"""The command evaluate: a reconstructed motion against its truth, and public data sets by their names."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Group, Parameter
from rich.table import Column, Table

from rtof_kin.cli.options import Fields, Output, Overwrite, Workers, command
from rtof_kin.cli.terminal import (
    SCORE_COLUMNS,
    figure_text,
    job_progress,
    out,
    print_scores,
    print_tables,
    with_zero_motion,
)
from rtof_kin.core.choices import SPACES
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError

if TYPE_CHECKING:
    from rtof_kin.body.skeleton import Motion
    from rtof_kin.recording.recording import Recording

Json = Annotated[Path | None, Parameter(metavar="FILE", help="write all figures there as well")]
_SAVED = Parameter(help="folder for the motions, as DIR/S5/acting3/cam1/rtof/motion.npz")

evaluate = App(name="evaluate", group_commands=Group("Public data sets"))


@evaluate.default
@command
def evaluate_motion(
    motion: Path,
    /,
    *,
    truth: Annotated[Path, Parameter(metavar="TRUTH")],
    clinical: bool = False,
    movement: Literal["walk", "squat", "sit-to-stand", "arms", "floor", "other"] = "other",
    output: Annotated[
        Path | None, Parameter(name=("--output", "-o"), metavar="OUT", help="write the table of angles there too")
    ] = None,
) -> None:
    """Errors of a reconstructed motion against its truth, or of the package on a public data set.

    Prints position, acceleration, jerk and angle errors, pooled and per joint, beside a predictor that never moves;
    --clinical: of clinical joint angles, as published for other systems. A public set, which is on the user's disk,
    has options of its own: rtof-kin evaluate total-capture --help

    Args:
        motion: output folder of reconstruct or run, or its motion.npz
        truth: folder of a recording with the truth, or an OpenSim .mot or .sto (angles alone)
        clinical: also RMSE, mean and median absolute error of clinical joint angles, beside published values
        movement: class of the movement, for that table
    """
    from rtof_kin.body.metrics import aligned_worlds, comparable
    from rtof_kin.body.metrics import evaluate as measure
    from rtof_kin.formats.motion_npz import motion_path, read_motion_npz
    from rtof_kin.formats.opensim_table import SUFFIXES
    from rtof_kin.recording.recording import Recording

    found = read_motion_npz(motion_path(motion))
    if truth.suffix.lower() in SUFFIXES:
        _evaluate_angles(found.motion(), truth, movement, output)
        return
    recording = Recording.load(truth)
    if recording.truth is None:
        raise InvalidInputError(f"{truth}: the recording has no truth to compare with")
    poses = comparable(found.poses, recording.truth, found.mode)
    moved, turn, shift = aligned_worlds(poses, recording.truth)
    metrics, aligned = (measure(p, recording.truth, recording.skeleton) for p in (poses, moved))
    name = found.mode or "motion"
    print_scores(with_zero_motion(recording) | {name: metrics, f"{name}, worlds\naligned": aligned})
    out.print(
        f"worlds aligned: the motion is turned by {math.degrees(turn):.1f} deg about the vertical and moved "
        f"by {math.hypot(*shift):.2f} m, once for all frames; without that, its world counts as the truth's. "
        "By joint below: not aligned.",
        soft_wrap=True,
    )
    columns = {key: label for key, label in SCORE_COLUMNS.items() if key != "coverage"}
    table = Table(Column("joint", no_wrap=True), *columns.values())
    for joint, figures in metrics.per_joint.items():
        table.add_row(joint, *(figure_text(key, figures.get(key)) for key in columns))
    out.print(table)
    if clinical or output:
        _evaluate_angles(found.motion(), recording, movement, output)


def _evaluate_angles(motion: Motion, truth: Path | Recording, movement: str, output: Path | None) -> None:
    """Print the errors of clinical angles, and write them if asked."""
    from rtof_kin.protocols.angle_evaluation import against_opensim, against_recording

    found = (against_opensim if isinstance(truth, Path) else against_recording)(motion, truth, movement)  # type: ignore[arg-type]
    out.print(found.first, style="bold", soft_wrap=True)
    print_tables(found.tables)
    if output:
        out.print("wrote " + ", ".join(map(str, found.write(output))), soft_wrap=True)


@evaluate.command(name="total-capture")
@command
def total_capture(
    *,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "root",
            "subjects",
            "takes",
            "cameras",
            "keypoints",
            "layout",
            "noise_px",
            "sensors",
            "modes",
            "calibrate",
            "posture",
            "studies",
            "seed",
            "save",
            lifter="model",
            of="rtof_kin.protocols.total_capture:TotalCaptureProtocol",
        ),
    ],
    space: Literal["joint", "cartesian", "both"] = "joint",
    output: Output = Path("out/total_capture"),
    json: Json = None,
    workers: Workers = None,
    overwrite: Overwrite = False,
) -> None:
    """The paper's protocol and tables on Total Capture.

    ROOT is the dataset as its authors hand it out, unpacked in any layout. Every take is scored on each camera by
    itself; tables stand beside the paper's, with the rows that calibrate its acceleration and jerk errors. The same
    command resumes after an interruption. SENSORS may be 8, 10 or 13, the paper's sets.

    Args:
        space: variables of the solver; fragment length and k_V are varied in cartesian space, where they are defined
    """
    from rtof_kin.body.skeleton import SkeletonModel
    from rtof_kin.protocols.total_capture import SENSOR_SETS, TotalCaptureProtocol, run
    from rtof_kin.protocols.total_capture_tables import all_tables

    given = settings.get("sensors", ())
    settings |= {"sensors": SENSOR_SETS[given[0]]} if len(given) == 1 and given[0] in SENSOR_SETS else {}
    for name, change in (("subjects", str.upper), ("takes", str.lower)):
        settings |= {name: tuple(map(change, settings[name]))} if name in settings else {}
    save, studies = settings.get("save"), settings.get("studies", True)
    # With both, each has folders of its own, and the JSON file gets its name.
    spaces = {own: own for own in SPACES} if space == "both" else {space: ""}
    files = {name: _json_file(json, output / name, name, overwrite) for name in spaces.values()}
    outcomes: list[Any] = []
    for own, name in spaces.items():
        apart = {"space": own, "studies": own == "cartesian" and studies, "save": save and save / name}
        protocol = TotalCaptureProtocol(**{**settings, **apart})
        with job_progress() as update:
            outcome = run(protocol, output / name, overwrite=overwrite, workers=workers, progress=update)
        tables = all_tables(protocol, outcome)
        _write(protocol, outcome, tables, output / name, files[name], overwrite, SkeletonModel.default(), 60.0)
        outcomes.append(outcome)
    for outcome in outcomes:
        _refuse_if_nothing(outcome)


@evaluate.command
@command
def human36m(
    *,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "root",
            "cameras_file",
            "keypoints",
            "subjects",
            "actions",
            "cameras",
            "modes",
            "save",
            lifter="model",
            of="rtof_kin.protocols.human36m:Human36MProtocol",
        ),
    ],
    output: Output = Path("out/human36m"),
    json: Json = None,
    workers: Workers = None,
    overwrite: Overwrite = False,
) -> None:
    """The paper's protocol and table on Human3.6M.

    ROOT holds the archives that VideoPose3D makes of the dataset (data_3d_h36m.npz and data_2d_h36m_gt.npz or a
    detector's). Vision alone: lift and rto, 17 joints, S9 and S11. The same command resumes after an interruption.
    """
    from rtof_kin.body.skeleton import SkeletonModel
    from rtof_kin.datasets.human36m import RATE_HZ
    from rtof_kin.protocols.human36m import Human36MProtocol, all_tables, run

    settings |= {"subjects": tuple(map(str.upper, settings["subjects"]))} if "subjects" in settings else {}
    file, protocol = _json_file(json, output, "", overwrite), Human36MProtocol(**settings)
    with job_progress() as update:
        outcome = run(protocol, output, overwrite=overwrite, workers=workers, progress=update)
    tables = all_tables(protocol, outcome)
    _write(protocol, outcome, tables, output, file, overwrite, SkeletonModel.human36m(), RATE_HZ)
    _refuse_if_nothing(outcome)


def _write(
    protocol: Any,
    outcome: Any,
    tables: Sequence[Any],
    folder: Path,
    file: Path | None,
    overwrite: bool,
    skeleton: Any,
    rate_hz: float,
) -> None:
    """Write and print the tables of a protocol."""
    from rtof_kin.core.packages import can_draw
    from rtof_kin.protocols.measures import rows_of
    from rtof_kin.protocols.tables import write_tables

    facts = {"settings": protocol.settings(), "rows": list(rows_of(outcome)), "failed": outcome.failed}
    written = write_tables(folder, tables, facts, file, overwrite)
    if can_draw():
        from rtof_kin.protocols.pictures import write_pictures

        written += write_pictures(outcome, folder / "figures", skeleton.table, rate_hz)
    print_tables(tables)
    out.print("wrote " + ", ".join(map(str, written)), soft_wrap=True)


def _json_file(file: Path | None, folder: Path, name: str, overwrite: bool) -> Path | None:
    """JSON file for all figures; one that may not be written is refused before the work."""
    from rtof_kin.protocols.tables import check_json_file

    if file is not None:
        file = file.with_name(f"{file.stem}_{name}{file.suffix}") if name else file
        check_json_file(folder, file, overwrite)
    return file


def _refuse_if_nothing(outcome: Any) -> None:
    """Raise where every job with a camera failed."""
    if outcome.failed and not any(facts["camera"] is not None for facts in outcome.done.values()):
        raise RtofError(f"nothing could be measured; first of all: {next(iter(outcome.failed.values()))}")


def _angles_of(dataset: str) -> Callable[..., int]:
    """Return the command that evaluates one set with a reference of joint angles."""

    @command
    def measured(
        *,
        settings: Annotated[
            dict[str, Any],
            Fields(
                "root",
                "takes",
                "mode",
                "keypoints",
                "calibrate",
                "align",
                "seconds",
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
        workers: Workers = None,
        overwrite: Overwrite = False,
    ) -> int:
        """Errors of joint angles on a public data set.

        The set is unpacked below ROOT (layouts: docs/validate.md). Every take is set up, reconstructed and compared
        with the set's own reference; the table has RMSE, mean and median absolute error and RMSE without offset by
        joint angle and movement, beside published values of the same metric. Goes on where it was stopped. Exit code
        1: a take failed.

        Args:
            uncalibrated: without the set's calibration of the cameras, as of a phone that was put anywhere
            heights: columns subject,height_m, where the set has no heights
            only_list: print the takes and their classes, and stop
        """
        from rtof_kin.protocols.validation import CAMERAS, ValidationProtocol, run
        from rtof_kin.protocols.validation_tables import write_validation

        settings |= {"camera": CAMERAS[uncalibrated]} | ({"heights": _heights(heights)} if heights else {})
        protocol = ValidationProtocol(dataset, **settings)
        if only_list:
            for take in protocol.chosen():
                out.print(f"{take.key}  {take.kind}", soft_wrap=True, highlight=False)
            return 0
        with job_progress() as update:
            found = run(protocol, output, overwrite=overwrite, workers=workers, progress=update)
        first, tables, written = write_validation(output, protocol, found)
        alarming = found.outcome.failed or "NOT ACC" in first or "IN DOUBT" in first
        out.print(first, style="bold red" if alarming else "bold", soft_wrap=True)
        if not found.outcome.done:
            reason = next(iter(found.outcome.failed.values()), "")
            raise RtofError(f"no take could be measured; first of all: {reason}")
        print_tables(tables)
        out.print("wrote " + ", ".join(map(str, written)), soft_wrap=True)
        return int(bool(found.outcome.failed))

    return measured


def _heights(path: Path) -> dict[str, float]:
    """Return the height, m, of each subject."""
    from rtof_kin.core.files.text import read_text

    rows = list(csv.DictReader(read_text(path, "a CSV with the columns subject,height_m").splitlines()))
    try:
        found = {row["subject"].strip(): float(row["height_m"]) for row in rows}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(path, "expected the columns subject,height_m and a number in each row") from error
    for subject, height in found.items():
        if not 0.4 < height < 2.6:
            raise FileFormatError(path, f"{subject}: {height:g} is no human height in metres")
    return found


for _name in ("opencap", "vidimu", "movi", "gaitex"):
    evaluate.command(_angles_of(_name), name=_name)
