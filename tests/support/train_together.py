"""Trainings of a tiny lifter into a folder, for `test_distributed`: alone, or by two processes.

Each process writes its reports and the first windows that it drew.
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
import torch._dynamo  # loaded by the first optimiser: here once, before the processes are forked
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from lifting.training.data import plain
from lifting.training.noise import SensorConfig
from lifting.training.run import Run
from lifting.training.settings import TrainConfig
from lifting.training.train import train, workers
from rtof_kin.core.errors import RtofError

QUICK = TrainConfig(
    windows=288,
    batch=48,
    channels=12,
    skeletons=0,
    report_every=1,
    validations=2,
    validation_windows=16,
    bfloat16=False,
    same_windows=True,
    augment=replace(plain(), mirror=0.5, sensors=SensorConfig()),
)
CONFIGS = {"same": QUICK, "own": replace(QUICK, same_windows=False)}


def refuse() -> None:
    raise RtofError("as it was")


def main(folder: Path) -> None:
    """Train all of `CONFIGS`, the first one again in two parts."""
    folder.mkdir(exist_ok=True)
    rank, corpus = int(os.environ.get("RANK", "0")), support.tiny_corpus(frames=40)
    found: dict[str, list[Any]] = {}
    with workers("cpu") as team:  # connected once for all of them
        for name, config in CONFIGS.items():
            torch.manual_seed(0)
            run = Run(config, corpus, team)
            reports = []
            while run.share_done < 1:
                run.step()
                reports.append(run.report())
            found[name] = reports
        found["parts"] = []
        for windows in (96, 240):
            part = replace(QUICK, windows=windows)
            train(part, corpus, folder / "parts.pt", found["parts"].append, resume=windows > 96)
        found["refused"] = []
        for attempt in (lambda: Run(replace(QUICK, batch=47), corpus, team), lambda: team.from_first(refuse)):
            try:
                attempt()
            except RtofError as error:
                found["refused"].append(str(error))
        for name in ("same", "own"):
            drawn = Run(CONFIGS[name], corpus, team).batches(0)[0].root
            torch.save(drawn, folder / f"{name}{rank}.pt")
    (folder / f"reports{rank}.json").write_text(json.dumps(found))


def together(folder: Path) -> None:
    """The same by two processes with the environment that ``torchrun`` gives, which this one starts."""
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        run_id="together",
        max_restarts=0,
        monitor_interval=0.1,
        start_method="fork",
    )
    elastic_launch(config, main)(folder)


if __name__ == "__main__":
    together(Path(sys.argv[1]))
