"""The commands report and study: how reliable a motion is, and what each sensor contributes."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from rtof_kin.cli.solver_options import add_solver_options, settings_of, use_threads
from rtof_kin.cli.terminal import add_model, add_output, command, decimal, job_progress, out, print_headline


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_report(commands)
    _add_study(commands)


# --- what they do --------------------------------------------------------------------------------


def _report(options: argparse.Namespace) -> None:
    from rtof_kin.body.motion_file import motion_folder
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.core.files.text import write_text
    from rtof_kin.recording.session import Session
    from rtof_kin.reporting.page import PAGE, report

    folder = motion_folder(options.motion)
    path = Path(options.output or folder / PAGE)
    check_new_file(path, options.overwrite)
    session = Session(**{field.name: getattr(options, field.name) for field in fields(Session)})
    write_text(path, report(folder, session, options.weight, options.sex), options.overwrite)
    out.print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB, opens in any browser", soft_wrap=True)


def _study(options: argparse.Namespace) -> None:
    use_threads(options)
    from lifting.predict import Lifter
    from rtof_kin.core.jobs import open_runs
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.document import show
    from rtof_kin.reporting.sensor_study.document import document, remove_results, unused_removed, write_study
    from rtof_kin.reporting.sensor_study.study import identity_of, number_of_runs, study_sensors

    folder, recording = Path(options.output), Recording.load(options.recording)
    camera = recording.keypoints is not None
    settings = settings_of(options, "rtof" if camera else "imu")
    greedy = {"greedy": True, "ranked": False}.get(options.path)
    lifter = Lifter.load(options.model) if camera else None
    identity = identity_of(recording, lifter, settings, options.seconds)
    runs = open_runs(folder, identity, options.overwrite, None, {})
    remove_results(folder)
    sensors = len(recording.imus.names) if recording.imus is not None else 0
    out.print(f"{sensors} sensors: at most {number_of_runs(sensors, camera, greedy)} reconstructions")
    with job_progress("study") as update, _quiet(), unused_removed(folder):
        study = study_sensors(
            recording,
            greedy=greedy,
            lifter=lifter,
            settings=settings,
            longest=options.seconds,
            folder=runs,
            workers=options.workers,
            progress=update,
        )
    print_headline(study.verdict, "all sensors: ")
    written = write_study(study, folder, not options.no_figures)
    show(document(study), out)
    out.print(f"wrote {', '.join(map(str, written))}", soft_wrap=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence warnings, which are the same at every run."""
    logger = logging.getLogger("rtof_kin")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


# --- their arguments -----------------------------------------------------------------------------


def _add_report(commands: Any) -> None:
    parser = command(
        commands,
        "report",
        _report,
        "one page of a reconstructed motion that opens in any browser",
        "MOTION is the output of reconstruct or run. The page begins with a summary; ranges of motion, "
        "curves, an animated skeleton, gait, torques, quality, the items to report of a study with inertial "
        "sensors and the audit follow. It reads on a phone and on paper, and needs no network.",
    )
    parser.add_argument("motion", metavar="MOTION", help="output folder of reconstruct or run")
    add_output(parser, "", "file to write; default: report.html beside the motion")
    labels = {
        "subject": "name or code of the subject",
        "operator": "operator",
        "date": "day of the recording, as 2026-01-31",
        "place": "place",
        "protocol": "protocol",
    }
    for name, what in labels.items():
        parser.add_argument(f"--{name}", default="", help=f"{what}; overrides the recording")
    parser.add_argument("--weight", type=decimal, metavar="KG", help="body mass, for torques; overrides the recording")
    parser.add_argument("--sex", choices=["male", "female"], help="of the tables of body mass")


def _add_study(commands: Any) -> None:
    parser = command(
        commands,
        "study",
        _study,
        "contribution of each sensor of a recording, angle by angle",
        "Reconstructs RECORDING with all its sensors, without each of them, and with fewer and fewer, "
        "the one with the smallest effect removed first. OUT gets a table, figures, and sentences on what "
        "the sensors contribute to each angle. Without a truth in the recording, the table has the "
        "difference from the full set, which is no error.",
    )
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    add_output(parser, None, "folder for results and every run: the same command resumes there after an interruption")
    parser.add_argument(
        "--path",
        choices=["greedy", "ranked"],
        help="greedy: each step tries every remaining sensor; ranked: in the order of their effect alone, "
        "with fewer runs; default: greedy up to eight sensors",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=120.0,
        metavar="S",
        help="of a longer recording, study as many seconds: those with the most movement",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes; one per core if not given")
    add_model(parser)
    add_solver_options(parser)
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")
