"""Training of one lifter by several processes that ``torchrun`` started, on one machine or many.

Every process learns from its share of each batch. Gradients are averaged (DistributedDataParallel), and so are the
statistics of batch normalisation, so that a batch has the same effect in one process and in several. The first process
measures, reports and writes.
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
from torch.distributed.nn.functional import all_reduce
from torch.nn.parallel import DistributedDataParallel

from lifting.model import TemporalNetwork
from rtof_kin.core.errors import InvalidInputError, RtofError

T = TypeVar("T")


@dataclass(frozen=True)
class Workers:
    """The processes of a training, seen from one of them."""

    device: torch.device  #: Device of this process
    rank: int = 0  #: Number of this process
    count: int = 1  #: Number of processes

    @property
    def first(self) -> bool:
        """Whether this process measures, reports and writes."""
        return self.rank == 0

    def mean(self, x: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes."""
        if self.count > 1:
            x = x.clone()
            dist.all_reduce(x)
        return x / self.count

    def from_first(self, make: Callable[[], T]) -> T:
        """Return the first process's result of `make` in every process.

        Raises:
            RtofError: raised by `make` in the first process; with the same message in the others.
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
        if made[1]:
            raise error or RtofError(made[1])
        result: T = made[0]
        return result

    def check_same(self, what: str, value: str) -> None:
        """Check that all processes have the same value.

        Raises:
            InvalidInputError: this process differs from the first one.
        """
        if self.from_first(lambda: value) != value:
            raise InvalidInputError(
                f"training: process {self.rank} has another {what} than the first one; give all the same"
            )

    def forward(self, network: TemporalNetwork) -> nn.Module:
        """Return a network that all processes train together."""
        if self.count == 1:
            return network
        for layer in network.modules():
            for name, part in list(layer.named_children()):
                if isinstance(part, nn.BatchNorm1d):
                    setattr(layer, name, _SharedBatchNorm(part, self.count))
        return DistributedDataParallel(network)


@contextmanager
def workers(device: str) -> Iterator[Workers]:
    """Connect the processes that ``torchrun`` started: by gloo on CPUs, by nccl with one GPU each."""
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


class _SharedBatchNorm(nn.BatchNorm1d):
    """Batch normalisation of rows (N, C) by the statistics of all processes, N rows in each.

    torch.nn.SyncBatchNorm does the same on GPUs only.
    """

    def __init__(self, norm: nn.BatchNorm1d, count: int):
        super().__init__(norm.num_features, norm.eps, norm.momentum, device=norm.weight.device)
        self.weight, self.bias, self.count = norm.weight, norm.bias, count
        self.load_state_dict(norm.state_dict())
        self.train(norm.training)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (B, C) by the mean and variance over the batches of all processes."""
        if not self.training:
            return super().forward(x)
        values, rows = x.float(), len(x) * self.count
        mean = self._mean(values)
        variance = self._mean((values - mean).square())
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (rows / max(rows - 1, 1)), self.momentum)
            self.num_batches_tracked += 1
        normal: Tensor = (values - mean) * (variance + self.eps).rsqrt()
        return (normal * self.weight + self.bias).to(x.dtype)

    def _mean(self, values: Tensor) -> Tensor:
        """(C,) mean over the rows of all processes, with gradients to all of them."""
        total: Tensor = all_reduce(values.mean(dim=0))  # type: ignore[no-untyped-call]
        return total / self.count
