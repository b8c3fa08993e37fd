"""Joint torques against statics, and the external wrench."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import planted
import pytest
from clinical_support import body_paths, walk
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.body_dynamics import UNKNOWN, BodyDynamics, ErrorSpectrum, error_gains
from rtof_kin.clinical.gait import analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.ground_reaction import single_support
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.clinical.torques import JointTorques, joint_torques
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T = 60
LIGHT_LINKS = 1e-3
"""Share of the body's mass that the URDF's links between the revolutes of a ball joint add at most."""


def static(**degrees: float) -> Motion:
    """The T-pose with some revolutes turned, constant for a second."""
    q = np.tile(BODY.t_pose(), (T, 1))
    for name, angle in degrees.items():
        q[:, 7 + BODY.dof_names.index(name)] = np.radians(angle)
    p, R = BODY.forward_kinematics(q)
    return Motion(BODY, q, PoseSequence(np.arange(T) / 60, p, R, BODY.names), BODY.check(q))


def middle(torques: JointTorques, name: str) -> float:
    return float(torques.torques[T // 2, torques.dof_names.index(name)])


def body_weights(torques: JointTorques) -> Array:
    """(T,) vertical external force."""
    return np.asarray(torques.root_wrench[:, 2] / (torques.weight_kg * STANDARD_GRAVITY))


def test_shoulder_torque_of_a_level_arm_is_its_weight_times_its_lever() -> None:
    torques = joint_torques(static(), 80.0)
    model = BODY.with_mass(80.0).model
    data = model.createData()
    pin.forwardKinematics(model, data, BODY.t_pose())
    shoulder = data.oMi[model.getJointId("RightArm_z")].translation
    expected = 0.0
    for i in range(1, model.njoints):
        if model.names[i].startswith(("RightArm", "RightForeArm", "RightHand")):
            lever = data.oMi[i].act(model.inertias[i].lever) - shoulder
            expected += model.inertias[i].mass * model.gravity.linear[2] * lever[1]
    # About x, forward, a positive torque lowers the right arm.
    assert middle(torques, "RightArm_x") == pytest.approx(-expected, rel=1e-6)
    assert 8 < expected < 14


def test_unobserved_degrees_of_freedom_are_noted_by_clinical_name() -> None:
    motion = static(RightLeg_y=20.0)
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA)
    seen = replace(motion, poses=replace(motion.poses, provenance=provenance))
    assert any(
        "right ankle dorsiflexion/plantarflexion (RightFoot_y)" in note for note in joint_torques(seen, 80.0).notes
    )
    assert not any("RightFoot_y" in note for note in joint_torques(motion, 80.0).notes)


def test_external_force_at_rest_is_one_body_weight() -> None:
    torques = joint_torques(static(), 80.0)
    inside = torques.root_wrench[8:-8]
    np.testing.assert_allclose(inside[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(body_weights(torques)[8:-8], 1, atol=LIGHT_LINKS)
    np.testing.assert_array_equal(torques.unexplained, torques.root_wrench)
    assert "no ground reaction force" in torques.notes[0]


def test_free_fall_needs_no_external_force() -> None:
    motion = static()
    q = np.array(motion.q)
    q[:, 2] += 5 - 0.5 * STANDARD_GRAVITY * (np.arange(T) / 60) ** 2
    torques = joint_torques(replace(motion, q=q), 70.0)
    assert np.nanmax(np.abs(body_weights(torques)[15:-15])) < 0.05


def test_the_supporting_leg_bears_the_whole_external_wrench() -> None:
    torques = joint_torques(static(), 80.0, support=np.zeros(T, dtype=int))
    np.testing.assert_allclose(torques.unexplained[8:-8], 0, atol=1e-9)
    assert np.nanmin(torques.root_wrench[:, 2]) == pytest.approx(80 * STANDARD_GRAVITY, rel=LIGHT_LINKS)
    hanging = joint_torques(static(), 80.0)
    assert abs(middle(torques, "RightUpLeg_x")) > 10 * abs(middle(hanging, "RightUpLeg_x"))
    assert middle(torques, "LeftUpLeg_x") == pytest.approx(middle(hanging, "LeftUpLeg_x"), abs=1e-9)
    assert middle(torques, "RightArm_x") == pytest.approx(middle(hanging, "RightArm_x"), abs=1e-9)


def test_walking_has_a_mean_force_of_one_body_weight_and_ankle_push_off() -> None:
    motion = walk()
    gait = analyse_gait(gait_events(body_paths(motion.poses, motion.skeleton)))
    support = single_support(gait)
    for stride in gait.strides:
        swing = (motion.times > stride.toe_off) & (motion.times < stride.stop)
        assert set(support[swing]) <= {{"right": 1, "left": 0}[stride.side], UNKNOWN}
    assert 0.3 < np.mean(support != UNKNOWN) < 0.7
    torques = joint_torques(motion, 70.0, support=support)
    (first, *_, last) = (s for s in gait.strides if s.side == "right")
    cycles = (motion.times >= first.start) & (motion.times < last.stop)
    assert np.nanmean(body_weights(torques)[cycles]) == pytest.approx(1, abs=0.05)
    assert np.nanmax(np.abs(torques.unexplained[support != UNKNOWN])) < 1e-9
    ankle = torques.torques[:, torques.dof_names.index("RightFoot_y")] / 70  # positive: toes down
    assert 1.0 < np.nanmax(ankle) < 2.2  # Winter: 1.6 N m / kg
    swinging = np.abs(ankle[support == 1])
    assert np.nanmax(swinging) < 0.1
    assert np.isnan(ankle[support == UNKNOWN]).all()
    assert any("torques of the legs in" in note for note in torques.notes)


@pytest.mark.parametrize(
    ("weight", "options", "message"),
    [
        (-70.0, {}, "kilograms"),
        (70_000.0, {}, "kilograms"),
        (float("nan"), {}, "kilograms"),
        (70.0, {"height": 172.0}, "give metres"),
        (70.0, {"support": np.full(T, 2)}, "support: 0 is the right foot"),
        (70.0, {"support": np.zeros(3, dtype=int)}, "support: expected shape"),
    ],
)
def test_implausible_input_is_rejected(weight: float, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        joint_torques(static(), weight, **options)


def test_a_height_that_differs_from_the_skeleton_is_noted() -> None:
    notes = joint_torques(static(), 70.0, height=1.95).notes
    assert any("the height given 1.95 m" in note for note in notes)
    assert len(joint_torques(static(), 70.0, height=BODY.height).notes) == 2


def test_gaps_and_short_stretches_have_no_torques() -> None:
    motion = planted.moving(BODY, 100)
    q = np.array(motion.q)
    q[70:80] = np.nan
    torques = joint_torques(replace(motion, q=q), 70.0)
    assert np.isnan(torques.torques[64:]).all()
    assert np.isfinite(torques.torques[6:64]).all()
    assert any("shorter than 0.5 s" in note for note in torques.notes)
    valid = np.ones_like(motion.poses.valid)
    valid[40:50] = False  # interpolated
    bridged = joint_torques(replace(motion, poses=replace(motion.poses, valid=valid)), 70.0)
    assert np.isnan(bridged.torques[34:56]).all()


HEAVY = SkeletonModel.default().with_mass(75.0)
STEP = 1e-3  # [s]


def state(size: float, motion: Array, error: Array) -> tuple[Array, Array, Array]:
    """q, v and a at time 0 of a smooth motion with a smooth error of a size; both (nv, 3), Taylor's terms."""
    times = STEP * np.arange(-2, 3)
    powers = np.stack([np.ones(5), times, times**2 / 2])
    rows = []
    for x, e in zip((motion @ powers).T, size * (error @ powers).T, strict=True):
        q = pin.integrate(HEAVY.model, pin.neutral(HEAVY.model), np.concatenate([np.zeros(3), x[3:]]))
        R = pin.Quaternion(q[3:7]).toRotationMatrix() @ pin.exp3(e[3:6])
        rows.append(np.concatenate([x[:3] + e[:3], pin.Quaternion(R).coeffs(), q[7:] + e[6:]]))
    v = [pin.difference(HEAVY.model, rows[k - 1], rows[k + 1]) / (2 * STEP) for k in (1, 2, 3)]
    return rows[2], v[1], (v[2] - v[0]) / (2 * STEP)


