"""``python -m lifting --corpus DIR_OR_NPZ --out FILE``: training with every setting at hand, and torch's
launcher in front of it for several processes: ``torchrun --nproc-per-node 2 -m lifting ...``. What most
people need of it is ``rtof-kin train``.
"""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

from lifting.curves import figure_file
from lifting.data import augmentation
from lifting.models import MODELS, RAYS
from lifting.noise import TRAINING_NOISE
from lifting.settings import TrainConfig
from lifting.train import train
from rtof_kin.core.errors import RtofError


def main(arguments: list[str] | None = None) -> int:
    """Train a lifter; returns the exit code."""
    options = vars(_parser().parse_args(arguments))
    corpus, out = options.pop("corpus"), options.pop("out")
    how = {name: options.pop(name) for name in ("resume", "start", "overwrite")}
    augment = augmentation(options.pop("noise"), options.pop("camera"))
    try:
        config = TrainConfig(**options, augment=augment)
        path = train(config, corpus, out, _print_report, **how)
    except RtofError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\ninterrupted; --resume goes on from {out}.state", file=sys.stderr)
        return 130
    if os.environ.get("RANK", "0") == "0":
        print(f"\nwrote {path}, its curves {figure_file(path)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m lifting", description=__doc__)
    parser.add_argument("--corpus", required=True, help="folder of motion capture, or .npz file")
    parser.add_argument("--out", required=True, help="lifter to write")
    parser.add_argument("--model", choices=list(MODELS), default=RAYS)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--minutes", type=float, help="stop after this many minutes")
    parser.add_argument("--windows", type=int, help="stop after this many windows")
    parser.add_argument("--batch", type=int, help="windows per step; the model's own if not given")
    parser.add_argument("--channels", type=int, help="width of the network; likewise")
    parser.add_argument("--dropout", type=float, help="likewise")
    parser.add_argument("--learning-rate", type=float, help="likewise")
    parser.add_argument("--bfloat16", action=argparse.BooleanOptionalAction, help="likewise")
    parser.add_argument("--weight-decay", type=float, default=0.01)
    parser.add_argument("--ema", type=float, default=0.998)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2, help="1 or 2")
    parser.add_argument("--validation-windows", type=int, default=4096)
    parser.add_argument("--start", help="lifter whose weights are the first ones")
    parser.add_argument("--noise", choices=list(TRAINING_NOISE), default="mixed")
    parser.add_argument(
        "--camera", nargs=2, type=float, metavar=("M", "M"),
        help="one distance and height for all virtual cameras; ranges of both if not given",
    )  # fmt: skip
    parser.add_argument("--causal", action="store_true", help="estimate the last frame of a window")
    parser.add_argument("--deterministic", action="store_true", help="the same bits every time")
    parser.add_argument(
        "--same-windows", action="store_true", help="several processes: learn from one's windows"
    )
    parser.add_argument("--resume", action="store_true", help="go on from OUT.state")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT and OUT.state")
    return parser


def _print_report(report: dict[str, Any]) -> None:
    line = (
        f"{100 * report['share_done']:5.1f} %  {report['windows'] / 1e6:8.2f} M windows  "
        f"{report['windows_per_second']:9,.0f} /s  loss {report['loss_mm']:6.1f} mm"
    )
    end = "\r"
    for name, value in report.get("validation", {}).items():
        line += f"  {name} {value['rr_mm']:.1f}/{value['abs_mm']:.1f}"
        end = "\n"
    print(line, end=end, flush=True)


if __name__ == "__main__":
    sys.exit(main())
