"""Banded systems against dense linear algebra, with LAPACK and with compiled code."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import Factor, Store, factorise

Array = NDArray[np.float64]
Solver = Callable[[Array, int], Factor]
SIZES = [(1, 1), (2, 1), (7, 2), (33, 9), (40, 5), (40, 40), (90, 28), (150, 70), (200, 132)]
"""Unknowns and width; LAPACK works in blocks from a width of about 32."""


def system(size: int, width: int, seed: int = 0) -> Array:
    """A positive definite matrix whose entries are zero from `width` below the diagonal."""
    L = np.tril(np.triu(np.random.default_rng(seed).normal(size=(size, size)), 1 - width))
    np.fill_diagonal(L, 1 + np.abs(np.diag(L)) + np.sqrt(width))
    return np.asarray(L @ L.T)


def band_of(H: Array, width: int) -> Array:
    """(n, w) for `factorise`; entries below the last row are NaN."""
    band = np.full((len(H), width), np.nan)
    for below in range(width):
        band[: len(H) - below, below] = np.diag(H, -below)
    return band


def stored(H: Array, width: int, compile: bool = True) -> Store:
    store = Store(len(H), width - 1, compile)
    for below in range(width):
        store.entries[: len(H) - below, below] = np.diag(H, -below)
    return store


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compilation turned on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("RTOF_KIN_COMPILE", raising=False)
        if Store(1, 0)._code is None:
            pytest.skip("banded systems are not compiled on this machine")
        yield


@pytest.fixture(scope="module", params=["lapack", "compiled"])
def solver(request: pytest.FixtureRequest) -> Solver:
    """Factorisation of a matrix of a given width."""
    if request.param == "lapack":
        return lambda H, width: factorise(band_of(H, width))
    request.getfixturevalue("compiled")
    return lambda H, width: stored(H, width).factorise(0.0)


@pytest.mark.parametrize("size, width", SIZES)
def test_solution_equals_that_of_the_dense_system(solver: Solver, size: int, width: int) -> None:
    H, rng = system(size, width), np.random.default_rng(1)
    right, scale = rng.normal(size=size), 10.0 ** rng.uniform(-6, 6, size)  # very different stiffness
    expected = np.linalg.solve(H, right)
    np.testing.assert_allclose(solver(H, width).solve(right), expected, rtol=1e-9, atol=1e-12)
    scaled = solver(H * np.outer(scale, scale), width).solve(scale * right)
    np.testing.assert_allclose(scale * scaled, expected, rtol=1e-6, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 90), st.integers(1, 60), st.integers(0, 1000))
def test_any_size_and_width_leaves_no_residual(solver: Solver, size: int, width: int, seed: int) -> None:
    width = min(width, size)
    H, right = system(size, width, seed), np.random.default_rng(seed).normal(size=size)
    solved = solver(H, width).solve(right)
    assert np.abs(H @ solved - right).max() < 1e-12 * (1 + np.abs(H).max() * np.abs(solved).max())


def test_factor_serves_right_hand_sides_of_any_shape_and_outlives_other_factors(solver: Solver) -> None:
    H, right = system(24, 5), np.random.default_rng(1).normal(size=24)
    factor, before = solver(H, 5), right.copy()
    flat = factor.solve(right)
    solver(system(24, 5, 1), 5).solve(np.ones(24))
    for array in (right, right.reshape(2, 4, 3), np.asfortranarray(right.reshape(4, 6))):
        solved = factor.solve(array)
        assert solved.shape == array.shape
        np.testing.assert_array_equal(solved.ravel(), flat)
    np.testing.assert_array_equal(right, before)


@pytest.mark.parametrize("size, width", SIZES)
@pytest.mark.parametrize("count", [1, 12, 31])
def test_half_solutions_multiply_to_products_with_the_inverse(
    solver: Solver, size: int, width: int, count: int
) -> None:
    H, right = system(size, width), np.random.default_rng(1).normal(size=(size, count))
    before = right.copy()
    half = solver(H, width).forward_columns(right)
    assert half.shape == right.shape
    np.testing.assert_allclose(half.T @ half, right.T @ np.linalg.solve(H, right), rtol=1e-8, atol=1e-11)
    np.testing.assert_array_equal(right, before)


def test_right_hand_side_of_another_size_is_refused(solver: Solver) -> None:
    factor = solver(system(4, 2), 2)
    for size in (3, 5):
        with pytest.raises(SolverError, match=f"{size} numbers for a system of 4"):
            factor.solve(np.ones(size))
        with pytest.raises(SolverError, match="right-hand sides"):
            factor.forward_columns(np.ones((size, 2)))


@pytest.mark.parametrize("width", [1, 5, 60])
@pytest.mark.parametrize("at", [0, 40, 79])
@pytest.mark.parametrize("value", [0.0, -1e-9, -1e9, np.nan, np.inf])
def test_pivot_that_is_not_positive_is_refused(solver: Solver, width: int, at: int, value: float) -> None:
    H = np.eye(80)
    H[at, at] = value
    with pytest.raises(SolverError, match="Hessian is not positive definite"):
        solver(H, width)


@pytest.mark.parametrize("size, width", SIZES[2:6])
def test_matrix_is_refused_from_a_negative_eigenvalue_on(solver: Solver, size: int, width: int) -> None:
    H = system(size, width)
    least = np.linalg.eigvalsh(H)[0]
    solver(H - 0.999 * least * np.eye(size), width)
    with pytest.raises(SolverError, match="not positive definite"):
        solver(H - 1.001 * least * np.eye(size), width)


def test_factor_overwrites_the_band_in_any_memory_layout() -> None:
    H, right = system(30, 4), np.ones(30)
    band = band_of(H, 4)
    factor = factorise(band)
    assert np.shares_memory(factor.band, band)
    for wide in (np.full((60, 8), np.nan), np.full((60, 8), np.nan, order="F")):
        wide[::2, ::2] = band_of(H, 4)
        np.testing.assert_array_equal(factorise(wide[::2, ::2]).solve(right), factor.solve(right))


@pytest.mark.parametrize("compile", [True, False])
@pytest.mark.usefixtures("compiled")
def test_store_keeps_its_matrix_and_adds_damping(compile: bool) -> None:
    H, right = system(33, 9), np.ones(33)
    store = stored(H, 9, compile)
    for damping in (3.0, 0.0, 100.0):
        expected = np.linalg.solve(H + damping * np.eye(33), right)
        np.testing.assert_allclose(store.factorise(damping).solve(right), expected, rtol=1e-9)


def diagonal_of_inverse(H: Array, size: int) -> Array:
    inverse = np.linalg.inv(H).reshape(len(H) // size, size, -1, size)
    return np.array([inverse[t, :, t] for t in range(len(inverse))])


@pytest.mark.parametrize(
    "size, lags, frames", [(1, 1, 4), (3, 1, 5), (1, 4, 9), (4, 3, 7), (5, 4, 12), (6, 4, 2), (21, 4, 25)]
)
def test_inverse_diagonal_equals_that_of_the_dense_inverse(solver: Solver, size: int, lags: int, frames: int) -> None:
    width = min((lags - 1) * size + 1, size * frames)
    H = system(size * frames, width)
    found = solver(H, width).inverse_diagonal(size, lags)
    np.testing.assert_allclose(found, diagonal_of_inverse(H, size), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(solver(H, width).inverse_diagonal(size, lags, 1), found[1:])


def test_inverse_diagonal_of_a_long_stiff_chain_stays_accurate_and_symmetric(solver: Solver) -> None:
    """Third differences as in jerk: without symmetrisation rounding errors grow exponentially."""
    frames, size = 120, 3
    third = np.kron(np.diff(np.eye(frames), n=3, axis=0), np.eye(size))
    H = 1e6 * third.T @ third + np.kron(np.eye(frames), system(size, size, 3))
    found = solver(H, 3 * size + 1).inverse_diagonal(size, 4)
    np.testing.assert_allclose(found, diagonal_of_inverse(H, size), rtol=1e-6)
    assert np.linalg.eigvalsh(found).min() > 0
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))


def test_blocks_that_do_not_fit_the_band_are_refused(solver: Solver) -> None:
    factor = solver(system(12, 5), 5)
    for size in (5, 2):
        with pytest.raises(SolverError, match=f"12 unknowns with a band of 4: not 2 blocks of {size}"):
            factor.inverse_diagonal(size, 2)
