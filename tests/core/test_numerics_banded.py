"""Banded systems against dense linear algebra."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.core.errors import ShapeError, SolverError
from rtof_kin.core.numerics.banded import Store, factorise, inverse_diagonal

Array = NDArray[np.float64]
SIZES = [(1, 1), (6, 1), (7, 2), (40, 5), (40, 40), (90, 28), (150, 70)]
"""Unknowns and width; LAPACK goes by blocks from a width of about 32."""


def system(size: int, width: int, seed: int = 0) -> Array:
    """A positive definite matrix whose entries are zero from `width` below the diagonal."""
    L = np.tril(np.triu(np.random.default_rng(seed).normal(size=(size, size)), 1 - width))
    np.fill_diagonal(L, 1 + np.abs(np.diag(L)) + np.sqrt(width))
    return np.asarray(L @ L.T)


def band_of(H: Array, width: int) -> Array:
    """(n, w) as `factorise` takes it; what would lie below the last row is NaN."""
    size = len(H)
    band = np.full((size, width), np.nan)
    for below in range(width):
        band[: size - below, below] = np.diag(H, -below)
    return band


@pytest.mark.parametrize("size, width", SIZES)
def test_a_banded_system_is_solved_as_the_dense_one(size: int, width: int) -> None:
    H, right = system(size, width), np.random.default_rng(1).normal(size=size)
    solved = factorise(band_of(H, width)).solve(right)
    np.testing.assert_allclose(solved, np.linalg.solve(H, right), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size, width", SIZES)
def test_the_factor_is_that_of_cholesky(size: int, width: int) -> None:
    H = system(size, width)
    factor, L = factorise(band_of(H, width)), np.linalg.cholesky(H)
    assert factor.band.shape == (width, size)
    for below in range(width):
        own = factor.band[below, : size - below]
        np.testing.assert_allclose(own, np.diag(L, -below), atol=1e-11)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 1000))
def test_any_size_and_width_leaves_no_residual(size: int, width: int, seed: int) -> None:
    width = min(width, size)
    H, right = system(size, width, seed), np.random.default_rng(seed).normal(size=size)
    solved = factorise(band_of(H, width)).solve(right)
    assert np.abs(H @ solved - right).max() < 1e-12 * (1 + np.abs(H).max() * np.abs(solved).max())


def test_unknowns_of_very_different_stiffness_are_solved_as_accurately() -> None:
    scale = 10.0 ** np.random.default_rng(0).uniform(-6, 6, 50)
    H, x = system(50, 7), np.random.default_rng(1).normal(size=50)
    H *= np.outer(scale, scale)
    solved = factorise(band_of(H, 7)).solve(H @ (x / scale))
    np.testing.assert_allclose(scale * solved, x, rtol=1e-6)


def test_the_solution_has_the_shape_of_the_right_hand_side_which_stays() -> None:
    H, right = system(24, 5), np.random.default_rng(1).normal(size=24)
    factor, before = factorise(band_of(H, 5)), right.copy()
    flat = factor.solve(right)
    for shape in [(24,), (4, 6), (2, 4, 3), (24, 1)]:
        solved = factor.solve(right.reshape(shape))
        assert solved.shape == shape
        np.testing.assert_array_equal(solved.ravel(), flat)
    turned = np.asfortranarray(right.reshape(4, 6))
    np.testing.assert_array_equal(factor.solve(turned).ravel(), flat)
    np.testing.assert_array_equal(right, before)


def test_a_factor_serves_many_right_hand_sides_and_outlives_other_factors() -> None:
    H = system(30, 4)
    factor = factorise(band_of(H, 4))
    inverse = np.array([factor.solve(row) for row in np.eye(30)])
    factorise(band_of(system(30, 4, 1), 4)).solve(np.ones(30))
    np.testing.assert_array_equal([factor.solve(row) for row in np.eye(30)], inverse)
    np.testing.assert_allclose(inverse @ H, np.eye(30), atol=1e-10)


def test_the_factor_lies_where_the_band_was() -> None:
    band = band_of(system(20, 3), 3)
    assert np.shares_memory(factorise(band).band, band)


@pytest.mark.parametrize("order", ["C", "F"])
def test_the_layout_in_memory_does_not_matter(order: str) -> None:
    H, right = system(30, 4), np.ones(30)
    wide = np.full((60, 8), np.nan, order=order)  # type: ignore[call-overload]
    wide[::2, ::2] = band_of(H, 4)
    expected = factorise(band_of(H, 4)).solve(right)
    np.testing.assert_array_equal(factorise(wide[::2, ::2]).solve(right), expected)


# --- what cannot be factorised -------------------------------------------------------------------


@pytest.mark.parametrize("width", [1, 5, 60])
@pytest.mark.parametrize("at", [0, 40, 79])
@pytest.mark.parametrize("value", [0.0, -1e-9, -1e9])
def test_a_pivot_that_is_not_positive_is_refused(width: int, at: int, value: float) -> None:
    band = band_of(np.eye(80), width)
    band[at, 0] = value
    with pytest.raises(SolverError, match="Hessian is not positive definite"):
        factorise(band)


@pytest.mark.parametrize("size, width", SIZES[2:])
def test_a_matrix_is_refused_from_where_its_least_eigenvalue_is_negative(size: int, width: int) -> None:
    H = system(size, width)
    least = np.linalg.eigvalsh(H)[0]
    factorise(band_of(H - 0.999 * least * np.eye(size), width))
    with pytest.raises(SolverError, match="not positive definite"):
        factorise(band_of(H - 1.001 * least * np.eye(size), width))


@pytest.mark.parametrize("width", [1, 5, 60])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_matrix_with_a_value_that_is_no_number_is_refused(width: int, value: float) -> None:
    band = band_of(np.eye(80), width)
    band[40, 0] = value
    with pytest.raises(SolverError):
        factorise(band)


def test_a_right_hand_side_that_is_too_short_is_refused() -> None:
    with pytest.raises(SolverError, match="3 numbers for a system of 4"):
        factorise(band_of(system(4, 2), 2)).solve(np.ones(3))


def test_a_right_hand_side_that_is_too_long_is_refused() -> None:
    with pytest.raises(SolverError):
        factorise(band_of(system(4, 2), 2)).solve(np.ones(5))


# --- parts of the inverse ------------------------------------------------------------------------


def diagonal_of_inverse(H: Array, size: int) -> Array:
    inverse = np.linalg.inv(H).reshape(len(H) // size, size, -1, size)
    return np.array([inverse[t, :, t] for t in range(len(inverse))])


@pytest.mark.parametrize(
    "size, lags, frames", [(1, 1, 4), (3, 1, 5), (1, 4, 9), (4, 3, 7), (5, 4, 12), (6, 4, 2)]
)
def test_the_diagonal_of_the_inverse_is_that_of_the_dense_one(size: int, lags: int, frames: int) -> None:
    width = min((lags - 1) * size + 1, size * frames)
    H = system(size * frames, width)
    factor = factorise(band_of(H, width))
    found = inverse_diagonal(factor.blocks(size, lags))
    np.testing.assert_allclose(found, diagonal_of_inverse(H, size), rtol=1e-9, atol=1e-12)


def test_the_inverse_of_a_long_stiff_chain_stays_exact_and_positive() -> None:
    """Third differences, as of jerk, and little else: rounding that is not kept symmetric explodes."""
    frames, size = 120, 3
    third = np.kron(np.diff(np.eye(frames), n=3, axis=0), np.eye(size))
    H = 1e6 * third.T @ third + np.kron(np.eye(frames), system(size, size, 3))
    factor = factorise(band_of(H, 3 * size + 1))
    found = inverse_diagonal(factor.blocks(size, 4))
    np.testing.assert_allclose(found, diagonal_of_inverse(H, size), rtol=1e-6)
    assert np.linalg.eigvalsh(found).min() > 0
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))


def test_blocks_that_do_not_fit_the_band_are_refused() -> None:
    factor = factorise(band_of(system(12, 5), 5))
    with pytest.raises(SolverError, match="12 unknowns with a band of 4: not 2 blocks of 5"):
        factor.blocks(5, 2)
    with pytest.raises(SolverError, match="not 2 blocks of 2"):
        factor.blocks(2, 2)


# --- compiled ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compilation turned on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("RTOF_KIN_COMPILE", raising=False)
        if not Store.available():
            pytest.skip("banded systems are not compiled on this machine")
        yield


def stored(H: Array, width: int) -> Store:
    store = Store(len(H), width - 1)
    for below in range(width):
        store.entries[: len(H) - below, below] = np.diag(H, -below)
    return store


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("size, width", [*SIZES, (2, 1), (8, 8), (33, 9), (200, 132)])
def test_a_stored_band_is_solved_as_the_dense_system(size: int, width: int) -> None:
    H, right = system(size, width), np.random.default_rng(1).normal(size=size)
    store = stored(H, width)
    for damping in (0.0, 3.0):  # the matrix stays
        expected = np.linalg.solve(H + damping * np.eye(size), right)
        solved = store.factorise(damping).solve(right)
        np.testing.assert_allclose(solved, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.usefixtures("compiled")
@settings(max_examples=50, deadline=None)
@given(st.integers(1, 90), st.integers(1, 60), st.integers(0, 1000))
def test_any_size_and_width_is_stored_alike(size: int, width: int, seed: int) -> None:
    width = min(width, size)
    H, right = system(size, width, seed), np.random.default_rng(seed).normal(size=size)
    solved = stored(H, width).factorise(0.0).solve(right)
    assert np.abs(H @ solved - right).max() < 1e-12 * (1 + np.abs(H).max() * np.abs(solved).max())


@pytest.mark.usefixtures("compiled")
def test_a_stored_factor_outlives_others_and_keeps_the_right_hand_sides_shape() -> None:
    H, right = system(30, 4), np.random.default_rng(1).normal(size=(5, 6))
    store = stored(H, 4)
    factor, before = store.factorise(0.0), right.copy()
    solved = factor.solve(right)
    store.factorise(100.0)
    stored(system(30, 4, 1), 4).factorise(0.0).solve(right)
    np.testing.assert_array_equal(factor.solve(right), solved)
    np.testing.assert_array_equal(right, before)
    np.testing.assert_allclose(H @ solved.ravel(), right.ravel(), atol=1e-9)
    with pytest.raises(SolverError, match="3 numbers for a system of 30"):
        factor.solve(np.ones(3))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("width", [1, 5, 60])
@pytest.mark.parametrize("at", [0, 40, 79])
@pytest.mark.parametrize("value", [0.0, -1e-9, -1e9, np.nan, np.inf])
def test_a_stored_pivot_that_is_not_positive_is_refused(width: int, at: int, value: float) -> None:
    store = stored(np.eye(80), width)
    store.entries[at, 0] = value
    with pytest.raises(SolverError, match="Hessian is not positive definite"):
        store.factorise(0.0)


def test_without_compiled_code_nothing_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    assert not Store.available()
    with pytest.raises(ShapeError, match="not compiled here; use `factorise`"):
        Store(10, 2)


@pytest.mark.usefixtures("compiled")
def test_a_stored_factor_has_the_blocks_of_the_other() -> None:
    H = system(60, 18)
    expected = factorise(band_of(H, 18)).blocks(6, 4)
    found = stored(H, 18).factorise(0.0).blocks(6, 4)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    L = np.linalg.cholesky(H)
    np.testing.assert_allclose(found[3, 2], L[30:36, 18:24], atol=1e-12)


@pytest.mark.usefixtures("compiled")
def test_a_stored_factor_solves_columns_as_it_solves_one() -> None:
    store = Store(12, 3)
    store.entries[:, 0] = 4.0
    store.entries[:-1, 1] = -1.0
    factor, right = store.factorise(0.0), np.random.default_rng(0).normal(size=(12, 3))
    columns = factor.solve_columns(right)
    for i in range(3):
        np.testing.assert_array_equal(columns[:, i], factor.solve(right[:, i]))
    with pytest.raises(SolverError, match="right-hand sides"):
        factor.solve_columns(right[:5])
