"""SPM{t} of comparisons: against closed forms, a permutation test, and planted differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import spm1d
from comparison_support import one
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter1d

from rtof_kin.clinical.comparison import Compared, Comparison, compare
from rtof_kin.clinical.comparison_spm import ComparisonSpm, compare_spm
from rtof_kin.core.errors import InvalidInputError

Array = NDArray[np.float64]
KNEE = "right_knee_flexion"


def smooth(rng: np.random.Generator, count: int) -> Array:
    """(count, 101) smooth curves of standard deviation 1."""
    noise = gaussian_filter1d(rng.normal(size=(count, 301)), 10, axis=1)[:, 100:201]
    return np.asarray(noise * np.sqrt(2 * np.sqrt(np.pi) * 10))


def strides_of(name: str, curves: Array, sigma: float | None = None, late: float = 0.0) -> Compared:
    """A motion whose right strides of one second have these knee flexions, degrees."""
    times = late + np.arange(curves.shape[0] * 101 + 1) / 100
    values = np.append(curves.ravel(), curves[-1, -1])
    gapless = [(late + k * 1.01, late + k * 1.01 + 1.0) for k in range(len(curves))]
    return replace(one(name, times, {KNEE: values}, sigma), strides={"right": gapless})


def mapped(a: Array, b: Array, sigma: float | None = None, late: float = 0.5) -> tuple[Comparison, ComparisonSpm]:
    """SPM of B, whose strides are those of A if neither is later."""
    found = compare(strides_of("a", a, sigma), strides_of("b", b, sigma, late), "cycle")
    return found, compare_spm(found)


def test_t_is_that_of_every_phase() -> None:
    rng = np.random.default_rng(1)
    a, b = 20 + smooth(rng, 6), 21 + 2 * smooth(rng, 8)
    angle = mapped(a, b)[1].angles[0]
    welch = stats.ttest_ind(b, a, axis=0, equal_var=False)
    np.testing.assert_allclose(angle.t, welch.statistic, rtol=1e-6, atol=1e-6)
    paired = mapped(a, a + 1 + smooth(rng, 6), late=0.0)[1].angles[0]
    assert paired.paired


def test_threshold_and_clusters_are_those_of_spm1d_where_both_apply() -> None:
    rng = np.random.default_rng(9)
    a, b = 20 + smooth(rng, 10), 20 + smooth(rng, 10) + 3 * np.exp(-((np.arange(101) - 60) ** 2) / 200)
    own = mapped(a, b)[1].angles[0]
    peer = spm1d.stats.ttest2(np.radians(b), np.radians(a), equal_var=True).inference(0.05, two_tailed=True)
    assert own.threshold == pytest.approx(peer.zstar, rel=0.02)
    assert len(own.clusters) == len(peer.clusters) == 1
    ends = np.array(peer.clusters[0].endpoints) / 100
    assert [own.clusters[0].start, own.clusters[0].stop] == pytest.approx(ends, abs=0.01)


def test_threshold_agrees_with_a_permutation_test() -> None:
    rng = np.random.default_rng(3)
    both = smooth(rng, 20)
    angle = mapped(20 + both[:10], 20 + both[10:])[1].angles[0]
    largest = []
    for _ in range(1000):
        order = rng.permutation(20)
        largest.append(np.abs(stats.ttest_ind(both[order[:10]], both[order[10:]], axis=0).statistic).max())
    assert angle.threshold == pytest.approx(np.quantile(largest, 0.95), rel=0.1)


@pytest.mark.parametrize("count, spread", [(8, 1.0), (20, 3.0)])
def test_false_clusters_are_as_rare_as_stated(count: int, spread: float) -> None:
    rng = np.random.default_rng(4)
    false = sum(
        bool(mapped(20 + smooth(rng, count), 20 + spread * smooth(rng, 8))[1].angles[0].clusters) for _ in range(100)
    )
    assert stats.binom.ppf(0.001, 100, 0.05) <= false <= stats.binom.ppf(0.999, 100, 0.05)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_planted_difference_is_found_where_it_is(sign: int) -> None:
    rng, hill = np.random.default_rng(5), np.exp(-((np.arange(101) - 60) ** 2) / 128)
    a, b = 20 + smooth(rng, 9), 20 + smooth(rng, 9) + sign * 6 * hill
    (cluster,) = mapped(a, b)[1].angles[0].clusters
    assert cluster.start < 0.6 < cluster.stop
    assert cluster.stop - cluster.start < 0.5
    assert cluster.sign == sign
    assert cluster.p < 0.001
    assert cluster.beyond_bands is None


def test_a_cluster_within_the_bands_is_said() -> None:
    rng = np.random.default_rng(6)
    a, b = 20 + smooth(rng, 9), 26 + smooth(rng, 9)
    for sigma, beyond in ((1.0, True), (8.0, False)):
        clusters = mapped(a, b, sigma)[1].angles[0].clusters
        assert {cluster.beyond_bands for cluster in clusters} == {beyond}


def test_the_same_repeats_are_paired() -> None:
    rng = np.random.default_rng(7)
    a = 20 + 5 * smooth(rng, 9)
    found = mapped(a, a + 1 + 0.3 * smooth(rng, 9), late=0.0)[1].angles[0]
    assert found.paired
    assert found.dof == 8
    assert found.clusters


def test_few_repeats_and_another_axis_are_not_tested() -> None:
    rng = np.random.default_rng(8)
    _, found = mapped(20 + smooth(rng, 2), 20 + smooth(rng, 9))
    assert "3 of each" in found.not_tested[KNEE]
    by_range = compare(strides_of("a", 20 + smooth(rng, 3)), strides_of("b", 20 + smooth(rng, 3)), "range")
    with pytest.raises(InvalidInputError, match="--by cycle"):
        compare_spm(by_range)
