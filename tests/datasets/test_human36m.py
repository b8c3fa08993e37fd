"""Human3.6M: planted archives as recordings, cameras, bodies, and refusals."""

from __future__ import annotations

import copy
import json
import shutil
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
from rtof_kin.datasets.human36m import RATE_HZ, Human36M, bone_lengths
from rtof_kin.datasets.human36m_files import read_cameras

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


# --- recordings ----------------------------------------------------------------------------------


def test_a_recording_has_keypoints_truth_and_labels(root: Path, truth: files.Positions) -> None:
    for camera in range(4):
        recording = Human36M(root).recording("S9", "Action 1", camera)
        seen = recording.video.camera.project(recording.truth.p_world_joint)
        error_px = np.linalg.norm(seen - recording.video.uv_px, axis=-1)
        assert error_px.max() < 0.3  # Human3.6M's formula of distortion differs from OpenCV's
        assert np.median(error_px) < 0.1
    assert recording.name == "S9 Action 1 cam3"
    assert recording.skeleton_table == "human36m"
    assert recording.imus is None
    assert "Human3.6M" in recording.acknowledgement
    assert recording.notes == ""
    assert recording.video.names == SKELETON.names
    assert (recording.video.confidence == 1).all()
    np.testing.assert_allclose(recording.video.times, np.arange(30) / RATE_HZ, atol=1e-12)
    np.testing.assert_array_equal(recording.truth.p_world_joint, truth["S9"]["Action 1"])
    assert recording.truth.valid.all()
    observed = recording.truth.orientation_observed[0]
    assert [n for n, o in zip(SKELETON.names, observed, strict=True) if o] == ["Hip", "Thorax"]


def test_orientations_and_offsets_reproduce_the_positions(root: Path) -> None:
    data = Human36M(root)
    for subject, action in data.sequences:
        recording = data.recording(subject, action, 0)
        poses, offsets = recording.truth, recording.joint_offsets
        p = kinematics.positions(SKELETON.parents, offsets, poses.p_world_joint[:, 0], poses.R_world_bone)
        np.testing.assert_allclose(p, poses.p_world_joint, atol=2e-6)


def test_truth_and_detections_are_cut_to_the_shorter(root: Path, own: tuple[Path, files.Positions]) -> None:
    recording = Human36M(root, keypoints="cpn_ft_h36m_dbb").recording("S9", "Action 0", 3)
    assert len(recording.video) == len(recording.truth) == 30
    seen = recording.video.camera.project(recording.truth.p_world_joint)
    assert 7 < np.median(np.linalg.norm(seen - recording.video.uv_px, axis=-1)) < 12  # 8 px per axis
    folder, positions = own
    entries = files.keypoints(positions)
    entries["S9"]["Action 0"] = [uv[:7] for uv in entries["S9"]["Action 0"]]
    sides = (list(files.METADATA["keypoints_symmetry"][0]), files.METADATA["keypoints_symmetry"][1])  # type: ignore[index]
    files.write_keypoints(folder, entries, "gt", {"num_joints": np.int64(17), "keypoints_symmetry": sides})
    recording = Human36M(folder).recording("S9", "Action 0", 0)
    assert (len(recording.video), len(recording.truth)) == (7, 7)
    assert len(Human36M(folder).motion("S9", "Action 0").p_world_joint) == 12


