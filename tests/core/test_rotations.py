"""SO(3) against SciPy, near singularities, and choices of representatives."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
RNG = np.random.default_rng(0)
ORDERS = ["".join(axes) for axes in permutations("xyz")]
VECTORS = st.tuples(*[st.floats(-4, 4)] * 3).map(np.array)


def random_rotations(n: int, seed: int = 0) -> Array:
    return np.asarray(Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix())


def assert_close(a: Array, b: Array, tolerance: float = 1e-13) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    assert_close(so3.skew(a) @ b, np.cross(a, b))


@given(VECTORS)
def test_exp_equals_scipy_and_its_inverse_is_of_the_negative(v: Array) -> None:
    assert_close(so3.exp(v), Rotation.from_rotvec(v).as_matrix())
    assert so3.is_rotation(so3.exp(v), tolerance=1e-13)
    assert_close(so3.exp(v) @ so3.exp(-v), np.eye(3))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_log_inverts_exp_up_to_half_a_turn(angle: float) -> None:
    v = angle * so3.unit(RNG.normal(size=(50, 3)))
    assert_close(so3.log(so3.exp(v)), v, 1e-7 if angle > 3.1 else 1e-12)
    assert_close(so3.log(so3.exp([0, 0, 4.0])), np.array([0, 0, 4.0 - 2 * np.pi]))


def test_batches_equal_single_rotations() -> None:
    v = RNG.normal(size=(2, 3, 4, 3))
    R = so3.exp(v)
    assert R.shape == (2, 3, 4, 3, 3)
    assert so3.log(R).shape == v.shape
    for i in np.ndindex(2, 3, 4):
        assert_close(R[i], so3.exp(v[i]))
        assert_close(so3.to_quat_wxyz(R)[i][None] ** 2, so3.to_quat_wxyz(R[i])[None] ** 2)
    assert_close(so3.about_axis("y", v[..., 0])[1, 2, 3], so3.about_axis("y", v[1, 2, 3, 0]))
    assert_close(so3.skew(v)[1, 2, 3], so3.skew(v[1, 2, 3]))


@pytest.mark.parametrize("angle", [0.0, 1e-14, 1e-9, 1e-3, 1.0, 3.0, np.pi])
def test_angle_between_is_accurate_even_when_tiny(angle: float) -> None:
    R = random_rotations(20)
    turned = R @ so3.exp(angle * so3.unit(RNG.normal(size=(20, 3))))
    # At half a turn the chord is flat: the square root of the rounding.
    tolerance = 1e-15 if angle < 0.1 else 1e-7 if angle > 3.1 else 1e-13
    assert_close(so3.angle_between(R, turned), np.full(20, angle), tolerance)


@given(VECTORS, VECTORS)
def test_minimal_rotation_turns_a_to_b_by_their_angle(a: Array, b: Array) -> None:
    a, b = a + np.array([0, 0, 4.5]), b + np.array([4.5, 0, 0])  # neither is zero
    R = so3.minimal_rotation(a, b)
    assert so3.is_rotation(R, tolerance=1e-14)
    assert_close(R @ so3.unit(a), so3.unit(b), 1e-15)
    sine, cosine = np.linalg.norm(np.cross(a, b)), a @ b
    assert_close(so3.angle_between(R, np.eye(3)), np.arctan2(sine, cosine), 1e-7)


@pytest.mark.parametrize("gap", [1e-1, 1e-4, 4.5e-5, 1e-5, 1e-8, 1e-11, 1e-14, 0.0])
def test_minimal_rotation_is_accurate_near_opposite_directions(gap: float) -> None:
    a = so3.unit(RNG.normal(size=(500, 3)))
    across = so3.unit(np.cross(a, RNG.normal(size=(500, 3))))
    b = -np.cos(gap) * a + np.sin(gap) * across
    R = so3.minimal_rotation(a, b)
    assert so3.is_rotation(R, tolerance=1e-14)
    assert_close((R @ a[..., None])[..., 0], b, 1e-14)


def test_minimal_rotation_of_opposite_equal_and_zero_vectors() -> None:
    for a in np.vstack([np.eye(3), -np.eye(3)]):
        R = so3.minimal_rotation(a, -a)
        assert_close(R @ a, -a)
        assert_close(R @ R, np.eye(3))
    assert_close(so3.minimal_rotation([0, 0, 2.0], [0, 0, 5.0]), np.eye(3))
    assert_close(so3.minimal_rotation([0, 0, 0], [0, 0, 5.0]), np.eye(3))
    b = RNG.normal(size=(4, 5, 3))
    assert_close(so3.minimal_rotation([0, 0, 1.0], b)[..., 2], so3.unit(b), 1e-15)
    assert_close(so3.unit(np.array([[0, 0, 0], [1e-150, 0, 0]])), np.array([[0, 0, 0], [1, 0, 0]]))


def test_nearest_rotation_equals_kabsch_of_scipy_and_never_reflects() -> None:
    R = random_rotations(20, seed=5)
    assert_close(so3.nearest_rotation(3 * R), R)
    for count, noise in [(2, 0.0), (2, 0.1), (5, 0.3)]:
        a = RNG.normal(size=(count, 3))
        b = a @ R[0].T + noise * RNG.normal(size=(count, 3))
        expected, _ = Rotation.align_vectors(b, a)
        assert_close(so3.nearest_rotation(np.einsum("ni,nj->ij", b, a)), expected.as_matrix(), 1e-9)
    assert_close(so3.nearest_rotation(np.diag([3.0, 2.0, -1.0])), np.eye(3))


@given(st.floats(-3.1, 3.1), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_heading_is_the_nearest_rotation_about_z(yaw: float, pitch: float, roll: float) -> None:
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    assert so3.heading(so3.about_axis("z", yaw)) == pytest.approx(yaw)
    best = so3.heading(R)
    own = so3.angle_between(so3.about_axis("z", best), R)
    around = best + np.linspace(-0.5, 0.5, 41)
    assert own <= so3.angle_between(so3.about_axis("z", around), R).min() + 1e-12


def test_quaternions_are_continuous_over_time() -> None:
    angle = np.linspace(0, 6 * np.pi, 400)
    R = np.stack([so3.about_axis("x", angle), so3.about_axis("z", -2 * angle)], axis=1)
    quat = so3.to_quat_wxyz(R)
    assert np.linalg.norm(np.diff(quat, axis=0), axis=-1).max() < 0.1
    assert_close(so3.from_quat_wxyz(quat), R)
    scipy = Rotation.from_matrix(R[:, 0]).as_quat(scalar_first=True)
    assert_close(quat[:, 0] ** 2, scipy**2)
    assert_close(so3.from_quat_wxyz([1.0, 0, 0, 0]), np.eye(3))
    turns = np.concatenate(
        [R.reshape(-1, 3, 3), [np.diag(d) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]]
    )
    for matrix in (*turns, R.reshape(-1, 3, 3)[0] * (1 + 1e-6)):  # the last is no rotation to rounding
        assert_close(so3.to_quat_wxyz(matrix), Rotation.from_matrix(matrix).as_quat(scalar_first=True), 1e-15)
    with pytest.raises(ValueError, match="determinant"):
        so3.to_quat_wxyz(np.diag([1.0, 1.0, -1.0]))


def test_is_rotation_refuses_reflections_scaling_nan_and_infinity() -> None:
    assert so3.is_rotation(random_rotations(5))
    assert so3.is_rotation(np.empty((0, 3, 3)))
    assert not so3.is_rotation(np.diag([1.0, 1, -1]))
    assert not so3.is_rotation(1.001 * np.eye(3))
    assert so3.is_rotation(1.001 * np.eye(3), tolerance=0.01)
    assert not so3.is_rotation(np.full((3, 3), np.nan))
    assert not so3.is_rotation(np.full((3, 3), np.inf))
    assert not so3.is_rotation(np.stack([np.eye(3), np.full((3, 3), np.nan)]))


@pytest.mark.parametrize("order", ORDERS)
def test_euler_products_and_angles_equal_scipy(order: str) -> None:
    angles = RNG.uniform(-7, 7, (40, 3))
    expected = Rotation.from_euler(order.upper(), angles).as_matrix()
    assert_close(so3.euler_to_matrix(order, angles), expected)
    angles = RNG.uniform([-3, -1.4, -3], [3, 1.4, 3], (40, 3))
    assert_close(so3.matrix_to_euler(order, so3.euler_to_matrix(order, angles)), angles, 1e-12)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("gap", [0.0, 1e-14, 1e-12, 1e-10, 1e-7, 1e-4])
def test_angles_are_exact_at_and_near_a_singular_posture(order: str, gap: float) -> None:
    outer = RNG.uniform(-3, 3, (20, 2))
    for side in (1, -1):
        angles = np.stack([outer[:, 0], np.full(20, side * (np.pi / 2 - gap)), outer[:, 1]], -1)
        R = so3.euler_to_matrix(order, angles)
        found = so3.matrix_to_euler(order, R)
        assert_close(so3.euler_to_matrix(order, found), R, 3e-12 if gap < 1e-11 else 1e-15)
        assert np.all(np.abs(found[:, 1]) <= np.pi / 2)


def test_singular_posture_has_the_whole_turn_in_the_third_angle() -> None:
    R = so3.euler_to_matrix("yxz", [0.3, np.pi / 2, 0.0])
    found = so3.matrix_to_euler("yxz", R)
    assert_close(found[..., :2], np.array([0.0, np.pi / 2]))
    assert abs(found[2]) == pytest.approx(0.3)


@given(VECTORS, st.tuples(*[st.floats(-20, 20)] * 3).map(np.array))
def test_nearest_angles_are_the_nearest_of_all_equivalent_ones(angles: Array, near: Array) -> None:
    best = so3.euler_near(angles, near)
    assert_close(so3.euler_to_matrix("zyx", best), so3.euler_to_matrix("zyx", angles), 1e-12)
    turns = 2 * np.pi * np.array(list(product(range(-5, 6), repeat=3)))
    other = np.array([angles[0] + np.pi, np.pi - angles[1], angles[2] + np.pi])
    family = np.vstack([angles + turns, other + turns])
    shortest = np.linalg.norm(family - near, axis=1).min()
    assert np.linalg.norm(best - near) <= shortest + 1e-9


@pytest.mark.parametrize("order", ORDERS)
def test_continuous_angles_pass_turns_and_branches_without_a_jump(order: str) -> None:
    t = np.linspace(0, 1, 400)[:, None]
    angles = np.stack([9 * t, 1 + 4 * t, -8 * t], axis=-1)  # the middle one passes 90 degrees twice
    R = so3.euler_to_matrix(order, angles)
    found = so3.euler_continuous(so3.matrix_to_euler(order, R))
    assert_close(found, angles, 1e-9)
    assert_close(so3.euler_continuous(found[:1]), found[:1])


def test_angle_about_a_given_axis() -> None:
    rng = np.random.default_rng(8)
    for angle in [*rng.uniform(-np.pi, np.pi, 20), 0.0, 1e-9, np.pi / 2]:
        axis = so3.unit(rng.normal(size=3))
        assert so3.angle_about(axis, so3.exp(angle * axis)) == pytest.approx(angle, abs=1e-12)


def test_missing_rotations_stay_missing_as_quaternions_and_vectors() -> None:
    R = so3.exp(np.random.default_rng(0).normal(size=(5, 2, 3)))
    R[1, 0] = R[4] = np.nan
    for there, back in ((so3.known_to_quat_wxyz, so3.known_from_quat_wxyz), (so3.known_log, so3.known_exp)):
        values = there(R)
        np.testing.assert_array_equal(np.isnan(values).all(axis=-1), np.isnan(R[..., 0, 0]))
        np.testing.assert_allclose(back(values), R, rtol=0, atol=1e-12)
