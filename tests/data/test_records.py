"""Keypoints, IMUs and poses as data classes: validation, immutability, selection, slices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
T, S, J, L = 6, 2, 3, 4
TIMES = np.arange(T) / 60
RNG = np.random.default_rng(0)


def rotations(*shape: int) -> Array:
    return so3.exp(RNG.normal(size=(*shape, 3)))


def camera(**changes: Any) -> Camera:
    return replace(Camera.looking_at([4.0, 0, 1.5], [0.0, 0, 1], 1000.0), **changes)


def keypoints(**changes: Any) -> KeypointSequence:
    uv, confidence = RNG.uniform(0, 1000, (T, L, 2)), RNG.uniform(0.1, 1, (T, L))
    return replace(KeypointSequence(camera(), TIMES, uv, confidence, tuple("abcd")), **changes)


def imus(**changes: Any) -> ImuSequence:
    f = np.tile([0.0, 0.0, 9.81], (T, S, 1))
    return replace(ImuSequence(TIMES, rotations(T, S), f, ("chest", "wrist")), **changes)


def bone_imus(**changes: Any) -> BoneImuSequence:
    a = RNG.normal(size=(T, S, 3))
    made = BoneImuSequence(TIMES, rotations(T, S), a, np.zeros((S, 3)), ("Spine3", "LeftForeArm"))
    return replace(made, **changes)


def poses(**changes: Any) -> PoseSequence:
    p, R = RNG.normal(size=(T, J, 3)), rotations(T, J)
    return replace(PoseSequence(TIMES, p, R, ("Hips", "Spine", "Head")), **changes)


def with_value(array: Array, index: Any, value: float) -> Array:
    out = np.array(array)
    out[index] = value
    return out


@pytest.mark.parametrize("make", [camera, keypoints, imus, bone_imus, poses])
def test_records_are_frozen_and_their_arrays_read_only(make: Callable[[], Any]) -> None:
    record = make()
    for field in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(record, field.name, None)
        value = getattr(record, field.name)
        assert not (isinstance(value, np.ndarray) and value.flags.writeable), field.name


@pytest.mark.parametrize(
    ("make", "changes", "message"),
    [
        (keypoints, {"times": TIMES[:-1]}, r"keypoints uv_px: expected shape \(5, 4, 2\)"),
        (keypoints, {"confidence": np.ones((T, 3))}, r"keypoints confidence: expected shape \(6, 4\)"),
        (keypoints, {"names": ("a", "b", "b", "a")}, "keypoint names: a, b .* more than once"),
        (keypoints, {"confidence": np.full((T, L), 1.5)}, "keypoints confidence: outside .0, 1.; divide"),
        (keypoints, {"uv_px": np.full((T, L, 2), np.inf)}, "keypoints uv_px: infinite; write NaN"),
        (imus, {"R_inertial_sensor": np.zeros((T, S, 3))}, "IMU R_inertial_sensor: expected shape"),
        (imus, {"f_sensor": np.zeros((T, S))}, r"IMU f_sensor: expected shape \(6, 2, 3\), got \(6, 2\)"),
        (imus, {"f_sensor": np.full((T, S, 3), np.inf)}, "IMU f_sensor: infinite; write NaN where"),
        (imus, {"names": ("a", "a")}, "IMU names: a .* more than once"),
        (imus, {"times": TIMES[::-1]}, "IMU times: time does not increase from index 0"),
        (bone_imus, {"joints": ("Hips", "Hips")}, "bone IMU joints: Hips .* more than once"),
        (bone_imus, {"a_world": np.zeros((T, 1, 3))}, r"bone IMU a_world: expected shape \(6, 2, 3\)"),
        (bone_imus, {"p_bone_sensor": np.zeros(3)}, r"bone IMU p_bone_sensor: expected shape \(2, 3\)"),
        (poses, {"p_world_joint": np.zeros((T, 2, 3))}, r"pose p_world_joint: expected shape \(6, 3"),
        (poses, {"R_world_bone": np.zeros((T, J, 9))}, r"pose R_world_bone: expected shape \(6, 3"),
        (poses, {"names": ("a", "b", "a")}, "pose names: a .* more than once"),
        (poses, {"times": np.full(T, np.nan)}, "pose times: not finite at index 0"),
        (poses, {"provenance": np.zeros(T)}, r"pose provenance: expected shape \(6, 3\), got \(6,\)"),
        (poses, {"provenance": np.full((T, J), 6)}, "pose provenance: .*<Prov"),
        (poses, {"valid": np.ones((T, 1))}, r"pose valid: expected shape \(6, 3\), got \(6, 1\)"),
        (poses, {"orientation_observed": np.ones((T, 2))}, "pose orientation_observed: expected shape"),
        (poses, {"sigma_rad": np.ones((T, 2))}, r"pose sigma_rad: expected shape \(6, 3\), got \(6, 2\)"),
        (poses, {"sigma_rad": with_value(np.ones((T, J)), 2, 0.0)}, "pose sigma_rad: not positive"),
    ],
)
def test_invalid_field_is_named(make: Callable[..., Any], changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make(**changes)


@pytest.mark.parametrize(
    ("make", "field"), [(imus, "R_inertial_sensor"), (bone_imus, "R_world_bone"), (poses, "R_world_bone")]
)
def test_matrix_that_is_not_a_rotation_is_located(make: Callable[..., Any], field: str) -> None:
    good = getattr(make(), field)
    for index, value in (((3, 1, 0, 0), 0.5), ((3, 1), np.diag([1.0, 1, -1])), ((3, 1), np.inf)):
        with pytest.raises(InvalidInputError, match=rf"{field}: not a rotation matrix at index \(3, 1\)"):
            make(**{field: with_value(good, index, value)})  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match=f"{field}: a matrix is partly NaN"):
        make(**{field: with_value(good, (2, 0, 1, 1), np.nan)})
    missing = make(**{field: with_value(good, (2, 0), np.nan)})
    assert np.isnan(getattr(missing, field)).sum() == 9


@pytest.mark.parametrize("make", [keypoints, bone_imus, poses])
def test_slice_cuts_every_field_over_time(make: Callable[[], Any]) -> None:
    base = make()
    part = base[2:5]
    assert len(part) == 3
    for field in fields(base):
        whole, cut = getattr(base, field.name), getattr(part, field.name)
        if isinstance(whole, np.ndarray) and len(whole) == T:
            np.testing.assert_array_equal(cut, whole[2:5])
        elif not isinstance(whole, Camera):
            np.testing.assert_array_equal(cut, whole)
    with pytest.raises(InvalidInputError, match="times: empty"):
        base[4:4]


def test_missing_keypoints_are_nan_with_confidence_zero() -> None:
    base = keypoints()
    uv = with_value(base.uv_px, (0, 0, 1), np.nan)
    confidence = with_value(with_value(base.confidence, (1, 1), 0.0), (2, 2), np.nan)
    out = replace(base, uv_px=uv, confidence=confidence)
    for t, l in [(0, 0), (1, 1), (2, 2)]:
        assert np.isnan(out.uv_px[t, l]).all()
        assert out.confidence[t, l] == 0
    assert out.seen.sum() == T * L - 3
    assert np.isfinite(out.uv_px).sum() == 2 * (T * L - 3)


def test_selection_follows_the_names() -> None:
    base = keypoints()
    out = base.select(["c", "elbow", "a"])
    assert out.names == ("c", "elbow", "a")
    np.testing.assert_array_equal(out.uv_px[:, [0, 2]], base.uv_px[:, [2, 0]])
    assert not out.seen[:, 1].any()
    sensors = imus()
    turned = sensors.select(["wrist", "chest"])
    np.testing.assert_array_equal(turned.R_inertial_sensor, sensors.R_inertial_sensor[:, ::-1])
    with pytest.raises(UnknownNameError, match=r"unknown sensor 'wrst'\. Did you mean 'wrist'"):
        sensors.select(["wrst"])
    bones = bone_imus()
    chosen = bones.select(["LeftForeArm"])
    assert chosen.joints == ("LeftForeArm",)
    np.testing.assert_array_equal(chosen.a_world[:, 0], bones.a_world[:, 1])
    with pytest.raises(UnknownNameError, match=r"unknown IMU segment 'Spine4'\. Did you mean"):
        bones.select(["Spine4"])


def test_keypoints_are_resampled_but_not_over_missing_frames() -> None:
    uv = np.stack([np.arange(T, dtype=float), 2.0 * np.arange(T)], axis=-1)[:, None]
    uv[3] = np.nan
    given = KeypointSequence(camera(), TIMES, uv, np.full((T, 1), 0.5), ("Hips",))
    other = given.resample(TIMES[:-1] + 0.25 / 60)
    np.testing.assert_allclose(other.uv_px[[0, 1, 4], 0], [[0.25, 0.5], [1.25, 2.5], [4.25, 8.5]])
    np.testing.assert_array_equal(other.seen[:, 0], [True, True, False, False, True])
    assert given.resample(TIMES) is given
    assert not given.resample(TIMES + 10.0).seen.any()


def test_a_missing_position_is_invalid_and_no_orientation_is_observed_by_default() -> None:
    base = poses()
    out = PoseSequence(base.times, with_value(base.p_world_joint, (1, 2, 0), np.nan), base.R_world_bone, base.names)
    assert out.valid.sum() == T * J - 1
    assert not replace(out, valid=np.ones((T, J))).valid[1, 2]
    assert not out.orientation_observed.any()
    one_row = poses(orientation_observed=np.array([True, False, True]))
    np.testing.assert_array_equal(one_row.orientation_observed, [[True, False, True]] * T)
