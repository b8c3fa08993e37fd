"""Two processes that train one lifter: the same curve as one, the same weights in both."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import train_together

ROOT = Path(__file__).parents[2]
Reports = dict[str, list[Any]]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders written by one process, and by two that the launcher behind ``torchrun`` started."""
    one, two = (tmp_path_factory.mktemp(name) for name in ("one", "two"))
    script = str(Path(train_together.__file__))
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    both = subprocess.Popen(
        [sys.executable, script, str(two)],
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    train_together.main(one)
    output, _ = both.communicate(timeout=300)
    assert both.returncode == 0, output
    return one, two


def reports(folder: Path, rank: int = 0) -> Reports:
    content: Reports = json.loads((folder / f"reports{rank}.json").read_text())
    return content


def curve(reports: list[Any]) -> list[float]:
    return [report["loss_mm"] for report in reports]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["same", "parts"])
def test_two_processes_have_the_loss_curve_of_one_up_to_rounding(folders: tuple[Path, Path], name: str) -> None:
    """Batch normalisation, gradients, their limit, and a resumed training's optimiser included."""
    one, two = (reports(folder)[name] for folder in folders)
    assert [r["step"] for r in one] == [r["step"] for r in two]
    assert len(one) >= 5
    np.testing.assert_allclose(curve(two), curve(one), rtol=1e-5)
    assert max(curve(one)) > 1.01 * min(curve(one))  # so that something was learnt


@pytest.mark.slow
def test_processes_report_the_same_loss_and_only_the_first_validates(folders: tuple[Path, Path]) -> None:
    first, second = reports(folders[1], 0), reports(folders[1], 1)
    for name in train_together.CONFIGS:
        assert curve(first[name]) == curve(second[name])
        assert any("validation" in report for report in first[name])
        assert not any("validation" in report for report in second[name])
    assert first["parts"]
    assert not second["parts"]
    assert (folders[1] / "parts.pt").is_file()


@pytest.mark.slow
def test_each_process_learns_from_its_own_windows(folders: tuple[Path, Path]) -> None:
    one, two = folders
    whole = torch.load(one / "same0.pt")
    parts = [torch.load(two / f"same{rank}.pt") for rank in (0, 1)]
    for rank in (0, 1):
        assert torch.equal(parts[rank], whole[rank::2])
    own = [torch.load(two / f"own{rank}.pt") for rank in (0, 1)]
    assert len(own[0]) == len(own[1]) == 24
    assert not torch.isclose(own[0], own[1]).all(dim=1).any()


@pytest.mark.slow
def test_errors_reach_all_processes_and_wrong_batches_are_refused(folders: tuple[Path, Path]) -> None:
    for rank in (0, 1):
        batch, raised = reports(folders[1], rank)["refused"]
        assert "47 windows cannot be shared evenly by 2" in batch
        assert "as it was" in raised
    assert "refused" in reports(folders[0])
