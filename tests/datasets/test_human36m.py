"""Human3.6M's archives as recordings: planted people come back; what does not fit is named."""

from __future__ import annotations

import copy
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import human36m_files as files
import numpy as np
import pytest

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, FileFormatError, UnitError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.datasets.human36m import RATE_HZ, SUBJECTS_TEST, SUBJECTS_TRAIN, Human36M
from rtof_kin.datasets.human36m_body import bone_lengths, measured_offsets
from rtof_kin.datasets.human36m_cameras import CAMERA_IDS, read_cameras
from rtof_kin.datasets.human36m_files import JOINTS_OF_32
from rtof_kin.recording.recording import Recording

SKELETON = SkeletonModel.human36m()
TWO = ("S9", "S11")


@pytest.fixture(scope="module")
def planted_root(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, files.Positions]:
    root = tmp_path_factory.mktemp("h36m")
    return root, files.write_dataset(root, TWO)


@pytest.fixture(scope="module")
def root(planted_root: tuple[Path, files.Positions]) -> Path:
    return planted_root[0]


@pytest.fixture(scope="module")
def truth(planted_root: tuple[Path, files.Positions]) -> files.Positions:
    return planted_root[1]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, files.Positions]:
    root = tmp_path_factory.mktemp("template")
    positions = files.motions(TWO, actions=3, frames=12)
    files.write_positions(root, positions)
    files.write_keypoints(root, files.keypoints(positions))
    files.write_camera_json(root, TWO)
    return root, positions


@pytest.fixture
def own(template: tuple[Path, files.Positions], tmp_path: Path) -> tuple[Path, files.Positions]:
    """A folder of two subjects that a test may spoil."""
    shutil.copytree(template[0], tmp_path, dirs_exist_ok=True)
    return tmp_path, copy.deepcopy(template[1])


# --- positions -----------------------------------------------------------------------------------


def test_the_17_joints_are_taken_from_the_32_in_the_skeletons_order(
    root: Path, truth: files.Positions
) -> None:
    motion = Human36M(root).motion("S9", "Action 1")
    np.testing.assert_array_equal(motion.p_world_joint, truth["S9"]["Action 1"])
    assert (motion.subject, motion.action, motion.rate_hz) == ("S9", "Action 1", 50.0)
    assert motion.p_world_joint.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        motion.p_world_joint[0] = 0


def test_the_archives_32_joints_have_the_places_that_human36m_gives_them() -> None:
    names_of_32 = (
        "Hip", "RHip", "RKnee", "RFoot", "RFootEnd", "RToes", "LHip", "LKnee", "LFoot", "LFootEnd",
        "LToes", "Root2", "Spine", "Thorax", "Neck", "Head", "LClavicle", "LShoulder", "LElbow", "LWrist",
        "LThumb", "LThumb2", "LHand", "LHand2", "RClavicle", "RShoulder", "RElbow", "RWrist", "RThumb",
        "RThumb2", "RHand", "RHand2",
    )  # fmt: skip
    assert tuple(names_of_32[i] for i in JOINTS_OF_32) == SKELETON.names
    unused = {4, 5, 9, 10, 11, 16, 20, 21, 22, 23, 24, 28, 29, 30, 31}
    assert sorted({*JOINTS_OF_32, *unused}) == list(range(32))


def test_sequences_are_listed_by_the_number_of_the_subject(tmp_path: Path) -> None:
    positions = files.motions(("S11", "S1", "S9"), frames=3)
    files.write_positions(tmp_path, positions)
    listed = Human36M(tmp_path).sequences
    assert [subject for subject, _ in listed] == ["S1", "S1", "S9", "S9", "S11", "S11"]
    assert listed[:2] == (("S1", "Action 0"), ("S1", "Action 1"))


def test_nothing_is_read_before_it_is_asked_for(tmp_path: Path) -> None:
    """Positions alone are enough for motions."""
    files.write_positions(tmp_path, files.motions(("S1",), frames=3))
    assert len(Human36M(tmp_path).motion("S1", "Action 0").p_world_joint) == 3
    assert Human36M(tmp_path / "nowhere").root == tmp_path / "nowhere"


# --- recordings ----------------------------------------------------------------------------------


def test_a_recording_has_everything_that_is_known(root: Path, truth: files.Positions) -> None:
    recording = Human36M(root).recording("S9", "Action 1", 2)
    assert recording.name == "S9 Action 1 cam2"
    assert recording.skeleton_table == "human36m"
    assert recording.imus is None
    assert "Human3.6M" in recording.acknowledgement
    assert recording.notes == ""
    assert recording.keypoints.names == SKELETON.names
    assert (recording.keypoints.confidence == 1).all()
    np.testing.assert_allclose(recording.keypoints.times, np.arange(30) / RATE_HZ, atol=1e-12)
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.truth.p_world_joint, truth["S9"]["Action 1"])
    assert recording.truth.valid.all()
    observed = recording.truth.orientation_observed[0]
    assert [n for n, o in zip(SKELETON.names, observed, strict=True) if o] == ["Hip", "Thorax"]


