"""Straight legs as evidence of mountings: who stands, who walks, and what that says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.straight_legs import StraightLeg, straight_legs
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import BoneImuSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
SENSORS = planted.LIMBS


def bent(motion: Motion, degrees: float) -> Motion:
    """The motion with both shanks turned back."""
    R = np.array(motion.poses.R_world_bone)
    for name in ("LeftLeg", "RightLeg"):
        j = BODY.index(name)[0]
        R[:, j] = R[:, j] @ so3.about_axis("y", np.radians(degrees))
    return replace(motion, poses=replace(motion.poses, R_world_bone=R))


def worn(motion: Motion, mounting: Array) -> BoneImuSequence:
    """Sensors on the limbs, mounted otherwise than declared by rotations (S, 3)."""
    measured = planted.bone_imus(BODY, motion.poses, SENSORS, 0.0)
    return replace(measured, R_world_bone=measured.R_world_bone @ so3.exp(-mounting))


def found(motion: Motion, mounting: Array | None = None) -> tuple[StraightLeg, ...]:
    mounting = np.zeros((len(SENSORS), 3)) if mounting is None else mounting
    imus = worn(motion, mounting)
    return straight_legs([(imus, motion.poses)], imus.joints)


def test_standing_is_found_and_lacks_nothing_but_the_spread_of_people() -> None:
    mounting = 0.1 * np.random.default_rng(0).normal(size=(len(SENSORS), 3))
    legs = found(planted.upright(BODY, 120), mounting)
    assert [leg.still for leg in legs] == [True, True]
    for leg in legs:
        r, _ = leg.residuals(mounting)
        share = np.sqrt(5 / 4)  # of Student's t with 4 degrees of freedom, where nothing contradicts
        assert r[0] == pytest.approx(-0.5 * share, abs=0.05)  # knees of 0 where others have 2 +- 4 degrees
        assert r[1] == pytest.approx(-1.0, abs=0.1)
        assert r[2:] == pytest.approx([0.0, 0.0], abs=1e-5)


def test_a_walk_counts_by_its_straightest_tenth_and_not_beside_a_still_second() -> None:
    walk, _ = planted.walking(BODY, 6.0)
    legs = found(walk)
    assert [leg.still for leg in legs] == [False, False]
    assert {leg.up.shape[1] for leg in legs} == {36}
    imus, stood = worn(walk, np.zeros((len(SENSORS), 3))), planted.upright(BODY, 90)
    both = straight_legs([(imus, walk.poses), (worn(stood, np.zeros((8, 3))), stood.poses)], imus.joints)
    assert [leg.still for leg in both] == [True, True]


def test_nobody_stands_who_sits_or_dances_or_lacks_a_sensor() -> None:
    sits = planted.upright(BODY, 120)
    R = np.array(sits.poses.R_world_bone)
    R[:, BODY.index("LeftUpLeg", "RightUpLeg")] = so3.about_axis("y", -np.pi / 2)
    assert found(replace(sits, poses=replace(sits.poses, R_world_bone=R))) == ()
    assert found(planted.moving(BODY, 240, radians=0.5)) == ()
    stood = planted.upright(BODY, 120)
    imus = worn(stood, np.zeros((len(SENSORS), 3)))
    assert straight_legs([(imus, stood.poses)], ["LeftUpLeg", "RightLeg"]) == ()


def test_bent_knees_that_contradict_count_less() -> None:
    zero = np.zeros((len(SENSORS), 3))
    by_degrees = {bend: found(bent(planted.upright(BODY, 120), bend))[0].residuals(zero) for bend in (2.0, 10.0, 25.0)}
    assert by_degrees[2.0][0][0] == pytest.approx(0.0, abs=0.02)
    slopes = [float(np.abs(J[0]).max()) for _, J in by_degrees.values()]
    assert slopes[0] > 1.2 * slopes[1] > 2 * slopes[2]
    assert by_degrees[25.0][0][0] < 25 / 4  # of a normal distribution


@pytest.mark.parametrize("still", [True, False])
def test_derivatives_equal_finite_differences(still: bool) -> None:
    rng = np.random.default_rng(1)
    leg = StraightLeg((1, 3), so3.unit(np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(2, 5, 3))), still)
    y, step = 0.2 * rng.normal(size=(4, 3)), 1e-6
    numeric = [
        (leg.residuals(y + e.reshape(4, 3))[0] - leg.residuals(y - e.reshape(4, 3))[0]) / (2 * step)
        for e in step * np.eye(12)
    ]
    np.testing.assert_allclose(leg.residuals(y)[1], np.transpose(numeric), atol=1e-6)
