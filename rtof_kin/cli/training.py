"""The command that trains a lifter."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn

from rtof_kin.cli.terminal import command, err, out


def add_commands(commands: Any) -> None:
    parser = command(
        commands, "train", _train, "train a lifter on motion capture",
        "CORPUS is a folder of BVH and AMC files with an index.csv (see benchmarks/README.md). "
        "Subjects are split once and for all; the test subjects are never used.",
    )  # fmt: skip
    parser.add_argument("corpus", metavar="CORPUS", help="folder, or .npz made from one")
    parser.add_argument("-o", "--output", default="lifter.pt", help="checkpoint to write")
    parser.add_argument("--minutes", type=float, help="stop after this many minutes")
    parser.add_argument("--windows", type=int, help="stop after this many windows")
    parser.add_argument("--batch", type=int, default=512, help="windows in a step")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where to train")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true", help="go on where a run was interrupted")


def _train(options: argparse.Namespace) -> None:
    from lifting.train import TrainConfig, train

    config = TrainConfig(
        minutes=options.minutes,
        windows=options.windows,
        seed=options.seed,
        device=options.device,
        batch=options.batch,
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

        path = train(config, options.corpus, options.output, tell, options.resume)
    out.print(f"wrote {path}")
