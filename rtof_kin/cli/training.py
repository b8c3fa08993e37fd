"""The command that trains a lifter."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from rtof_kin.cli.terminal import command, err, out
from rtof_kin.core.errors import InvalidInputError

if TYPE_CHECKING:
    from lifting.training.corpus import Corpus
    from lifting.training.settings import TrainConfig

DEFAULT_MINUTES = 45.0
"""How long a lifter is trained where neither minutes nor windows are given."""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "train",
        _train,
        "train a model on motion capture: lifter and pose prior in one file",
        "CORPUS is a folder of BVH and AMC files with an index.csv (see benchmarks/README.md), split by "
        "subject once and for all. Or train on a dataset that you have: Total Capture's paper split "
        "(S1-S3 without the test takes) or Human3.6M's (S1, S5-S8). Such weights are yours to keep, "
        "under the dataset's terms; --model takes the file in every command. Several processes or "
        "machines: torchrun --nproc-per-node 2 -m "
        "rtof_kin.cli train ...",
    )
    parser.add_argument("corpus", nargs="?", metavar="CORPUS", help="folder, or .npz made from one")
    parser.add_argument("--total-capture", metavar="DIR", help="folder of Total Capture, instead")
    parser.add_argument("--human36m", metavar="DIR", help="folder of Human3.6M's archives, instead")
    parser.add_argument("-o", "--output", default="model.pt", help="model to write")
    parser.add_argument(
        "--minutes",
        type=float,
        help=f"stop after so many; {DEFAULT_MINUTES:g} where neither they nor windows are given",
    )
    parser.add_argument("--windows", type=int, help="stop after so many windows")
    parser.add_argument("--resume", action="store_true", help="go on where a run was interrupted")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an earlier model and the state of its training"
    )
    parser.add_argument("--start", metavar="MODEL", help="begin with its weights; a file, or a shipped one by name")
    _add_model(parser.add_argument_group("what is trained"))
    _add_how(parser.add_argument_group("how it is trained"))


def _add_model(group: Any) -> None:
    group.add_argument(
        "--network",
        dest="model",
        choices=["rays", "videopose3d"],
        default="rays",
        help="the package's own, or the baseline: VideoPose3D with its published recipe",
    )
    group.add_argument("--channels", type=int, help="width; 256, or 1024 of videopose3d, if not given")
    group.add_argument("--dropout", type=float, help="share of hidden values; 0, or 0.25 of videopose3d")
    group.add_argument("--causal", action="store_true", help="no delay: the last frame of a window is estimated")
    group.add_argument(
        "--prior",
        choices=["auto", "even", "own", "none"],
        default="auto",
        help="pose prior. own: trunk of the one rig of the corpus; even: of several rigs, a bend shared "
        "evenly by the spine; auto: own if all skeletons divide the trunk alike; none: the shipped prior",
    )
    group.add_argument(
        "--noise",
        choices=["mixed", "perfect", "realistic", "independent"],
        default="mixed",
        help="2D to train for: exact (5-7 mm better on ground truth), a real detector's, with errors of each "
        "joint alone, or all of these",
    )
    group.add_argument(
        "--camera",
        nargs=2,
        type=float,
        metavar=("DISTANCE", "HEIGHT"),
        help="one place of all virtual cameras, m, from any side; if not given, each window has its own",
    )


def _add_how(group: Any) -> None:
    group.add_argument(
        "--batch", type=int, help="windows in a step, of all processes; 512, or 1024 of videopose3d, if not given"
    )
    group.add_argument("--learning-rate", type=float, help="largest; the model's own if not given")
    group.add_argument("--weight-decay", type=float, help="of AdamW, per unit of learning rate; 0.01")
    group.add_argument("--ema", type=float, help="factor per step of the mean of the weights; 0.998")
    group.add_argument("--bfloat16", action=argparse.BooleanOptionalAction, help="multiply in bfloat16")
    group.add_argument("--validation-windows", type=int, help="of each kind of 2D; 4096")
    group.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where; of several GPUs one a process")
    group.add_argument("--threads", type=int, choices=[1, 2], default=2, help="2: draw windows while learning")
    group.add_argument("--seed", type=int, default=0, help="of everything drawn")
    group.add_argument(
        "--deterministic", action="store_true", help="the same bits every time: stop by --windows, not by the clock"
    )
    group.add_argument(
        "--same-windows",
        action="store_true",
        help="several processes learn from the very windows of one: slower, the same curves",
    )


def _train(options: argparse.Namespace) -> None:
    from lifting.training.train import figure_file, train

    config, corpus = _config(options), _corpus(options)
    text = "{task.fields[note]}"
    columns = TextColumn("training"), BarColumn(), TextColumn(text)
    with Progress(*columns, console=err, disable=not _first()) as progress:
        task = progress.add_task("training", total=1.0, note="")

        def update(report: Mapping[str, Any]) -> None:
            note = f"loss {report['loss_mm']:.0f} mm, {report['windows_per_second']:,.0f} windows/s"
            progress.update(task, completed=report["share_done"], note=note)
            for name, value in report.get("validation", {}).items():
                line = f"{report['windows'] / 1e6:.2f} M windows, validation, {name} 2D: "
                line += f"{value['rr_mm']:.1f} mm root-relative, {value['abs_mm']:.1f} absolute"
                progress.console.print(line)

        try:
            path = train(config, corpus, options.output, update, options.resume, options.start, options.overwrite)
        except KeyboardInterrupt:
            if _first():
                where = f"{options.output}.state; curves so far: {figure_file(options.output)}"
                err.print(f"--resume continues from {where}", soft_wrap=True)
            raise
    if _first():
        out.print(f"wrote {path}", soft_wrap=True)
        out.print(f"curves: {figure_file(path)}", soft_wrap=True)


def _first() -> bool:
    """Whether this is the process that prints, of those that ``torchrun`` started."""
    return os.environ.get("RANK", "0") == "0"


def _config(options: argparse.Namespace) -> TrainConfig:
    """The settings asked for."""
    from lifting.training.data import augmentation
    from lifting.training.settings import TrainConfig

    minutes = options.minutes
    if minutes is None and options.windows is None:
        minutes = DEFAULT_MINUTES
    augment = augmentation(options.noise, options.camera)
    same = (
        "model",
        "prior",
        "windows",
        "channels",
        "dropout",
        "causal",
        "batch",
        "learning_rate",
        "weight_decay",
        "ema",
        "bfloat16",
        "validation_windows",
        "device",
        "threads",
        "seed",
        "deterministic",
        "same_windows",
    )
    settings = {name: getattr(options, name) for name in same}
    return TrainConfig.for_model(**settings, minutes=minutes, augment=augment)


def _corpus(options: argparse.Namespace) -> Corpus | str:
    """What to train on: a dataset's training takes, or the path of a corpus."""
    from lifting.training.corpus import human36m_corpus, total_capture_corpus

    given = [x for x in (options.corpus, options.total_capture, options.human36m) if x is not None]
    if len(given) != 1:
        raise InvalidInputError("train: name one of CORPUS, --total-capture DIR and --human36m DIR")
    if options.corpus is not None:
        return str(options.corpus)
    with _reading() as update:
        if options.total_capture is not None:
            return total_capture_corpus(options.total_capture, update)
        return human36m_corpus(options.human36m, update)


@contextmanager
def _reading() -> Iterator[Callable[[int, int, str], None]]:
    """A bar over takes, and a line for each that is left out."""
    columns = TextColumn("reading"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=err, disable=not _first()) as progress:
        task = progress.add_task("takes", total=None)

        def update(done: int, total: int, note: str) -> None:
            progress.update(task, completed=done, total=total)
            if " skipped: " in note:
                progress.console.print(note, soft_wrap=True)

        yield update
