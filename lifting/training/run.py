"""State of a training: one step, its report, and how it is saved and resumed."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass, replace
from math import cos, exp, isfinite, log, pi
from pathlib import Path
from typing import Any, ClassVar, Final, Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim import Adam, AdamW, Optimizer

from lifting import checkpoint
from lifting.body import Body
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.models import RAYS, VIDEOPOSE3D, model_of
from lifting.training import losses
from lifting.training.corpus import Corpus
from lifting.training.data import Batch, MotionBank
from lifting.training.distributed import Workers
from lifting.training.losses import Validation
from lifting.training.noise import SensorConfig
from lifting.training.settings import TrainConfig, prior_of_corpus
from lifting.windows import Encoded, Estimate
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, SolverError
from rtof_kin.core.resources import lifter_path, model_path

USUAL_RADIUS: Final = 0.4
"""First estimate of the RMS distance of a person's joints from their mean across the line of sight, m."""
EPOCHS: Final = 60  #: Epochs of the published training; here an epoch is this share of the training
DECAY: Final = 0.95  #: Factor on the published learning rate from epoch to epoch
MOMENTUM: Final = (0.1, 0.001)  #: Published momentum of batch normalisation in the first epoch and after the last
NEAREST: Final = 0.2  #: Least depth for the weight of a root, m


class Recipe:
    """AdamW with warm-up and cosine, clipped gradients, a running mean of the weights."""

    regularised: ClassVar[bool] = True  #: Whether gradients are clipped and weights averaged

    def __init__(self, config: TrainConfig, network: TemporalNetwork, body: Body):
        """Set the first weights and make the optimiser."""
        self.config, self.network = config, network
        self.optimizer = self._prepare(body)

    def _prepare(self, body: Body) -> Optimizer:
        with torch.no_grad():
            self.network.shrink.bias.copy_(first_answer(body))
        config = self.config
        return AdamW(self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay)

    def set_rates(self, share: float) -> None:
        """Set the learning rate after a share of the training: linear warm-up, then a cosine to 0."""
        warm_up = self.config.warm_up
        if share < warm_up:
            self._set_learning_rate(max(share / warm_up, 0.01))
        else:
            self._set_learning_rate(0.5 * (1 + cos(pi * min((share - warm_up) / (1 - warm_up), 1.0))))

    def _set_learning_rate(self, factor: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * factor

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """Return the loss to minimise."""
        return losses.lifting_loss(estimate, batch)

    def limit(self) -> None:
        """Clip the gradient."""
        if self.regularised:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)

    def memory(self, steps: int) -> float:
        """Return the factor of the running mean of the weights after a number of steps."""
        return min(self.config.ema, (1 + steps) / (10 + steps)) if self.regularised else 0.0


class Published(Recipe):
    """VideoPose3D's: Adam (amsgrad) with a rate and a momentum that fall from epoch to epoch."""

    regularised = False

    def _prepare(self, body: Body) -> Optimizer:  # noqa: ARG002, of the base
        return Adam(self.network.parameters(), self.config.learning_rate, amsgrad=True)

    def set_rates(self, share: float) -> None:
        """Set the learning rate and the momentum of batch normalisation."""
        epoch = min(int(share * EPOCHS), EPOCHS - 1)
        self._set_learning_rate(DECAY**epoch)
        first, last = MOMENTUM
        for layer in self.network.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.momentum = first * exp(-epoch / EPOCHS * log(first / last))

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """Return the mean joint distance plus that of the root weighted by 1 / depth."""
        assert batch.windows.picture is not None
        forward = batch.windows.picture.R_camera_world[:, 2]
        depth = (forward * batch.root).sum(dim=1).clamp_min(NEAREST)
        joints = losses.mean_joint_distance(estimate.pose, batch.pose)
        return (joints + losses.root_distance(estimate.root, batch.root) / depth).mean()


