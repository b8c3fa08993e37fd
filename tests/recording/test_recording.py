"""Recordings as folders: exact round trips, folders written by hand, and wrong input."""

from __future__ import annotations

import pickle
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from same_records import assert_same

from rtof_kin.body.pose_prior import NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import (
    CalibrationError,
    FileFormatError,
    InvalidInputError,
    OutputExistsError,
    RtofError,
    UnknownNameError,
)
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.core.over_time import BLOCK
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.recording.index import INDEX, Session
from rtof_kin.recording.recording import Recording, RecordingReader
from rtof_kin.vision.lift_points import LiftPoints, convention

SKELETON = SkeletonModel.default()
T, S = 12, 2
LIFTS = ("lift_1.npz", "lift_2.npz")
BY_HAND = """
    schema_version = 1
    name = "by hand"
    [subject]
    height_m = 1.80
    mass_kg = 82.5
    sex = "male"
    [camera]
    width_px = 1920
    height_px = 1080
    focal_px = 1250.0
    position_m = [4.0, 0.6, 1.5]
    target_m = [0.0, 0.0, 1.0]
    [keypoints]
    file = "keypoints.npz"
    rate_hz = 60.0
    start_s = 0.5
    layout = "joints"
    [imus]
    file = "imus.npz"
    rate_hz = 100.0
    start_s = 0.4
    [imus.sensors.L_UpArm]
    quat_wxyz_world_inertial = [1, 0, 0, 0]
    quat_wxyz_sensor_bone = [0.5, 0.5, 0.5, 0.5]
    [imus.sensors.strap]
    joint = "RightLeg"
    lever_arm_m = [0.05, 0.0, -0.16]
    R_world_inertial = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    [notes]
    acknowledgement = "Data by nobody."
"""


def keypoint_arrays() -> dict[str, np.ndarray]:
    uv = np.random.default_rng(0).uniform(100, 900, (T, 21, 2))
    return {"uv_px": uv, "confidence": np.full((T, 21), 0.9)}


def imu_arrays() -> dict[str, np.ndarray]:
    quat = np.random.default_rng(1).normal(size=(40, S, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    f = np.tile([0.0, 0.0, 9.81], (40, S, 1))
    return {"quat_wxyz": quat, "f_sensor": f}


def write(
    folder: Path,
    old: str = "",
    new: str = "",
    keypoints: dict[str, np.ndarray] | None = None,
    imus: dict[str, np.ndarray] | None = None,
) -> Path:
    """The folder of `BY_HAND`, with one piece of its text or one of its files changed."""
    text = textwrap.dedent(BY_HAND)
    assert old in text
    (folder / INDEX).write_text(text.replace(old, new, 1))
    np.savez(folder / "keypoints.npz", **(keypoints or keypoint_arrays()))
    np.savez(folder / "imus.npz", **(imus or imu_arrays()))
    return folder


def lifted() -> MarkerSequence:
    """Points of another model, one of them missing."""
    form = convention("smpl24")
    p = np.random.default_rng(5).normal(size=(7, len(form.layout), 3))
    p[2, 3] = np.nan
    return MarkerSequence(np.arange(7) / 30, form.layout.names, p)


def full_recording() -> Recording:
    """A recording with every field set and something missing in every array."""
    moving = planted.moving(SKELETON.with_height(1.65), T)
    base = planted.recording(moving, sigma_px=2.0)
    assert base.imus is not None
    assert base.calibration is not None
    assert base.truth is not None
    uv, R, f = (np.array(a) for a in (base.keypoints.uv_px, base.imus.R_inertial_sensor, base.imus.f_sensor))
    uv[3, 4], R[2, 1], f[5, 0] = np.nan, np.nan, np.nan
    confidence = np.random.default_rng(2).uniform(0.1, 1, uv.shape[:2])
    sensors = len(base.imus.names)
    calibration = replace(
        base.calibration,
        R_sensor_bone=so3.exp(np.random.default_rng(3).standard_normal((sensors, 3))),
        mounting_sd_deg=np.where(np.arange(sensors) == 1, np.nan, 6.1),  # where it is known
    )
    camera = replace(base.keypoints.camera, distortion=[0.01, 1e-3, -2e-4, 1e-17, 0.3])
    keypoints = replace(base.keypoints, camera=camera, uv_px=uv, confidence=confidence)
    return replace(
        base,
        name='a "quoted" name, ünïcode',
        keypoints=keypoints,
        calibration=calibration,
        imus=replace(base.imus, times=base.imus.times + 1 / 30, R_inertial_sensor=R, f_sensor=f),
        joint_offsets=moving.skeleton.joint_offsets * np.pi / 3,
        bone_lengths={"LeftLeg": float(moving.skeleton.bone_lengths["LeftLeg"] * np.pi / 3)},
        height=1.7,
        mass_kg=61.0,
        sex="female",
        truth=replace(base.truth, valid=np.random.default_rng(4).random((T, 21)) > 0.2),
        first_frame=17,
        floor_height=-0.02,
        lifts=(LiftPoints("lift_1.npz", lifted()), LiftPoints("lift_2.npz", lifted(), "smpl24")),
        posture=NeutralPosture(("Spine2", "LeftShoulder"), np.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0]])),
        acknowledgement="Thanks\nto all.",
        notes="α = 3",
    )


