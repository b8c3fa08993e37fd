from __future__ import annotations

import threading

import lifting_support as support
import pytest
import torch

from lifting.data import AugmentConfig, MotionBank
from lifting.supply import Supply, step_seed
from lifting.windows import encode


@pytest.fixture(scope="module")
def bank() -> MotionBank:
    return MotionBank(support.tiny_corpus(frames=40), [0, 1], torch.device("cpu"))


def supply(bank: MotionBank, ahead: bool, seed: int = 3, causal: bool = False) -> Supply:
    return Supply(bank, 16, 27, AugmentConfig(), seed, ahead, causal)


def test_a_batch_is_what_the_bank_draws_with_the_seed_of_its_step(bank: MotionBank) -> None:
    for causal in (False, True):
        with supply(bank, ahead=False, causal=causal) as source:
            batch, encoded = source.batch(5)
        generator = torch.Generator().manual_seed(step_seed(3, 5))
        drawn = bank.draw(16, 27, AugmentConfig(), generator, causal=causal)
        assert torch.equal(batch.windows.rays_world, drawn.windows.rays_world)
        assert torch.equal(batch.windows.axes_world, drawn.windows.axes_world)
        assert batch.windows.estimated == (26 if causal else 13)
        again = encode(bank.body, drawn.windows)
        assert torch.equal(encoded.features, again.features)
        assert torch.equal(encoded.constants, again.constants)


def test_drawn_ahead_or_not_and_in_any_order_batches_are_the_same(bank: MotionBank) -> None:
    with supply(bank, ahead=False) as plain, supply(bank, ahead=True) as ahead:
        for step in (0, 1, 2, 7, 8, 3):
            here, there = plain.batch(step), ahead.batch(step)
            assert torch.equal(here[0].pose, there[0].pose), step
            assert torch.equal(here[0].axes, there[0].axes), step
            assert torch.equal(here[1].features, there[1].features), step
            assert torch.equal(here[1].constants, there[1].constants), step


def test_steps_and_seeds_draw_different_windows(bank: MotionBank) -> None:
    with supply(bank, ahead=False) as one, supply(bank, ahead=False, seed=4) as other:
        first = one.batch(0)[0].pose
        assert not torch.equal(first, one.batch(1)[0].pose)
        assert not torch.equal(first, other.batch(0)[0].pose)


def test_an_error_of_the_other_thread_reaches_the_caller_and_the_thread_ends(bank: MotionBank) -> None:
    with pytest.raises(IndexError), supply(bank, ahead=True) as source:
        source.bank = MotionBank(support.tiny_corpus(frames=40), [0], torch.device("cpu"))
        source.bank.bones = source.bank.bones[:, :3]
        source.batch(0)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("windows")]