@pytest.mark.parametrize("camera", range(4))
def test_keypoints_lie_where_the_camera_sees_the_truth(root: Path, camera: int) -> None:
    """Human3.6M's own formula of distortion against OpenCV's: a fraction of a pixel apart."""
    recording = Human36M(root).recording("S11", "Action 0", camera)
    assert recording.truth is not None
    seen = recording.keypoints.camera.project(recording.truth.p_world_joint)
    error_px = np.linalg.norm(seen - recording.keypoints.uv_px, axis=-1)
    assert error_px.max() < 0.3
    assert np.median(error_px) < 0.1


def test_the_truths_orientations_and_the_subjects_bones_make_the_truths_positions(root: Path) -> None:
    """The planted people are rigid, with hips and shoulders in no table."""
    data = Human36M(root)
    for subject, action in data.sequences:
        recording = data.recording(subject, action, 0)
        poses, offsets = recording.truth, recording.joint_offsets
        assert poses is not None
        p = kinematics.positions(SKELETON.parents, offsets, poses.p_world_joint[:, 0], poses.R_world_bone)
        np.testing.assert_allclose(p, poses.p_world_joint, atol=2e-6)


def test_a_recording_goes_through_a_folder_of_its_own(root: Path, tmp_path: Path) -> None:
    recording = Human36M(root).recording("S9", "Action 0", 1)
    recording.save(tmp_path / "take")
    back = Recording.load(tmp_path / "take")
    np.testing.assert_array_equal(back.keypoints.uv_px, recording.keypoints.uv_px)
    np.testing.assert_array_equal(back.joint_offsets, recording.joint_offsets)
    assert back.acknowledgement == recording.acknowledgement


def test_detected_keypoints_may_be_noisy_and_longer_than_the_truth(root: Path) -> None:
    recording = Human36M(root, keypoints="cpn_ft_h36m_dbb").recording("S9", "Action 0", 3)
    assert recording.truth is not None
    assert len(recording.keypoints) == len(recording.truth) == 30
    seen = recording.keypoints.camera.project(recording.truth.p_world_joint)
    error_px = np.linalg.norm(seen - recording.keypoints.uv_px, axis=-1)
    assert 7 < np.median(error_px) < 12  # 8 px in each direction


