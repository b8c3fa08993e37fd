"""Training of a lifter, from top to bottom.

``python -m lifting.train --corpus DIR_OR_NPZ --out FILE`` runs it alone; the command line of the
package calls `train`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from math import isfinite, log
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting import losses
from lifting.checkpoint import ACKNOWLEDGEMENT, LifterDescription, save_checkpoint
from lifting.corpus import Corpus, read_corpus
from lifting.data import AugmentConfig, MotionBank
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.supply import Supply, step_seed
from lifting.threads import torch_threads
from lifting.validation import Validation
from lifting.windows import decode
from rtof_kin.errors import FileFormatError, RtofError, ShapeError, SolverError
from rtof_kin.resources import model_path
from rtof_kin.skeleton_table import read_skeleton_table

USUAL_RADIUS = 0.4
"""RMS distance of a person's joints from their mean across the line of sight, m: where distance
estimates start."""

SKELETONS = ("skeleton", "human36m")
"""The package's skeleton tables."""

Progress = Callable[[dict[str, Any]], None]
"""Called after every `TrainConfig.report_every` steps with the step, the share done, the loss, the
windows per second, and the validation errors where they were just measured."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training. It ends at `windows` or `minutes`, whichever comes first."""

    windows: int | None = None
    """How many windows to learn from."""
    minutes: float | None = None
    """How long to train and measure, minutes; resumed time counts, reading the corpus does not."""
    filter_widths: tuple[int, ...] = (3, 3, 3)
    """Frames seen by each convolution; the product is the receptive field."""
    channels: int = 256
    """Width of the network."""
    dropout: float = 0.0
    """Share of hidden values dropped."""
    batch: int = 512
    """Windows per step."""
    learning_rate: float = 2e-3
    """Largest step of AdamW, after warm-up."""
    weight_decay: float = 0.01
    """AdamW's, per unit of learning rate."""
    warm_up: float = 0.02
    """Share of the training over which the rate rises from 0; then it falls as a cosine."""
    ema: float = 0.998
    """Memory of the running mean of the weights, per step."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    validations: int = 20
    """How often the validation subjects are measured, evenly over the training."""
    validation_windows: int = 4096
    """Windows per kind of 2D that they are measured on."""
    report_every: int = 20
    """Steps between progress reports."""
    seed: int = 0
    """Of the initial weights and everything drawn."""
    device: str = "cpu"
    """'cpu' or 'cuda'."""
    threads: int = 2
    """1: windows are drawn and learnt from in turn. 2: the next ones are drawn meanwhile. The lifter is
    the same."""
    bfloat16: bool = True
    """Multiply matrices in bfloat16."""
    skeletons: int = 12
    """How many bodies of the corpus every motion is also carried over to, besides the package's."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """What is drawn for each window."""

    def __post_init__(self) -> None:
        if self.windows is None and self.minutes is None:
            raise ShapeError("training: give a number of windows, of minutes, or both")
        positive = {
            "windows": self.windows, "minutes": self.minutes, "batch": self.batch,
            "learning_rate": self.learning_rate, "channels": self.channels, "threads": self.threads,
        }  # fmt: skip
        for name, value in positive.items():
            if value is not None and not value > 0:
                raise ShapeError(f"training: {name} is {value}; it must be positive")
        if self.threads > 2:
            raise ShapeError(f"training: {self.threads} threads; more than 2 gain nothing")


def train(
    config: TrainConfig,
    corpus: Corpus | str | Path,
    out: str | Path,
    progress: Progress | None = None,
    resume: bool = False,
) -> Path:
    """Train a lifter on the training subjects, measured on the validation subjects.

    Beside the lifter stand ``<out>.state``, from which an interrupted training goes on, and
    ``<out>.curves.json``. An exception, also one raised by `progress`, first saves the state.

    Args:
        config: settings.
        corpus: motion, or the folder or .npz file to read it from.
        out: file to write.
        progress: see `Progress`.
        resume: go on from the state file where there is one.

    Returns:
        The path of the lifter.

    Raises:
        ShapeError: the corpus has no training clip.
        SolverError: the training diverged.
        FileFormatError: the corpus or the state to resume from cannot be read.
    """
    out = Path(out)
    state_file = out.with_name(out.name + ".state")
    if not isinstance(corpus, Corpus):
        corpus = read_corpus(corpus)
    with _own_randomness(), torch_threads(1):
        run = _Run(config, corpus)
        if resume and state_file.exists():
            run.restore(state_file)
        try:
            with run.supply:
                while run.share_done < 1:
                    run.step()
                    report = run.report()
                    if report and "validation" in report:
                        run.save(state_file)
                    if report and progress:
                        progress(report)
        finally:
            run.save(state_file)
        curves = {"recipe": run.recipe(), "history": run.history}
        out.with_name(out.name + ".curves.json").write_text(json.dumps(curves, indent=1))
        return save_checkpoint(out, run.averaged, run.description())


