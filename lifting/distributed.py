"""Several processes that train one lifter together, on one machine or many, as ``torchrun`` starts them.

Every process learns from its own rows of each batch. Gradients are averaged (DistributedDataParallel)
and so are the statistics of batch normalisation, so that a batch means the same in one process and in
several. What only one shall do (measure, report, write) is done by the first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lifting.model import TemporalNetwork
from rtof_kin.core.errors import RtofError, ShapeError

T = TypeVar("T")


@dataclass(frozen=True)
class Workers:
    """The processes of a training, as one of them sees them."""

    device: torch.device
    """Where this one computes."""
    rank: int = 0
    """Which one it is."""
    count: int = 1
    """How many there are."""

    @property
    def first(self) -> bool:
        """Whether this is the one that measures, reports and writes."""
        return self.rank == 0

    def mean(self, x: Tensor) -> Tensor:
        """Mean over all processes of a tensor that each has."""
        if self.count > 1:
            x = _summed(x) / self.count
        return x

    def agree(self, value: float) -> float:
        """The first process' value, such as its time."""
        if self.count == 1:
            return value
        told = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.broadcast(told, 0)
        return float(told)

    def from_first(self, make: Callable[[], T]) -> T:
        """What the first process makes, in all of them.

        Raises:
            RtofError: raised by `make` in the first one; in the others with the same message.
        """
        if self.count == 1:
            return make()
        made: list[Any] = [None, ""]
        error: RtofError | None = None
        if self.first:
            try:
                made[0] = make()
            except RtofError as raised:
                error, made[1] = raised, str(raised)
        dist.broadcast_object_list(made, 0, device=self.device)
        if error is not None:
            raise error
        if made[1]:
            raise RtofError(made[1])
        result: T = made[0]
        return result

    def check_same(self, what: str, value: str) -> None:
        """Refuse to train together on different things.

        Raises:
            ShapeError: some process has another value.
        """
        if self.count > 1 and self.from_first(lambda: value) != value:
            raise ShapeError(
                f"training: process {self.rank} has another {what} than the first one; give all the same"
            )

    def forward(self, network: TemporalNetwork) -> nn.Module:
        """The network in its strided form, (features, constants) -> answers, learnt by all together."""
        if self.count == 1:
            return _Strided(network)
        for layer in network.modules():
            for name, part in list(layer.named_children()):
                if isinstance(part, nn.BatchNorm1d):
                    setattr(layer, name, _SharedBatchNorm.of(part, self.count))
        return DistributedDataParallel(_Strided(network))


@contextmanager
def workers(device: str) -> Iterator[Workers]:
    """The processes that ``torchrun`` started, connected: by gloo on CPUs, by nccl on GPUs, one on each.

    Args:
        device: 'cpu' or 'cuda'.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Workers(torch.device(device))
        return
    own = torch.device(device)
    if own.type == "cuda":
        own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(own)
    connect = not dist.is_initialized()
    if connect:
        dist.init_process_group("nccl" if own.type == "cuda" else "gloo")
    try:
        yield Workers(own, dist.get_rank(), count)
    finally:
        if connect:
            dist.destroy_process_group()


class _Strided(nn.Module):
    """A network whose ``forward`` is the strided form: what DistributedDataParallel hooks into."""

    def __init__(self, network: TemporalNetwork):
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        return self.network.forward_windows(features, constants)


class _SharedBatchNorm(nn.BatchNorm1d):
    """Batch normalisation by the statistics of the rows (N, C) of all processes, N in each.

    torch's SyncBatchNorm does the same on GPUs alone.
    """

    @classmethod
    def of(cls, norm: nn.BatchNorm1d, count: int) -> _SharedBatchNorm:
        """With the weights and statistics of another one, shared by so many processes."""
        shared = cls(norm.num_features, norm.eps, norm.momentum).to(norm.weight.device)
        shared.weight, shared.bias = norm.weight, norm.bias
        shared.load_state_dict(norm.state_dict())
        shared.train(norm.training)
        shared.count = count
        return shared

    count: int

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        values = x.float()
        mean = self._mean(values)
        variance = self._mean((values - mean).square())
        self._remember(mean, variance, len(x) * self.count)
        normal = (values - mean) * (variance + self.eps).rsqrt()
        out: Tensor = normal * self.weight + self.bias
        return out.to(x.dtype)

    def _mean(self, values: Tensor) -> Tensor:
        """(C,) over the rows of all processes; gradients reach all of them."""
        total: Tensor = _Sum.apply(values.mean(dim=0))  # type: ignore[no-untyped-call]
        return total / self.count

    @torch.no_grad()
    def _remember(self, mean: Tensor, variance: Tensor, rows: int) -> None:
        if self.running_mean is None or self.running_var is None or self.momentum is None:
            return
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance * (rows / max(rows - 1, 1)), self.momentum)
        if self.num_batches_tracked is not None:
            self.num_batches_tracked += 1


class _Sum(torch.autograd.Function):
    """Sum over all processes of a tensor; what any of them makes of it counts for its gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return _summed(x)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _summed(gradients[0])


def _summed(x: Tensor) -> Tensor:
    total = x.contiguous().clone()
    dist.all_reduce(total)
    return total
