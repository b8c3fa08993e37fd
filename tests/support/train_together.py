"""Trainings of a tiny lifter into a folder, for `test_lifting_distributed`: alone, or under ``torchrun``.

Each process writes its reports and its first windows.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import torch

from lifting.data import plain
from lifting.distributed import workers
from lifting.run import Run
from lifting.sensors import SensorConfig
from lifting.settings import TrainConfig
from lifting.train import train
from rtof_kin.core.errors import RtofError

QUICK = TrainConfig(
    windows=480, batch=48, threads=1, channels=12, skeletons=0, report_every=1, validations=2,
    validation_windows=16, bfloat16=False, same_windows=True,
    augment=replace(plain(), mirror=0.5, sensors=SensorConfig()),
)  # fmt: skip
CONFIGS = {
    "same": QUICK,
    "own": replace(QUICK, same_windows=False),
    "baseline": replace(QUICK, model="videopose3d", dropout=0.0, learning_rate=1e-3, windows=240),
}


def main(folder: Path) -> None:
    """Train all of `CONFIGS`, the first one again in two parts."""
    folder.mkdir(exist_ok=True)
    rank, corpus = int(os.environ.get("RANK", "0")), support.tiny_corpus(frames=40)
    told: dict[str, list[Any]] = {}
    with workers("cpu") as team:  # connected once for all of them
        for name, config in CONFIGS.items():
            torch.manual_seed(0)
            run = Run(config, corpus, team)
            reports = []
            while run.share_done < 1:
                run.step()
                reports.append(run.report())
            told[name] = reports
        told["parts"] = []
        for windows in (96, 240):
            part = replace(QUICK, windows=windows)
            train(part, corpus, folder / "parts.pt", told["parts"].append, resume=windows > 96)
        for batch in (47, 48):
            try:
                Run(replace(QUICK, batch=batch), corpus, team)
            except RtofError as error:
                told["refused"] = [str(error)]
        for name in ("same", "own"):
            drawn = Run(CONFIGS[name], corpus, team).supply.batch(0)[0].root
            torch.save(drawn, folder / f"{name}{rank}.pt")
    (folder / f"told{rank}.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