@pytest.mark.parametrize("carries", [UNKNOWN, 0, 1])
def test_derivatives_are_those_of_a_motion_with_a_planted_error(carries: int) -> None:
    rng = np.random.default_rng(0)
    scales = np.array([1.0, 3.0, 30.0])
    motion, error = (rng.normal(size=(HEAVY.nv, 3)) * scales for _ in range(2))
    body = BodyDynamics(HEAVY)

    def rows(size: float) -> Array:
        found = body.at(*state(size, 0.4 * motion, error), carries)
        return np.concatenate([found.tau[6:], found.wrench])

    numeric = (rows(1e-5) - rows(-1e-5)) / 2e-5
    S = body.derivatives(*state(0.0, 0.4 * motion, error), carries)
    linear = S.value @ error[:, 0] + S.velocity @ error[:, 1] + S.acceleration @ error[:, 2]
    np.testing.assert_allclose(linear, numeric, atol=5e-4 * np.abs(numeric).max())


def test_gains_are_those_of_random_errors_through_the_filter() -> None:
    rate_hz, spectrum = 60.0, ErrorSpectrum(0.7, 0.12)
    times = np.arange(241) / rate_hz
    fast = np.exp(-0.5 * ((times[:, None] - times) / spectrum.seconds) ** 2)
    root = np.linalg.cholesky(fast + 1e-9 * np.eye(len(times)))
    rng = np.random.default_rng(1)
    errors = np.sqrt(spectrum.share) * root @ rng.normal(size=(len(times), 4000))
    errors += np.sqrt(1 - spectrum.share) * rng.normal(size=4000)
    value = smoothed(errors, rate_hz, CUTOFF_HZ)
    velocity = np.gradient(value, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    x, v, a = value[120], velocity[120], acceleration[120]
    found = [x @ x, v @ v, a @ a, x @ a]
    np.testing.assert_allclose(np.array(found) / 4000, error_gains(rate_hz, spectrum), rtol=0.1)
