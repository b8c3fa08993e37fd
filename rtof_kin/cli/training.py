"""The command that trains a lifter."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from rtof_kin.cli.terminal import command, err, out
from rtof_kin.errors import ShapeError

if TYPE_CHECKING:
    from lifting.corpus import Corpus

DATASET_MINUTES = 28.0
"""How long a lifter is trained on a dataset where neither minutes nor windows are given."""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands, "train", _train, "train a lifter on motion capture",
        "CORPUS is a folder of BVH and AMC files with an index.csv (see benchmarks/README.md), split by "
        "subject once and for all. Or train on a dataset that you have: Total Capture's paper split "
        "(S1-S3 without the test takes) or Human3.6M's (S1, S5-S8). Such weights are yours to keep, "
        "under the dataset's terms.",
    )  # fmt: skip
    parser.add_argument("corpus", nargs="?", metavar="CORPUS", help="folder, or .npz made from one")
    parser.add_argument("--total-capture", metavar="DIR", help="folder of Total Capture, instead")
    parser.add_argument("--human36m", metavar="DIR", help="folder of Human3.6M's archives, instead")
    parser.add_argument("-o", "--output", default="lifter.pt", help="checkpoint to write")
    parser.add_argument(
        "--minutes",
        type=float,
        help=f"stop after so many; on a dataset {DATASET_MINUTES:g} if not given",
    )
    parser.add_argument("--windows", type=int, help="stop after so many windows")
    parser.add_argument("--batch", type=int, default=512, help="windows in a step")
    parser.add_argument(
        "--noise", choices=["mixed", "perfect", "realistic"], default="mixed",
        help="2D to train for: a detector's, exact (5-7 mm better on ground truth), or both",
    )  # fmt: skip
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where to train")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true", help="go on where a run was interrupted")


def _train(options: argparse.Namespace) -> None:
    from lifting.data import AugmentConfig
    from lifting.noise import training_noise
    from lifting.train import TrainConfig, train

    corpus = _corpus(options)
    minutes = options.minutes
    if minutes is None and options.windows is None and options.corpus is None:
        minutes = DATASET_MINUTES
    config = TrainConfig(
        minutes=minutes,
        windows=options.windows,
        seed=options.seed,
        device=options.device,
        batch=options.batch,
        augment=AugmentConfig(noise=training_noise(options.noise)),
    )
    text = "{task.fields[note]}"
    with Progress(TextColumn("training"), BarColumn(), TextColumn(text), console=err) as progress:
        task = progress.add_task("training", total=1.0, note="")

        def tell(report: Mapping[str, Any]) -> None:
            note = f"loss {report['loss_mm']:.0f} mm, {report['windows_per_second']:,.0f} windows/s"
            progress.update(task, completed=report["share_done"], note=note)
            for name, value in report.get("validation", {}).items():
                line = f"{report['windows'] / 1e6:.2f} M windows, validation, {name} 2D: "
                line += f"{value['rr_mm']:.1f} mm root-relative, {value['abs_mm']:.1f} absolute"
                progress.console.print(line)

        path = train(config, corpus, options.output, tell, options.resume)
    out.print(f"wrote {path}")


def _corpus(options: argparse.Namespace) -> Corpus | str:
    """What to train on: a dataset's training takes, or the path of a corpus."""
    from lifting.datasets import human36m_corpus, total_capture_corpus

    given = [x for x in (options.corpus, options.total_capture, options.human36m) if x is not None]
    if len(given) != 1:
        raise ShapeError("train: name one of CORPUS, --total-capture DIR and --human36m DIR")
    if options.corpus is not None:
        return str(options.corpus)
    with _reading() as tell:
        if options.total_capture is not None:
            return total_capture_corpus(options.total_capture, tell)
        return human36m_corpus(options.human36m, tell)


@contextmanager
def _reading() -> Iterator[Callable[[int, int, str], None]]:
    """A bar over takes, and a line for each that is left out."""
    columns = TextColumn("reading"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=err) as progress:
        task = progress.add_task("takes", total=None)

        def tell(done: int, total: int, note: str) -> None:
            progress.update(task, completed=done, total=total)
            if " skipped: " in note:
                progress.console.print(note, markup=False, soft_wrap=True)

        yield tell
