"""The shift between two clocks: planted shifts, uncertainty, other and periodic movements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import walk
from comparison_support import angles_of
from numpy.typing import NDArray

from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.comparison_samples import align
from rtof_kin.core.errors import InvalidInputError

NAMES = ("right_knee_flexion", "left_knee_flexion", "right_hip_flexion", "right_elbow_flexion")
TIMES = np.arange(600) / 60


def random_movement(seed: int) -> NDArray[np.float64]:
    return 20 * planted.smooth_noise(seed, (600, len(NAMES)), 12, 1.0)


def columns(values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return dict(zip(NAMES, values.T, strict=True))


def moved(angles: ClinicalAngles, seconds: float) -> ClinicalAngles:
    """The same movement on a clock that shows earlier times by so many seconds."""
    return replace(angles, times=angles.times - seconds)


@pytest.mark.parametrize("shift", [0.0, 0.437, -3.21, 100.0])
def test_planted_shift_is_found_to_milliseconds(shift: float) -> None:
    a = angles_of(TIMES, columns(random_movement(0)))
    found = align(a, moved(a, shift), NAMES)
    assert found.shift == pytest.approx(shift, abs=0.003)
    assert found.agreement > 0.98
    assert not found.poor
    assert not found.ambiguous


def test_shift_is_found_despite_offsets_scales_noise_and_another_rate() -> None:
    values = random_movement(1)
    a = angles_of(TIMES, columns(values))
    times = np.arange(100, 700) / 100
    other = np.stack([np.interp(times, TIMES, v) for v in values.T], axis=1)
    noise = planted.smooth_noise(9, (600, len(NAMES)), 10, 4.0)
    b = angles_of(times, columns(0.8 * other + [30, -10, 5, 0] + noise))
    found = align(a, moved(b, 1.5), NAMES)
    assert found.shift == pytest.approx(1.5, abs=0.05)
    assert abs(found.shift - 1.5) < 4 * found.sigma
    assert 0.002 < found.sigma < 0.05


def test_stated_deviation_of_the_shift_is_that_of_its_errors() -> None:
    scores = []
    for seed in range(30):
        values = random_movement(seed)
        a = angles_of(TIMES, columns(values))
        noise = planted.smooth_noise(500 + seed, (600, len(NAMES)), 8, 8.0)
        found = align(a, angles_of(TIMES, columns(values + noise)), NAMES)
        scores.append(found.shift / found.sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_other_movement_hardly_agrees() -> None:
    first, second = (angles_of(TIMES, columns(random_movement(seed))) for seed in (0, 77))
    found = align(first, second, NAMES)
    assert found.poor


def test_walking_is_ambiguous_by_a_stride() -> None:
    angles = clinical_angles(walk())
    found = align(angles, angles, [name for name in NAMES if "elbow" not in name])
    assert found.shift == pytest.approx(0.0, abs=1e-3)
    assert abs(found.rival) == pytest.approx(1.2, abs=0.15)  # the stride time of this walk
    assert found.ambiguous


def test_agreement_without_a_shift_is_that_of_the_given_clocks() -> None:
    a = angles_of(TIMES, columns(random_movement(0)))
    assert align(a, a, NAMES).unshifted == pytest.approx(align(a, a, NAMES).agreement)
    assert align(a, moved(a, 0.5), NAMES).unshifted < 0.6
    assert np.isnan(align(a, moved(a, 100.0), NAMES).unshifted)


def test_nothing_that_moves_is_refused() -> None:
    still = angles_of(TIMES, dict.fromkeys(NAMES, 10.0))
    with pytest.raises(InvalidInputError, match="--angles"):
        align(still, still, NAMES)


def test_gaps_do_not_count() -> None:
    values = random_movement(3)
    a = angles_of(TIMES, columns(values))
    values[100:200, 0] = np.nan
    values[300:310] = np.nan
    found = align(a, moved(angles_of(TIMES, columns(values)), 0.25), NAMES)
    assert found.shift == pytest.approx(0.25, abs=0.005)
    assert found.agreement > 0.97
