"""The records: what they accept, what they refuse and in which words, and that nobody can change them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.checks import checked_times, indices_of, readonly
from rtof_kin.errors import FileFormatError, RtofError, ShapeError, UnitError, UnknownNameError
from rtof_kin.types import (
    GRAVITY_WORLD,
    BoneImuSequence,
    Camera,
    ImuSequence,
    KeypointSequence,
    PoseSequence,
    Provenance,
)

Array = NDArray[np.float64]
T, S, J, L = 6, 2, 3, 4
TIMES = np.arange(T) / 60
RNG = np.random.default_rng(0)
K = np.array([[1200.0, 0, 960], [0, 1100.0, 540], [0, 0, 1]])
UPRIGHT = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""A camera that looks along world x: right is -y, down is -z."""


def rotations(*shape: int) -> Array:
    return so3.exp(RNG.normal(size=(*shape, 3)))


def pinhole(**changes: Any) -> Camera:
    return replace(Camera(K, UPRIGHT, np.array([0.0, 1.0, 2.0]), 1920, 1080), **changes)


def keypoints(**changes: Any) -> KeypointSequence:
    uv, confidence = RNG.uniform(0, 1000, (T, L, 2)), RNG.uniform(0.1, 1, (T, L))
    return replace(KeypointSequence(pinhole(), TIMES, uv, confidence, tuple("abcd")), **changes)


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


# --- helpers ----------------------------------------------------------------------------------------


