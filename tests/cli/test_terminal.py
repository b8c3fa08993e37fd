"""What the summary says of accuracy where nothing is known of it."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.cli import terminal


@pytest.mark.parametrize("sigma, words", [(np.nan, "unknown"), (0.01, "expected 16 mm relative")])
def test_accuracy_without_truth_is_that_of_the_covariances_or_unknown(sigma: float, words: str) -> None:
    assert words in terminal.accuracy(None, (sigma, sigma), "rto")
