"""IMU alignment with planted sensors: Pinocchio moves the body, the sensors say what they feel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.calibration import ImuCalibration
from rtof_kin.errors import CalibrationError, RtofError, ShapeError, UnknownNameError
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import GRAVITY_WORLD, ImuSequence

Array = NDArray[np.float64]
RNG = np.random.default_rng(3)
SENSORS = ("L_LowArm", "Pelvis", "R_LowLeg", "Head")
S, T, RATE = len(SENSORS), 40, 60.0


@dataclass(frozen=True)
class Planted:
    """A moving body with sensors on it, all from Pinocchio."""

    imus: ImuSequence
    calibration: ImuCalibration
    R_world_bone: Array
    a_world: Array
    p_world_sensor: Array


def body_motion(skeleton: SkeletonModel) -> tuple[Array, Array, Array]:
    """Configurations (T, nq), velocities and accelerations (T, nv) that belong together."""
    model = skeleton.model
    t = np.arange(T) / RATE
    phase, rate = RNG.uniform(0, 6, model.nv), RNG.uniform(2, 6, model.nv)
    amplitude = RNG.uniform(0.1, 0.4, model.nv)
    # Along the manifold from the N-pose: for the free base only its translation, plus a constant spin.
    x = amplitude * np.sin(rate * t[:, None] + phase)
    v = amplitude * rate * np.cos(rate * t[:, None] + phase)
    a = -amplitude * rate**2 * np.sin(rate * t[:, None] + phase)
    spin = np.array([0.3, -0.5, 1.1])
    q = np.tile(skeleton.n_pose(), (T, 1))
    R = so3.exp(t[:, None] * spin)
    q[:, :3], q[:, 7:] = x[:, :3], q[:, 7:] + x[:, 6:]
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(R), -1, axis=-1)
    # Pinocchio's base velocity is in the base's own axes: v_base = R^T v_world, and its derivative.
    R_base_world = np.swapaxes(R, -1, -2)
    v_base = (R_base_world @ v[:, :3, None])[..., 0]
    a_base = (R_base_world @ a[:, :3, None])[..., 0] - np.cross(spin, v_base)
    v[:, :3], a[:, :3] = v_base, a_base
    v[:, 3:6], a[:, 3:6] = spin, 0.0
    return q, v, a


@pytest.fixture(scope="module")
def planted_body() -> Planted:
    skeleton = SkeletonModel.default()
    model = skeleton.model.copy()
    joints = [skeleton.sensors[name][0] for name in SENSORS]
    levers = np.array([skeleton.sensors[name][1] for name in SENSORS])
    R_sensor_bone = so3.exp(RNG.normal(size=(S, 3)))
    R_world_inertial = so3.about_axis("z", RNG.uniform(-3, 3, S))
    frames = []
    for name, joint, lever, R in zip(SENSORS, joints, levers, R_sensor_bone, strict=True):
        body = model.frames[model.getFrameId(joint, pin.FrameType.BODY)]
        placement = body.placement * pin.SE3(R.T, lever)
        frame = pin.Frame(f"imu {name}", body.parentJoint, placement, pin.FrameType.SENSOR)
        frames.append(model.addFrame(frame))
    data = model.createData()
    R_world_bone, R_world_sensor = np.empty((T, S, 3, 3)), np.empty((T, S, 3, 3))
    a_world, p_world_sensor = np.empty((T, S, 3)), np.empty((T, S, 3))
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for t, (q, v, a) in enumerate(zip(*body_motion(skeleton), strict=True)):
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        for s, frame in enumerate(frames):
            bone = model.getFrameId(joints[s], pin.FrameType.BODY)
            R_world_bone[t, s] = data.oMf[bone].rotation
            R_world_sensor[t, s] = data.oMf[frame].rotation
            p_world_sensor[t, s] = data.oMf[frame].translation
            a_world[t, s] = pin.getFrameClassicalAcceleration(model, data, frame, axes).linear
    f = np.einsum("tsji,tsj->tsi", R_world_sensor, a_world - GRAVITY_WORLD)
    R_inertial_sensor = np.swapaxes(R_world_inertial, -1, -2) @ R_world_sensor
    imus = ImuSequence(np.arange(T) / RATE, R_inertial_sensor, f, SENSORS)
    calibration = ImuCalibration(SENSORS, tuple(joints), R_world_inertial, R_sensor_bone, levers)
    return Planted(imus, calibration, R_world_bone, a_world, p_world_sensor)


def calibration(**changes: Any) -> ImuCalibration:
    eye = np.tile(np.eye(3), (2, 1, 1))
    made = ImuCalibration(("a", "b"), ("Hips", "Head"), eye, eye, np.full((2, 3), 0.1))
    return replace(made, **changes)


# --- physics ----------------------------------------------------------------------------------------


def test_orientation_equals_pinocchios_link_placement(planted_body: Planted) -> None:
    out = planted_body.calibration.apply(planted_body.imus)
    assert np.abs(out.R_world_bone - planted_body.R_world_bone).max() < 1e-12


def test_acceleration_equals_pinocchios_at_the_lever_arm(planted_body: Planted) -> None:
    out = planted_body.calibration.apply(planted_body.imus)
    np.testing.assert_allclose(out.a_world, planted_body.a_world, atol=1e-10)
    assert np.linalg.norm(planted_body.a_world, axis=-1).max() > 3.0


def test_it_is_the_second_difference_of_the_sensors_path_not_of_the_joints(
    planted_body: Planted,
) -> None:
    out = planted_body.calibration.apply(planted_body.imus)
    differences = np.diff(planted_body.p_world_sensor, n=2, axis=0) * RATE**2
    averaged = out.resample(out.times).a_world[1:-1]  # [1 4 1] / 6, as the differences are
    assert np.abs(averaged - differences).max() < 0.05
    levers = np.einsum("tsij,sj->tsi", out.R_world_bone, out.p_bone_sensor)
    joint = np.diff(planted_body.p_world_sensor - levers, n=2, axis=0) * RATE**2
    assert np.abs(averaged - joint).max() > 0.5


def test_the_result_carries_segments_lever_arms_and_the_sensors_own_times(
    planted_body: Planted,
) -> None:
    out = planted_body.calibration.apply(planted_body.imus)
    assert out.joints == ("LeftForeArm", "Hips", "RightLeg", "Head")
    np.testing.assert_array_equal(out.times, planted_body.imus.times)
    np.testing.assert_array_equal(out.p_bone_sensor, planted_body.calibration.p_bone_sensor)


@pytest.mark.parametrize("axis", range(3))
def test_at_rest_it_reads_one_gravity_upwards_and_the_acceleration_is_zero(axis: int) -> None:
    """Any of the sensor's axes may be up; the reading is +9.81 along it."""
    up = np.eye(3)[axis]
    R_inertial_sensor = so3.minimal_rotation(up, [0.0, 0.0, 1.0])
    f = np.tile(9.81 * up, (5, 2, 1))
    imus = ImuSequence(np.arange(5.0), np.tile(R_inertial_sensor, (5, 2, 1, 1)), f, ("a", "b"))
    np.testing.assert_allclose(calibration().apply(imus).a_world, 0, atol=1e-14)
    # Upside down the same reading would be two gravities of fall.
    flipped = replace(imus, R_inertial_sensor=so3.about_axis("x", np.pi) @ imus.R_inertial_sensor)
    np.testing.assert_allclose(
        calibration().apply(flipped).a_world, np.broadcast_to([0, 0, -19.62], (5, 2, 3)), atol=1e-12
    )