def test_readonly_copies_and_locks() -> None:
    mine = np.zeros((2, 3))
    locked = readonly("x", mine, ("T", 3))
    mine[0, 0] = 5
    assert locked[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        locked[0, 0] = 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 4)), r"x: expected shape \(T, 3\), got \(2, 4\)"),
        (np.zeros(3), r"x: expected shape \(T, 3\), got \(3,\)"),
        ([[1, 2, 3], [1, 2]], r"x: not an array of numbers \("),
        ([["a", "b", "c"]], r"x: not an array of numbers \("),
        ([[None, {}, 1]], r"x: not an array of numbers \("),
    ],
)
def test_an_array_of_another_shape_or_kind_is_refused_by_name(value: Any, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        readonly("x", value, ("T", 3))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([], "t: empty; at least one sample is needed"),
        ([0.0, np.nan, 1.0], "t: not finite at index 1; every sample needs a time"),
        ([0.0, 1.0, np.inf], "t: not finite at index 2"),
        (
            [0.0, 0.5, 0.5],
            r"t: time does not increase from index 1 \(0.5 s\) to 2 \(0.5 s\); "
            "sort the samples and drop duplicates",
        ),
        ([0.0, 2.0, 1.0, 3.0], r"from index 1 \(2 s\) to 2 \(1 s\)"),
        ([[0.0, 1.0]], r"t: expected shape \(T\), got \(1, 2\)"),
    ],
)
def test_times_must_increase(times: Any, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        checked_times("t", times)


def test_an_unknown_name_is_reported_with_what_there_is_and_the_likely_one() -> None:
    assert indices_of("joint", ["Head", "Hips"], ("Hips", "Head")) == [1, 0]
    with pytest.raises(UnknownNameError) as caught:
        indices_of("joint", ["Hips", "Hedd", "tail"], ("Hips", "Head"))
    assert str(caught.value) == (
        "unknown joint 'Hedd', 'tail'. Did you mean 'Head'? Known: Hips, Head"
    )
    with pytest.raises(UnknownNameError, match=r"^unknown joint 'zzz'\. Known: Hips$"):
        indices_of("joint", ["zzz"], ["Hips"])


def test_every_error_is_one_of_the_packages_and_of_python_s_own_kind() -> None:
    assert issubclass(ShapeError, RtofError)
    assert issubclass(ShapeError, ValueError)
    assert issubclass(UnknownNameError, KeyError)
    error = FileFormatError("a.csv", "seven columns", line=12)
    assert str(error) == "a.csv, line 12: seven columns"
    assert str(FileFormatError("a.csv", "empty")) == "a.csv: empty"
    assert (error.path.name, error.line) == ("a.csv", 12)


# --- records in general -------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [pinhole, keypoints, imus, bone_imus, poses])
def test_records_are_frozen_and_their_arrays_read_only(make: Callable[[], Any]) -> None:
    record = make()
    for field in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(record, field.name, None)
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable, field.name


@pytest.mark.parametrize(
    ("make", "changes", "message"),
    [
        (keypoints, {"times": TIMES[:-1]}, r"keypoints uv_px: expected shape \(5, 4, 2\)"),
        (keypoints, {"confidence": np.ones((T, 3))}, r"keypoint confidence: expected shape \(6, 4\)"),
        (keypoints, {"names": ("a", "b", "b", "a")}, "keypoint names: a, b stands there more than"),
        (keypoints, {"confidence": np.full((T, L), 1.5)}, "keypoint confidence: outside .0, 1.; divide"),
        (keypoints, {"confidence": np.full((T, L), -0.1)}, "keypoint confidence: outside"),
        (keypoints, {"uv_px": np.full((T, L, 2), np.inf)}, "keypoints uv_px: infinite; write NaN"),
        (imus, {"R_inertial_sensor": np.zeros((T, S, 3))}, r"IMU R_inertial_sensor: expected shape"),
        (imus, {"f_sensor": np.zeros((T, S))}, r"IMU f_sensor: expected shape \(6, 2, 3\), got \(6, 2\)"),
        (imus, {"f_sensor": np.full((T, S, 3), np.inf)}, "IMU f_sensor: infinite; write NaN where"),
        (imus, {"names": ("a", "a")}, "IMU names: a stands there more than once"),
        (imus, {"times": TIMES[::-1]}, "IMU times: time does not increase from index 0"),
        (bone_imus, {"joints": ("Hips", "Hips")}, "bone IMU joints: Hips stands there more than once"),
        (bone_imus, {"a_world": np.zeros((T, 1, 3))}, r"bone IMU a_world: expected shape \(6, 2, 3\)"),
        (bone_imus, {"p_bone_sensor": np.zeros(3)}, r"bone IMU p_bone_sensor: expected shape \(2, 3\)"),
        (bone_imus, {"times": [0.0]}, r"bone IMU R_world_bone: expected shape \(1, 2"),
        (poses, {"p_world_joint": np.zeros((T, 2, 3))}, r"pose p_world_joint: expected shape \(6, 3"),
        (poses, {"R_world_bone": np.zeros((T, J, 9))}, r"pose R_world_bone: expected shape \(6, 3"),
        (poses, {"names": ("a", "b", "a")}, "pose names: a stands there more than once"),
        (poses, {"times": np.full(T, np.nan)}, "pose times: not finite at index 0"),
        (poses, {"provenance": np.zeros(T)}, r"pose provenance: expected shape \(6, 3\), got \(6,\)"),
        (poses, {"provenance": np.full((T, J), 6)}, "pose provenance: a value is none of <Prov"),
        (poses, {"provenance": np.full((T, J), -1.0)}, "pose provenance: a value is none of"),
        (poses, {"valid": np.ones((T, 1))}, r"pose valid: expected shape \(6, 3\), got \(6, 1\)"),
        (poses, {"orientation_observed": np.ones((T, 2))}, r"pose orientation_observed: expected shape"),
        (poses, {"orientation_observed": np.ones(2)}, r"orientation_observed: expected shape \(6, 3\)"),
    ],
)  # fmt: skip
def test_a_wrong_field_is_named(
    make: Callable[..., Any], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ShapeError, match=message):
        make(**changes)


@pytest.mark.parametrize(
    ("make", "field"),
    [(imus, "R_inertial_sensor"), (bone_imus, "R_world_bone"), (poses, "R_world_bone")],
)
def test_a_matrix_that_is_no_rotation_is_found_and_located(
    make: Callable[..., Any], field: str
) -> None:
    good = getattr(make(), field)
    skewed = with_value(good, (3, 1, 0, 0), 0.5)
    with pytest.raises(ShapeError, match=rf"{field}: not a rotation matrix at index \(3, 1\)"):
        make(**{field: skewed})
    mirrored = np.array(good)
    mirrored[4, 1] = np.diag([1.0, 1, -1])
    with pytest.raises(ShapeError, match=r"not a rotation matrix at index \(4, 1\)"):
        make(**{field: mirrored})
    with pytest.raises(ShapeError, match=r"not a rotation matrix at index \(2, 0\)"):
        make(**{field: with_value(good, (2, 0), np.inf)})
    with pytest.raises(ShapeError, match=rf"{field}: a matrix is partly NaN; missing ones are NaN"):
        make(**{field: with_value(good, (2, 0, 1, 1), np.nan)})
    missing = make(**{field: with_value(good, (2, 0), np.nan)})
    assert np.isnan(getattr(missing, field)).sum() == 9


# --- camera -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": np.eye(2)}, r"camera K: expected shape \(3, 3\), got \(2, 2\)"),
        ({"R_camera_world": np.eye(3) * 1.1}, "camera R_camera_world: not a rotation matrix"),
        ({"R_camera_world": np.diag([1.0, 1, -1])}, "camera R_camera_world: not a rotation matrix"),
        (
            {"R_camera_world": np.full((3, 3), np.nan)},
            "camera R_camera_world: not a rotation matrix",
        ),
        ({"t_camera_world": np.zeros((3, 1))}, r"camera t_camera_world: expected shape \(3\), got"),
        ({"t_camera_world": np.array([0, np.nan, 0])}, "camera t_camera_world: not finite"),
        ({"K": with_value(K, (0, 0), 0.0)}, "camera K: singular; it needs positive focal lengths"),
        ({"K": with_value(K, (1, 1), -5.0)}, "camera K: singular"),
        ({"K": with_value(K, (2, 2), 0.0)}, "camera K: singular.*0, 0, 1 as its last row"),
        ({"K": with_value(K, (0, 0), np.inf)}, "camera K: not finite"),
        ({"distortion": np.zeros(4)}, r"camera distortion: expected shape \(5\), got \(4,\)"),
        ({"distortion": np.array([0, 0, np.nan, 0, 0])}, "camera distortion: not finite"),
        ({"width_px": 0}, "camera: width_px and height_px must be positive"),
        ({"height_px": -3}, "camera: width_px and height_px must be positive"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        pinhole(**changes)


def test_projection_divides_by_depth_with_x_right_and_y_down() -> None:
    camera = pinhole(t_camera_world=np.zeros(3))
    # 4 m ahead, 1 m to the left (world +y), 0.5 m up.
    np.testing.assert_allclose(camera.project([4.0, 1.0, 0.5]), [960 - 300, 540 - 137.5])


def test_a_camera_looking_at_a_point_is_upright_and_sees_it_in_the_middle() -> None:
    camera = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 1.0], 1000.0, 640, 480)
    np.testing.assert_allclose(camera.project([0.0, 0.0, 1.0]), [320, 240])
    np.testing.assert_allclose(camera.center_world, [4, 1, 1.5])
    above = camera.project([0.0, 0.0, 1.2])
    assert above[0] == pytest.approx(320)
    assert above[1] < 240
    assert camera.to_camera([0.0, 0.0, 1.0])[2] == pytest.approx(np.sqrt(17.25))