def test_a_truth_longer_than_the_keypoints_is_cut_too(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    entries["S9"]["Action 0"] = [uv[:7] for uv in entries["S9"]["Action 0"]]
    files.write_keypoints(root, entries)
    recording = Human36M(root).recording("S9", "Action 0", 0)
    assert recording.truth is not None
    assert (len(recording.keypoints), len(recording.truth)) == (7, 7)
    assert len(Human36M(root).motion("S9", "Action 0").p_world_joint) == 12


def test_what_is_not_finite_is_missing(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    entries["S9"]["Action 0"][0][2, 5] = [np.inf, 3.0]
    positions["S9"]["Action 0"][4, 8, 1] = np.nan
    positions["S9"]["Action 0"][5, 8] = np.inf
    files.write_keypoints(root, entries)
    files.write_positions(root, positions)
    recording = Human36M(root).recording("S9", "Action 0", 0)
    assert recording.truth is not None
    assert np.argwhere(recording.keypoints.confidence == 0).tolist() == [[2, 5]]
    assert np.isnan(recording.keypoints.uv_px[2, 5]).all()
    assert np.argwhere(~recording.truth.valid).tolist() == [[4, 8], [5, 8]]
    assert np.isnan(recording.truth.R_world_bone[[4, 5]]).all()
    assert np.isfinite(recording.truth.R_world_bone[6:]).all()


# --- the subject's body --------------------------------------------------------------------------


@pytest.mark.parametrize("subject", TWO)
def test_a_rigid_subjects_body_is_recovered_from_positions_alone(root: Path, subject: str) -> None:
    """Up to a turn of pelvis and thorax as a whole, which positions cannot tell from a posture."""
    planted = files.body(subject)
    offsets = Human36M(root).motion(subject, "Action 0").joint_offsets
    lengths = np.linalg.norm(offsets, axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(planted.joint_offsets, axis=1), atol=1e-6)
    for joint in ("Hip", "Thorax"):
        children = kinematics.children_of(SKELETON.parents, SKELETON.index(joint)[0])
        a, b = offsets[children], planted.joint_offsets[children]
        R = so3.nearest_rotation(a.T @ b)
        np.testing.assert_allclose(a, b @ R.T, atol=2e-6)
        assert np.degrees(np.linalg.norm(so3.log(R))) < 15
    one_child = [i for i, n in enumerate(SKELETON.names) if n.endswith(("Knee", "Foot", "Wrist"))]
    unit = so3.unit(SKELETON.joint_offsets)
    np.testing.assert_allclose(so3.unit(offsets)[one_child], unit[one_child], atol=1e-9)


def test_axes_of_the_measured_segments_are_those_of_the_table() -> None:
    """No turn of pelvis or thorax brings their children nearer to where the table has them."""
    p = files.motions(("S9",), 1, 200)["S9"]["Action 0"]
    offsets = measured_offsets(SKELETON, p)
    for joint in ("Hip", "Thorax"):
        children = kinematics.children_of(SKELETON.parents, SKELETON.index(joint)[0])
        table = so3.unit(SKELETON.joint_offsets[children])
        weighted = offsets[children] * np.linalg.norm(offsets[children], axis=1, keepdims=True)
        R = so3.nearest_rotation(table.T @ weighted)
        np.testing.assert_allclose(R, np.eye(3), atol=1e-7)


def test_the_body_does_not_depend_on_where_the_subject_stands_and_faces() -> None:
    p = files.motions(("S9",), 1, 60)["S9"]["Action 0"]
    R = so3.exp(np.random.default_rng(0).normal(size=3))
    np.testing.assert_allclose(
        measured_offsets(SKELETON, p @ R.T + [5.0, -3.0, 1.0]), measured_offsets(SKELETON, p), atol=1e-7
    )


def test_a_spine_that_turns_about_the_pelvis_is_measured_at_its_mean() -> None:
    """As in the real data: bones of constant length in a pelvis that is not quite rigid."""
    rng, T = np.random.default_rng(3), 1500
    hips = np.array([[0.0, -0.13, -0.01], [0.0, 0.13, -0.01], [0.02, 0.0, 0.24]])
    bend = so3.exp(rng.normal(size=(T, 3)) * np.radians([10.0, 0.0, 10.0]))
    R_world_bone = so3.exp(rng.normal(size=(T, 3)))
    shown = np.tile(hips, (T, 1, 1))
    shown[:, 2] = bend @ hips[2]
    p = np.zeros((T, 17, 3))
    p += SKELETON.forward_kinematics(np.tile(SKELETON.t_pose(), (T, 1)))[0]
    children = SKELETON.index("RHip", "LHip", "Spine")
    p[:, children] = p[:, [0]] + np.einsum("tij,tcj->tci", R_world_bone, shown)
    offsets = measured_offsets(SKELETON, p)[children]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), np.linalg.norm(hips, axis=1), atol=1e-9)
    R = so3.nearest_rotation(offsets.T @ hips)
    np.testing.assert_allclose(offsets, hips @ R.T, atol=0.006)


def test_bone_lengths_are_medians_and_survive_a_few_wild_frames(root: Path) -> None:
    p = np.array(Human36M(root).motion("S9", "Action 0").p_world_joint)
    usual = bone_lengths(SKELETON, p)
    p[:5] *= 100.0
    np.testing.assert_allclose(bone_lengths(SKELETON, p), usual, atol=1e-5)
    assert usual[0] == 0


# --- cameras -------------------------------------------------------------------------------------


def test_both_files_of_cameras_say_the_same(root: Path) -> None:
    from_json = read_cameras(root / "camera-parameters.json")
    from_source = read_cameras(root / "h36m_dataset.py")
    assert list(from_json) == list(from_source) == list(TWO)
    for subject in TWO:
        for i in range(4):
            a, b = from_json[subject][i], from_source[subject][i]
            for field in ("K", "R_camera_world", "t_camera_world", "distortion"):
                np.testing.assert_allclose(getattr(a, field), getattr(b, field), atol=1e-12)
            assert (a.width_px, a.height_px) == (b.width_px, b.height_px) == files.SIZES_PX[i]
            np.testing.assert_allclose(a.center_world, files.PLACES[i], atol=1e-12)


