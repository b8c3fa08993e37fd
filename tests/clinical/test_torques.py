"""Joint torques against statics by hand, and the wrench that the floor must give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import planted
import pytest
from clinical_support import walk
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.gait import analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.torques import UNKNOWN, JointTorques, joint_torques, single_support
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T = 60
LIGHT_LINKS = 1e-3
"""Share of the body's mass that the URDF's links between the revolutes of a ball joint add at most."""


def held(**degrees: float) -> MotionSequence:
    """The T-pose with some revolutes turned, held for a second."""
    q = np.tile(BODY.t_pose(), (T, 1))
    for name, angle in degrees.items():
        q[:, 7 + BODY.dof_names.index(name)] = np.radians(angle)
    p, R = BODY.forward_kinematics(q)
    return MotionSequence(BODY, q, PoseSequence(np.arange(T) / 60, p, R, BODY.names), BODY.check(q))


def middle(torques: JointTorques, name: str) -> float:
    return float(torques.torques[T // 2, torques.dof_names.index(name)])


def test_an_arm_held_level_asks_the_shoulder_for_its_weight_times_its_lever() -> None:
    torques = joint_torques(held(), 80.0)
    model = BODY.with_mass(80.0).model
    data = model.createData()
    pin.forwardKinematics(model, data, BODY.t_pose())
    shoulder = data.oMi[model.getJointId("RightArm_z")].translation
    expected = 0.0
    for i in range(1, model.njoints):
        if model.names[i].startswith(("RightArm", "RightForeArm", "RightHand")):
            lever = data.oMi[i].act(model.inertias[i].lever) - shoulder
            expected += model.inertias[i].mass * STANDARD_GRAVITY * -lever[1]
    # About x, forward: positive lowers the right arm, so holding it up is negative.
    assert middle(torques, "RightArm_x") == pytest.approx(-expected, rel=1e-6)
    assert 8 < expected < 14


def test_torques_about_what_nobody_observed_are_said_to_be_that() -> None:
    motion = held(RightLeg_y=20.0)
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA)
    seen = replace(motion, poses=replace(motion.poses, provenance=provenance))
    assert any("RightFoot_y" in note for note in joint_torques(seen, 80.0).notes)
    assert not any("RightFoot_y" in note for note in joint_torques(motion, 80.0).notes)


def test_at_rest_the_floor_gives_one_body_weight_and_no_more() -> None:
    torques = joint_torques(held(), 80.0)
    inside = torques.root_wrench[8:-8]
    np.testing.assert_allclose(inside[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(torques.body_weights[8:-8], 1, atol=LIGHT_LINKS)
    np.testing.assert_array_equal(torques.unexplained, torques.root_wrench)
    assert "no force of the floor is attributed" in torques.notes[0]


def test_torques_are_proportional_to_the_weight() -> None:
    light, heavy = (joint_torques(held(), kg) for kg in (50.0, 100.0))
    np.testing.assert_allclose(heavy.torques, 2 * light.torques, atol=40 * LIGHT_LINKS)


def test_a_body_in_free_fall_needs_no_force_from_outside() -> None:
    motion = held()
    q = np.array(motion.q)
    q[:, 2] += 5 - 0.5 * STANDARD_GRAVITY * (np.arange(T) / 60) ** 2
    torques = joint_torques(replace(motion, q=q), 70.0)
    assert np.nanmax(np.abs(torques.body_weights[15:-15])) < 0.05


def test_on_one_foot_that_leg_carries_the_whole_body_and_nothing_is_left_over() -> None:
    torques = joint_torques(held(), 80.0, support=np.zeros(T, dtype=int))
    np.testing.assert_allclose(torques.unexplained[8:-8], 0, atol=1e-9)
    assert np.nanmin(torques.root_wrench[:, 2]) == pytest.approx(80 * STANDARD_GRAVITY, rel=LIGHT_LINKS)
    # The body's weight acts some centimetres to the left of the right hip: the thigh is held against it.
    hanging = joint_torques(held(), 80.0)
    assert abs(middle(torques, "RightUpLeg_x")) > 10 * abs(middle(hanging, "RightUpLeg_x"))
    assert middle(torques, "LeftUpLeg_x") == pytest.approx(middle(hanging, "LeftUpLeg_x"), abs=1e-9)
    assert middle(torques, "RightArm_x") == pytest.approx(middle(hanging, "RightArm_x"), abs=1e-9)


def test_in_real_walking_the_floor_gives_a_body_weight_on_average_and_push_off_is_at_the_ankle() -> None:
    motion = walk()
    gait = analyse_gait(gait_events(motion.poses, motion.skeleton))
    support = single_support(gait)
    torques = joint_torques(motion, 70.0, support=support)
    (first, *_, last) = (s for s in gait.strides if s.side == "right")
    cycles = (motion.times >= first.start) & (motion.times < last.stop)
    assert np.nanmean(torques.body_weights[cycles]) == pytest.approx(1, abs=0.05)
    assert np.nanmax(np.abs(torques.unexplained[support != UNKNOWN])) < 1e-9
    ankle = torques.torques[:, torques.dof_names.index("RightFoot_y")] / 70  # positive: toes down
    assert 1.0 < np.nanmax(ankle) < 2.2  # Winter: 1.6 N m / kg
    swinging = np.abs(ankle[support == 1])
    assert np.nanmax(swinging) < 0.1
    assert np.isnan(ankle[support == UNKNOWN]).all()
    assert any("torques of the legs in" in note for note in torques.notes)


def test_one_foot_carries_exactly_while_the_other_swings() -> None:
    motion = walk()
    gait = analyse_gait(gait_events(motion.poses, motion.skeleton))
    support = single_support(gait)
    for stride in gait.strides:
        swing = (motion.times > stride.toe_off) & (motion.times < stride.stop)
        carrier = {"right": 1, "left": 0}[stride.side]
        assert set(support[swing]) <= {carrier, UNKNOWN}
    assert 0.3 < np.mean(support != UNKNOWN) < 0.7


# --- bad input ---


def test_without_a_weight_there_are_no_torques_and_it_is_said_why() -> None:
    with pytest.raises(ShapeError, match="no weight is given; they are proportional to it: say it in kg"):
        joint_torques(held(), None)


@pytest.mark.parametrize("weight", [0.0, -70.0, 70_000.0, float("nan")])
def test_a_weight_that_is_no_persons_is_refused(weight: float) -> None:
    with pytest.raises(InvalidInputError, match="is no person's; give kilograms"):
        joint_torques(held(), weight)


def test_a_height_in_centimetres_is_refused_and_one_that_does_not_fit_is_noted() -> None:
    with pytest.raises(ShapeError, match="a height of 172 m is no person's; give metres"):
        joint_torques(held(), 70.0, height=172.0)
    assert any(
        "the skeleton is 1.7" in note and "the height given 1.95 m" in note
        for note in joint_torques(held(), 70.0, height=1.95).notes
    )
    assert len(joint_torques(held(), 70.0, height=BODY.height).notes) == 1


def test_support_by_a_third_foot_or_of_another_length_is_refused() -> None:
    with pytest.raises(ShapeError, match="support: 0 is the right foot, 1 the left, -1 unknown"):
        joint_torques(held(), 70.0, support=np.full(T, 2))
    with pytest.raises(ShapeError, match="support: expected shape"):
        joint_torques(held(), 70.0, support=np.zeros(3, dtype=int))


def test_gaps_and_short_stretches_have_no_torques() -> None:
    motion = planted.moving(BODY, 100)
    q = np.array(motion.q)
    q[70:80] = np.nan
    torques = joint_torques(replace(motion, q=q), 70.0)
    assert np.isnan(torques.torques[64:]).all()
    assert np.isfinite(torques.torques[6:64]).all()
    assert "1 stretch(es) shorter than 0.5 s have no torques" in torques.notes
    valid = np.ones_like(motion.poses.valid)
    valid[40:50] = False  # bridged: a number for a motion that nobody saw
    bridged = joint_torques(replace(motion, poses=replace(motion.poses, valid=valid)), 70.0)
    assert np.isnan(bridged.torques[34:56]).all()