def test_points_not_in_front_of_the_camera_are_nan() -> None:
    camera = pinhole(t_camera_world=np.zeros(3))
    uv = camera.project([[1.0, 0, 0], [-1.0, 0, 0], [0.0, 1, 0], [np.nan, 0, 0]])
    np.testing.assert_array_equal(np.isnan(uv).all(axis=-1), [False, True, True, True])


DISTORTIONS = [np.zeros(5), np.array([-0.28, 0.08, 0.001, -0.0015, -0.01])]


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_rays_pass_through_the_points_that_were_projected(
    camera: Camera, distortion: Array
) -> None:
    camera = replace(camera, distortion=distortion)
    p = RNG.uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 1.8], (7, 9, 3))
    rays = camera.rays_world(camera.project(p))
    np.testing.assert_allclose(rays, so3.unit(p - camera.center_world), atol=1e-9)
    xy = camera.normalise(camera.project(p))
    inside = camera.undistorted()
    np.testing.assert_allclose(inside.project(p), xy @ inside.K[:2, :2].T + inside.K[:2, 2])
    assert not inside.distortion.any()


def test_distortion_is_opencv_s_formula_written_out() -> None:
    k1, k2, p1, p2, k3 = distortion = np.array([-0.3, 0.1, 0.002, -0.001, 0.02])
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3), 10, 10, distortion)
    x, y = 0.3, -0.2
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    ]
    np.testing.assert_allclose(camera.project([2 * x, 2 * y, 2.0]), expected)