def test_the_heading_turns_about_the_vertical_and_leaves_gravity_alone() -> None:
    f = np.tile([1.0, 0.0, 9.81], (3, 2, 1))
    imus = ImuSequence(np.arange(3.0), np.tile(np.eye(3), (3, 2, 1, 1)), f, ("a", "b"))
    turned = calibration(R_world_inertial=so3.about_axis("z", np.array([0.0, np.pi / 2])))
    out = turned.apply(imus)
    np.testing.assert_allclose(out.a_world[0], [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(out.R_world_bone[0, 1] @ [1.0, 0, 0], [0, 1, 0], atol=1e-12)


def test_missing_samples_stay_missing_each_for_itself(planted_body: Planted) -> None:
    R, f = np.array(planted_body.imus.R_inertial_sensor), np.array(planted_body.imus.f_sensor)
    R[3, 1], f[5, 2] = np.nan, np.nan
    out = planted_body.calibration.apply(
        replace(planted_body.imus, R_inertial_sensor=R, f_sensor=f)
    )
    assert np.isnan(out.R_world_bone[3, 1]).all()
    assert np.isnan(out.a_world[3, 1]).all()  # no acceleration in world without an orientation
    assert np.isfinite(out.R_world_bone[5, 2]).all()
    assert np.isnan(out.a_world[5, 2]).all()
    assert np.isfinite(out.a_world).sum() == 3 * (T * S - 2)


def test_the_order_is_the_sensors_not_the_calibrations(planted_body: Planted) -> None:
    whole = planted_body.calibration.apply(planted_body.imus)
    some = planted_body.calibration.apply(planted_body.imus.select(["Head", "L_LowArm"]))
    assert some.joints == ("Head", "LeftForeArm")
    np.testing.assert_array_equal(some.R_world_bone, whole.R_world_bone[:, [3, 0]])
    np.testing.assert_array_equal(some.p_bone_sensor, whole.p_bone_sensor[[3, 0]])
    np.testing.assert_array_equal(some.a_world, whole.a_world[:, [3, 0]])


# --- what it refuses ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"joints": ("Hips",)}, CalibrationError, "calibration: 2 sensors but 1 segments"),
        ({"sensors": ("a", "a")}, CalibrationError, "sensor a stands there more than once"),
        ({"joints": ("Hips", "Hips")}, CalibrationError, "segment Hips stands there more than once"),
        ({"R_world_inertial": np.eye(3)}, ShapeError, r"R_world_inertial: expected shape \(2, 3, 3\)"),
        ({"R_sensor_bone": np.zeros((1, 3, 3))}, ShapeError, r"R_sensor_bone: expected shape \(2, 3"),
        ({"p_bone_sensor": np.zeros((3, 2))}, ShapeError, r"p_bone_sensor: expected shape \(2, 3\)"),
        (
            {"R_sensor_bone": np.stack([np.eye(3), 2 * np.eye(3)])},
            CalibrationError,
            "calibration of b: R_sensor_bone is not a rotation",
        ),
        (
            {"R_world_inertial": np.stack([np.full((3, 3), np.nan), np.eye(3)])},
            CalibrationError,
            "calibration of a: R_world_inertial is not a rotation",
        ),
        (
            {"p_bone_sensor": np.array([[0, 0, 0], [0, 130.0, 0]])},
            CalibrationError,
            "calibration of b: its lever arm is not finite or longer than 1 m; give metres",
        ),
        (
            {"p_bone_sensor": np.array([[0, np.nan, 0], [0, 0, 0]])},
            CalibrationError,
            "calibration of a: its lever arm is not finite",
        ),
    ],
)  # fmt: skip
def test_a_calibration_that_cannot_be_is_refused(
    changes: dict[str, Any], error: type[RtofError], message: str
) -> None:
    with pytest.raises(error, match=message):
        calibration(**changes)


