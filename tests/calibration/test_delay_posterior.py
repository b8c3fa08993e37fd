"""The posterior of a delay on a grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.result import Verdict
from rtof_kin.calibration.sequential import DelayPosterior, LateSensors, Sensors

Array = NDArray[np.float64]
TIMES = 5.0 + np.arange(40) / 60
USUAL = 0.05


def clock(times: Array) -> Sensors:
    """Sensors that measure the time."""
    return times[:, None], np.ones((len(times), 1)), times[:, None], np.ones((len(times), 1))


def told(posterior: DelayPosterior, energy: Callable[[Array], Array], rate_hz: float = 60.0) -> LateSensors:
    """Tell the posterior the energy of every delay."""
    late = posterior.around(TIMES, rate_hz, clock)
    delays = np.array([TIMES[0] - late.sensors(k)[0][0, 0] for k in late.steps])
    posterior.add(posterior.interpolated(late, energy(delays)), 1.0)
    posterior.estimate(1.0)
    return late


@pytest.mark.parametrize("delay", [0.0, 0.04, -0.06])
def test_sensors_are_those_at_the_stamps_less_the_delay(delay: float) -> None:
    late = DelayPosterior(USUAL, delay, USUAL).around(TIMES, 60.0, clock)
    np.testing.assert_allclose(late.sensors(0)[0][:, 0], TIMES - delay)
    np.testing.assert_allclose(late.sensors(1)[0][:, 0], TIMES - delay - late.step)
    tried = delay + late.step * late.steps
    assert tried[0] < delay - 2 * USUAL < delay + 2 * USUAL < tried[-1]
    assert len(late.sensors(int(late.steps[0]))[1]) == len(late.sensors(int(late.steps[-1]))[1]) == 40


def test_slow_videos_are_searched_between_frames() -> None:
    times = 5.0 + np.arange(10) / 10
    late = DelayPosterior(USUAL, 0.0, USUAL).around(times, 10.0, clock)
    assert late.step <= USUAL / 3
    np.testing.assert_allclose(late.sensors(3)[0][:, 0], times - 3 * late.step)


def test_moments_are_those_of_a_parabola() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: 0.5 * ((d - 0.03) / 0.01) ** 2)
    precision = 1 / 0.01**2 + 1 / USUAL**2
    assert posterior.delay == pytest.approx(0.03 / 0.01**2 / precision, abs=2e-4)
    assert posterior.sigma == pytest.approx(precision**-0.5, rel=0.03)
    assert posterior.quantity.verdict is Verdict.OBSERVED


def test_two_likely_delays_are_no_known_delay() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: 2e4 * np.abs(np.abs(d) - 0.05))
    assert posterior.sigma > 0.04
    assert posterior.quantity.verdict is Verdict.PRIOR


def test_a_delay_beyond_the_search_is_in_doubt() -> None:
    posterior = DelayPosterior(USUAL, 0.0, USUAL)
    told(posterior, lambda d: -1e4 * d)
    assert posterior.quantity.verdict is Verdict.DOUBTFUL


def test_a_saved_delay_that_is_wrong_is_forgotten() -> None:
    posterior = DelayPosterior(USUAL, -0.05, USUAL / 2)
    for _ in range(2):
        told(posterior, lambda d: 0.5 * ((d - 0.04) / 0.005) ** 2)
    assert posterior.delay == pytest.approx(0.04, abs=2e-3)
    assert posterior.quantity.verdict is Verdict.OBSERVED


def test_every_delay_counts_the_same_samples() -> None:
    """A gap that only some delays see would favour these."""

    def until(times: Array) -> Sensors:
        q, w, a, _ = clock(times)
        known = (times < TIMES[-5])[:, None].astype(float)
        return q, known * w, a, known * w

    late = DelayPosterior(USUAL, 0.0, USUAL).around(TIMES, 60.0, until)
    first, last = (late.sensors(int(k)) for k in late.steps[[0, -1]])
    np.testing.assert_array_equal(first[1], last[1])
    np.testing.assert_array_equal(first[3], last[3])
    assert 0 < first[1].sum() < len(TIMES) - 4