# --- keypoints ----------------------------------------------------------------------------------------


def test_missing_is_nan_in_the_value_and_zero_in_the_confidence_both() -> None:
    base = keypoints()
    uv = with_value(base.uv_px, (0, 0, 1), np.nan)
    confidence = with_value(with_value(base.confidence, (1, 1), 0.0), (2, 2), np.nan)
    out = replace(base, uv_px=uv, confidence=confidence)
    for t, l in [(0, 0), (1, 1), (2, 2)]:
        assert np.isnan(out.uv_px[t, l]).all()
        assert out.confidence[t, l] == 0
    assert out.seen.sum() == T * L - 3
    assert np.isfinite(out.uv_px).sum() == 2 * (T * L - 3)


def test_landmarks_are_chosen_by_name_and_those_not_there_are_unseen() -> None:
    base = keypoints()
    out = base.select(["c", "elbow", "a"])
    assert out.names == ("c", "elbow", "a")
    np.testing.assert_array_equal(out.uv_px[:, [0, 2]], base.uv_px[:, [2, 0]])
    assert not out.seen[:, 1].any()


# --- IMUs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (
            1 / 9.81,
            "IMU wrist: the median specific force is 1.00, which is one gravity in g; multiply",
        ),
        (
            0.01,
            r"IMU wrist: the median specific force is 0.10 m/s\^2, so gravity was removed; give",
        ),
        (0.3, r"the median specific force is 2.94 m/s\^2, so gravity was removed"),
        (
            1000 / 9.81,
            r"specific force is 1e\+03, far above one gravity; give m/s\^2 \(9.81 at rest\)",
        ),
    ],
)
def test_specific_force_in_another_unit_or_without_gravity_is_refused(
    scale: float, message: str
) -> None:
    f = np.tile([0.0, 0.0, 9.81], (T, S, 1))
    f[:, 1] *= scale
    with pytest.raises(UnitError, match=message):
        imus(f_sensor=f)


def test_slow_movement_without_gravity_is_not_taken_for_a_sensor_in_g() -> None:
    f = 0.6 * np.random.default_rng(0).normal(size=(100, 1, 3))  # about 1 m/s^2, or 1 g
    R = np.tile(np.eye(3), (100, 1, 1, 1))
    with pytest.raises(UnitError, match="gravity was removed"):
        ImuSequence(np.arange(100) / 60, R, f, ("wrist",))


def test_a_sensor_that_is_frozen_in_a_swing_is_not_said_to_lack_gravity() -> None:
    f, R = np.tile([0.0, 0.0, 3.5], (100, 1, 1)), np.tile(np.eye(3), (100, 1, 1, 1))
    assert len(ImuSequence(np.arange(100) / 60, R, f, ("wrist",))) == 100


def test_a_sensor_that_never_spoke_is_not_judged() -> None:
    f = np.tile([0.0, 0.0, 9.81], (T, S, 1))
    f[:, 1] = np.nan
    assert np.isnan(imus(f_sensor=f).f_sensor[:, 1]).all()


