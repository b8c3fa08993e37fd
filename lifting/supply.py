"""Batches of windows ready for the network, drawn one step ahead by a second thread where asked to."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

import torch

from lifting.data import AugmentConfig, Batch, MotionBank
from lifting.windows import EncodedWindows, encode

Supplied = tuple[Batch, EncodedWindows]


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
    ):
        """Draw nothing yet.

        Args:
            bank: where windows are drawn from.
            batch: how many in a step.
            window: frames in each.
            config: what is drawn for each.
            seed: of everything drawn.
            ahead: draw the next batch in another thread while the last one is used.
        """
        self.bank, self.size, self.window = bank, batch, window
        self.config, self.seed = config, seed
        self._pool = ThreadPoolExecutor(1, "windows") if ahead else None
        self._next: tuple[int, Future[Supplied]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
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
        generator = torch.Generator(self.bank.device)
        generator.manual_seed(step_seed(self.seed, step))
        batch = self.bank.draw(self.size, self.window, self.config, generator)
        encoded = encode(
            self.bank.body, batch.rays_world, batch.seen, batch.bones, batch.camera_height
        )
        return batch, encoded


def step_seed(seed: int, step: int) -> int:
    """The seed of one step of a training: a resumed one draws what an uninterrupted one does."""
    return seed * 1_000_003 + step