# --- round trips ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("without", "names"),
    [
        ((), [MANIFEST, "imus.npz", "keypoints.npz", *LIFTS, INDEX, "truth.npz"]),
        (("imus", "calibration", "truth"), [MANIFEST, "keypoints.npz", *LIFTS, INDEX]),
        (("keypoints",), [MANIFEST, "imus.npz", *LIFTS, INDEX, "truth.npz"]),
        (("imus",), [MANIFEST, "keypoints.npz", *LIFTS, INDEX, "truth.npz"]),
        (("calibration",), [MANIFEST, "imus.npz", "keypoints.npz", *LIFTS, INDEX, "truth.npz"]),
    ],
)
def test_save_and_load_are_exact(tmp_path: Path, without: tuple[str, ...], names: list[str]) -> None:
    lacking = {name: () if name == "lifts" else None for name in without}
    recording = replace(full_recording(), **lacking)  # type: ignore[arg-type]
    recording.save(tmp_path / "take")
    assert_same(Recording.load(tmp_path / "take"), recording)
    assert sorted(p.name for p in (tmp_path / "take").iterdir()) == names
    assert_same(pickle.loads(pickle.dumps(recording)), recording)


def test_a_posture_of_unknown_joints_is_refused(tmp_path: Path) -> None:
    full_recording().save(tmp_path / "take")
    path = tmp_path / "take" / INDEX
    path.write_text(
        path.read_text(encoding="utf-8").replace("\nSpine2 = [\n    1.0", "\nSpine9 = [\n    1.0"), encoding="utf-8"
    )
    with pytest.raises(UnknownNameError, match=r"posture.*'Spine9'"):
        Recording.load(tmp_path / "take")


def test_a_human36m_recording_is_saved_with_its_17_joints(tmp_path: Path) -> None:
    skeleton = SkeletonModel.human36m()
    moving = planted.moving(skeleton, T)
    recording = Recording("h", planted.keypoints(moving.poses), skeleton_table="human36m", truth=moving.poses)
    recording.save(tmp_path / "take")
    loaded = Recording.load(tmp_path / "take")
    assert_same(loaded, recording)
    assert loaded.skeleton.names == skeleton.names


# --- folders written by hand ---------------------------------------------------------------------


def test_a_folder_written_by_hand_is_read(tmp_path: Path) -> None:
    recording = Recording.load(write(tmp_path))
    assert recording.name == "by hand"
    assert recording.acknowledgement == "Data by nobody."
    assert recording.keypoints.names == SKELETON.names
    np.testing.assert_array_equal(recording.keypoints.uv_px, keypoint_arrays()["uv_px"])
    np.testing.assert_allclose(recording.keypoints.times, 0.5 + np.arange(T) / 60)
    np.testing.assert_allclose(recording.keypoints.camera.center_world, [4.0, 0.6, 1.5])
    np.testing.assert_allclose(recording.keypoints.camera.project([0.0, 0.0, 1.0]), [960, 540])
    assert recording.skeleton.height == pytest.approx(1.80, abs=0.01)
    assert recording.skeleton.table.mass_kg == 82.5
    assert recording.skeleton.table.sex == "male"
    assert recording.imus is not None
    assert recording.calibration is not None
    assert recording.imus.names == recording.calibration.sensors == ("L_UpArm", "strap")
    np.testing.assert_allclose(recording.imus.times, 0.4 + np.arange(40) / 100)
    np.testing.assert_allclose(
        recording.imus.R_inertial_sensor, so3.from_quat_wxyz(imu_arrays()["quat_wxyz"]), atol=1e-12
    )
    assert recording.calibration.joints == ("LeftArm", "RightLeg")
    np.testing.assert_allclose(recording.calibration.R_sensor_bone[0] @ [1, 0, 0], [0, 1, 0])
    lever = SKELETON.with_height(1.80).sensors["L_UpArm"][1]  # the table's, scaled to the subject
    np.testing.assert_allclose(recording.calibration.p_bone_sensor, [lever, [0.05, 0.0, -0.16]])