def test_values_that_are_not_finite_are_missing(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    entries = files.keypoints(positions)
    entries["S9"]["Action 0"][0][2, 5] = [np.inf, 3.0]
    positions["S9"]["Action 0"][4, 8, 1] = np.nan
    positions["S9"]["Action 0"][5, 8] = np.inf
    files.write_keypoints(root, entries)
    files.write_positions(root, positions)
    recording = Human36M(root).recording("S9", "Action 0", 0)
    assert np.argwhere(recording.keypoints.confidence == 0).tolist() == [[2, 5]]
    assert np.isnan(recording.keypoints.uv_px[2, 5]).all()
    assert np.argwhere(~recording.truth.valid).tolist() == [[4, 8], [5, 8]]
    assert np.isnan(recording.truth.R_world_bone[[4, 5]]).all()
    assert np.isfinite(recording.truth.R_world_bone[6:]).all()


# --- the subject's body --------------------------------------------------------------------------


@pytest.mark.parametrize("subject", TWO)
def test_a_body_is_recovered_from_positions(root: Path, subject: str) -> None:
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
    p = np.array(Human36M(root).motion(subject, "Action 0").p_world_joint)
    p[:5] *= 100.0  # medians survive a few wild frames
    np.testing.assert_allclose(bone_lengths(SKELETON, p), lengths, atol=1e-5)


# --- cameras -------------------------------------------------------------------------------------


def test_both_camera_files_give_the_same_cameras(root: Path) -> None:
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


def test_tangential_coefficients_of_the_source_are_swapped(root: Path) -> None:
    """Where x is 0 both formulas give the same u; there the order decides."""
    for i, camera in read_cameras(root / "h36m_dataset.py")["S9"].items():
        points = np.array([[0.0, y, 1.0] for y in (-0.35, 0.1, 0.4)])
        p_world = (points - camera.t_camera_world) @ camera.R_camera_world
        np.testing.assert_allclose(camera.project(p_world)[:, 0], files.projected(p_world, "S9", i)[:, 0], atol=1e-9)
        swapped = camera.distortion[[0, 1, 3, 2, 4]]
        other = Camera(camera.K, camera.R_camera_world, camera.t_camera_world, 1000, 1000, swapped).project(p_world)
        assert np.abs(other[:, 0] - files.projected(p_world, "S9", i)[:, 0]).max() > 0.05


def test_the_camera_file_can_be_given(root: Path, own: tuple[Path, files.Positions]) -> None:
    folder, _ = own
    (folder / "camera-parameters.json").unlink()
    recording = Human36M(folder, root / "h36m_dataset.py").recording("S9", "Action 0", 0)
    np.testing.assert_allclose(recording.video.camera.center_world, files.PLACES[0], atol=1e-9)
    with pytest.raises(FileFormatError, match="neither camera-parameters.json nor h36m_dataset.py"):
        Human36M(folder).recording("S9", "Action 0", 0)


def changed_source(old: str, new: str) -> str:
    intrinsics, extrinsics = files.camera_source(("S9",))
    text = f"h36m_cameras_intrinsic_params = {intrinsics!r}\nh36m_cameras_extrinsic_params = {extrinsics!r}\n"
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("h36m_cameras_intrinsic_params", "x", "there is no h36m_cameras_intrinsic_params"),
        ("intrinsic_params = [", "intrinsic_params = [open('x'), ", "is read, never run"),
        ("'54138969'", "'1'", "cameras 1, 55011271, 58860488, 60457274; expected 54138969"),
        ("'focal_length'", "'f'", r"h36m_cameras_intrinsic_params.1\] focal_length: missing; add it"),
        ("'orientation': [", "'orientation': [0.0, ", r"params.S9.1\] orientation: expected 4 numbers"),
        ("[{}, {}, {}, {}]", "[{}]", "S2 does not have four cameras"),
    ],
)
def test_a_wrong_source_is_refused_with_the_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "h36m_dataset.py"
    path.write_text(changed_source(old, new))
    with pytest.raises(FileFormatError, match=rf"h36m_dataset\.py: .*{message}"):
        read_cameras(path)


@pytest.mark.parametrize(
    "field, value, error, message",
    [
        ("translation", [2.1, 4.9, 1.6], UnitError, "would stand 0.00557 m from .* millimetres"),
        ("orientation", [1.0, 1.0, 0.0, 0.0], FileFormatError, "orientation is not a unit quaternion"),
    ],
)
def test_implausible_cameras(
    tmp_path: Path, field: str, value: list[float], error: type[Exception], message: str
) -> None:
    intrinsics, extrinsics = files.camera_source(("S9",))
    extrinsics["S9"][0][field] = value
    path = tmp_path / "c.py"
    path.write_text(f"h36m_cameras_intrinsic_params={intrinsics}\nh36m_cameras_extrinsic_params={extrinsics}")
    with pytest.raises(error, match=f"S9, camera 0.*{message}"):
        read_cameras(path)


# --- cameras that do not belong to the keypoints -------------------------------------------------


