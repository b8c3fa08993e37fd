"""The command train: a model of lifter and pose prior."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from cyclopts import Parameter
from rich.progress import BarColumn, Progress, TextColumn

from rtof_kin.cli.options import Fields, Overwrite, command, written
from rtof_kin.cli.terminal import err, job_progress, remark, say
from rtof_kin.core.errors import InvalidInputError

if TYPE_CHECKING:
    from lifting.training.corpus import Corpus

DEFAULT_MINUTES: Final = 45.0
"""How long a lifter is trained where neither minutes nor windows are given."""
Trained = Parameter(group="What is trained")


@command
def train(
    corpus: Path | None = None,
    /,
    *,
    total_capture: Annotated[Path | None, Parameter(metavar="DIR")] = None,
    human36m: Annotated[Path | None, Parameter(metavar="DIR")] = None,
    output: Annotated[Path, written("model to write", "FILE")] = Path("model.npz"),
    resume: bool = False,
    initial: Annotated[str | None, Parameter(metavar="MODEL")] = None,
    noise: Annotated[Literal["mixed", "perfect", "realistic", "independent"], Trained] = "mixed",
    camera_at: Annotated[tuple[float, float] | None, Trained, Parameter(metavar="DISTANCE HEIGHT")] = None,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "windows minutes receptive_field channels dropout causal prior batch learning_rate weight_decay ema "
            "bfloat16 validation_windows device seed deterministic",
            of="lifting.training.settings:TrainConfig",
            group="How it is trained",
        ),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Train a model on motion capture: lifter and pose prior in one file.

    CORPUS is a folder of BVH and AMC files with an index.csv (see benchmarks/README.md), split by subject once and for
    all. Or train on a dataset that you have: Total Capture's paper split (S1-S3 without the test takes) or Human3.6M's
    (S1, S5-S8). Such weights are yours to keep, under the dataset's terms; --model takes the file in every command.
    A training ends at --windows or --minutes, after 45 minutes without either.

    Args:
        corpus: folder, or .npz made from one
        total_capture: folder of Total Capture, instead
        human36m: folder of Human3.6M's archives, instead
        resume: go on where a run was interrupted
        initial: begin with the weights of this model; a file, or a shipped one by name
        noise: 2D to train for: exact (5-7 mm better on ground truth), a real detector's, with errors of each joint
            alone, or all of these
        camera_at: one location of all virtual cameras, m, from any side; if not given, each window has its own
    """
    from lifting.training.data import augmentation
    from lifting.training.settings import TrainConfig
    from lifting.training.train import figure_file
    from lifting.training.train import train as learn

    usual: dict[str, Any] = {} if {"minutes", "windows"} & {*settings} else {"minutes": DEFAULT_MINUTES}
    config = TrainConfig(**usual, **settings, augment=augmentation(noise, camera_at))
    takes = _corpus(corpus, total_capture, human36m)
    text = "{task.fields[note]}"
    columns = TextColumn("training"), BarColumn(), TextColumn(text)
    with Progress(*columns, console=err) as progress:
        task = progress.add_task("training", total=1.0, note="")

        def update(report: Mapping[str, Any]) -> None:
            note = f"loss {report['loss_mm']:.0f} mm, {report['windows_per_second']:,.0f} windows/s"
            progress.update(task, completed=report["share_done"], note=note)
            for name, value in report.get("validation", {}).items():
                line = f"{report['windows'] / 1e6:.2f} M windows, validation, {name} 2D: "
                line += f"{value['rr_mm']:.1f} mm root-relative, {value['abs_mm']:.1f} absolute"
                progress.console.print(line)

        try:
            path = learn(config, takes, output, update, resume, initial, overwrite)
        except KeyboardInterrupt:
            remark(f"--resume continues from {output}.state; curves so far: {figure_file(output)}")
            raise
    say(f"wrote {path}")
    say(f"curves: {figure_file(path)}")


def _corpus(corpus: Path | None, total_capture: Path | None, human36m: Path | None) -> Corpus | str:
    """What to train on: a dataset's training takes, or the path of a corpus."""
    from lifting.training.corpus import human36m_corpus, total_capture_corpus

    if sum(one is not None for one in (corpus, total_capture, human36m)) != 1:
        raise InvalidInputError("train: name one of CORPUS, --total-capture DIR and --human36m DIR")
    if corpus is not None:
        return str(corpus)
    with job_progress("reading") as update:
        if total_capture is not None:
            return total_capture_corpus(total_capture, update)
        assert human36m is not None
        return human36m_corpus(human36m, update)
