"""Resampling with gaps, the averaging kernel of accelerations, differences and filters."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import InvalidInputError

Array = NDArray[np.float64]
RNG = np.random.default_rng(1)


def assert_close(a: Array, b: Array, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


def test_interpolation_is_exact_for_a_straight_line_and_keeps_the_shape() -> None:
    times = np.cumsum(RNG.uniform(0.01, 0.05, 20))
    slope = RNG.normal(size=(2, 3))
    at = RNG.uniform(times[0], times[-1], 50)
    out = signals.interpolate(times, times[:, None, None] * slope, at)
    assert out.shape == (50, 2, 3)
    assert_close(out, at[:, None, None] * slope)


def test_interpolation_is_nan_outside_the_samples_and_in_long_gaps() -> None:
    out = signals.interpolate(np.arange(3.0), np.arange(3.0), [-0.01, 0.0, 2.0, 2.01])
    np.testing.assert_array_equal(out, [np.nan, 0.0, 2.0, np.nan])
    times, values = np.arange(10.0), np.arange(10.0)
    values[3:6] = np.nan  # 2 and 6 are four seconds apart
    at = [2.0, 2.5, 4.0, 5.999, 6.0]
    np.testing.assert_array_equal(
        signals.interpolate(times, values, at, max_gap=3.9), [2.0, np.nan, np.nan, np.nan, 6.0]
    )
    assert_close(signals.interpolate(times, values, at, max_gap=4.0), np.array(at))
    times = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    out = signals.interpolate(times, times, [0.15, 0.5, 1.05], max_gap=0.11)
    np.testing.assert_allclose(out, [0.15, np.nan, 1.05])


def test_interpolation_of_no_sample_and_of_one() -> None:
    out = signals.interpolate(np.arange(4.0), np.full((4, 2), np.nan), [1.0, 2.0])
    assert np.isnan(out).all()
    one = signals.interpolate(np.array([1.0]), np.array([7.0]), [0.9, 1.0, 1.1])
    np.testing.assert_array_equal(one, [np.nan, 7.0, np.nan])
    R = signals.interpolate_rotations(np.array([1.0]), np.eye(3)[None, None], [0.0, 1.0])
    np.testing.assert_array_equal(np.isnan(R[:, 0, 0, 0]), [True, False])
    none = signals.interpolate_rotations(np.arange(3.0), np.full((3, 1, 3, 3), np.nan), [1.0])
    assert np.isnan(none).all()


def test_rotations_between_samples_equal_scipy_slerp() -> None:
    times = np.cumsum(RNG.uniform(0.01, 0.05, 12))
    R = np.stack([Rotation.random(12, rng=s).as_matrix() for s in (1, 2)], axis=1)
    at = np.sort([*times, *RNG.uniform(times[0], times[-1], 40)])
    out = signals.interpolate_rotations(times, R, at)
    for s in range(2):
        assert_close(out[:, s], Slerp(times, Rotation.from_matrix(R[:, s]))(at).as_matrix())


def test_rotation_in_a_gap_or_outside_is_nan_as_a_whole() -> None:
    times = np.arange(8.0)
    R = so3.about_axis("z", times * 0.1)[:, None]
    R[3:5] = np.nan
    out = signals.interpolate_rotations(times, R, [-0.1, 1.5, 2.0, 3.5, 5.0, 7.1], max_gap=2.0)
    unknown = np.isnan(out[:, 0]).all(axis=(1, 2))
    np.testing.assert_array_equal(unknown, [True, False, False, True, False, True])
    assert np.isfinite(out[~unknown]).all()
    filled = signals.interpolate_rotations(times, R, [3.5], max_gap=3.0)
    assert_close(filled[0, 0], so3.about_axis("z", 0.35))


def test_kernel_at_equal_rates_is_1_4_1_over_6_and_renormalised_at_the_ends() -> None:
    times = np.arange(30) / 60
    x = RNG.normal(size=(30, 2, 3))
    out = signals.hat_average(times, x, times, 1 / 60)
    assert_close(out[1:-1], (x[:-2] + 4 * x[1:-1] + x[2:]) / 6)
    assert_close(out[0], (2 * x[0] + x[1]) / 3)
    assert_close(out[-1], (2 * x[-1] + x[-2]) / 3)


def test_average_integrates_irregular_samples_exactly() -> None:
    """Against a brute-force integral of the piecewise linear signal under the hat."""
    times = np.cumsum(RNG.uniform(0.002, 0.02, 200))
    x = RNG.normal(size=200)
    at = RNG.uniform(times[0] + 0.05, times[-1] - 0.05, 10)
    for h in (0.003, 0.02, 0.05):
        fine = np.linspace(-h, h, 200_001)
        hat = 1 - np.abs(fine) / h
        brute = [np.trapezoid(np.interp(t + fine, times, x) * hat, fine) / np.trapezoid(hat, fine) for t in at]
        assert_close(signals.hat_average(times, x, at, h), np.array(brute), 1e-7)


def test_kernel_does_not_cross_gaps() -> None:
    for rate, first in [(30.0, 7), (50.0, 40), (60.0, 33), (90.0, 20), (100.0, 61), (120.0, 40)]:
        times = 0.013 + np.arange(80) / rate  # at 90 Hz a corner of the kernel rounds into the gap
        x = np.ones((80, 2))
        x[first, 0] = np.nan
        out = signals.hat_average(times, x, times, 1 / rate, max_gap=1.5 / rate)
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(out[:, 0])), [first - 1, first, first + 1])
        np.testing.assert_allclose(out[np.isfinite(out)], 1, rtol=1e-8)
        assert np.isfinite(out[:, 1]).all()


def test_average_fills_short_gaps_and_is_nan_outside() -> None:
    times, x = np.arange(20) / 60, np.ones(20)
    x[9] = np.nan
    assert np.isnan(signals.hat_average(times, x, times[[9]], 1 / 60, max_gap=1.5 / 60)).all()
    assert_close(signals.hat_average(times, x, times[[9]], 1 / 60, max_gap=2 / 60), np.ones(1))
    at = [-1.0, -0.01, 0.1, 19.5 / 60, 2.0]
    out = signals.hat_average(times, np.ones(20), at, 1 / 60)
    np.testing.assert_array_equal(np.isnan(out), [True, True, False, True, True])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_differences_of_a_polynomial_are_its_derivative(order: int) -> None:
    rate = 50.0
    t = np.arange(20) / rate
    p = np.polynomial.Polynomial(RNG.normal(size=order + 1))
    out = signals.derivative(p(t), rate, order)
    assert out.shape == (20 - order,)
    assert_close(out, np.full(20 - order, p.deriv(order)(0.0)), 1e-6)


def test_low_pass_keeps_slow_and_removes_fast_signals_without_delay() -> None:
    t = np.arange(1000) / 100.0
    slow, edge, fast = (np.sin(2 * np.pi * f * t) for f in (1, 6, 30))
    out = signals.low_pass(np.stack([slow, edge, fast, slow + 5], axis=1), 100.0, 6.0)[200:800]
    assert np.abs(out[:, 0] - slow[200:800]).max() < 2e-3
    assert np.abs(out[:, 1]).max() == pytest.approx(0.5, abs=0.01)  # -3 dB in each direction
    assert np.abs(out[:, 2]).max() < 5e-3
    assert_close(out[:, 3], out[:, 0] + 5, 1e-6)
    assert_close(signals.low_pass(np.full((5, 2), 3.0), 60.0, 6.0), np.full((5, 2), 3.0), 1e-9)


@pytest.mark.parametrize(("frames", "cutoff_hz"), [(1, 10.0), (2, 6.0), (5, 29.9), (400, 6.0), (3000, 0.2)])
def test_low_pass_equals_scipys_filter_forwards_and_backwards(frames: int, cutoff_hz: float) -> None:
    x = 50 + np.cumsum(RNG.normal(size=(frames, 2, 3)), axis=0)
    kept = x.copy()
    sos = scipy.signal.butter(2, cutoff_hz, fs=60.0, output="sos")
    expected = scipy.signal.sosfiltfilt(sos, x, axis=0, padlen=min(frames - 1, int(180 / cutoff_hz)))
    assert_close(signals.low_pass(x, 60.0, cutoff_hz), expected, 1e-9)
    np.testing.assert_array_equal(x, kept)


def test_low_pass_of_no_signal_is_none_and_a_gap_stays_in_its_column() -> None:
    assert signals.low_pass(np.zeros((5, 0)), 60.0, 6.0).shape == (5, 0)
    x = RNG.normal(size=(30, 2))
    x[7, 1] = np.nan
    out = signals.low_pass(x, 60.0, 6.0)
    assert_close(out[:, :1], signals.low_pass(x[:, :1], 60.0, 6.0))
    assert np.isnan(out[:, 1]).any()


@pytest.mark.parametrize("cutoff_hz", [0.0, 30.0, 60.0, np.nan])
def test_a_cutoff_beyond_half_the_rate_is_an_error(cutoff_hz: float) -> None:
    with pytest.raises(InvalidInputError, match="cutoff"):
        signals.low_pass(np.zeros((9, 1)), 60.0, cutoff_hz)


def test_low_pass_filters_each_interval_between_gaps() -> None:
    t = np.arange(60) / 60
    x = RNG.normal(size=(60, 3))
    x[20, 1] = np.nan
    x[22:] += 100.0
    x[21:22] = np.nan
    out = signals.low_pass_known(t, x, 12.0)
    assert_close(out[:20], signals.low_pass(x[:20], 60.0, 12.0), 1e-12)
    assert_close(out[22:], signals.low_pass(x[22:], 60.0, 12.0), 1e-12)
    assert np.isnan(out[20, 1])
    assert np.isnan(out[21]).all()
    assert_close(out[20, [0, 2]], x[20, [0, 2]])


@pytest.mark.parametrize(("frames", "cutoff_hz"), [(60, 30.0), (60, 50.0), (3, 12.0), (1, 12.0), (0, 12.0)])
def test_low_rates_and_short_intervals_are_not_filtered(frames: int, cutoff_hz: float) -> None:
    x = RNG.normal(size=(frames, 3))
    assert_close(signals.low_pass_known(np.arange(frames) / 60, x, cutoff_hz), x)


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        ("", []),
        ("0000", []),
        ("1111", [(0, 4)]),
        ("0110", [(1, 3)]),
        ("1001", [(0, 1), (3, 4)]),
        ("10110", [(0, 1), (2, 4)]),
    ],
)
def test_runs_are_the_intervals_where_a_mask_is_true(mask: str, expected: list[tuple[int, int]]) -> None:
    assert signals.runs([c == "1" for c in mask]) == expected


def test_the_vertex_of_a_parabola_is_found_between_samples() -> None:
    values = [5.0 - 2.0 * (x - 0.3) ** 2 for x in (-1, 0, 1)]
    assert signals.vertex(*values) == pytest.approx(0.3)
    assert signals.vertex(1.0, 2.0, 1.0) == 0.0