def test_a_sensor_without_a_calibration_is_named(planted_body: Planted) -> None:
    with pytest.raises(
        CalibrationError,
        match="no calibration for the sensors L_LowArm, Pelvis, R_LowLeg, Head; there is one for a, b",
    ):
        calibration().apply(planted_body.imus)
    with pytest.raises(UnknownNameError, match=r"unknown calibrated sensor 'c'\. Known: a, b"):
        calibration().select(("c",))


def test_a_calibration_cannot_be_changed_by_accident() -> None:
    made, mine = calibration(), np.zeros((2, 3))
    with pytest.raises(FrozenInstanceError):
        made.sensors = ("x", "y")  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        made.R_sensor_bone[0, 0, 0] = 5
    kept = calibration(p_bone_sensor=mine)
    mine[0] = 0.9
    assert not kept.p_bone_sensor.any()


@pytest.mark.parametrize("field", ["R_world_inertial", "R_sensor_bone", "p_bone_sensor"])
def test_every_part_of_the_calibration_changes_the_result(
    planted_body: Planted, field: str
) -> None:
    """Else a test above could pass with a part ignored."""
    wrong: Callable[[Array], Array] = (
        (lambda x: x + 0.01) if field == "p_bone_sensor" else lambda x: x @ so3.exp([0, 0, 0.1])
    )
    changes: dict[str, Any] = {field: wrong(getattr(planted_body.calibration, field))}
    off = replace(planted_body.calibration, **changes)
    a, b = planted_body.calibration.apply(planted_body.imus), off.apply(planted_body.imus)
    changed = [
        name
        for name in ("R_world_bone", "a_world", "p_bone_sensor")
        if not np.allclose(getattr(a, name), getattr(b, name), atol=1e-6)
    ]
    expected = {
        "R_world_inertial": ["R_world_bone", "a_world"],
        "R_sensor_bone": ["R_world_bone"],
        "p_bone_sensor": ["p_bone_sensor"],
    }
    assert changed == expected[field]
