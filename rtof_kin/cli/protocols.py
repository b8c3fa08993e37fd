"""Commands that run a published protocol on the user's copy of a dataset."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Column
from rich.table import Table as RichTable

from rtof_kin.cli.terminal import add_model, add_output, command, job_progress, out
from rtof_kin.core.choices import SPACES

if TYPE_CHECKING:
    from rtof_kin.reporting.document import Document

_WIDEST_FIGURE = 10
"""Columns of longer cells hold text."""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_total_capture(commands)
    _add_human36m(commands)


def _total_capture(options: argparse.Namespace) -> None:
    # With both, each has folders of its own, and the JSON file gets its name.
    spaces = {space: space for space in SPACES} if options.space == "both" else {options.space: ""}
    for space, name in spaces.items():
        file = options.json and options.json.with_stem("_".join(filter(None, (options.json.stem, name))))
        measure(
            "total-capture",
            options,
            Path(options.output) / name,
            file,
            subjects=_names(options.subjects),
            **({"takes": _names(options.takes)} if options.takes else {}),
            cameras=tuple(_integers("--cameras", options.cameras)),
            keypoints=None if options.keypoints == "ground-truth" else Path(options.keypoints),
            layout=options.layout,
            noise_px=options.noise_px,
            sensors=_names(options.sensors),
            space=space,
            modes=_names(options.modes),
            lifter=options.model,
            calibrate=options.calibrate,
            posture=not options.no_posture,
            studies=space == "cartesian" and not options.no_studies,
            seed=options.seed,
            save=options.save and options.save / name,
        )


def _human36m(options: argparse.Namespace) -> None:
    measure(
        "human36m",
        options,
        Path(options.output),
        options.json,
        lifter=options.model,
        cameras_file=options.cameras_file,
        keypoints=options.keypoints,
        subjects=_names(options.subjects, str.upper),
        actions=_names(options.actions or ""),
        cameras=tuple(_integers("--cameras", options.cameras)),
        modes=_names(options.modes),
        save=options.save,
    )


def measure(
    name: str, options: argparse.Namespace, folder: Path, json_file: Path | None = None, **settings: Any
) -> dict[str, str]:
    """Measure on a data set, print the tables, and return the failures.

    Raises:
        RtofError: nothing could be measured.
    """
    from rtof_kin.core.errors import RtofError
    from rtof_kin.protocols import run

    with job_progress() as update:
        found = run(
            name,
            options.root,
            folder,
            overwrite=options.overwrite,
            workers=options.workers,
            progress=update,
            json_file=json_file,
            **settings,
        )
    print_first(found.document)
    print_tables(found.document.printed)
    out.print("wrote " + ", ".join(map(str, found.written)), soft_wrap=True)
    if found.problem:
        raise RtofError(found.problem)
    return found.outcome.failed


# --- printing ------------------------------------------------------------------------------------


def print_first(document: Document) -> None:
    """Print the headline, in red where the result may be worthless."""
    out.print(document.headline, style="bold red" if document.alarm else "bold", soft_wrap=True)


def print_tables(tables: Iterable[Any]) -> None:
    """Print tables with their notes."""
    for table in tables:
        rows = table.text()
        columns = [_column(*texts) for texts in zip(table.columns, *rows, strict=True)]
        shown = RichTable(*columns, title=table.title)
        for row in rows:
            shown.add_row(*row)
        out.print(shown, crop=False)
        for note in table.notes:
            out.print(f"  {note}", style="dim", soft_wrap=True)


def _column(heading: str, *cells: str) -> Column:
    """Column that folds text but never cuts a figure."""
    widest = max(map(len, cells), default=0)
    if widest > _WIDEST_FIGURE:
        return Column(heading, min_width=min(widest, 2 * _WIDEST_FIGURE), overflow="fold")
    words = heading.split()
    return Column("\n".join(words), justify="right", min_width=max(widest, *map(len, words)))


# --- arguments -----------------------------------------------------------------------------------


def _names(text: str, change: Callable[[str], str] = str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(change(name.strip()) for name in text.split(",") if name.strip()))


def _integers(option: str, text: str) -> list[int]:
    from rtof_kin.core.errors import InvalidInputError

    try:
        return [int(number) for number in _names(text)]
    except ValueError as error:
        raise InvalidInputError(f"{option} {text}: give numbers separated by commas") from error


def _add_run(parser: argparse.ArgumentParser, default: str, save_example: str) -> None:
    """Arguments of every protocol."""
    parser.add_argument("--save", type=Path, metavar="DIR", help=f"write {save_example} and so on")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there as well")
    parser.add_argument("--workers", type=int, metavar="N", help="processes; one per core if not given")
    add_output(
        parser,
        default,
        "folder for tables, figures and what is done so far: the same command resumes there after an interruption",
    )


def _add_total_capture(commands: Any) -> None:
    parser = command(
        commands,
        "total-capture",
        _total_capture,
        "the paper's protocol and tables on Total Capture",
        "DIR is the dataset as its authors hand it out, unpacked in any layout. Every take is scored on "
        "each camera by itself; tables stand beside the paper's, with the rows that calibrate its "
        "acceleration and jerk errors.",
    )
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="folder of the dataset")
    parser.add_argument("--subjects", default="S1,S2,S3,S4,S5", help="separated by commas")
    parser.add_argument("--takes", metavar="TAKES", help="the paper's three test takes if not given")
    parser.add_argument("--cameras", default="1,3,4,5,6,7,8", help="numbers; camera 2 is miscalibrated")
    parser.add_argument(
        "--keypoints",
        default="ground-truth",
        metavar="DIR",
        help="'ground-truth', or a folder with a detector's 2D (TC_S5_acting3_cam1.npz or .csv)",
    )
    parser.add_argument(
        "--layout",
        metavar="NAME",
        help="of the points in a detector's own files, as in a recording: auto to have it recognised, or "
        "its name, such as body25, coco17 or mediapipe33; without it they are the skeleton's landmarks",
    )
    parser.add_argument("--noise-px", type=float, default=0.0, metavar="PX", help="white noise on ground-truth 2D")
    parser.add_argument("--sensors", default="8", metavar="8|10|13|LIST", help="how many IMUs, or their names")
    parser.add_argument(
        "--space",
        choices=[*SPACES, "both"],
        default=SPACES[0],
        help="variables of the solver; fragment length and k_V are varied in cartesian space, where they are defined",
    )
    parser.add_argument("--modes", default="lift,rto,sf2,rtof", help="stages to measure")
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="calibrate every take from itself first; the paper takes its files as they are",
    )
    parser.add_argument(
        "--no-posture",
        action="store_true",
        help="do not take the subject's neutral posture from the reference's first T-pose",
    )
    parser.add_argument("--no-studies", action="store_true", help="leave out the tables of fragment length and k_V")
    add_model(parser)
    parser.add_argument("--seed", type=int, default=0, help="of all noise; same seed, same table")
    _add_run(parser, "out/total_capture", "DIR/S5/acting3/cam1/rtof/motion.h5")


def _add_human36m(commands: Any) -> None:
    parser = command(
        commands,
        "human36m",
        _human36m,
        "the paper's protocol and table on Human3.6M",
        "DIR holds the archives that VideoPose3D makes of the dataset (data_3d_h36m.npz and "
        "data_2d_h36m_gt.npz or a detector's). Vision alone: lift and rto, 17 joints, S9 and S11.",
    )
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="folder of the archives")
    add_model(parser, "of 17 joints: rtof-kin train --human36m DIR; shipped ones have 21", required=True)
    parser.add_argument(
        "--cameras-file",
        type=Path,
        metavar="FILE",
        help="camera-parameters.json or VideoPose3D's h36m_dataset.py; default: found in DIR",
    )
    parser.add_argument("--keypoints", default="gt", metavar="KIND", help="gt, cpn_ft_h36m_dbb, detectron_ft_h36m")
    parser.add_argument("--subjects", default="S9,S11", help="separated by commas")
    parser.add_argument("--actions", metavar="NAMES", help="such as Walking,Eating; all if not given")
    parser.add_argument("--cameras", default="0,1,2,3", help="numbers")
    parser.add_argument("--modes", default="lift,rto", help="stages to measure")
    _add_run(parser, "out/human36m", "DIR/S9/Walking/cam0/rto/motion.h5")
