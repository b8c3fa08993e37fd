"""Two processes that train one lifter: the same curve as one, the same weights in both."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch
import train_together
from torch import Tensor

from lifting.data import MotionBank, plain
from lifting.distributed import Workers
from lifting.supply import Supply, rows, step_seed
from rtof_kin.core.errors import RtofError

ROOT = Path(__file__).parents[2]
CPU = torch.device("cpu")
Told = dict[str, list[Any]]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """What one process and two, started by ``torchrun``, have written."""
    one, two = (tmp_path_factory.mktemp(name) for name in ("one", "two"))
    script = str(Path(train_together.__file__))
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    both = subprocess.Popen(
        [sys.executable, *launch, script, str(two)],
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    train_together.main(one)
    output, _ = both.communicate(timeout=300)
    assert both.returncode == 0, output
    return one, two


def told(folder: Path, rank: int = 0) -> Told:
    content: Told = json.loads((folder / f"told{rank}.json").read_text())
    return content


def curve(reports: list[Any]) -> list[float]:
    return [report["loss_mm"] for report in reports]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["same", "baseline", "parts"])
def test_two_processes_have_the_loss_curve_of_one_up_to_rounding(
    folders: tuple[Path, Path], name: str
) -> None:
    """Batch normalisation, gradients, their limit, and a resumed training's optimiser included."""
    one, two = (told(folder)[name] for folder in folders)
    assert [r["step"] for r in one] == [r["step"] for r in two]
    assert len(one) >= 5
    np.testing.assert_allclose(curve(two), curve(one), rtol=1e-5)
    assert max(curve(one)) > 1.01 * min(curve(one))  # so that something was learnt


@pytest.mark.slow
def test_windows_drawn_by_each_process_give_the_same_curve_within_their_noise(
    folders: tuple[Path, Path],
) -> None:
    one, two = (curve(told(folder)["own"]) for folder in folders)
    noise = np.std(np.array(curve(told(folders[0])["same"]))[:4])
    assert one != pytest.approx(two, rel=1e-3)
    assert np.mean(two) == pytest.approx(np.mean(one), abs=max(3 * noise, 0.05 * np.mean(one)))


@pytest.mark.slow
def test_both_processes_report_the_loss_of_all_and_the_first_alone_measures(
    folders: tuple[Path, Path],
) -> None:
    first, second = told(folders[1], 0), told(folders[1], 1)
    for name in train_together.CONFIGS:
        assert curve(first[name]) == curve(second[name])
        assert any("validation" in report for report in first[name])
        assert not any("validation" in report for report in second[name])
    assert first["parts"]
    assert not second["parts"]
    assert (folders[1] / "parts.pt").is_file()


@pytest.mark.slow
def test_each_process_learns_from_windows_of_its_own(folders: tuple[Path, Path]) -> None:
    one, two = folders
    whole = torch.load(one / "same0.pt")
    parts = [torch.load(two / f"same{rank}.pt") for rank in (0, 1)]
    for rank in (0, 1):
        assert torch.equal(parts[rank], whole[rank::2])
    own = [torch.load(two / f"own{rank}.pt") for rank in (0, 1)]
    assert len(own[0]) == len(own[1]) == 24
    assert not torch.isclose(own[0], own[1]).all(dim=1).any()


@pytest.mark.slow
def test_a_batch_that_cannot_be_shared_is_refused(folders: tuple[Path, Path]) -> None:
    message = "a batch of 47 windows cannot be shared evenly by 2 processes; choose a multiple"
    assert told(folders[1], 1)["refused"] == [f"training: {message}"]
    assert "refused" not in told(folders[0])


def supply(share: tuple[int, int], same: bool) -> Tensor:
    bank = MotionBank(support.tiny_corpus(frames=30), [0], CPU)
    drawn = Supply(bank, 12, 9, plain(), 5, False, share=share, same=same)
    with drawn:
        return drawn.batch(3)[1].features


def test_shares_of_the_same_windows_make_up_the_batch_of_one_process() -> None:
    whole = supply((0, 1), False)
    for part in range(3):
        torch.testing.assert_close(supply((part, 3), True), whole[part::3])


def test_shares_drawn_apart_have_seeds_of_their_own() -> None:
    assert supply((1, 3), False).shape[0] == 4
    assert not torch.equal(supply((1, 3), False), supply((2, 3), False))
    seeds = {step_seed(s, t, r) % 2**32 for s in range(3) for t in range(2000) for r in range(4)}
    assert len(seeds) == 3 * 2000 * 4


def test_rows_of_a_batch_reach_what_is_nested_in_it() -> None:
    bank = MotionBank(support.tiny_corpus(frames=30), [0], CPU)
    batch = bank.draw(6, 9, plain(), torch.Generator().manual_seed(0))
    some = rows(batch, slice(1, None, 2))
    assert len(some.root) == len(some.windows.rays_world) == len(some.windows.picture.xy) == 3
    assert torch.equal(some.windows.bones[2], batch.windows.bones[5])
    assert some.windows.estimated == batch.windows.estimated


def test_one_process_alone_asks_nobody() -> None:
    alone, x = Workers(CPU), torch.tensor([1.0, 2.0])
    assert alone.first
    assert alone.mean(x) is x
    assert alone.agree(1.5) == 1.5
    alone.check_same("motion", "whatever")
    with pytest.raises(RtofError, match="as it was"):
        alone.from_first(lambda: _refuse("as it was"))


def _refuse(why: str) -> None:
    raise RtofError(why)