def test_sensors_with_times_of_their_own_are_joined_at_even_ones() -> None:
    """One at 100 Hz, one at 60 Hz that starts later and pauses: the same turn about z of both."""

    def turning(times: Array, name: str) -> ImuSequence:
        R = so3.about_axis("z", 2.0 * times)[:, None]
        f = np.stack([0 * times, times, 0 * times + 9.81], axis=-1)[:, None]
        return ImuSequence(times, R, f, (name,))

    fast = turning(np.arange(101) / 100, "fast")
    late = 0.305 + np.arange(40) / 60
    slow = turning(late[(late < 0.5) | (late > 0.7)], "slow")
    both = ImuSequence.joined([slow, fast])
    assert both.names == ("slow", "fast")
    np.testing.assert_allclose(both.times, np.arange(101) / 100, atol=1e-12)
    known = np.isfinite(both.f_sensor[:, 0, 0])
    np.testing.assert_array_equal(known, np.isfinite(both.R_inertial_sensor[:, 0, 0, 0]))
    assert known[31:48].all()
    assert not known[:30].any()
    assert not known[52:69].any()
    for s, ok in ((0, known), (1, np.ones(101, dtype=bool))):
        expected = so3.about_axis("z", 2.0 * both.times[ok])
        np.testing.assert_allclose(both.R_inertial_sensor[ok, s], expected, atol=1e-9)
        np.testing.assert_allclose(both.f_sensor[ok, s, 1], both.times[ok], atol=1e-9)


def test_sensors_with_the_same_times_are_joined_as_they_are() -> None:
    base = imus()
    parts = [base.select([name]) for name in base.names]
    both = ImuSequence.joined(parts)
    for field in ("times", "R_inertial_sensor", "f_sensor"):
        np.testing.assert_array_equal(getattr(both, field), getattr(base, field))
    with pytest.raises(ShapeError, match="there are none"):
        ImuSequence.joined([])
    with pytest.raises(ShapeError, match="stands there more than once"):
        ImuSequence.joined([parts[0], parts[0]])


def test_sensors_are_chosen_by_name_in_the_order_asked() -> None:
    base = imus()
    out = base.select(["wrist", "chest"])
    np.testing.assert_array_equal(out.R_inertial_sensor, base.R_inertial_sensor[:, ::-1])
    with pytest.raises(UnknownNameError, match=r"unknown sensor 'wrst'\. Did you mean 'wrist'"):
        base.select(["wrst"])
    bones = bone_imus()
    chosen = bones.select(["LeftForeArm"])
    assert chosen.joints == ("LeftForeArm",)
    np.testing.assert_array_equal(chosen.a_world[:, 0], bones.a_world[:, 1])
    with pytest.raises(UnknownNameError, match=r"unknown IMU segment 'Spine4'\. Did you mean"):
        bones.select(["Spine4"])


def test_gravity_points_down() -> None:
    np.testing.assert_array_equal(GRAVITY_WORLD, [0, 0, -9.81])


def test_resampling_is_geodesic_for_orientation_and_hat_averaged_for_acceleration() -> None:
    fast = np.arange(200) / 240
    rate, ramp = 1.3, np.array([2.0, -1.0, 0.5])
    R = np.stack([so3.about_axis("x", rate * fast), so3.about_axis("z", -rate * fast)], axis=1)
    a = np.stack([fast[:, None] * ramp, -fast[:, None] * ramp], axis=1)
    a[::2] += 1.0  # the fast rate's own ripple averages out to a half
    sequence = BoneImuSequence(fast, R, a, np.zeros((2, 3)), ("Hips", "Head"))
    video = np.arange(3, 40) / 60
    out = sequence.resample(video)
    np.testing.assert_allclose(
        out.R_world_bone[:, 0], so3.about_axis("x", rate * video), atol=1e-12
    )
    np.testing.assert_allclose(out.a_world[:, 0], video[:, None] * ramp + 0.5, atol=0.03)
    assert out.joints == sequence.joints
    np.testing.assert_array_equal(out.times, video)


def test_resampling_at_the_own_rate_is_1_4_1_over_6() -> None:
    base = bone_imus()
    a = base.a_world
    np.testing.assert_allclose(
        base.resample(base.times).a_world[1:-1], (a[:-2] + 4 * a[1:-1] + a[2:]) / 6, atol=1e-12
    )