class _Run:
    """The state of a training and one step of it."""

    def __init__(self, config: TrainConfig, corpus: Corpus):
        self.config, self.corpus, self.body = config, corpus, corpus.body()
        self.device = torch.device(config.device)
        torch.manual_seed(config.seed)
        shape = NetworkConfig(
            self.body.inputs, self.body.outputs, config.filter_widths, config.channels,
            config.dropout,
        )  # fmt: skip
        self.network = TemporalNetwork(shape).to(self.device)
        with torch.no_grad():
            self.network.shrink.bias[-1] = log(USUAL_RADIUS)
        self.averaged = TemporalNetwork(shape).to(self.device).eval()
        self.averaged.load_state_dict(self.network.state_dict())
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        others = corpus.skeletons("train", config.skeletons) + _shipped_skeleton(corpus)
        self.bank = MotionBank(corpus, corpus.clips("train"), self.device, others)
        self.validation = Validation(
            corpus, self.network.receptive_field(), self.device, config.validation_windows
        )
        self.supply = Supply(
            self.bank, config.batch, self.network.receptive_field(), config.augment, config.seed,
            ahead=config.threads > 1,
        )  # fmt: skip
        self.steps, self.seconds, self.validated = 0, 0.0, 0
        self.losses: list[Tensor] = []
        self.history: list[dict[str, Any]] = []

    @property
    def share_done(self) -> float:
        """How much of the training is over; at least 1 when it is."""
        config = self.config
        by_windows = self.steps * config.batch / config.windows if config.windows else 0.0
        by_time = self.seconds / (60 * config.minutes) if config.minutes else 0.0
        return max(by_windows, by_time)

    def step(self) -> None:
        """Learn from one batch."""
        start = time.perf_counter()
        config = self.config
        torch.manual_seed(step_seed(config.seed, self.steps))  # of dropout
        batch, encoded = self.supply.batch(self.steps)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=config.bfloat16):
            output = self.network.forward_windows(encoded.features)
        pose, root = decode(self.body, output, encoded)
        loss = losses.lifting_loss(pose, root, batch.pose, batch.root)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * _schedule(self.share_done, config.warm_up)
        self.optimizer.step()
        self._average()
        self.losses.append(loss.detach())
        self.steps += 1
        self.seconds += time.perf_counter() - start

    @torch.no_grad()
    def _average(self) -> None:
        """Running mean of weights and statistics; its memory is shorter at the beginning."""
        keep = min(self.config.ema, (1 + self.steps) / (10 + self.steps))
        mean, new = self.averaged.state_dict(), self.network.state_dict()
        floats = [k for k, v in mean.items() if v.is_floating_point()]
        torch._foreach_lerp_([mean[k] for k in floats], [new[k] for k in floats], 1 - keep)

    def report(self) -> dict[str, Any] | None:
        """What there is to say after this step, if anything."""
        config = self.config
        due = int(self.share_done * config.validations) > self.validated or self.share_done >= 1
        if not due and self.steps % config.report_every:
            return None
        loss = float(torch.stack(self.losses).mean())
        if not isfinite(loss):
            raise SolverError(
                f"training diverged after {self.steps} steps (the loss is {loss}); delete the state "
                "file and start afresh with a smaller learning rate"
            )
        report: dict[str, Any] = {
            "step": self.steps, "windows": self.steps * config.batch,
            "share_done": min(self.share_done, 1.0), "seconds": self.seconds,
            "loss_mm": 1000 * loss,
            "windows_per_second": self.steps * config.batch / max(self.seconds, 1e-9),
        }  # fmt: skip
        if due:
            self.validated = int(self.share_done * config.validations)
            start = time.perf_counter()
            report["validation"] = self.validation.measure(self.averaged)
            self.seconds += time.perf_counter() - start
            self.history.append(report)
            self.losses = []
        return report

    def recipe(self) -> dict[str, Any]:
        """The settings, and what came of them, as plain values."""
        return {
            **json.loads(json.dumps(asdict(self.config))),
            "windows_seen": self.steps * self.config.batch,
            "seconds": round(self.seconds, 1),
            "frames_of_motion": len(self.bank),
            "torch": torch.__version__.split("+")[0],
        }

    def description(self) -> LifterDescription:
        """What the lifter is, with the last errors measured."""
        errors = self.history[-1]["validation"] if self.history else {}
        return LifterDescription(
            self.body, self.network.config, self.corpus.rate_hz, self.recipe(), errors,
            self.corpus.acknowledgement or ACKNOWLEDGEMENT,
        )  # fmt: skip

    def save(self, path: Path) -> None:
        """Write what a later run needs to go on as if it had not been interrupted."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".part")
        torch.save(
            {
                "config": _fixed(self.config), "network": self.network.state_dict(),
                "averaged": self.averaged.state_dict(), "optimizer": self.optimizer.state_dict(),
                "steps": self.steps, "seconds": self.seconds, "validated": self.validated,
                "losses": [float(x) for x in self.losses], "history": self.history,
            },
            partial,
        )  # fmt: skip
        os.replace(partial, path)

    def restore(self, path: Path) -> None:
        """Go on from a state file."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            if state["config"] != _fixed(self.config):
                raise FileFormatError(
                    path, "belongs to a training with other settings; delete it or do not resume"
                )
            self.network.load_state_dict(state["network"])
            self.averaged.load_state_dict(state["averaged"])
            self.optimizer.load_state_dict(state["optimizer"])
        except RtofError:
            raise
        except Exception as error:  # torch raises many types on damaged archives
            raise FileFormatError(
                path, f"not a readable training state ({error}); delete it to start afresh"
            ) from error
        self.steps, self.seconds = state["steps"], state["seconds"]
        self.validated, self.history = state["validated"], state["history"]
        self.losses = [torch.tensor(x, device=self.device) for x in state["losses"]]


