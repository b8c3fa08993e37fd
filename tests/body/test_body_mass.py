"""De Leva's table: totals, centres of mass, physical inertias."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton_table import SEGMENTS, SEXES, inertia, mass_fraction

Array = NDArray[np.float64]
TRUNK_AND_HEAD = ("head", "upper trunk", "middle trunk", "lower trunk")


def test_values_without_a_sex_are_the_mean_of_both() -> None:
    assert mass_fraction("thigh", None) == pytest.approx((0.1416 + 0.1478) / 2)
    end = np.array([0.0, 0.0, -0.4])
    centers = [inertia("thigh", 8.0, end, sex)[0] for sex in SEXES]
    np.testing.assert_allclose(inertia("thigh", 8.0, end, None)[0], np.mean(centers, axis=0))


def test_thigh_of_a_man() -> None:
    center, matrix = inertia("thigh", 10.0, np.array([0.0, 0.0, -0.4]), "male")
    np.testing.assert_allclose(center, [0, 0, -0.4 * 0.4095])
    across, along = 10 * (0.329 * 0.4) ** 2, 10 * (0.149 * 0.4) ** 2
    np.testing.assert_allclose(matrix, np.diag([across, across, along]), atol=1e-15)


def test_trunk_segment_is_measured_from_its_top() -> None:
    center, _ = inertia("upper trunk", 10.0, np.array([0.0, 0.0, 0.3]), "male")
    assert center[2] == pytest.approx(0.3 * (1 - 0.5066))


@pytest.mark.parametrize("sex", ["male", "female", None])
@pytest.mark.parametrize("name", SEGMENTS)
def test_inertias_are_physical(name: str, sex: str | None) -> None:
    """Positive, and no principal moment larger than the sum of the other two."""
    rng = np.random.default_rng(0)
    for end in rng.normal(size=(10, 3)):
        center, matrix = inertia(name, 3.0, end, sex)
        moments = np.sort(np.linalg.eigvalsh(matrix))
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1]
        np.testing.assert_allclose(matrix, matrix.T)
        assert 0 < center @ end / (end @ end) < 1
        np.testing.assert_allclose(np.cross(center, end), 0, atol=1e-12)
        if name not in TRUNK_AND_HEAD:  # slim: the smallest moment is about the bone
            assert end @ matrix @ end / (end @ end) == pytest.approx(moments[0])