def test_resampling_leaves_gaps_longer_than_allowed_open() -> None:
    times = np.arange(60) / 60
    R = np.tile(np.eye(3), (60, 1, 1, 1))
    a = np.ones((60, 1, 3))
    R[20:30], a[20:30] = np.nan, np.nan
    sequence = BoneImuSequence(times, R, a, np.zeros((1, 3)), ("Hips",))
    out = sequence.resample(times, max_gap=0.1)
    np.testing.assert_array_equal(
        np.flatnonzero(np.isnan(out.R_world_bone[:, 0, 0, 0])), np.arange(20, 30)
    )
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out.a_world[:, 0, 0])), np.arange(19, 31))
    assert np.isfinite(sequence.resample(times, max_gap=0.2).R_world_bone).all()
    late = sequence.resample([0.5, 1.5])
    assert np.isnan(late.R_world_bone[1]).all()
    assert np.isnan(late.a_world[1]).all()


# --- poses --------------------------------------------------------------------------------------------


def test_what_is_not_said_about_a_pose_is_assumed_modestly() -> None:
    base = poses()
    p = with_value(base.p_world_joint, (1, 2, 0), np.nan)
    out = PoseSequence(base.times, p, base.R_world_bone, base.names)
    assert not out.valid[1, 2]
    assert out.valid.sum() == T * J - 1
    assert (out.provenance == Provenance.NOBODY).all()
    assert not out.orientation_observed.any()


def test_uncertainties_of_orientations_are_not_known_where_not_given() -> None:
    assert np.isnan(poses().sigma_rad).all()
    assert poses().sigma_rad.shape == (T, J)
    sigma = with_value(RNG.uniform(0.1, 0.5, (T, J)), (1, 2), np.nan)
    out = poses(sigma_rad=sigma)
    np.testing.assert_array_equal(out.sigma_rad, sigma)
    np.testing.assert_array_equal(out[2:4].sigma_rad, sigma[2:4])
    with pytest.raises(ValueError, match="read-only"):
        out.sigma_rad[0, 0] = 1.0


@pytest.mark.parametrize("wrong", [0.0, -0.1])
def test_an_uncertainty_that_is_not_positive_is_refused(wrong: float) -> None:
    with pytest.raises(ShapeError, match="pose sigma_rad: not positive; write NaN where it is not known"):
        poses(sigma_rad=with_value(np.ones((T, J)), (2, 1), wrong))


def test_uncertainties_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"pose sigma_rad: expected shape \(6, 3\), got \(6, 2\)"):
        poses(sigma_rad=np.ones((T, 2)))


def test_a_position_that_is_not_known_is_never_valid() -> None:
    base = poses()
    p = with_value(base.p_world_joint, (1, 2), np.nan)
    out = replace(base, p_world_joint=p, valid=np.ones((T, J), dtype=bool))
    assert not out.valid[1, 2]
    kept = poses(valid=with_value(np.ones((T, J)), (0, 0), 0.0))
    assert not kept.valid[0, 0]
    assert kept.valid.sum() == T * J - 1


def test_one_row_of_observed_orientations_stands_for_all_frames() -> None:
    out = poses(orientation_observed=np.array([True, False, True]))
    np.testing.assert_array_equal(out.orientation_observed, [[True, False, True]] * T)


@pytest.mark.parametrize("make", [keypoints, bone_imus, poses])
def test_a_slice_cuts_every_field_that_runs_over_time(make: Callable[[], Any]) -> None:
    base = make()
    part = base[2:5]
    assert len(part) == 3
    for field in fields(base):
        whole, cut = getattr(base, field.name), getattr(part, field.name)
        if isinstance(whole, np.ndarray) and len(whole) == T:
            np.testing.assert_array_equal(cut, whole[2:5])
        elif not isinstance(whole, Camera):
            np.testing.assert_array_equal(cut, whole)
    with pytest.raises(ShapeError, match="times: empty; at least one sample is needed"):
        base[4:4]


def test_the_rate_is_that_of_the_median_step() -> None:
    assert poses().rate_hz == pytest.approx(60)
    assert poses(times=np.array([0, 0.02, 0.04, 0.5, 0.52, 0.54])).rate_hz == pytest.approx(50)
    assert poses()[:1].rate_hz == 60