def test_the_example_of_the_documentation_can_be_loaded(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs/recording.md").read_text(encoding="utf-8")
    (tmp_path / INDEX).write_text(text.split("```toml\n")[1].split("```")[0])
    np.savez(tmp_path / "keypoints.npz", uv_px=UV[:, :3], confidence=np.ones((T, 3)))
    np.savez(tmp_path / "imus.npz", quat_wxyz=QUAT[:, :1], f_sensor=FORCE[:, :1])
    poses = planted.moving(SKELETON, T).poses
    np.savez(
        tmp_path / "truth.npz", times=poses.times, p_world_joint=poses.p_world_joint, R_world_bone=poses.R_world_bone
    )
    recording = Recording.load(tmp_path)
    assert recording.name == "walk"
    assert recording.keypoints.names == ("LeftArm", "Nose")
    assert recording.skeleton.bone_lengths["LeftLeg"] == pytest.approx(0.41)
    assert recording.bone_imus() is not None
    assert recording.truth is not None


def test_points_of_other_models_are_read_at_the_times_of_the_video(tmp_path: Path) -> None:
    joints = np.random.default_rng(3).normal(size=(T, 17, 3))
    np.savez(tmp_path / "joints.npz", joints=joints)
    lift = '[lift]\nfiles = ["joints.npz:coco17"]\n[notes]'
    first, *others = Recording.load(write(tmp_path, "[notes]", lift)).lifts
    assert (first.name, first.convention, others) == ("joints.npz", "coco17", [])
    np.testing.assert_allclose(first.points.times, np.arange(T) / 60)  # the keypoints start at 0.5 s
    np.testing.assert_array_equal(first.points.p_world, joints)
    np.savez(tmp_path / "joints.npz", joints=joints[:-1])
    with pytest.raises(FileFormatError, match=r"joints\.npz: has no times, and 11 frames where the video has 12"):
        Recording.load(tmp_path)


def test_points_without_a_name_are_left_out_and_times_are_shifted(tmp_path: Path) -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.02, T))
    arrays = {"uv_px": keypoint_arrays()["uv_px"][:, :3], "times": times}
    old, new = (
        'rate_hz = 60.0\nstart_s = 0.5\nlayout = "joints"',
        'start_s = 0.5\nlandmarks = ["Nose", "", "LeftHand"]',
    )
    keypoints = Recording.load(write(tmp_path, old, new, arrays)).video
    assert keypoints.names == ("Nose", "LeftHand")
    np.testing.assert_array_equal(keypoints.uv_px, arrays["uv_px"][:, [0, 2]])
    assert np.all(keypoints.confidence == 1)
    np.testing.assert_array_equal(keypoints.times, times + 0.5)


def test_bone_lengths_override_the_height(tmp_path: Path) -> None:
    write(tmp_path, "[camera]", "[skeleton]\nbone_lengths_m = {LeftLeg = 0.45}\n[camera]")
    recording = Recording.load(tmp_path)
    taller = SKELETON.with_height(1.80).bone_lengths
    assert recording.skeleton.bone_lengths["LeftLeg"] == pytest.approx(0.45)
    assert recording.skeleton.bone_lengths["RightLeg"] == pytest.approx(taller["RightLeg"])


def test_the_camera_may_be_given_by_its_matrices(tmp_path: Path) -> None:
    wanted = planted.camera()
    old = "focal_px = 1250.0\nposition_m = [4.0, 0.6, 1.5]\ntarget_m = [0.0, 0.0, 1.0]\n"
    new = (
        f"K = {wanted.K.tolist()}\nR_camera_world = {wanted.R_camera_world.tolist()}\n"
        f"t_camera_world_m = {wanted.t_camera_world.tolist()}\n"
    )
    camera = Recording.load(write(tmp_path, old, new)).keypoints.camera
    assert_same(camera, wanted)


def csv_text(columns: dict[str, np.ndarray]) -> str:
    rows = zip(*columns.values(), strict=True)
    cells = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows]
    return "\n".join([",".join(columns), *cells]) + "\n"


