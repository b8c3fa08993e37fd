"""Statistics of columns that arrive in blocks are those of NumPy on the whole."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.core.errors import ShapeError
from rtof_kin.reporting import statistics
from rtof_kin.reporting.statistics import ColumnStatistics


def in_blocks(times: np.ndarray, values: np.ndarray, sizes: list[int]) -> ColumnStatistics:
    out, start = ColumnStatistics(values.shape[1]), 0
    for size in sizes:
        out.add(times[start : start + size], values[start : start + size])
        start += size
    assert start == len(times)
    return out


@pytest.mark.parametrize("sizes", [[200], [1, 0, 99, 100], [67, 133]])
def test_blocks_give_the_figures_of_the_whole(sizes: list[int]) -> None:
    rng = np.random.default_rng(1)
    times, values = np.arange(200) / 60, rng.normal(size=(200, 4))
    values[rng.random(values.shape) < 0.2] = np.nan
    values[:, 3] = np.nan
    found = in_blocks(times, values, sizes)
    known = values[:, :3]
    np.testing.assert_allclose(found.mean[:3], np.nanmean(known, axis=0), atol=1e-12)
    np.testing.assert_allclose(found.rms[:3], np.sqrt(np.nanmean(known**2, axis=0)))
    np.testing.assert_array_equal(found.median[:3], np.nanmedian(known, axis=0))
    np.testing.assert_array_equal(found.largest[:3], np.nanmax(known, axis=0))
    np.testing.assert_array_equal(found.largest_at[:3], times[np.nanargmax(known, axis=0)])
    assert found.known.tolist() == [*np.isfinite(known).sum(axis=0), 0]
    assert found.median_of_all == np.nanmedian(known)
    assert found.mean_of_all == pytest.approx(np.nanmean(known))
    assert found.rms_of_all == pytest.approx(np.sqrt(np.nanmean(known**2)))
    for figures in (found.mean, found.rms, found.median, found.largest, found.largest_at):
        assert np.isnan(figures[3])


def test_medians_of_many_rows_are_those_of_evenly_spaced_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "KEPT_ROWS", 100)
    times = np.arange(1234.0)
    found = in_blocks(times, times[:, None], [7, 93, 500, 34, 600])
    assert found.median[0] == np.median(times[::16])  # the rows kept do not depend on the blocks
    assert found.mean[0] == times.mean()


def test_masks_and_wrong_shapes() -> None:
    found = ColumnStatistics(2)
    found.add(np.arange(2.0), np.array([[True, False], [True, True]]))
    assert found.mean.tolist() == [1.0, 0.5]
    with pytest.raises(ShapeError, match="expected"):
        found.add(np.arange(2.0), np.zeros((2, 3)))