def test_the_sources_tangential_coefficients_are_opencvs_the_other_way_round(root: Path) -> None:
    """Where x is 0 both formulas give the same u; there the order decides."""
    for i, camera in read_cameras(root / "h36m_dataset.py")["S9"].items():
        points = np.array([[0.0, y, 1.0] for y in (-0.35, 0.1, 0.4)])
        p_world = (points - camera.t_camera_world) @ camera.R_camera_world
        np.testing.assert_allclose(
            camera.project(p_world)[:, 0], files.projected(p_world, "S9", i)[:, 0], atol=1e-9
        )
        swapped = camera.distortion[[0, 1, 3, 2, 4]]
        other = Camera(camera.K, camera.R_camera_world, camera.t_camera_world, 1000, 1000, swapped).project(
            p_world
        )
        assert np.abs(other[:, 0] - files.projected(p_world, "S9", i)[:, 0]).max() > 0.05


def test_the_source_is_never_run(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert list(read_cameras(root / "h36m_dataset.py")) == list(TWO)
    assert not list(tmp_path.iterdir())


def test_the_file_of_cameras_can_be_named(own: tuple[Path, files.Positions], tmp_path: Path) -> None:
    root, _ = own
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    source = files.write_camera_source(elsewhere, TWO)
    by_source = Human36M(root, source).recording("S9", "Action 0", 0)
    by_json = Human36M(root).recording("S9", "Action 0", 0)
    np.testing.assert_allclose(
        by_source.keypoints.camera.center_world, by_json.keypoints.camera.center_world, atol=1e-9
    )
    (root / "camera-parameters.json").unlink()
    assert Human36M(root, source).cameras.keys() == set(TWO)
    message = "neither camera-parameters.json nor h36m_dataset.py is in this folder; name the file"
    with pytest.raises(FileFormatError, match=message):
        Human36M(root).recording("S9", "Action 0", 0)


def test_subjects_without_cameras_are_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown camera of S9 in .*'4'.*Known: 0, 1, 2, 3"):
        Human36M(root).recording("S9", "Action 0", 4)
    files.write_camera_source(tmp_path, ("S9",))
    cameras = tmp_path / "h36m_dataset.py"
    with pytest.raises(UnknownNameError, match=r"unknown subject in h36m_dataset\.py 'S11'.*Known: S9"):
        Human36M(root, cameras).recording("S11", "Action 0", 0)


def change_json(change: Callable[[dict[str, Any]], Any]) -> str:
    data = files.camera_json(("S9",))
    change(data)
    return json.dumps(data)


def setter(*keys: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def set_(data: dict[str, Any]) -> None:
        for key in keys[:-1]:
            data = data[key]
        if value is None:
            del data[keys[-1]]
        else:
            data[keys[-1]] = value

    return set_


LAST = CAMERA_IDS[3]


@pytest.mark.parametrize("change, message", [
    (setter("intrinsics", value=None), "intrinsics: missing"),
    (setter("extrinsics", value=[1]), "extrinsics: missing, or not a table"),
    (setter("extrinsics", value={}), "there is no camera of any subject"),
    (setter("extrinsics", "S9", value=[]), "extrinsics of S9: missing, or not a table"),
    (setter("intrinsics", LAST, value=None), f"S9, camera {LAST}: intrinsics: missing"),
    (setter("intrinsics", LAST, "distortion", value=None), f"S9, camera {LAST}: distortion is missing"),
    (setter("intrinsics", LAST, "distortion", value=[0.0] * 4), r"not of shape \(5,\)"),
    (setter("intrinsics", LAST, "calibration_matrix", value=[[1.0]]), r"not of shape \(3, 3\)"),
    (setter("intrinsics", LAST, "calibration_matrix", value=np.zeros((3, 3)).tolist()), "singular"),
    (setter("extrinsics", "S9", LAST, "R", value=None), "R is missing"),
    (setter("extrinsics", "S9", LAST, "R", value=np.ones((3, 3)).tolist()), "not a rotation matrix"),
    (setter("extrinsics", "S9", LAST, "R", value="abc"), "R is not made of numbers"),
    (setter("extrinsics", "S9", LAST, "t", value=[[1.0], [2.0]]), r"shape \(3\), got \(2, 1\)"),
    (setter("extrinsics", "S9", LAST, "t", value=[[np.nan], [1.0], [2.0]]), "t is not finite"),
    (setter("extrinsics", "S9", LAST, "t", value=[[[1.0], [2.0, 3.0]]]), "t is not made of numbers"),
])  # fmt: skip
def test_a_json_file_that_does_not_fit_is_refused_with_the_field(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], message: str
) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(change_json(change))
    with pytest.raises(FileFormatError, match=rf"cameras\.json: .*{message}"):
        read_cameras(path)


def test_a_camera_that_a_json_file_lacks_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(change_json(setter("extrinsics", "S9", LAST, value=None)))
    assert list(read_cameras(path)["S9"]) == [0, 1, 2]


def changed_source(old: str, new: str) -> str:
    intrinsics, extrinsics = files.camera_source(("S9",))
    text = f"h36m_cameras_intrinsic_params = {intrinsics!r}\nh36m_cameras_extrinsic_params = {extrinsics!r}\n"
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize("old, new, message", [
    ("h36m_cameras_intrinsic_params", "x", "there is no h36m_cameras_intrinsic_params"),
    ("h36m_cameras_extrinsic_params", "x", "there is no h36m_cameras_extrinsic_params"),
    ("intrinsic_params = [", "intrinsic_params = [open('x'), ", "is read, never run"),
    ("intrinsic_params = [", "intrinsic_params = [__import__('os').system('true'), ", "never run"),
    ("intrinsic_params = [", "intrinsic_params = [" + "-" * 100_000 + "1, ", "never run"),
    ("intrinsic_params = [", "intrinsic_params = [" + "[" * 1000 + "]" * 1000 + ", ", "never run"),
    ("intrinsic_params = [", "intrinsic_params = [{}, ", "not a list of four cameras"),
    ("intrinsic_params = [", "intrinsic_params = 3; x = [", "not a list of four cameras"),
    ("intrinsic_params = [", "intrinsic_params = [[", "never run"),
    ("'54138969'", "'1'", "cameras 1, 55011271, 58860488, 60457274; expected 54138969"),
    ("'focal_length'", "'f'", "S9, camera 0: focal_length is missing"),
    ("'focal_length': [", "'focal_length': ['x', ", "focal_length is not made of numbers"),
    ("'focal_length': [1140.0, ", "'focal_length': [-1140.0, ", "camera K: singular"),
    ("'res_w': 1000", "'res_w': 0", "width_px and height_px must be positive"),
    ("'res_w': 1000", "'res_w': 1e999", "res_w is not finite"),
    ("'radial_distortion': [", "'radial_distortion': [0.0, ", r"not of shape \(3,\)"),
    ("'orientation': [", "'orientation': [7.0] or [", "never run"),
    ("'orientation': [", "'orientation': [0.0, ", r"not of shape \(4,\)"),
    ("'translation'", "'x'", "translation is missing"),
    ("[{}, {}, {}, {}]", "[{}]", "S2 does not have four cameras"),
    ("[{}, {}, {}, {}]", "[1, {}, {}, {}]", "S2, camera 0: missing, or not a table"),
])  # fmt: skip
def test_a_source_that_does_not_fit_is_refused_with_the_field(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "h36m_dataset.py"
    path.write_text(changed_source(old, new))
    with pytest.raises(FileFormatError, match=rf"h36m_dataset\.py: .*{message}"):
        read_cameras(path)


def test_a_quaternion_that_is_none_is_refused(tmp_path: Path) -> None:
    intrinsics, extrinsics = files.camera_source(("S9",))
    extrinsics["S9"][2]["orientation"] = [1.0, 1.0, 0.0, 0.0]
    path = tmp_path / "c.py"
    path.write_text(f"h36m_cameras_intrinsic_params={intrinsics}\nh36m_cameras_extrinsic_params={extrinsics}")
    with pytest.raises(FileFormatError, match="S9, camera 2: orientation is not a unit quaternion"):
        read_cameras(path)


@pytest.mark.parametrize("scale, stands", [(1e-3, "0.00557"), (1e3, "5.57e\\+03")])
def test_cameras_in_another_unit_are_named(tmp_path: Path, scale: float, stands: str) -> None:
    intrinsics, extrinsics = files.camera_source(("S9",))
    for entry in extrinsics["S9"]:
        entry["translation"] = [scale * x for x in entry["translation"]]
    path = tmp_path / "c.py"
    path.write_text(f"h36m_cameras_intrinsic_params={intrinsics}\nh36m_cameras_extrinsic_params={extrinsics}")
    message = f"S9, camera 0 would stand {stands} m from .* must be in millimetres"
    with pytest.raises(UnitError, match=message):
        read_cameras(path)


@pytest.mark.parametrize("name, content, message", [
    ("cameras.toml", b"", "not a file of cameras; name the JSON file"),
    ("cameras.json", b"{", "not readable as JSON"),
    ("cameras.json", b"[" * 100_000, "not readable as JSON"),
    ("cameras.json", b"[]", "the file: missing, or not a table"),
    ("cameras.json", b"\xff\xfe", "not a text file in UTF-8, so not JSON"),
    ("cameras.py", b"def", "never run"),
    ("cameras.py", b"x = 1\0", "never run"),
    ("cameras.py", b"", "empty; expected a list of cameras"),
    ("cameras.py", b"#" * 5_000_000, "larger than 4 MiB"),
])  # fmt: skip
def test_a_file_that_is_no_list_of_cameras_is_refused(
    tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=rf"{name}.*: .*{message}"):
        read_cameras(tmp_path / name)


def test_a_file_of_cameras_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"nowhere\.json: there is no such file"):
        read_cameras(tmp_path / "nowhere.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(FileFormatError, match=r"folder\.json: a folder, not JSON"):
        read_cameras(tmp_path / "folder.json")


# --- cameras that do not belong to the keypoints -------------------------------------------------


def spoil(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = root / "camera-parameters.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_cameras_of_another_subject_are_found_out(own: tuple[Path, files.Positions]) -> None:
    root, _ = own
    spoil(root, lambda data: data["extrinsics"].update(S9=data["extrinsics"]["S11"]))
    with pytest.raises(CalibrationError) as caught:
        Human36M(root).recording("S9", "Action 0", 1)
    for part in (
        "S9 Action 0, camera 1: the truth projects ",
        " px beside the keypoints in the median, more than 3",
        "camera-parameters.json do not belong to these keypoints",
        "data_2d_h36m_gt.npz",
        "a unit is wrong",
    ):
        assert part in str(caught.value)
    Human36M(root).recording("S11", "Action 0", 1)


def test_cameras_in_another_order_are_found_out(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    files.write_keypoints(root, {
        subject: {a: [uv[1], uv[0], uv[2], uv[3]] for a, uv in actions.items()}
        for subject, actions in entries.items()
    })  # fmt: skip
    Human36M(root).recording("S9", "Action 0", 2)
    for camera in (0, 1):
        with pytest.raises(CalibrationError, match=f"Action 0, camera {camera}: the truth projects"):
            Human36M(root).recording("S9", "Action 0", camera)


def test_keypoints_that_are_not_pixels_are_found_out(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    scaled = {
        subject: {a: [uv / 500 - 1 for uv in cameras] for a, cameras in actions.items()}
        for subject, actions in entries.items()
    }
    files.write_keypoints(root, scaled)
    files.write_keypoints(root, scaled, "cpn_ft_h36m_dbb")
    for kind, limit in (("gt", 3), ("cpn_ft_h36m_dbb", 30)):
        with pytest.raises(CalibrationError, match=rf"more than {limit}: .*keypoints in px"):
            Human36M(root, keypoints=kind).recording("S9", "Action 0", 0)


def test_projected_keypoints_fit_better_than_a_detectors(own: tuple[Path, files.Positions]) -> None:
    """What passes as detected does not as projected."""
    root, positions = own
    noisy = files.keypoints(positions, sigma_px=8.0)
    files.write_keypoints(root, noisy, "cpn_ft_h36m_dbb")
    files.write_keypoints(root, noisy, "gt")
    assert Human36M(root, keypoints="cpn_ft_h36m_dbb").recording("S9", "Action 0", 0).notes == ""
    with pytest.raises(CalibrationError, match="more than 3"):
        Human36M(root).recording("S9", "Action 0", 0)


def test_one_truth_in_the_wrong_place_is_kept_with_a_remark(own: tuple[Path, files.Positions]) -> None:
    """The image shows somebody else's place: known of a few sequences, whose camera is right."""
    root, positions = own
    detected = files.keypoints(positions, sigma_px=5.0)
    for uv in detected["S9"]["Action 1"]:
        uv += 60.0
    files.write_keypoints(root, detected, "cpn_ft_h36m_dbb")
    files.write_keypoints(root, detected, "gt")
    data = Human36M(root, keypoints="cpn_ft_h36m_dbb")
    notes = data.recording("S9", "Action 1", 0).notes
    assert notes.startswith("S9 Action 1, camera 0: the truth projects 8")
    assert "this truth stands in the wrong place" in notes
    assert data.recording("S9", "Action 0", 0).notes == ""
    with pytest.raises(CalibrationError):
        Human36M(root).recording("S9", "Action 1", 0)


# --- archives that are not what they should be ---------------------------------------------------


def test_unknown_names_are_answered_with_the_known_ones(root: Path) -> None:
    data = Human36M(root)
    with pytest.raises(UnknownNameError, match=r"unknown subject in data_3d_h36m\.npz 'S2'.*S9, S11"):
        data.motion("S2", "Action 0")
    message = r"unknown action of S9 in data_3d_h36m\.npz 'Action0'. Did you mean 'Action 0'\?"
    with pytest.raises(UnknownNameError, match=message):
        data.motion("S9", "Action0")
    with pytest.raises(UnknownNameError, match=r"unknown keypoints in .* 'vitpose'.*cpn_ft_h36m_dbb, gt"):
        Human36M(root, keypoints="vitpose").recording("S9", "Action 0", 0)


@pytest.mark.parametrize("entry, message", [
    (np.zeros((5, 31, 3), dtype=np.float32), r"expected shape \(T, 32, 3\), got \(5, 31, 3\)"),
    (np.zeros((32, 3), dtype=np.float32), r"got \(32, 3\)"),
    ([1, 2], "got list"),
    ("text", "got str"),
    (np.full((5, 32, 3), np.nan, dtype=np.float32), "in no frame are all joints finite"),
    (np.zeros((0, 32, 3), dtype=np.float32), "in no frame are all joints finite"),
    (np.zeros((5, 32, 3), dtype=np.float32), "the bone that ends at RHip is 0.000 m long, but 0.1"),
])  # fmt: skip
def test_a_corrupt_action_is_named_and_leaves_the_others_usable(
    own: tuple[Path, files.Positions], entry: Any, message: str
) -> None:
    root, positions = own
    before = Human36M(root).motion("S9", "Action 0").joint_offsets
    spoiled: dict[str, Any] = {**positions, "S9": {**positions["S9"], "Bad": entry}}
    files.write_positions(root, spoiled)
    data = Human36M(root)
    with pytest.raises(FileFormatError, match=rf"data_3d_h36m\.npz: S9 'Bad': .*{message}"):
        data.motion("S9", "Bad")
    np.testing.assert_allclose(data.motion("S9", "Action 0").joint_offsets, before, atol=0.02)
    data.recording("S9", "Action 0", 0)
    assert any("S9 'Bad'" in line for line in data.missing(["S9"]))


def test_positions_in_millimetres_are_refused(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    positions["S9"] = {a: 1000 * p for a, p in positions["S9"].items()}
    files.write_positions(root, positions)
    data = Human36M(root)
    message = r"data_3d_h36m\.npz: S9: the right thigh is 4\d\d m long; positions must be in metres"
    with pytest.raises(UnitError, match=message):
        data.motion("S9", "Action 0")
    data.motion("S11", "Action 0")
    lines = [line for line in data.missing(["S9"]) if "thigh" in line]
    assert len(lines) == 1


@pytest.mark.parametrize("entry, message", [
    ([np.zeros((12, 17, 2))] * 3, "not a list of four cameras"),
    (np.zeros((4, 12, 17, 2)), "not a list of four cameras"),
    ([np.zeros((12, 16, 2))] * 4, r"camera 0: expected shape \(T, 17, 2\), got \(12, 16, 2\)"),
    ([np.zeros((12, 17, 3))] * 4, r"camera 0: expected shape \(T, 17, 2\), got \(12, 17, 3\)"),
    ([None] * 4, "camera 0: .*got NoneType"),
    ([np.full((12, 17, 2), np.nan)] * 4, "camera 0: there is no finite number"),
    ([np.zeros((0, 17, 2))] * 4, "camera 0: there is no finite number"),
])  # fmt: skip
def test_corrupt_keypoints_are_named(own: tuple[Path, files.Positions], entry: Any, message: str) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    entries["S9"]["Action 2"] = entry
    files.write_keypoints(root, entries)
    data = Human36M(root)
    with pytest.raises(FileFormatError, match=rf"data_2d_h36m_gt\.npz: S9 'Action 2'.*{message}"):
        data.recording("S9", "Action 2", 0)
    data.recording("S9", "Action 1", 0)
    assert any("S9 'Action 2'" in line for line in data.missing(["S9"]))


@pytest.mark.parametrize("metadata", [
    {**files.METADATA, "layout_name": "coco"},
    {**files.METADATA, "num_joints": 16},
    {"num_joints": 17, "keypoints_symmetry": [[1, 3, 5, 7, 9, 11, 13, 15], [2, 4, 6, 8, 10, 12, 14, 16]]},
    {"num_joints": 17, "keypoints_symmetry": [[1, 2, 3, 14, 15, 16], [4, 5, 6, 11, 12, 13]]},
    {"num_joints": 17, "keypoints_symmetry": 5},
    {"num_joints": 17, "keypoints_symmetry": ["a", None]},
    {}, [], None,
])  # fmt: skip
def test_17_points_that_are_not_human36ms_are_refused(
    own: tuple[Path, files.Positions], metadata: Any
) -> None:
    root, positions = own
    files.write_keypoints(root, files.keypoints(positions), "detectron_pt_coco", metadata)
    with pytest.raises(FileFormatError, match=r"coco\.npz: metadata: .*only Human3\.6M's own 17"):
        Human36M(root, keypoints="detectron_pt_coco").recording("S9", "Action 0", 0)


def test_metadata_as_the_projected_archive_has_it_are_accepted(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    sides = (list(files.METADATA["keypoints_symmetry"][0]), files.METADATA["keypoints_symmetry"][1])  # type: ignore[index]
    files.write_keypoints(
        root, files.keypoints(positions), "gt", {"num_joints": np.int64(17), "keypoints_symmetry": sides}
    )
    Human36M(root).recording("S9", "Action 0", 0)


@pytest.mark.parametrize("content", [None, [1], {"S9": [1, 2]}, {"S9": None}, np.zeros((5, 32, 3))])
def test_an_archive_of_another_shape_is_refused(tmp_path: Path, content: Any) -> None:
    contents: dict[str, Any] = {"positions_3d": [content] if content is None else content}
    if isinstance(content, dict):
        np.savez(tmp_path / "data_3d_h36m.npz", **contents)
    elif isinstance(content, np.ndarray):
        np.savez(tmp_path / "data_3d_h36m.npz", positions_3d=content)
    else:
        box = np.empty((), dtype=object)
        box[()] = content
        np.savez(tmp_path / "data_3d_h36m.npz", positions_3d=box)
    with pytest.raises(FileFormatError, match="positions_3d: not a dictionary of subjects"):
        Human36M(tmp_path).motion("S9", "Action 0")


class Harm:
    """Pickled as a command."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> Any:
        return (os.system, (self.command,))


@pytest.mark.parametrize("member", ["positions_3d", "positions_2d", "metadata"])
def test_an_archive_that_would_run_a_command_is_refused_and_does_not(
    own: tuple[Path, files.Positions], member: str
) -> None:
    root, _ = own
    name = "data_3d_h36m.npz" if member == "positions_3d" else "data_2d_h36m_gt.npz"
    mark = root / "it ran"
    box = np.empty((), dtype=object)
    box[()] = {"S9": {"Action 0": Harm(f"touch '{mark}'")}, "num_joints": 17}
    with zipfile.ZipFile(root / name) as archive:
        members = {entry: archive.read(entry) for entry in archive.namelist()}
    header = members[f"{member}.npy"][:128]
    members[f"{member}.npy"] = header + pickle.dumps(box, 3)
    with zipfile.ZipFile(root / name, "w") as archive:
        for entry, data in members.items():
            archive.writestr(entry, data)
    message = rf"{name}: {member}: not opened: it wants to run (posix|nt)\.system"
    with pytest.raises(FileFormatError, match=message):
        Human36M(root).recording("S9", "Action 0", 0)
    assert not mark.exists()
    assert any("it wants to run" in line for line in Human36M(root).missing())


# --- what is missing -----------------------------------------------------------------------------


def test_nothing_is_missing_of_a_complete_folder(tmp_path: Path) -> None:
    files.write_dataset(tmp_path, ("S1", "S11"), actions=30, frames=3)
    assert Human36M(tmp_path).missing(["S1", "S11"]) == []
    assert Human36M(tmp_path, keypoints="cpn_ft_h36m_dbb").missing(["S1"]) == []
    lines = Human36M(tmp_path).missing()
    assert {line.split(":")[0] for line in lines} == {"S5", "S6", "S7", "S8", "S9"}
    assert lines[0] == "S5: 0 of 30 actions in data_3d_h36m.npz"
    assert lines[1] == "S5: no camera 0, 1, 2, 3 in camera-parameters.json"


def test_what_is_missing_is_said_one_line_each(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    del entries["S11"]["Action 1"]
    files.write_keypoints(root, entries)
    spoil(root, setter("extrinsics", "S9", LAST, value=None))
    assert Human36M(root).missing(["S9", "S11"]) == [
        "S9: 3 of 30 actions in data_3d_h36m.npz",
        "S9: no camera 3 in camera-parameters.json",
        "S11: 3 of 29 actions in data_3d_h36m.npz",
        "unknown action of S11 in data_2d_h36m_gt.npz 'Action 1'. Did you mean 'Action 2'? "
        "Known: Action 0, Action 2",
    ]


def test_of_an_empty_folder_every_file_is_missing(tmp_path: Path) -> None:
    lines = Human36M(tmp_path).missing()
    assert len(lines) == 3
    assert "data_3d_h36m.npz: there is no such file" in lines[0]
    assert "unknown keypoints" in lines[1]
    assert "name the file of cameras" in lines[2]


def test_the_split_is_the_usual_one() -> None:
    assert (*SUBJECTS_TRAIN, *SUBJECTS_TEST) == ("S1", "S5", "S6", "S7", "S8", "S9", "S11")
    assert SUBJECTS_TEST == ("S9", "S11")