RECIPES: Final[Mapping[str, type[Recipe]]] = {RAYS: Recipe, VIDEOPOSE3D: Published}


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

    def __init__(self, make: Callable[[int], T], ahead: bool):
        """Prepare without computing."""
        self._make = make
        self._pool = ThreadPoolExecutor(1, "windows") if ahead else None
        self._next: tuple[int, Future[T]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool:
            self._pool.shutdown(cancel_futures=True)

    def __call__(self, step: int) -> T:
        """Return the result of a step, and begin with the next one."""
        if self._pool is None:
            return self._make(step)
        if self._next is None or self._next[0] != step:
            self._next = step, self._pool.submit(self._make, step)
        made = self._next[1].result()
        self._next = step + 1, self._pool.submit(self._make, step + 1)
        return made


def step_seed(seed: int, step: int, part: int = 0) -> int:
    """Return the seed of one step, so that a resumed training draws what an uninterrupted one does."""
    return seed * 1_000_003 + step + part * 2_654_435_761  # a CPU generator uses the lower 32 bits


def rows(batch: Any, which: slice) -> Any:
    """Select rows of the tensors (B, ...) in a dataclass, such as `Batch`, and in its dataclasses."""
    if isinstance(batch, Tensor):
        return batch[which]
    if not is_dataclass(batch) or isinstance(batch, type):
        return batch
    return replace(batch, **{f.name: rows(getattr(batch, f.name), which) for f in fields(batch)})


class Run:
    """A training in progress."""

    def __init__(self, config: TrainConfig, corpus: Corpus, workers: Workers):
        """Prepare the first step.

        Raises:
            InvalidInputError: the corpus has no training clip; processes cannot share a batch or have
                different motion or settings.
        """
        self.config, self.workers, self.digest = config, workers, corpus.digest()
        self.prior = prior_of_corpus(corpus, config.prior) if workers.first else None
        self.corpus = corpus = corpus.in_shared_frames()
        self.model, self.body = model_of(config.model), corpus.body()
        self.augment = config.augment
        if not self.model.senses:
            self.body = replace(self.body, sensors=())
            self.augment = replace(self.augment, sensors=SensorConfig(none=1.0))
        if config.batch % workers.count:
            raise InvalidInputError(
                f"training: a batch of {config.batch} windows cannot be shared evenly by "
                f"{workers.count} processes; choose a multiple"
            )
        workers.check_same("motion", self.digest)
        workers.check_same("setting", config.fixed())
        torch.manual_seed(config.seed)
        layers = config.filter_widths, config.channels, config.dropout
        shape = NetworkConfig(*self.model.sizes(self.body), *layers, config.causal, config.model)
        self.network = self.model.network(shape).to(workers.device)
        self.recipe = RECIPES[config.model](config, self.network, self.body)
        self.averaged = self.model.network(shape).to(workers.device).eval()
        self.averaged.load_state_dict(self.network.state_dict())
        self.forward = workers.forward(self.network)
        others = corpus.skeletons("train", config.skeletons) + shipped_skeleton(corpus)
        self.bank = MotionBank(corpus, corpus.clips("train"), workers.device, others)
        self.size = self.network.receptive_field()
        self.validation: Validation | None = None
        if workers.first:
            self.validation = Validation(
                corpus, self.size, workers.device, config.validation_windows, config.causal, config.model
            )
        self.batches = Prefetch(self._draw, ahead=config.threads > 1)
        self.started_from = ""
        self.steps, self.seconds, self.validated = 0, 0.0, 0
        self.losses: list[Tensor] = []
        self.history: list[dict[str, Any]] = []

    def _draw(self, step: int) -> tuple[Batch, Encoded]:
        """This process's windows of a step, which depend on the seed and the step alone."""
        config, rank, count = self.config, self.workers.rank, self.workers.count
        whole = config.same_windows
        generator = torch.Generator(self.bank.device)
        generator.manual_seed(step_seed(config.seed, step, 0 if whole else rank))
        size = config.batch if whole else config.batch // count
        batch = self.bank.draw(size, self.size, self.augment, generator, causal=config.causal)
        if whole and count > 1:
            batch = rows(batch, slice(rank, None, count))
        return batch, self.model.encode(self.bank.body, batch.windows)

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
        config, workers, recipe = self.config, self.workers, self.recipe
        torch.manual_seed(step_seed(config.seed, self.steps, workers.rank))  # of dropout
        batch, encoded = self.batches(self.steps)
        recipe.set_rates(self.share_done)
        with torch.autocast(workers.device.type, torch.bfloat16, enabled=config.bfloat16):
            output = self.forward(encoded.features, encoded.constants)
        estimate = self.model.decode(self.body, output, encoded)
        recipe.optimizer.zero_grad(set_to_none=True)
        recipe.loss(estimate, batch).backward()  # type: ignore[no-untyped-call]
        recipe.limit()
        recipe.optimizer.step()
        self._average()
        self.losses.append(losses.position_loss(estimate, batch).detach())
        self.steps += 1
        self._spend(start)

    def _spend(self, start: float) -> None:
        """Count the time since `start`, by the first process's clock."""
        seconds = self.seconds + time.perf_counter() - start
        self.seconds = self.workers.from_first(lambda: seconds)

    @torch.no_grad()
    def _average(self) -> None:
        """Update the running mean of weights and statistics."""
        keep = self.recipe.memory(self.steps)
        mean, new = self.averaged.state_dict(), self.network.state_dict()
        floats = [k for k, v in mean.items() if v.is_floating_point()]
        torch._foreach_lerp_([mean[k] for k in floats], [new[k] for k in floats], 1 - keep)

    def report(self) -> dict[str, Any] | None:
        """Return the report after this step, None if it has none; the first process validates.

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
            if self.validation is not None:
                report["validation"] = self.validation.measure(self.averaged)
                self.history.append(report)
            self._spend(start)
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
            "processes": self.workers.count,
            "torch": torch.__version__.split("+")[0],
        }

    def save_lifter(self, path: Path, overwrite: bool) -> Path:
        """Write the lifter with its last validation errors and the pose prior of its motion."""
        errors = self.history[-1]["validation"] if self.history else {}
        data = self.corpus.acknowledgement or checkpoint.ACKNOWLEDGEMENT
        description = checkpoint.LifterDescription(
            self.body, self.network.config, self.corpus.rate_hz, self.facts(), errors, data, self.prior
        )
        return checkpoint.save_checkpoint(path, self.averaged, description, overwrite)

    def save(self, path: Path) -> None:
        """Write the state that `restore` reads."""
        state = {
            "config": self.config.fixed(),
            "corpus": self.digest,
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.recipe.optimizer.state_dict(),
            "steps": self.steps,
            "seconds": self.seconds,
            "validated": self.validated,
            "losses": [float(x) for x in self.losses],
            "history": self.history,
            "started_from": self.started_from,
        }
        checkpoint.save_tensors(state, path, overwrite=True)

    def start(self, lifter: str | Path) -> None:
        """Begin with the weights of another lifter, a file or a name, see `rtof_kin.core.resources.lifter_path`.

        Raises:
            FileFormatError: it is not a lifter, or does not fit.
        """
        path = self.workers.from_first(lambda: lifter_path(lifter))
        network, description = self.workers.from_first(lambda: checkpoint.load_checkpoint(path))
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
        """Resume from a state file if the first process has one.

        Raises:
            FileFormatError: it cannot be read, or belongs to other settings or motion.
        """
        state = self.workers.from_first(lambda: self._read(path) if path.exists() else None)
        if state is None:
            return
        with _readable(path):
            self.network.load_state_dict(state["network"])
            self.averaged.load_state_dict(state["averaged"])
            self.recipe.optimizer.load_state_dict(state["optimizer"])
            self.steps, self.seconds = state["steps"], state["seconds"]
            self.validated, self.history = state["validated"], state["history"]
            self.started_from = state["started_from"]
            self.losses = [torch.tensor(x, device=self.workers.device) for x in state["losses"]]

    def _read(self, path: Path) -> dict[str, Any]:
        """Read a state file of this training."""
        with _readable(path):
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
            if state["config"] != self.config.fixed():
                raise FileFormatError(path, "belongs to a training with other settings; delete it or do not resume")
            if state["corpus"] != self.digest:
                raise FileFormatError(
                    path, "belongs to a training on other motion; give that motion, delete it or do not resume"
                )
        return state


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn errors of reading a state into a `FileFormatError`; torch raises many types."""
    try:
        yield
    except RtofError:
        raise
    except Exception as error:
        message = f"not a readable training state ({error}); delete it to start afresh"
        raise FileFormatError(path, message) from error


def shipped_skeleton(corpus: Corpus) -> list[NDArray[np.float32]]:
    """Return the joint offsets (J, 3) in shared frames of the package's skeleton with the corpus's joints,
    if there is one, m.
    """
    tables = [read_skeleton_table(model_path(f"{name}.toml")) for name in ("skeleton", "human36m")]
    joints = corpus.names, corpus.parents
    found = [t for t in tables if (t.names, t.parents) == joints]
    shared = [to_shared(shared_frames(t.names, t.offsets), t.parents, t.offsets) for t in found]
    return [offsets.astype(np.float32) for offsets in shared]