def test_csv_files_give_the_same_recording_as_arrays(tmp_path: Path) -> None:
    arrays, imus = keypoint_arrays(), imu_arrays()
    arrays["uv_px"][4, 2] = np.nan
    arrays["confidence"][4, 2] = 0
    wanted = Recording.load(write(tmp_path, keypoints=arrays))
    columns = {"time": np.arange(T) / 60}
    for j, name in enumerate(SKELETON.names):
        columns |= {f"{name}_u_px": arrays["uv_px"][:, j, 0], f"{name}_v_px": arrays["uv_px"][:, j, 1]}
        columns[f"{name}_confidence"] = arrays["confidence"][:, j]
    (tmp_path / "keypoints.csv").write_text(csv_text(columns))
    columns = {}
    for s, name in enumerate(("L_UpArm", "strap")):
        for i, axis in enumerate("wxyz"):
            columns[f"{name}_q{axis}"] = imus["quat_wxyz"][:, s, i]
        for i, axis in enumerate("xyz"):
            columns[f"{name}_f{axis}"] = imus["f_sensor"][:, s, i]
    (tmp_path / "imus.csv").write_text(csv_text(columns))
    text = (tmp_path / INDEX).read_text().replace(".npz", ".csv")
    text = text.replace("rate_hz = 60.0\n", "").replace('layout = "joints"\n', "")
    (tmp_path / INDEX).write_text(text)
    assert_same(Recording.load(tmp_path), wanted)


# --- in memory -----------------------------------------------------------------------------------


def test_the_default_body_is_the_table() -> None:
    recording = Recording("x", planted.keypoints(planted.moving(SKELETON, 4).poses))
    np.testing.assert_array_equal(recording.joint_offsets, SKELETON.joint_offsets)
    assert recording.bone_imus() is None


def test_bone_imus_are_resampled_to_the_video() -> None:
    truth = planted.moving(SKELETON, 30)
    recording = planted.recording(truth)
    bones = recording.bone_imus()
    assert bones is not None
    np.testing.assert_array_equal(bones.times, recording.keypoints.times)
    index = SKELETON.index(*bones.joints)
    assert so3.angle_between(bones.R_world_bone, truth.poses.R_world_bone[:, index]).max() < 1e-9


def test_bone_imus_without_a_camera_have_their_own_or_given_times() -> None:
    recording = replace(full_recording(), keypoints=None)
    assert recording.imus is not None
    own = recording.bone_imus()
    assert own is not None
    np.testing.assert_array_equal(own.times, recording.imus.times)
    times = recording.imus.times[2:6]
    asked = recording.bone_imus(times=times)
    assert asked is not None
    np.testing.assert_array_equal(asked.times, times)


def test_what_a_recording_lacks_is_refused_when_used() -> None:
    with pytest.raises(InvalidInputError, match="neither keypoints nor IMUs"):
        Recording("empty")
    with pytest.raises(InvalidInputError, match="no keypoints"):
        _ = replace(full_recording(), keypoints=None).video
    with pytest.raises(CalibrationError, match=r"no calibration; add a table"):
        replace(full_recording(), calibration=None).bone_imus()


