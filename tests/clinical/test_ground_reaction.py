"""Ground reaction force and centre of pressure against statics, planted motion and momentum."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pinocchio as pin
import pytest
from clinical_support import walk
from numpy.typing import NDArray
from scipy.optimize import linprog

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.ground_reaction import Contact, GroundReaction, _hull_distance, _shares
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T, RATE = 240, 60.0
LIGHT_LINKS = 1e-3  # share of the body's mass that the URDF's massless links add at most
IN = slice(40, -40)


def motion_of(q: Array) -> Motion:
    p, R = BODY.forward_kinematics(q)
    return Motion(BODY, q, PoseSequence(np.arange(len(q)) / RATE, p, R, BODY.names), BODY.check(q))


def standing(**degrees: float) -> Array:
    """Configurations (T, nq) of the T-pose with some revolutes turned, the lowest heel at z = 0."""
    q = np.tile(BODY.t_pose(), (T, 1))
    for name, angle in degrees.items():
        q[:, 7 + BODY.dof_names.index(name)] = np.radians(angle)
    p, R = BODY.forward_kinematics(q[:1])
    heels = [BODY.landmarks[f"{side}Heel"][1] for side in ("Right", "Left")]
    ankles = BODY.index("RightFoot", "LeftFoot")
    low = min((p[0, j] + R[0, j] @ heel)[2] for j, heel in zip(ankles, heels, strict=True))
    q[:, 2] -= low
    return q


def reaction(q: Array, weight_kg: float = 70.0) -> GroundReaction:
    found = analyse(motion_of(q), weight_kg=weight_kg).ground_reaction
    assert found is not None
    return found


def identifiable(found: GroundReaction) -> NDArray[np.bool_]:
    """Frames in which one foot bears the whole known force."""
    return np.isin(found.state, (Contact.RIGHT, Contact.LEFT)) & np.isfinite(found.force[:, 2])


def centre_of_mass(q: Array, weight_kg: float = 70.0) -> Array:
    model = BODY.with_mass(weight_kg).model
    data = model.createData()
    return np.array([pin.centerOfMass(model, data, one).copy() for one in q])


def test_on_two_feet_the_floor_bears_the_weight_under_the_centre_of_mass() -> None:
    q = standing()
    found = reaction(q)
    assert set(found.state[IN]) == {Contact.BOTH}
    np.testing.assert_allclose(found.force[IN], [[0, 0, 70 * STANDARD_GRAVITY]] * (T - 80), atol=1.0)
    np.testing.assert_allclose(found.pressure[IN], centre_of_mass(q)[IN, :2], atol=2e-3)
    assert any("not identifiable" in note for note in found.notes)
    low, high = found.vertical[T // 2, 0] / found.force[T // 2, 2]
    assert low < 0.5 < high
    assert not identifiable(found).any()
    sums = found.vertical[IN].sum(axis=1)  # one foot's least is the other's most
    np.testing.assert_allclose(found.vertical[IN, 0, 0] + found.vertical[IN, 1, 1], found.force[IN, 2])
    assert np.all(np.diff(sums, axis=1) >= 0)


def test_on_one_foot_it_bears_all() -> None:
    q = standing(LeftUpLeg_y=-60.0, LeftLeg_y=60.0)
    found = reaction(q)
    assert set(found.state[IN]) == {Contact.RIGHT}
    weight = pytest.approx(70 * STANDARD_GRAVITY, rel=2 * LIGHT_LINKS)
    assert found.vertical[T // 2, 0].tolist() == [weight, weight]
    assert found.vertical[T // 2, 1].tolist() == [0.0, 0.0]
    assert identifiable(found)[IN].all()
    # The posture is not balanced: the body's centre of mass is not over that foot.
    assert np.nanmedian(found.outside) > 0.03
    assert any("outside the soles" in note for note in found.notes)


def test_a_body_that_bobs_presses_with_its_acceleration() -> None:
    q = standing()
    times, amplitude, omega = np.arange(T) / RATE, 0.02, 2 * np.pi * 0.8
    q[:, 2] += amplitude * (1 - np.cos(omega * times))
    found = reaction(q)
    expected = 70 * (STANDARD_GRAVITY + amplitude * omega**2 * np.cos(omega * times))
    np.testing.assert_allclose(found.force[IN, 2], expected[IN], rtol=5e-3)


def test_a_sway_moves_the_centre_of_pressure_beyond_that_of_mass() -> None:
    q = standing()
    times, omega = np.arange(T) / RATE, 2 * np.pi * 0.7
    q[:, 0] += 0.01 * np.sin(omega * times)
    found, com = reaction(q), centre_of_mass(q)
    height = com[:, 2] - found.floor
    expected = com[:, 0] + height * 0.01 * omega**2 * np.sin(omega * times) / STANDARD_GRAVITY
    np.testing.assert_allclose(found.pressure[IN, 0], expected[IN], atol=2e-3)


def test_ballistic_flight_has_no_force_and_no_centre_of_pressure() -> None:
    q = standing()
    q[:, 2] += 20 + 3 * np.arange(T) / RATE - 0.5 * STANDARD_GRAVITY * (np.arange(T) / RATE) ** 2
    q[:60, 2], q[180:, 2] = q[60, 2], q[180, 2]  # held, so that the feet are slow somewhere
    found = reaction(q)
    flight = slice(100, 140)
    assert set(found.state[flight]) == {Contact.NONE}
    assert np.abs(found.force[flight]).max() < 0.02 * found.body_weight
    assert np.isnan(found.pressure[flight]).all()
    assert (found.vertical[flight] == 0).all()
    assert any("should be zero" in note for note in found.notes)


def test_walking_keeps_the_balance_of_momentum() -> None:
    motion = walk()
    analysis = analyse(motion, weight_kg=70.0)
    found = analysis.ground_reaction
    assert found is not None
    known = np.flatnonzero(np.isfinite(found.force[:, 2]))
    a, b = known[10], known[-10]
    model = BODY.with_mass(70.0).with_offsets(motion.skeleton.joint_offsets).model
    data, mass = model.createData(), pin.computeTotalMass(model)
    com = np.array([pin.centerOfMass(model, data, one).copy() for one in motion.q])
    v = np.gradient(com, motion.times, axis=0)
    impulse = np.trapezoid(found.force[a : b + 1] - [0, 0, mass * STANDARD_GRAVITY], motion.times[a : b + 1], axis=0)
    change = mass * (v[b] - v[a])
    span = found.body_weight * (motion.times[b] - motion.times[a])
    np.testing.assert_allclose(impulse, change, atol=0.02 * span)
    assert {Contact.RIGHT, Contact.LEFT, Contact.BOTH} <= set(found.state[a:b])
    single = identifiable(found)
    assert np.nanmedian(found.outside[single]) < 0.05


def test_intervals_are_those_of_a_linear_programme() -> None:
    rng = np.random.default_rng(3)
    square = np.array([[-0.05, -0.12], [0.05, -0.12], [0.05, 0.12], [-0.05, 0.12]])
    for _ in range(20):
        soles = np.stack([square + rng.normal(0, 0.2, 2), square + rng.normal(0, 0.2, 2)])
        weights = rng.dirichlet(np.ones(8))
        point = weights @ soles.reshape(8, 2)
        low, high = _shares(point[None, None], soles[None])
        A = np.vstack([soles.reshape(8, 2).T, np.ones(8)])
        for sign, found in ((1, low), (-1, high)):
            cost = sign * np.r_[np.ones(4), np.zeros(4)]
            best = linprog(cost, A_eq=A, b_eq=[*point, 1.0], bounds=(0, None))
            assert found[0] == pytest.approx(sign * best.fun, abs=1e-6)


def test_distances_from_hulls() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    points = np.array([[0.5, 0.5], [2.0, 0.5], [2.0, 2.0], [1.0, 0.3]])
    found = _hull_distance(points, np.tile(square, (4, 1, 1)))
    np.testing.assert_allclose(found, [0, 1, np.sqrt(2), 0], atol=1e-12)


def test_bands_follow_the_wrench() -> None:
    from rtof_kin.clinical.ground_reaction import _pressure
    from rtof_kin.clinical.torques import joint_torques

    torques = joint_torques(motion_of(standing()), 70.0)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.array([5, 5, 5, 2, 2, 2])[:, None]
    C = A @ A.T
    wrench, reference = torques.wrench[[T // 2]], torques.reference[[T // 2]]
    drawn = wrench + rng.multivariate_normal(np.zeros(6), C, 4000)
    p, _ = _pressure(drawn, np.tile(reference, (4000, 1)), np.tile(C, (4000, 1, 1)), 0.0)
    _, spread = _pressure(wrench, reference, C[None], 0.0)
    np.testing.assert_allclose(np.cov(p.T), spread[0], rtol=0.15, atol=1e-7)
    assert len(list(combinations(range(8), 3))) == 56
