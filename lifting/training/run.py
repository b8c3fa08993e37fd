"""State of a training: one step, its report, and how it is saved and resumed."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from math import cos, isfinite, log, pi
from pathlib import Path
from typing import Any, Final, Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim import AdamW

from lifting import checkpoint
from lifting.body import Body
from lifting.model import FoldedNetwork, NetworkConfig
from lifting.training import losses
from lifting.training.corpus import Corpus
from lifting.training.data import Batch, MotionBank
from lifting.training.losses import Validation
from lifting.training.network import TemporalNetwork
from lifting.training.settings import TrainConfig, prior_of_corpus
from lifting.windows import EncodedWindows, decode, encode, sizes
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.errors import FileFormatError, SolverError, WritingError, reading
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.resources import lifter_path, model_path

USUAL_RADIUS: Final = 0.4
"""First estimate of the RMS distance of a person's joints from their mean across the line of sight, m."""


def first_answer(body: Body) -> Tensor:
    """Return the output (outputs,) of the first weights: upright, at a usual distance, large spread."""
    J = len(body.names)
    parts = [torch.zeros(3 * J - 1), torch.tensor([log(USUAL_RADIUS)]), torch.full((2 * J,), -2.5)]
    if body.sensors:
        upright = torch.zeros(2, 3, J)
        upright[0, 0] = upright[1, 2] = 1.0
        parts += [upright.flatten(), torch.full((J,), -1.0)]
    return torch.cat(parts)


T = TypeVar("T")


