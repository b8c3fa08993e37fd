"""The state of a training: one step of it, what it reports, and how it is kept and taken up again."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting import losses
from lifting.checkpoint import (
    ACKNOWLEDGEMENT,
    LifterDescription,
    load_checkpoint,
    save_checkpoint,
    save_tensors,
)
from lifting.corpus import Corpus
from lifting.data import MotionBank
from lifting.distributed import Workers
from lifting.model import NetworkConfig
from lifting.models import model_of
from lifting.recipes import RECIPES
from lifting.sensors import SensorConfig
from lifting.settings import TrainConfig
from lifting.supply import Supply, step_seed
from lifting.validation import Validation
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.errors import FileFormatError, RtofError, ShapeError, SolverError
from rtof_kin.core.resources import lifter_path, model_path

SKELETONS = ("skeleton", "human36m")
"""The package's skeleton tables."""


class Run:
    """A training in progress."""

    def __init__(self, config: TrainConfig, corpus: Corpus, workers: Workers):
        """Begin.

        Raises:
            ShapeError: the corpus has no training clip; a batch cannot be shared out; processes that
                train together have different motion or settings.
        """
        self.config, self.corpus, self.workers = config, corpus, workers
        self.model, self.recipe = model_of(config.model), RECIPES[config.model](config)
        self.body = corpus.body()
        if not self.model.senses:
            self.body = replace(self.body, sensors=())
        self.digest = corpus.digest()
        self._check_together()
        torch.manual_seed(config.seed)
        shape = NetworkConfig(
            *self.model.sizes(self.body), config.filter_widths, config.channels, config.dropout,
            config.causal, config.model,
        )  # fmt: skip
        self.network = self.model.network(shape).to(workers.device)
        self.recipe.prepare(self.network, self.body)
        self.averaged = self.model.network(shape).to(workers.device).eval()
        self.averaged.load_state_dict(self.network.state_dict())
        self.forward = workers.forward(self.network)
        self.optimizer = self.recipe.optimizer(self.network)
        self._prepare_windows()
        self.started_from = ""
        self.steps, self.seconds, self.validated = 0, 0.0, 0
        self.losses: list[Tensor] = []
        self.history: list[dict[str, Any]] = []

    def _check_together(self) -> None:
        config, workers = self.config, self.workers
        if config.batch % workers.count:
            raise ShapeError(
                f"training: a batch of {config.batch} windows cannot be shared evenly by "
                f"{workers.count} processes; choose a multiple"
            )
        workers.check_same("motion", self.digest)
        workers.check_same("setting", config.fixed())

    def _prepare_windows(self) -> None:
        config, corpus, workers = self.config, self.corpus, self.workers
        augment, size = config.augment, self.network.receptive_field()
        if not self.model.senses:
            augment = replace(augment, sensors=SensorConfig(none=1.0))
        others = corpus.skeletons("train", config.skeletons) + shipped_skeleton(corpus)
        self.bank = MotionBank(corpus, corpus.clips("train"), workers.device, others)
        self.validation: Validation | None = None
        if workers.first:
            self.validation = Validation(
                corpus, size, workers.device, config.validation_windows, config.causal, config.model
            )
        self.supply = Supply(
            self.bank, config.batch, size, augment, config.seed, config.threads > 1, config.causal,
            self.model.encode, (workers.rank, workers.count), config.same_windows,
        )  # fmt: skip

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
        config, workers = self.config, self.workers
        torch.manual_seed(step_seed(config.seed, self.steps, workers.rank))  # of dropout
        batch, encoded = self.supply.batch(self.steps)
        self.recipe.set_rates(self.network, self.optimizer, self.share_done)
        with torch.autocast(workers.device.type, torch.bfloat16, enabled=config.bfloat16):
            output = self.forward(encoded.features, encoded.constants)
        estimate = self.model.decode(self.body, output, encoded)
        self.optimizer.zero_grad(set_to_none=True)
        self.recipe.loss(estimate, batch).backward()  # type: ignore[no-untyped-call]
        self.recipe.limit(self.network)
        self.optimizer.step()
        self._average()
        self.losses.append(losses.position_loss(estimate, batch).detach())
        self.steps += 1
        self.seconds = workers.agree(self.seconds + time.perf_counter() - start)

    @torch.no_grad()
    def _average(self) -> None:
        """Running mean of weights and statistics."""
        keep = self.recipe.memory(self.steps)
        mean, new = self.averaged.state_dict(), self.network.state_dict()
        floats = [k for k, v in mean.items() if v.is_floating_point()]
        torch._foreach_lerp_([mean[k] for k in floats], [new[k] for k in floats], 1 - keep)

    def report(self) -> dict[str, Any] | None:
        """What there is to say after this step, if anything; the validation by the first process.

        Raises:
            SolverError: the training diverged.
        """
        config = self.config
        due = int(self.share_done * config.validations) > self.validated or self.share_done >= 1
        if not due and self.steps % config.report_every:
            return None
        loss = float(self.workers.mean(torch.stack(self.losses).mean()))
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
            self._validate(report)
            self.losses = []
        return report

    def _validate(self, report: dict[str, Any]) -> None:
        """Measure, and keep the report."""
        start = time.perf_counter()
        if self.validation is not None:
            report["validation"] = self.validation.measure(self.averaged)
            self.history.append(report)
        self.seconds = self.workers.agree(self.seconds + time.perf_counter() - start)

    def facts(self) -> dict[str, Any]:
        """The settings, and what came of them, as plain values."""
        return {
            **json.loads(json.dumps(asdict(self.config))),
            "windows_seen": self.steps * self.config.batch,
            "seconds": round(self.seconds, 1),
            "frames_of_motion": len(self.bank),
            "corpus_sha256": self.digest,
            "started_from_sha256": self.started_from,
            "processes": self.workers.count,
            "torch": torch.__version__.split("+")[0],
        }

    def save_lifter(self, path: Path, overwrite: bool) -> Path:
        """Write the lifter, with the last errors measured."""
        errors = self.history[-1]["validation"] if self.history else {}
        description = LifterDescription(
            self.body, self.network.config, self.corpus.rate_hz, self.facts(), errors,
            self.corpus.acknowledgement or ACKNOWLEDGEMENT,
        )  # fmt: skip
        return save_checkpoint(path, self.averaged, description, overwrite)

    def save(self, path: Path) -> None:
        """Write what a later run needs to go on as if it had not been interrupted."""
        save_tensors(
            {
                "config": self.config.fixed(), "corpus": self.digest,
                "network": self.network.state_dict(), "averaged": self.averaged.state_dict(),
                "optimizer": self.optimizer.state_dict(), "steps": self.steps,
                "seconds": self.seconds, "validated": self.validated,
                "losses": [float(x) for x in self.losses], "history": self.history,
                "started_from": self.started_from,
            },
            path, overwrite=True,
        )  # fmt: skip

    def start(self, lifter: str | Path) -> None:
        """Begin with the weights of another lifter, see `rtof_kin.core.resources.lifter_path`.

        Raises:
            FileFormatError: it is none, or does not fit.
        """
        path = self.workers.from_first(lambda: lifter_path(lifter))
        network, description = self.workers.from_first(lambda: load_checkpoint(path))
        other = description.network
        mine = replace(self.network.config, causal=other.causal, dropout=other.dropout)
        if other != mine or description.body.names != self.body.names:
            raise FileFormatError(
                path,
                f"a {other.model} lifter of {other.channels} channels and {len(description.body.names)} "
                f"joints; this training is of {mine.model}, {mine.channels} channels and "
                f"{len(self.body.names)} joints, or of other layers or sensors: start from one that fits",
            )
        for own in (self.network, self.averaged):
            own.load_state_dict(network.state_dict())
        self.started_from = self.workers.from_first(lambda: hashlib.sha256(path.read_bytes()).hexdigest())

    def restore(self, path: Path) -> None:
        """Go on from a state file, where the first process has one.

        Raises:
            FileFormatError: it cannot be read, or belongs to other settings or motion.
        """
        state = self.workers.from_first(lambda: self._read(path) if path.exists() else None)
        if state is None:
            return
        try:
            self.network.load_state_dict(state["network"])
            self.averaged.load_state_dict(state["averaged"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.steps, self.seconds = state["steps"], state["seconds"]
            self.validated, self.history = state["validated"], state["history"]
            self.started_from = state["started_from"]
            self.losses = [torch.tensor(x, device=self.workers.device) for x in state["losses"]]
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise FileFormatError(
                path, f"not a readable training state ({error}); delete it to start afresh"
            ) from error

    def _read(self, path: Path) -> dict[str, Any]:
        """The contents of a state file of this training."""
        try:
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
            if state["config"] != self.config.fixed():
                raise FileFormatError(
                    path, "belongs to a training with other settings; delete it or do not resume"
                )
            if state["corpus"] != self.digest:
                raise FileFormatError(
                    path,
                    "belongs to a training on other motion; give the motion it began with, delete it, "
                    "or do not resume",
                )
        except RtofError:
            raise
        except Exception as error:  # torch raises many types on damaged archives
            raise FileFormatError(
                path, f"not a readable training state ({error}); delete it to start afresh"
            ) from error
        return state


def shipped_skeleton(corpus: Corpus) -> list[NDArray[np.float32]]:
    """Offsets of the package's skeleton that has the corpus' joints, where one has."""
    tables = [read_skeleton_table(model_path(f"{name}.toml")) for name in SKELETONS]
    joints = corpus.names, corpus.parents
    return [t.offsets.astype(np.float32) for t in tables if (t.names, t.parents) == joints]