IMUS = full_recording().imus
assert IMUS is not None
IMUS_LATER = replace(IMUS, times=IMUS.times + 1.7e9)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"skeleton_table": "total_captur"}, UnknownNameError, "Did you mean 'total_capture'"),
        ({"bone_lengths": {"LeftLeg": 0.3}}, InvalidInputError, "but joint_offsets make it .* give only one"),
        ({"bone_lengths": {"LeftLegg": 0.3}}, UnknownNameError, "Did you mean 'LeftLeg'"),
        ({"height": 170.0}, InvalidInputError, "height: 170 m, but the skeleton stands"),
        ({"joint_offsets": np.zeros((20, 3))}, InvalidInputError, r"expected shape \(21, 3\)"),
        ({"joint_offsets": np.full((21, 3), np.nan)}, InvalidInputError, "offset of Spine is not finite"),
        ({"floor_height": np.nan}, InvalidInputError, "floor_height: not finite"),
        ({"imus": IMUS_LATER}, InvalidInputError, "IMU times run from .* shift them to one clock"),
        ({"truth": planted.moving(SkeletonModel.human36m(), T).poses}, InvalidInputError, "truth"),
        (
            {
                "skeleton_table": "human36m",
                "joint_offsets": np.empty((0, 3)),
                "height": None,
                "bone_lengths": None,
                "posture": None,
            },
            UnknownNameError,
            "unknown landmark",
        ),
    ],
)
def test_fields_that_contradict_each_other_are_refused(
    change: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        replace(full_recording(), **change)  # type: ignore[arg-type]


LAYOUT = 'layout = "joints"'


# --- hostile folders: text -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema_version = 1", "", "schema_version: missing"),
        ("schema_version = 1", "schema_version = 2", "schema_version: 2 is not 1"),
        ("width_px = 1920", "widht_px = 1920", r"line \d+, \[camera\] 'widht_px'\. Did you mean 'width_px'"),
        ("focal_px = 1250.0", "focal_px = 4.2", r"\[camera\] focal_px: .* is it in mm\? Give px"),
        ("[0.0, 0.0, 1.0]", "[4.0, 0.6, 0.0]", "target_m: straight above, below"),
        ('sex = "male"', 'sex = "m"', "'m' is not one of female, male"),
        ("keypoints.npz", "points.npz", r"there is no file .*points\.npz"),
        ("keypoints.npz", "../keypoints.npz", "leads out of the folder"),
        ("[notes]", '[lift]\nfiles = ["a.trc"]\n[notes]', r"\[lift\] files: there is no file .*a\.trc"),
        ("[notes]", '[lift]\nfiles = ["../a.trc"]\n[notes]', r"\[lift\] files: '../a\.trc' leads out of the folder"),
        ("[notes]", "[lift]\n[notes]", r"\[lift\] files: missing; add it: Each a \.trc"),
        ("rate_hz = 60.0\n", "", r"\[keypoints\] rate_hz: missing, and .* no times"),
        (LAYOUT, "", "landmarks: missing; list the names"),
        (LAYOUT, 'layout = "coco"', "'coco' is not one of joints, auto, .*Did you mean 'coco"),
        (LAYOUT, f"landmarks = {[*SKELETON.names[:-1], 'LeftFot']}", r"\] landmarks 'LeftFot'\. Did .*'LeftFoot'"),
        (LAYOUT, 'landmarks = ["Hips"]', "1 names, but .* 21 points"),
        ("RightLeg", "RightLag", r"line \d+, \[imus\.sensors\.strap\] joint 'RightLag'\. Did you mean 'RightLeg'"),
        ("lever_arm_m = [0.05, 0.0, -0.16]", "", "lever_arm_m: missing; add 3"),
        ("[0.5, 0.5, 0.5, 0.5]", "[0.5, 0.5, 0.5, 0.4]", r"L_UpArm\] quat_wxyz_sensor_bone: has norm 0\.95"),
        ("[imus.sensors.L_UpArm]", 'names = ["L_UpArm", "belt"]\n[imus.sensors.L_UpArm]', "'belt'"),
        ("[imus.sensors.L_UpArm]", 'names = ["strap"]\n[imus.sensors.L_UpArm]', "1 sensors are named, but .* has 2"),
        ("[camera]", "[skeleton]\ntable = 'smpl'\n[camera]", "'smpl' is not one of .*human36m"),
        ("[camera]", "[skeleton]\nbone_lengths_m = {Elbow = 1}\n[camera]", r"bone_lengths_m 'Elbow'"),
        ("[camera]", "[skeleton]\njoint_offsets_m = {Spine = [0, 0, 1]}\n[camera]", r"offsets_m\] Spine1: missing"),
    ],
)
def test_a_wrong_line_raises_with_file_field_and_remedy(tmp_path: Path, old: str, new: str, message: str) -> None:
    write(tmp_path, old, new)
    with pytest.raises(RtofError, match=message) as caught:
        Recording.load(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_a_folder_without_an_index_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"recording\.toml: there is no such file; rtof-kin run --only recording"):
        Recording.load(tmp_path)
    with pytest.raises(FileFormatError, match=r"nowhere.*there is no such file"):
        Recording.load(tmp_path / "nowhere")
    (tmp_path / INDEX).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match="not a text file in UTF-8, so not TOML"):
        Recording.load(tmp_path)


# --- hostile folders: arrays ---------------------------------------------------------------------


def changed(make: Callable[[], dict[str, np.ndarray]], **new: object) -> dict[str, np.ndarray]:
    """Arrays with some replaced, or taken away where None is given."""
    arrays = {**make(), **new}
    return {name: np.asarray(value) for name, value in arrays.items() if value is not None}


def with_value(array: np.ndarray, index: object, value: object) -> np.ndarray:
    out = np.array(array)
    out[index] = value  # type: ignore[index]
    return out