def spoil(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = root / "camera-parameters.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_cameras_of_another_subject_are_refused(own: tuple[Path, files.Positions]) -> None:
    root, _ = own
    spoil(root, lambda data: data["extrinsics"].update(S9=data["extrinsics"]["S11"]))
    message = r"S9 Action 0, camera 1: .* more than 3: .*camera-parameters\.json .*data_2d_h36m_gt\.npz.* unit"
    with pytest.raises(CalibrationError, match=message):
        Human36M(root).recording("S9", "Action 0", 1)
    Human36M(root).recording("S11", "Action 0", 1)


def test_a_misplaced_truth_is_kept_with_a_note(own: tuple[Path, files.Positions]) -> None:
    """A known fault of a few sequences whose camera is right; projected keypoints must fit better."""
    root, positions = own
    detected = files.keypoints(positions, sigma_px=5.0)
    for uv in detected["S9"]["Action 1"]:
        uv += 60.0
    files.write_keypoints(root, detected, "cpn_ft_h36m_dbb")
    files.write_keypoints(root, detected, "gt")
    data = Human36M(root, keypoints="cpn_ft_h36m_dbb")
    notes = data.recording("S9", "Action 1", 0).notes
    assert notes.startswith("S9 Action 1, camera 0: the truth projects 8")
    assert data.recording("S9", "Action 0", 0).notes == ""
    for action in ("Action 0", "Action 1"):
        with pytest.raises(CalibrationError, match="more than 3"):
            Human36M(root).recording("S9", action, 0)


# --- archives that are not what they should be ---------------------------------------------------


def test_unknown_names_are_refused_with_the_known_ones(root: Path, tmp_path: Path) -> None:
    data = Human36M(root)
    with pytest.raises(UnknownNameError, match=r"subject in data_3d_h36m\.npz 'S2'.*S9, S11"):
        data.motion("S2", "Action 0")
    with pytest.raises(UnknownNameError, match=r"action of S9 .* 'Action0'. Did you mean 'Action 0'\?"):
        data.motion("S9", "Action0")
    with pytest.raises(UnknownNameError, match=r"keypoints in .* 'vitpose'.*cpn_ft_h36m_dbb, gt"):
        Human36M(root, keypoints="vitpose").recording("S9", "Action 0", 0)
    with pytest.raises(UnknownNameError, match=r"camera of S9 in .*'4'.*Known: 0, 1, 2, 3"):
        data.recording("S9", "Action 0", 4)
    files.write_camera_source(tmp_path, ("S9",))
    with pytest.raises(UnknownNameError, match=r"subject in h36m_dataset\.py 'S11'.*Known: S9"):
        Human36M(root, tmp_path / "h36m_dataset.py").recording("S11", "Action 0", 0)


@pytest.mark.parametrize(
    "entry, message",
    [
        (np.zeros((5, 31, 3), dtype=np.float32), r"expected shape \(T, 32, 3\), got \(5, 31, 3\)"),
        (np.full((5, 32, 3), np.nan, dtype=np.float32), "in no frame are all joints finite"),
        (np.zeros((5, 32, 3), dtype=np.float32), "the bone that ends at RHip is 0.000 m long, but 0.1"),
    ],
)
def test_corrupt_action_is_refused_alone(own: tuple[Path, files.Positions], entry: Any, message: str) -> None:
    root, positions = own
    before = Human36M(root).motion("S9", "Action 0").joint_offsets
    spoiled: dict[str, Any] = {**positions, "S9": {**positions["S9"], "Bad": entry}}
    files.write_positions(root, spoiled)
    data = Human36M(root)
    with pytest.raises(FileFormatError, match=rf"data_3d_h36m\.npz: S9 'Bad': .*{message}"):
        data.motion("S9", "Bad")
    np.testing.assert_allclose(data.motion("S9", "Action 0").joint_offsets, before, atol=0.02)
    data.recording("S9", "Action 0", 0)


def test_positions_in_millimetres_are_refused(own: tuple[Path, files.Positions]) -> None:
    root, positions = own
    positions["S9"] = {a: 1000 * p for a, p in positions["S9"].items()}
    files.write_positions(root, positions)
    data = Human36M(root)
    message = r"data_3d_h36m\.npz: S9: the right thigh is 4\d\d m long; positions must be in metres"
    with pytest.raises(UnitError, match=message):
        data.motion("S9", "Action 0")
    data.motion("S11", "Action 0")


@pytest.mark.parametrize(
    "metadata",
    [
        {**files.METADATA, "layout_name": "coco"},
        {**files.METADATA, "num_joints": 16},
        {"num_joints": 17, "keypoints_symmetry": [[1, 3, 5, 7, 9, 11, 13, 15], [2, 4, 6, 8, 10, 12, 14, 16]]},
        {"num_joints": 17, "keypoints_symmetry": 5},
        {},
        None,
    ],
)
def test_17_points_of_another_layout_are_refused(own: tuple[Path, files.Positions], metadata: Any) -> None:
    root, positions = own
    files.write_keypoints(root, files.keypoints(positions), "detectron_pt_coco", metadata)
    with pytest.raises(FileFormatError, match=r"coco\.npz: metadata: .*only Human3\.6M's own 17"):
        Human36M(root, keypoints="detectron_pt_coco").recording("S9", "Action 0", 0)