def _shipped_skeleton(corpus: Corpus) -> list[NDArray[np.float32]]:
    """Offsets of the package's skeleton that has the corpus' joints, where one has."""
    tables = [read_skeleton_table(model_path(f"{name}.toml")) for name in SKELETONS]
    joints = corpus.names, corpus.parents
    return [t.offsets.astype(np.float32) for t in tables if (t.names, t.parents) == joints]


def _schedule(share: float, warm_up: float) -> float:
    """Factor on the learning rate: linear warm-up, then a cosine to 0."""
    if share < warm_up:
        return max(share / warm_up, 0.01)
    angle = torch.pi * min((share - warm_up) / (1 - warm_up), 1.0)
    return float(0.5 * (1 + torch.cos(torch.tensor(angle))))


def _fixed(config: TrainConfig) -> str:
    """The settings that a resumed training must share; how long it lasts may change."""
    free = {"windows", "minutes", "device", "threads"}
    free |= {"report_every", "validations", "validation_windows"}
    settings = {name: value for name, value in asdict(config).items() if name not in free}
    return json.dumps(settings, sort_keys=True)


@contextmanager
def _own_randomness() -> Iterator[None]:
    """Leave torch's global random state as it was."""
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_available() else []
    with torch.random.fork_rng(devices=devices):
        yield


def main(arguments: list[str] | None = None) -> int:
    """The command line of this module alone; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m lifting.train", description=__doc__)
    parser.add_argument("--corpus", required=True, help="folder of motion capture, or .npz file")
    parser.add_argument("--out", required=True, help="lifter to write")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--minutes", type=float, help="stop after this many minutes")
    parser.add_argument("--windows", type=int, help="stop after this many windows")
    parser.add_argument("--batch", type=int, default=512, help="windows per step")
    parser.add_argument("--channels", type=int, default=256, help="width of the network")
    parser.add_argument("--dropout", type=float, default=0.0)
    parser.add_argument("--learning-rate", type=float, default=2e-3)
    parser.add_argument("--weight-decay", type=float, default=0.01)
    parser.add_argument("--ema", type=float, default=0.998)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2, help="1 or 2")
    parser.add_argument("--validation-windows", type=int, default=4096)
    parser.add_argument("--resume", action="store_true", help="go on from OUT.state")
    options = vars(parser.parse_args(arguments))
    corpus, out, resume = (options.pop(name) for name in ("corpus", "out", "resume"))
    try:
        path = train(TrainConfig(**options), corpus, out, _print_report, resume)
    except RtofError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\ninterrupted; --resume goes on from {out}.state", file=sys.stderr)
        return 130
    print(f"\nwrote {path}")
    return 0


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