UV = keypoint_arrays()["uv_px"]
QUAT, FORCE = imu_arrays()["quat_wxyz"], imu_arrays()["f_sensor"]


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ({"uv_px": None}, "no array 'uv_px' of shape"),
        ({"uv_px": UV[0]}, r"uv_px: expected shape \(T, L, 2\), got \(21, 2\)"),
        ({"uv_px": UV[:0], "confidence": None}, "times: empty"),
        ({"uv_px": with_value(UV, (1, 2), np.inf)}, "infinite; write NaN"),
        ({"confidence": np.full((T, 20), 1.0)}, "confidence: expected shape"),
        ({"uvpx": UV}, "array in .*keypoints.npz 'uvpx'. Did you mean 'uv_px'"),
        ({"times": np.arange(T) / 60}, "rate_hz: .* has times of its own"),
        ({"uv_px": np.array(["a", "b"])}, "uv_px: has type <U1, not numbers"),
        ({"uv_px": np.array([{}], dtype=object)}, "uv_px: has type object"),
    ],
)
def test_wrong_keypoint_arrays_raise_with_file_and_field(tmp_path: Path, new: dict[str, object], message: str) -> None:
    write(tmp_path, keypoints=changed(keypoint_arrays, **new))
    with pytest.raises(RtofError, match=message) as caught:
        Recording.load(tmp_path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("new", "message"),
    [
        (
            {"quat_wxyz": with_value(QUAT, (7, 1), QUAT[7, 1] * 1.01)},
            r"imus\.npz: quat_wxyz: sample 7 of strap has norm 1\.01, not 1; normalise it",
        ),
        ({"quat_wxyz": np.zeros_like(QUAT)}, "sample 0 of L_UpArm has norm 0"),
        ({"quat_wxyz": QUAT[:-1]}, r"quat_wxyz: expected shape \(40, 2, 4\)"),
        ({"quat_wxyz": None}, "give one of quat_wxyz"),
        ({"R_inertial_sensor": np.ones((40, S, 3, 3))}, "give one of quat_wxyz"),
        (
            {"quat_wxyz": None, "R_inertial_sensor": np.ones((40, S, 3, 3))},
            r"imus\.npz: IMU R_inertial_sensor: not a rotation matrix at index \(0, 0\)",
        ),
        ({"f_sensor": FORCE / 9.81}, r"imus\.npz: IMU L_UpArm: .* in g; multiply"),
        ({"f_sensor": with_value(FORCE, (3, 1), np.inf)}, "infinite; write NaN"),
        ({"f_sensor": None}, "no array 'f_sensor' of shape"),
        ({"f_sensor": FORCE[:, :, :2]}, r"IMU f_sensor: expected shape \(40, 2, 3\)"),
    ],
)
def test_wrong_imu_arrays_raise_with_file_and_field(tmp_path: Path, new: dict[str, object], message: str) -> None:
    write(tmp_path, imus=changed(imu_arrays, **new))
    with pytest.raises(RtofError, match=message) as caught:
        Recording.load(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_quaternions_are_normalised_and_missing_ones_are_nan(tmp_path: Path) -> None:
    quat = with_value(QUAT * 1.0009, (3, 1), np.nan)
    imus = Recording.load(write(tmp_path, imus=changed(imu_arrays, quat_wxyz=quat))).imus
    assert imus is not None
    expected = with_value(so3.from_quat_wxyz(QUAT), (3, 1), np.nan)
    np.testing.assert_allclose(imus.R_inertial_sensor, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: empty; expected a CSV file; its first line names"),
        ("time;Hips_u_px;Hips_v_px\n", "line 1: separated by ';'"),
        ("time,Nouse_u_px,Nouse_v_px\n0,1,2\n", " 'Nouse'. Did you mean 'Nose'"),
        ("time,Hips_u_px\n0,1\n", "line 1: the column 'Hips_v_px' is missing"),
        ("time,Hips_x,Hips_y\n0,1,2\n", "line 1: column 'Hips_x': expected 'time'"),
        ("time\n0\n", "line 1: no column ends in _u_px"),
        ("time,Hips_u_px,Hips_u_px\n0,1,2\n", "'Hips_u_px' occurs more than once"),
        ("time,Hips_u_px,Hips_v_px\n0,1,2\n1,2\n", "line 3: 2 cells where the header names 3"),
        ("time,Hips_u_px,Hips_v_px\n0,1,two\n", "line 2: column Hips_v_px: 'two' is not a number"),
        ("time,Hips_u_px,Hips_v_px\n1,1,2\n0,1,2\n", "time does not increase from index 0"),
        ("time,Hips_u_px,Hips_v_px\n", "times: empty"),
    ],
)
def test_a_wrong_csv_file_raises_with_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    write(tmp_path, 'file = "keypoints.npz"\nrate_hz = 60.0', 'file = "keypoints.csv"')
    (tmp_path / "keypoints.csv").write_text(text)
    toml = (tmp_path / INDEX).read_text().replace('layout = "joints"\n', "")
    (tmp_path / INDEX).write_text(toml)
    with pytest.raises(RtofError, match=rf"keypoints\.csv.*{message}"):
        Recording.load(tmp_path)


