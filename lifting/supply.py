"""Batches of windows ready for the network, drawn one step ahead by a second thread where asked to."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass, replace
from types import TracebackType
from typing import Any, Self

import torch
from torch import Tensor

from lifting.body import Body
from lifting.data import AugmentConfig, Batch, MotionBank
from lifting.windows import Encoded, Windows, encode

Supplied = tuple[Batch, Encoded]


class Supply:
    """The batch of each step of a training; it depends on the seed and the step alone.

    Drawing windows takes longer than learning from them, and torch computes outside of Python's lock:
    a thread that draws ahead makes training 1.6 times as fast on two free cores, and up to a tenth
    slower on busy ones. To be used in a ``with`` statement, which ends the thread.
    """

    def __init__(
        self,
        bank: MotionBank,
        batch: int,
        window: int,
        config: AugmentConfig,
        seed: int,
        ahead: bool,
        causal: bool = False,
        encode: Callable[[Body, Windows], Encoded] = encode,
        share: tuple[int, int] = (0, 1),
        same: bool = False,
    ):
        """Draw nothing yet.

        Args:
            bank: where windows are drawn from.
            batch: how many in a step.
            window: frames in each.
            config: what is drawn for each.
            seed: of everything drawn.
            ahead: draw the next batch in another thread while the last one is used.
            causal: see `MotionBank.draw`.
            encode: makes the network's input, see `Model.encode`.
            share: which of how many equal parts of each batch is wanted.
            same: draw the whole batch, and take that part of its rows; otherwise the part alone.
        """
        self.bank, self.size, self.window = bank, batch, window
        self.config, self.seed, self.causal = config, seed, causal
        self.encode, self.share, self.same = encode, share, same
        self._pool = ThreadPoolExecutor(1, "windows") if ahead else None
        self._next: tuple[int, Future[Supplied]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool:
            self._pool.shutdown(cancel_futures=True)

    def batch(self, step: int) -> Supplied:
        """The windows of a step and the network's input made of them."""
        if self._pool is None:
            return self._draw(step)
        if self._next is None or self._next[0] != step:
            self._next = step, self._pool.submit(self._draw, step)
        drawn = self._next[1].result()
        self._next = step + 1, self._pool.submit(self._draw, step + 1)
        return drawn

    def _draw(self, step: int) -> Supplied:
        generator, (part, parts) = torch.Generator(self.bank.device), self.share
        generator.manual_seed(step_seed(self.seed, step, 0 if self.same else part))
        size = self.size if self.same else self.size // parts
        batch = self.bank.draw(size, self.window, self.config, generator, causal=self.causal)
        if self.same and parts > 1:
            batch = rows(batch, slice(part, None, parts))
        return batch, self.encode(self.bank.body, batch.windows)


def step_seed(seed: int, step: int, part: int = 0) -> int:
    """The seed of one step of a training, and of each part where its batch is drawn in parts: a resumed
    one draws what an uninterrupted one does. On a CPU the lower 32 bits count.
    """
    return seed * 1_000_003 + step + part * 2_654_435_761


def rows(batch: Any, which: slice) -> Any:
    """Some rows of a dataclass of tensors (B, ...), such as a `Batch`, and of those in it."""
    if isinstance(batch, Tensor):
        return batch[which]
    if not is_dataclass(batch) or isinstance(batch, type):
        return batch
    return replace(batch, **{f.name: rows(getattr(batch, f.name), which) for f in fields(batch)})
