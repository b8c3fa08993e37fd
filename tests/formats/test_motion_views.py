"""Markers, tree of joints, pieces and unobserved parts of a motion."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.motion_views import even_times


def test_jitter_of_stamps_is_evened_and_more_is_refused() -> None:
    times = np.arange(100) / 50
    jitter = np.random.default_rng(1).uniform(-0.00015, 0.00015, 100)
    np.testing.assert_allclose(even_times(times + jitter), times, atol=0.0002)
    times[60:] += 0.02
    with pytest.raises(InvalidInputError, match="beside even times.*resample"):
        even_times(times)