# --- writing -------------------------------------------------------------------------------------


def test_an_existing_recording_is_replaced_on_request_only(tmp_path: Path) -> None:
    recording = full_recording()
    recording.save(tmp_path / "take")
    with pytest.raises(OutputExistsError, match=r"take: is there already; .*overwrite=True"):
        replace(recording, name="other").save(tmp_path / "take")
    assert Recording.load(tmp_path / "take").name == recording.name
    replace(recording, name="other", imus=None).save(tmp_path / "take", overwrite=True)
    assert Recording.load(tmp_path / "take").name == "other"
    assert not (tmp_path / "take" / "imus.npz").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["take"]


LABELS = Session("P07 <x>", "Dr. Ü", "2026-01-31", "gait lab", "walk")


def test_labels_are_saved_with_a_recording_which_may_have_none(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    replace(planted.recording(planted.moving(SKELETON, 12)), session=LABELS).save(folder)
    assert Recording.load(folder).session == LABELS
    text = (folder / "recording.toml").read_text()
    (folder / "recording.toml").write_text(text.replace('date = "2026-01-31"', 'date = "31.1."'))
    with pytest.raises(FileFormatError, match=r"\[session\] date: .*'31.1.' is not a day"):
        Recording.load(folder)
    start, stop = text.index("[session]"), text.index("[subject]")
    (folder / "recording.toml").write_text(text[:start] + text[stop:])
    assert Recording.load(folder).session == Session()


def test_updated_labels_take_precedence() -> None:
    assert LABELS.updated(Session(subject="P08")) == replace(LABELS, subject="P08")
    assert Session().updated(LABELS) == LABELS
    assert Session(subject="P08").plain() == {"subject": "P08"}
    with pytest.raises(InvalidInputError, match="session place"):
        Session.of({"place": 3})


DEMO = Recording.load(model_path("demo"))


def demo() -> Recording:
    """The demo, whose sensors have more samples than a block of the reader, with a second camera."""
    assert DEMO.imus is not None
    imus = DEMO.imus
    twice = replace(
        imus,
        times=np.r_[imus.times, imus.times + imus.times[-1] - imus.times[0] + 1 / 60],
        R_inertial_sensor=np.concatenate([imus.R_inertial_sensor] * 2),
        f_sensor=np.concatenate([imus.f_sensor] * 2),
    )
    assert len(twice.times) > BLOCK
    return replace(DEMO, imus=twice, views=(DEMO.video[150:400:2],), lifts=(LiftPoints("a.trc", lifted()),))


def test_digest_is_that_of_the_saved_and_of_the_streamed_recording(tmp_path: Path) -> None:
    recording = demo()
    recording.save(tmp_path / "saved")
    digest = recording.digest()
    assert Recording.load(tmp_path / "saved").digest() == digest
    with RecordingReader.open(tmp_path / "saved") as reader:
        assert reader.digest() == digest


def test_labels_and_the_form_of_files_do_not_matter(tmp_path: Path) -> None:
    recording = demo()
    labelled = replace(
        recording, name="other", notes="a", acknowledgement="b", session=Session(subject="c", date="2026-01-31")
    )
    labelled.save(tmp_path / "a")
    arrays = dict(np.load(tmp_path / "a" / "keypoints.npz"))
    np.savez(tmp_path / "a" / "keypoints.npz", **dict(reversed(arrays.items())))
    assert Recording.load(tmp_path / "a").digest() == recording.digest()


def _later(recording: Recording) -> dict[str, Any]:
    return {"keypoints": replace(recording.video, times=np.nextafter(recording.video.times, np.inf))}


def _other_sample(recording: Recording) -> dict[str, Any]:
    assert recording.imus is not None
    f = recording.imus.f_sensor.copy()
    f[-1, 0, 0] = np.nextafter(f[-1, 0, 0], np.inf)
    return {"imus": replace(recording.imus, f_sensor=f)}


@pytest.mark.parametrize(
    "change",
    [
        _later,
        _other_sample,
        lambda _: {"mass_kg": 70.0},
        lambda _: {"floor_height": 0.0},
        lambda _: {"views": ()},
        lambda _: {"truth": None},
        lambda _: {"lifts": ()},
        lambda r: {"lifts": (replace(r.lifts[0], convention="smpl24"),)},
        lambda r: {"lifts": (LiftPoints("", replace(lifted(), p_world=lifted().p_world + 1e-9)),)},
        lambda r: {"calibration": replace(r.calibration, p_bone_sensor=r.calibration.p_bone_sensor + 1e-9)},
    ],
)
def test_any_other_number_gives_another_digest(change: Any) -> None:
    recording = demo()
    assert replace(recording, **change(recording)).digest() != recording.digest()


@pytest.mark.parametrize("degrees", [2.896076792883497, 3.2240400206284368, 5.0, 0.1, 7.3, 1 / 3])
def test_an_uncertain_camera_is_saved_exactly(tmp_path: Path, degrees: float) -> None:
    tilt = degrees * float(np.radians(1.0))  # as it is read
    camera = replace(DEMO.video.camera, uncertainty=CameraUncertainty(0.1, tilt, roll=tilt), heading_drift=tilt)
    recording = replace(DEMO, keypoints=replace(DEMO.video[:60], camera=camera), imus=None, calibration=None)
    recording.save(tmp_path / "a")
    after = Recording.load(tmp_path / "a")
    assert after.digest() == recording.digest()
    assert after.video.camera.uncertainty == camera.uncertainty
    assert after.video.camera.heading_drift == tilt


POSES = planted.moving(SkeletonModel.default(), 12).poses
SIDE = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], 900.0, 1280, 720)


