from __future__ import annotations

import threading

import lifting_support as support
import pytest
import torch

from lifting.training.data import MotionBank, plain
from lifting.training.run import Prefetch, rows, step_seed


@pytest.mark.parametrize("ahead", [True, False])
def test_results_are_those_of_their_steps_in_any_order(ahead: bool) -> None:
    made: list[int] = []

    def square(step: int) -> int:
        made.append(step)
        return step * step

    with Prefetch(square, ahead) as prefetch:
        assert [prefetch(step) for step in (0, 1, 2, 7, 8, 3)] == [0, 1, 4, 49, 64, 9]
    assert made[:8] == ([0, 1, 2, 3, 7, 8, 9, 3] if ahead else [0, 1, 2, 7, 8, 3])


def test_an_error_of_the_second_thread_reaches_the_caller_and_the_thread_ends() -> None:
    with pytest.raises(ZeroDivisionError), Prefetch(lambda step: 1 // step, ahead=True) as prefetch:
        prefetch(0)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("windows")]


def test_every_step_and_part_has_its_own_seed() -> None:
    seeds = {step_seed(s, t, r) % 2**32 for s in range(3) for t in range(2000) for r in range(4)}
    assert len(seeds) == 3 * 2000 * 4


def test_rows_are_selected_in_nested_dataclasses() -> None:
    bank = MotionBank(support.tiny_corpus(frames=30), [0], torch.device("cpu"))
    batch = bank.draw(6, 9, plain(), torch.Generator().manual_seed(0))
    some = rows(batch, slice(1, None, 2))
    assert len(some.root) == len(some.windows.rays_world) == len(some.windows.picture.xy) == 3
    assert torch.equal(some.windows.bones[2], batch.windows.bones[5])
    assert some.windows.estimated == batch.windows.estimated
