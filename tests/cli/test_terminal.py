"""What the summary says of accuracy where nothing is known of it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rtof_kin.cli import terminal


@pytest.mark.parametrize("sigma, words", [(np.nan, "unknown"), (0.01, "expected 16 mm relative")])
def test_accuracy_without_truth_is_that_of_the_covariances_or_unknown(sigma: float, words: str) -> None:
    covariance = np.full((2, 3, 3, 3), sigma)
    known = SimpleNamespace(
        position_covariance=covariance,
        relative_sigma=covariance[..., 0, 0],
        position_sigma=covariance[..., 0, 0],
    )
    assert words in terminal.accuracy(None, known, "rto")