def view(start: float = 0.01, rate_hz: float = 25.0) -> KeypointSequence:
    """A second camera with a rate, a start and points of its own."""
    uv = np.random.default_rng(0).uniform(100, 600, (5, 3, 2))
    uv[1, 2] = np.nan
    times = start + np.arange(5) / rate_hz
    return KeypointSequence(SIDE, times, uv, np.isfinite(uv[..., 0]) * 0.8, ("Hips", "Nose", "LeftHand"))


def two_views(*views: KeypointSequence) -> Recording:
    return Recording("two", planted.keypoints(POSES), views=views)


def test_views_are_read_back_exactly(tmp_path: Path) -> None:
    before = two_views(view(), replace(view(0.02), camera=planted.camera()))
    before.save(tmp_path / "two")
    assert_same(Recording.load(tmp_path / "two").views, before.views)


def written_with(folder: Path, text: str) -> Path:
    """The folder of a recording of one camera with more in its index."""
    two_views().save(folder)
    np.savez(folder / "side.npz", uv_px=view().uv_px)
    index = folder / INDEX
    index.write_text(index.read_text() + textwrap.dedent(text))
    return folder


SIDE_VIEW = """
    [[views]]
    [views.camera]
    width_px = 1280
    height_px = 720
    focal_px = 900.0
    position_m = [0.5, -4.0, 1.2]
    target_m = [0.0, 0.0, 1.0]
    assumed = ["focal length"]
    [views.keypoints]
    file = "side.npz"
    rate_hz = 25.0
    landmarks = ["Hips", "Nose", ""]
"""


def test_a_view_written_by_hand_is_read(tmp_path: Path) -> None:
    (side,) = Recording.load(written_with(tmp_path / "a", SIDE_VIEW)).views
    assert side.names == ("Hips", "Nose")
    assert side.camera.assumed == ("focal length",)
    np.testing.assert_allclose(side.camera.center_world, [0.5, -4.0, 1.2])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"Nose"', '"Nos"', r"views.1.keypoints.*Nos"),
        ("focal_px", "focal", r"views.1.camera.*focal_px"),
        ('file = "side.npz"', 'file = "../side.npz"', r"\[views.1.keypoints\] file.*folder"),
    ],
)
def test_errors_name_the_view(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(RtofError, match=f"(?s){words}"):
        Recording.load(written_with(tmp_path / "a", SIDE_VIEW.replace(old, new)))


def test_views_must_fit_the_recording() -> None:
    with pytest.raises(InvalidInputError, match="view 1 times"):
        two_views(view(start=100.0))
    with pytest.raises(UnknownNameError, match="Elbow"):
        two_views(replace(view(), names=("Hips", "Nose", "Elbow")))
    imus = planted.recording(planted.moving(SkeletonModel.default(), 12))
    with pytest.raises(InvalidInputError, match="first one as keypoints"):
        replace(imus, keypoints=None, views=(view(0.0),))