class Prefetch(Generic[T]):
    """Results of consecutive steps, each computed while the one before is used.

    torch computes without Python's lock, so a second thread makes training 1.6 times as fast on two free
    cores. Use it in a ``with`` statement, which ends the thread.
    """

    def __init__(self, make: Callable[[int], T]):
        self._make = make
        self._pool = ThreadPoolExecutor(1, "windows")
        self._next: tuple[int, Future[T]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def __call__(self, step: int) -> T:
        """Return the result of a step, and begin with the next one."""
        if self._next is None or self._next[0] != step:
            self._next = step, self._pool.submit(self._make, step)
        made = self._next[1].result()
        self._next = step + 1, self._pool.submit(self._make, step + 1)
        return made


def step_seed(seed: int, step: int) -> int:
    """Return the seed of one step, so that a resumed training draws what an uninterrupted one does."""
    return seed * 1_000_003 + step


FURTHER: Final = 0.05  #: First factor of layers that a lifter of a shorter receptive field lacks
VALIDATION_RARITY: Final = 19.0  #: Least time between two validations, in durations of one: they take 5 %
_TRAINED: Final = ("network", "averaged", "optimizer")  #: Fields of `Run` with a state of their own in the file
_COUNTED: Final = ("steps", "seconds", "validated", "history", "started_from")  #: Further fields in the file


class Run:
    """A training in progress."""

    def __init__(self, config: TrainConfig, corpus: Corpus):
        """Prepare the first step; raise `InvalidInputError` where the corpus has no training clip."""
        self.config, self.digest, self.device = config, corpus.digest(), torch.device(config.device)
        self.prior = prior_of_corpus(corpus, config.prior)
        self.corpus = corpus = corpus.in_shared_frames()
        self.body = corpus.body()
        torch.manual_seed(config.seed)
        layers = config.filter_widths, config.channels, config.dropout
        shape = NetworkConfig(*sizes(self.body), *layers, config.causal)
        self.network = TemporalNetwork(shape).to(self.device)
        with torch.no_grad():
            self.network.shrink.bias.copy_(first_answer(self.body))
        self.optimizer = AdamW(self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay)
        self.averaged = TemporalNetwork(shape).to(self.device).eval()
        self.averaged.load_state_dict(self.network.state_dict())
        others = corpus.skeletons("train", config.skeletons) + shipped_skeleton(corpus)
        self.bank = MotionBank(corpus, corpus.clips("train"), self.device, others)
        self.size = shape.receptive_field()
        self.validation = Validation(corpus, self.size, self.device, config.validation_windows, config.causal)
        self.batches = Prefetch(self._draw)
        self.started_from = ""
        self.steps, self.seconds, self.validated, self.affordable = 0, 0.0, 0, 0.0
        self.losses: list[Tensor] = []
        self.history: list[dict[str, Any]] = []

    def _draw(self, step: int) -> tuple[Batch, EncodedWindows]:
        """The windows of a step, which depend on the seed and the step alone."""
        config = self.config
        generator = torch.Generator(self.bank.device)
        generator.manual_seed(step_seed(config.seed, step))
        batch = self.bank.draw(config.batch, self.size, config.augment, generator, causal=config.causal)
        return batch, encode(self.bank.body, batch.windows)

    @property
    def share_done(self) -> float:
        """Share of the training done; at least 1 at its end."""
        config = self.config
        by_windows = self.steps * config.batch / config.windows if config.windows else 0.0
        by_time = self.seconds / (60 * config.minutes) if config.minutes else 0.0
        return max(by_windows, by_time)

    def step(self) -> None:
        """Learn from one batch."""
        start = time.perf_counter()
        config = self.config
        torch.manual_seed(step_seed(config.seed, self.steps))  # of dropout
        batch, encoded = self.batches(self.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * self._rate_factor()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=config.bfloat16):
            output = self.network(encoded.features, encoded.constants)
        estimate = decode(self.body, output.float(), encoded)
        self.optimizer.zero_grad(set_to_none=True)
        losses.lifting_loss(estimate, batch).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
        self.optimizer.step()
        self._average()
        self.losses.append(losses.position_loss(estimate, batch).detach())
        self.steps += 1
        self.seconds += time.perf_counter() - start

    def _rate_factor(self) -> float:
        """Factor on the learning rate: linear warm-up, then a cosine to 0."""
        warm_up, share = self.config.warm_up, self.share_done
        if share < warm_up:
            return max(share / warm_up, 0.01)
        return 0.5 * (1 + cos(pi * min((share - warm_up) / (1 - warm_up), 1.0)))

    @torch.no_grad()
    def _average(self) -> None:
        """Update the running mean of weights and statistics."""
        keep = min(self.config.ema, (1 + self.steps) / (10 + self.steps))
        mean, new = self.averaged.state_dict(), self.network.state_dict()
        floats = [k for k, v in mean.items() if v.is_floating_point()]
        torch._foreach_lerp_([mean[k] for k in floats], [new[k] for k in floats], 1 - keep)

    def report(self) -> dict[str, Any] | None:
        """Return the report after this step, None if it has none; `SolverError` where the training diverged."""
        config = self.config
        rare = self.seconds >= self.affordable  # validation is no more than 5 % of the time
        due = (int(self.share_done * config.validations) > self.validated and rare) or self.share_done >= 1
        if not due and self.steps % config.report_every:
            return None
        loss = float(torch.stack(self.losses).mean())
        if not isfinite(loss):
            raise SolverError(
                f"training diverged after {self.steps} steps (the loss is {loss}); delete the state "
                "file and start afresh with a smaller learning rate"
            )
        report: dict[str, Any] = {
            "step": self.steps,
            "windows": self.steps * config.batch,
            "share_done": min(self.share_done, 1.0),
            "seconds": self.seconds,
            "loss_mm": 1000 * loss,
            "windows_per_second": self.steps * config.batch / max(self.seconds, 1e-9),
        }
        if due:
            start = time.perf_counter()
            self.validated = int(self.share_done * config.validations)
            self.losses = []
            averaged = FoldedNetwork(self.body, self.averaged.config, self.averaged.state_dict())
            report["validation"] = self.validation.measure(averaged)
            self.history.append(report)
            spent = time.perf_counter() - start
            self.seconds += spent
            self.affordable = self.seconds + VALIDATION_RARITY * spent
        return report

    def facts(self) -> dict[str, Any]:
        """Return the settings and provenance of the training as plain values."""
        return {
            **json.loads(json.dumps(asdict(self.config))),
            "windows_seen": self.steps * self.config.batch,
            "seconds": round(self.seconds, 1),
            "frames_of_motion": len(self.bank),
            "corpus_sha256": self.digest,
            "started_from_sha256": self.started_from,
            "torch": torch.__version__.split("+")[0],
        }

    def save_lifter(self, path: Path, overwrite: bool) -> Path:
        """Write the lifter with its last validation errors and the pose prior of its motion."""
        errors = self.history[-1]["validation"] if self.history else {}
        data = self.corpus.acknowledgement or checkpoint.ACKNOWLEDGEMENT
        description = checkpoint.LifterDescription(
            self.body, self.network.config, self.corpus.rate_hz, self.facts(), errors, data, self.prior
        )
        return checkpoint.save_checkpoint(path, self.averaged.weights(), description, overwrite)

    def save(self, path: Path) -> None:
        """Write the state that `restore` reads."""
        state = {"config": self.config.fixed(), "corpus": self.digest, "losses": [float(x) for x in self.losses]}
        state |= {name: getattr(self, name).state_dict() for name in _TRAINED}
        save_tensors(state | {name: getattr(self, name) for name in _COUNTED}, path)

    def start(self, lifter: str | Path) -> None:
        """Begin with the weights of another lifter, a file or a name, see `rtof_kin.core.resources.lifter_path`.

        One of a shorter receptive field answers for the middle of the window; further layers start near zero beside it.
        `FileFormatError`: it is not a lifter, or does not fit.
        """
        path = lifter_path(lifter)
        weights, description = checkpoint.load_checkpoint(path)
        other = description.network
        widths, known = self.network.config.filter_widths, len(other.filter_widths)
        mine = replace(self.network.config, causal=other.causal, dropout=other.dropout, filter_widths=widths[:known])
        if other != mine or description.body.names != self.body.names:
            raise FileFormatError(
                path,
                f"a lifter of {other.channels} channels and {len(description.body.names)} joints; this training is of "
                f"{mine.channels} channels and {len(self.body.names)} joints, or of other layers or sensors: "
                "start from one that fits",
            )
        further = [f"pointwise.{layer}.norm.weight" for layer in range(known - 1, len(widths) - 1)]
        first = {name: torch.tensor(value) for name, value in weights.items()}
        for own in (self.network, self.averaged):
            own.load_state_dict(first, strict=len(widths) == known)
            for name, weight in own.named_parameters():
                if name in further:
                    nn.init.constant_(weight, FURTHER)
        self.started_from = hashlib.sha256(path.read_bytes()).hexdigest()

    def restore(self, path: Path) -> None:
        """Resume from a state file if there is one. `FileFormatError`: it cannot be read, or belongs to other settings
        or motion.
        """
        if not path.exists():
            return
        with reading(path, "not a readable training state ({}); delete it to start afresh", Exception):
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
            if state["config"] != self.config.fixed():
                raise FileFormatError(path, "belongs to a training with other settings; delete it or do not resume")
            if state["corpus"] != self.digest:
                raise FileFormatError(
                    path, "belongs to a training on other motion; give that motion, delete it or do not resume"
                )
            for name in _TRAINED:
                getattr(self, name).load_state_dict(state[name])
            for name in _COUNTED:
                setattr(self, name, state[name])
            self.losses = [torch.tensor(x, device=self.device) for x in state["losses"]]


def save_tensors(content: dict[str, Any], path: Path) -> None:
    """Write or replace a file by `torch.save`, atomically; `WritingError` where it cannot be written."""
    with new_file(path, overwrite=True) as whole:
        try:
            torch.save(content, whole)
        except RuntimeError as error:  # torch's error for a full disk
            raise WritingError(f"{path}: cannot be written ({error}); name another file") from error


def shipped_skeleton(corpus: Corpus) -> list[NDArray[np.float32]]:
    """Return the joint offsets (J, 3) in shared frames of the package's skeleton with the corpus's joints,
    if there is one, m.
    """
    tables = [read_skeleton_table(model_path(f"{name}.toml")) for name in ("skeleton", "human36m")]
    joints = corpus.names, corpus.parents
    found = [t for t in tables if (t.names, t.parents) == joints]
    shared = [to_shared(shared_frames(t.names, t.offsets), t.parents, t.offsets) for t in found]
    return [offsets.astype(np.float32) for offsets in shared]
