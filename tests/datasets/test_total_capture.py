"""Total Capture as the package reads it: planted takes come back, and nothing wrong passes unsaid."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import total_capture_support as support

from benchmarks import total_capture_files as files
from benchmarks import total_capture_motion as source
from benchmarks import total_capture_standin as standin
from rtof_kin.body.kinematics import positions
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.detections import read_detections
from rtof_kin.datasets.total_capture import SUBJECTS, TEST, TRAIN, Take, TotalCapture
from rtof_kin.datasets.total_capture_checks import check_keypoints, check_take
from rtof_kin.simulation.mocap import NAMES, PARENTS
from rtof_kin.simulation.noise import ImuNoise

ONE = ("S5", "acting3")
KINDS = ("positions", "orientations", "bvh", "sensors", "aux", "ref", "bone", "cameras")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one perfect take; not to be changed."""
    folder = tmp_path_factory.mktemp("perfect")
    support.dataset(folder)
    return folder


@pytest.fixture(scope="module")
def take(root: Path) -> Take:
    return TotalCapture(root).take(*ONE)


@pytest.fixture
def paths(tmp_path: Path, root: Path) -> dict[str, Path]:
    """A copy of it, to be spoiled."""
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    found = {kind: tmp_path / path for kind, path in files.take_paths("one", *ONE).items()}
    return found | {"cameras": tmp_path / "calibration.cal"}


def failed(checks: list[Check]) -> list[Check]:
    return [check for check in checks if not check.passed]


def said(take: Take) -> str:
    """Everything that a take says about itself."""
    return "\n".join([*take.notes, *take.missing])


# --- what was planted ----------------------------------------------------------------------------


def test_positions_come_back_within_the_rounding_of_the_text(take: Take) -> None:
    planted = support.motion()
    assert take.truth.names == NAMES
    np.testing.assert_allclose(take.truth.p_world_joint, planted.p_world_joint, atol=1e-5)
    assert take.truth.valid.all()
    np.testing.assert_allclose(take.truth.times, np.arange(len(planted)) / 60, atol=1e-12)


def test_orientations_come_back_in_link_axes(take: Take) -> None:
    planted = support.motion()
    assert support.degrees_apart(take.truth.R_world_bone, planted.R_world_bone) < 1e-3
    assert take.truth.orientation_observed.all()


def test_a_take_faces_plus_y_with_the_right_hand_at_plus_x(take: Take) -> None:
    """The documented heading, in the package's z-up world."""
    p = take.truth.p_world_joint[0]
    across = so3.unit(p[NAMES.index("RightHand")] - p[NAMES.index("LeftHand")])
    np.testing.assert_allclose(across, [1, 0, 0], atol=0.15)
    forward = take.truth.R_world_bone[0, :, :, 0]
    np.testing.assert_allclose(forward, np.tile([0, 1, 0], (21, 1)), atol=0.2)


def test_a_t_pose_written_by_hand_is_a_quarter_turn_about_z(tmp_path: Path) -> None:
    """Without the stand-in: x y z w of Rot_x(90) is a subject who faces -Z; 100 inches up is 2.54 m."""
    half = f"{np.sqrt(0.5):.6f}"
    for kind, cell in (("pos", "50 100 -25"), ("ori", f"{half} 0 0 {half}")):
        rows = [offset_row(cell) if kind == "pos" else f"{cell}\t" * 21 for _ in range(12)]
        path = tmp_path / "S1" / "walking1" / f"gt_skel_gbl_{kind}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\t".join(NAMES) + "\t\n" + "\n".join(rows) + "\n")
    found = TotalCapture(tmp_path).take("S1", "walking1")
    quarter = np.broadcast_to(so3.about_axis("z", np.pi / 2), (12, 21, 3, 3))
    np.testing.assert_allclose(found.truth.R_world_bone, quarter, atol=1e-5)
    np.testing.assert_allclose(found.truth.p_world_joint[0, 0], [1.27, 0.635, 2.54], atol=1e-6)
    # One inch right, two up, three forward of its parent.
    np.testing.assert_allclose(found.joint_offsets[1:], np.tile([3, -1, 2], (20, 1)) * 0.0254, atol=1e-6)


def offset_row(root_cell: str) -> str:
    """21 cells, each joint 1 inch right of, 2 above and 3 in front (-z) of its parent."""
    p = np.zeros((21, 3))
    p[0] = [float(x) for x in root_cell.split()]
    for j, parent in enumerate(PARENTS[1:], 1):
        p[j] = p[parent] + [1, 2, -3]
    return "".join(" ".join(f"{x:.6g}" for x in cell) + "\t" for cell in p)


def test_offsets_are_those_of_the_body(take: Take) -> None:
    np.testing.assert_allclose(take.joint_offsets, source.body(*ONE), atol=2e-6)
    assert take.spread_mm < 0.01
    skeleton = take.skeleton
    assert skeleton.bone_lengths["RightForeArm"] == pytest.approx(0.3207, abs=1e-5)


def test_offsets_are_derived_for_each_take(tmp_path: Path) -> None:
    """S1's freestyle2 is of another size than the rest of S1."""
    support.dataset(tmp_path, support.take("S1", "freestyle1"), support.take("S1", "freestyle2"))
    dataset = TotalCapture(tmp_path)
    usual, other = (dataset.take("S1", name).joint_offsets for name in ("freestyle1", "freestyle2"))
    np.testing.assert_allclose(other, 1.02 * usual, atol=5e-6)


def test_bones_orientations_and_acceleration_come_out_of_the_imus(take: Take) -> None:
    assert take.imus is not None
    assert take.calibration is not None
    planted = support.motion()
    bones = take.calibration.apply(take.imus)
    index = [NAMES.index(joint) for joint in bones.joints]
    assert support.degrees_apart(bones.R_world_bone, planted.R_world_bone[:, index]) < 0.01
    sensor = planted.p_world_joint[:, index] + np.einsum(
        "tsij,sj->tsi", planted.R_world_bone[:, index], bones.p_bone_sensor
    )
    expected = np.diff(sensor, n=2, axis=0) * 3600
    a = bones.a_world
    smoothed = (a[:-2] + 4 * a[1:-1] + a[2:]) / 6
    np.testing.assert_allclose(smoothed[12:-1], expected[12:-1], atol=0.01)


def test_the_calibration_is_the_planted_one(take: Take) -> None:
    planted = support.take().calibration
    found = take.calibration
    assert found is not None
    assert set(found.sensors) == set(planted.sensors)
    planted = planted.select(found.sensors)
    assert found.joints == planted.joints
    assert support.degrees_apart(found.R_world_inertial, planted.R_world_inertial) < 1e-3
    assert support.degrees_apart(found.R_sensor_bone, planted.R_sensor_bone) < 1e-3
    usual = SkeletonModel.default().sensors
    for sensor, joint, lever in zip(found.sensors, found.joints, found.p_bone_sensor, strict=True):
        assert usual[sensor][0] == joint
        np.testing.assert_array_equal(usual[sensor][1], lever)


def test_raw_sensor_data_come_back_but_for_the_first_ten_frames(tmp_path: Path) -> None:
    planted = support.take(stamp=True)
    support.dataset(tmp_path, planted)
    found = TotalCapture(tmp_path).take(*ONE).imus
    assert found is not None
    expected = planted.imus.select(found.names)
    assert np.isnan(found.f_sensor[:10]).all()
    np.testing.assert_allclose(found.f_sensor[10:], expected.f_sensor[10:], rtol=1e-5, atol=1e-6)
    assert support.degrees_apart(found.R_inertial_sensor, expected.R_inertial_sensor) < 1e-3


def test_cameras_are_those_of_the_file_in_the_z_up_world(root: Path) -> None:
    found = TotalCapture(root).cameras
    assert sorted(found) == list(range(1, 9))
    for number, planted in source.cameras().items():
        np.testing.assert_allclose(found[number].center_world, planted.center_world, atol=1e-6)
        p = support.motion().p_world_joint[::30]
        np.testing.assert_allclose(found[number].project(p), planted.project(p), atol=1e-4)
        assert (found[number].width_px, found[number].height_px) == (1920, 1080)
    assert found[1].center_world == pytest.approx([1.19, 4.70, 2.45], abs=1e-6)


# --- recordings ----------------------------------------------------------------------------------


def test_a_recording_has_the_true_joints_as_the_camera_sees_them(take: Take) -> None:
    recording = take.recording(3)
    np.testing.assert_allclose(
        recording.keypoints.uv_px, source.cameras()[3].project(support.motion().p_world_joint), atol=0.01
    )
    assert recording.keypoints.names == NAMES
    assert "S5" in recording.name
    assert "acting3" in recording.name
    assert "3" in recording.name.split("cam")[1]
    assert "Trumble" in recording.acknowledgement
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.joint_offsets, take.joint_offsets)
    bones = recording.bone_imus()
    assert bones is not None
    assert len(bones.joints) == 13
    assert len(bones) == len(recording.keypoints)


def test_a_recording_saves_and_loads(take: Take, tmp_path: Path) -> None:
    recording = take.recording(1)
    recording.save(tmp_path / "saved")
    again = type(recording).load(tmp_path / "saved")
    np.testing.assert_array_equal(again.keypoints.uv_px, recording.keypoints.uv_px)
    assert again.acknowledgement == recording.acknowledgement
    assert again.imus is not None
    assert recording.imus is not None
    np.testing.assert_array_equal(again.imus.f_sensor, recording.imus.f_sensor)


def test_joints_outside_the_picture_are_kept_and_behind_the_camera_unseen(take: Take) -> None:
    truth = take.truth
    moved = truth.p_world_joint + np.array([2.6, 0.0, 0.0])
    aside = replace(take, truth=replace(truth, p_world_joint=moved))
    centre = take.cameras[3].center_world
    near = truth.p_world_joint + (1.35 * centre * [1, 1, 0])
    behind = replace(take, truth=replace(truth, p_world_joint=near))
    uv = aside.recording(3).keypoints.uv_px
    assert np.isfinite(uv).all()
    assert ((uv < 0) | (uv > [1920, 1080])).any()
    assert np.isnan(behind.recording(3).keypoints.uv_px).all()


def test_noise_is_of_the_size_asked_for_and_of_take_camera_and_seed(take: Take) -> None:
    clean = take.recording(1).keypoints.uv_px
    one = take.recording(1, noise_px=5.0, seed=0).keypoints.uv_px
    assert (one - clean).std() == pytest.approx(5.0, rel=0.05)
    np.testing.assert_array_equal(one, take.recording(1, noise_px=5.0, seed=0).keypoints.uv_px)
    for other in (
        take.recording(1, noise_px=5.0, seed=1).keypoints.uv_px - clean,
        take.recording(4, noise_px=5.0).keypoints.uv_px - take.recording(4).keypoints.uv_px,
        replace(take, name="acting1").recording(1, noise_px=5.0).keypoints.uv_px - clean,
        replace(take, subject="S4").recording(1, noise_px=5.0).keypoints.uv_px - clean,
    ):
        assert abs(np.corrcoef((one - clean).ravel(), other.ravel())[0, 1]) < 0.1


def test_a_recording_has_the_sensors_asked_for(take: Take) -> None:
    recording = take.recording(1, sensors=("L_LowArm", "Pelvis"))
    assert recording.imus is not None
    assert recording.imus.names == ("L_LowArm", "Pelvis")
    assert recording.calibration is not None
    assert recording.calibration.joints == ("LeftForeArm", "Hips")


def test_an_unknown_camera_sensor_or_take_is_named_with_those_there_are(take: Take, root: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"camera.*'9'.*1, 2, 3"):
        take.recording(9)
    with pytest.raises(UnknownNameError, match=r"sensor.*'L_Hand'.*Head"):
        take.recording(1, sensors=("L_Hand",))
    with pytest.raises(UnknownNameError, match=r"'S4 acting3'|'S4'.*S5"):
        TotalCapture(root).take("S4", "acting3")


# --- a detector's 2D -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with detections of the perfect take by cameras 1 and 2."""
    folder = tmp_path_factory.mktemp("detected")
    for number in (1, 2):
        standin.write_detections(folder, support.take(), number, source.cameras()[number], seed=3)
    return folder


def test_detections_make_a_recording_and_only_camera_2_fails_its_check(take: Take, detected: Path) -> None:
    found = {n: read_detections(detected, *ONE, n, take.cameras[n]) for n in (1, 2)}
    recording = take.recording(1, found[1])
    np.testing.assert_array_equal(recording.keypoints.uv_px, found[1].uv_px)
    assert not failed(check_keypoints(take, 1, found[1]))
    (bad,) = failed(check_keypoints(take, 2, found[2]))
    assert "camera 2" in bad.message
    assert "miscalibrated" in bad.message
    assert "(+20, -8) px" in bad.message
    assert bad.value > bad.limit == 20


def test_a_video_that_ends_early_cuts_the_recording_from_frame_0(take: Take, detected: Path) -> None:
    short = read_detections(detected, *ONE, 1, take.cameras[1])[:50]
    recording = take.recording(1, short)
    assert len(recording.keypoints) == 50
    assert recording.truth is not None
    assert len(recording.truth) == 50
    assert recording.keypoints.times[0] == 0
    assert recording.bone_imus() is not None


def test_keypoints_of_other_times_are_refused(take: Take, detected: Path) -> None:
    found = read_detections(detected, *ONE, 1, take.cameras[1])
    for times in (found.times * 2, found.times + 0.5):
        with pytest.raises(ShapeError, match="S5 acting3: keypoints must begin at time 0"):
            take.recording(1, replace(found, times=times))


def test_a_camera_far_off_names_itself(take: Take) -> None:
    seen = take.recording(5).keypoints
    moved = replace(seen, uv_px=seen.uv_px + np.array([0.0, 40.0]))
    (bad,) = failed(check_keypoints(take, 5, moved))
    assert "camera 5" in bad.message
    assert bad.value == pytest.approx(40.0, abs=0.1)


# --- checks --------------------------------------------------------------------------------------


def test_a_perfect_take_passes_every_check(take: Take) -> None:
    checks = check_take(take)
    assert not failed(checks)
    about = {check.subject for check in checks}
    assert "take" in about
    assert {f"sensor {name}" for name in SkeletonModel.default().sensors} <= about
    assert all(check.message for check in checks)


def test_the_calibration_of_another_take_fails_and_says_so(tmp_path: Path, paths: dict[str, Path]) -> None:
    other = support.take("S5", "freestyle1", seed=4)
    files.write_imu_calibration(paths["ref"], paths["bone"], other.calibration)
    bad = failed(check_take(TotalCapture(tmp_path).take(*ONE)))
    turned = [check for check in bad if check.unit == "deg"]
    assert len(turned) >= 10
    assert all(check.subject.startswith("sensor ") for check in turned)
    assert all(check.value > check.limit == 15 for check in turned)
    for check in turned:
        assert check.subject in check.message
        assert "calibration of another take" in check.message


def test_ref_and_bone_exchanged_fail_the_check(tmp_path: Path, paths: dict[str, Path]) -> None:
    ref, bone = paths["ref"].read_bytes(), paths["bone"].read_bytes()
    paths["ref"].write_bytes(bone)
    paths["bone"].write_bytes(ref)
    bad = failed(check_take(TotalCapture(tmp_path).take(*ONE)))
    assert len({check.subject for check in bad}) >= 10


def test_sensor_quaternions_with_the_scalar_last_fail_the_check(
    tmp_path: Path, paths: dict[str, Path]
) -> None:
    rows = support.lines(paths["sensors"])
    for i, row in enumerate(rows):
        cells = row.split("\t")
        if len(cells) == 8:
            rows[i] = "\t".join([cells[0], *cells[2:5], cells[1], *cells[5:]])
    paths["sensors"].write_text("".join(rows))
    assert len(failed(check_take(TotalCapture(tmp_path).take(*ONE)))) >= 10


def test_a_take_that_starts_otherwise_fails_its_checks(take: Take) -> None:
    """Turned about the vertical, and with hanging arms."""
    turn = so3.about_axis("z", np.radians(120))
    truth = take.truth
    turned = replace(
        truth, p_world_joint=truth.p_world_joint @ turn.T, R_world_bone=turn @ truth.R_world_bone
    )
    bad = failed(check_take(replace(take, truth=turned, imus=None, calibration=None)))
    assert [check.subject for check in bad] == ["take"]
    assert bad[0].value == pytest.approx(120, abs=6)

    R = np.array(truth.R_world_bone)
    arm = [NAMES.index(n) for n in ("RightArm", "RightForeArm", "RightHand")]
    R[:, arm] = R[:, arm] @ so3.about_axis("x", np.radians(70))
    p = positions(PARENTS, take.joint_offsets, truth.p_world_joint[:, 0], R)
    hanging = replace(truth, p_world_joint=p, R_world_bone=R)
    bad = failed(check_take(replace(take, truth=hanging, imus=None, calibration=None)))
    assert len(bad) == 1
    assert "T-pose" in bad[0].message
    assert bad[0].value == pytest.approx(70, abs=8)


def test_gravity_that_was_taken_out_or_turned_fails_the_check_of_acceleration(take: Take) -> None:
    assert take.imus is not None
    f = np.array(take.imus.f_sensor)
    f[:, 0] *= 1.1
    bad = failed(check_take(replace(take, imus=replace(take.imus, f_sensor=f))))
    assert [check.subject for check in bad] == [f"sensor {take.imus.names[0]}"]
    assert bad[0].value == pytest.approx(0.98, abs=0.15)
    assert bad[0].limit == 0.5


# --- layouts and names ---------------------------------------------------------------------------


def same(one: Take, two: Take) -> None:
    np.testing.assert_array_equal(one.truth.p_world_joint, two.truth.p_world_joint)
    np.testing.assert_array_equal(one.truth.R_world_bone, two.truth.R_world_bone)
    assert one.imus is not None
    assert two.imus is not None
    np.testing.assert_array_equal(one.imus.f_sensor, two.imus.f_sensor)
    assert one.calibration is not None
    assert two.calibration is not None
    np.testing.assert_array_equal(one.calibration.R_sensor_bone, two.calibration.R_sensor_bone)
    assert set(one.cameras) == set(two.cameras)


@pytest.mark.parametrize("layout", files.LAYOUTS)
def test_every_layout_is_the_same_dataset(layout: str, tmp_path: Path, take: Take) -> None:
    support.dataset(tmp_path / "deep" / "down", support.take(), support.take("S4"), layout=layout)
    dataset = TotalCapture(tmp_path)
    assert dataset.takes == (("S4", "acting3"), ONE)
    assert not dataset.missing([("S4", "acting3"), ONE])
    found = dataset.take(*ONE)
    same(found, take)
    assert not found.missing


def test_names_are_found_whatever_their_case(tmp_path: Path, take: Take) -> None:
    paths = support.dataset(tmp_path, layout="vendor")
    for n, path in enumerate(paths.values()):
        changed = path.name.upper() if n % 2 else path.name.title()
        path.rename(path.with_name(changed))
    same(TotalCapture(tmp_path).take(*ONE), take)


def test_a_subject_may_be_asked_for_in_any_case(root: Path, take: Take) -> None:
    try:
        found = TotalCapture(root).take("s5", "Acting3")
    except UnknownNameError as error:
        assert "S5 acting3" in str(error)  # noqa: PT017
    else:
        same(found, take)


def test_the_gyroscope_s_file_stands_in_for_the_plain_one(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    paths["sensors"].unlink()
    found = TotalCapture(tmp_path).take(*ONE)
    same(found, take)


def test_what_mac_and_others_leave_behind_is_no_file_of_the_dataset(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    for path in list(paths.values()):
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
        ghost = tmp_path / "__MACOSX" / path.relative_to(tmp_path)
        ghost.parent.mkdir(parents=True, exist_ok=True)
        ghost.write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / "S5" / "acting3" / "notes.txt").write_text("mine")
    (tmp_path / "S5" / "acting3" / "TC_S5_acting3_cam1.mp4").write_bytes(b"video")
    dataset = TotalCapture(tmp_path)
    assert dataset.takes == (ONE,)
    same(dataset.take(*ONE), take)


def test_a_loop_of_links_ends_after_one_round(tmp_path: Path, paths: dict[str, Path], take: Take) -> None:
    os.symlink(tmp_path, tmp_path / "S5" / "again", target_is_directory=True)
    dataset = TotalCapture(tmp_path)
    assert len(dataset.index.files[ONE]["positions"]) == 1
    same(dataset.take(*ONE), take)


def test_a_folder_that_is_a_link_is_followed(tmp_path: Path, root: Path, take: Take) -> None:
    os.symlink(root, tmp_path / "TotalCapture", target_is_directory=True)
    same(TotalCapture(tmp_path).take(*ONE), take)


def test_a_subject_is_never_guessed(tmp_path: Path, paths: dict[str, Path]) -> None:
    """Vicon files in a folder of no subject belong to nobody, and that is said."""
    lost = tmp_path / "copies" / "walking1" / "gt_skel_gbl_pos.txt"
    lost.parent.mkdir(parents=True)
    shutil.copy(paths["positions"], lost)
    dataset = TotalCapture(tmp_path)
    assert dataset.takes == (ONE,)
    assert any("walking1" in line and "gt_skel_gbl_pos" in line for line in dataset.missing([ONE]))


def test_a_copy_does_not_matter_but_two_different_files_are_named(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    for kind in ("sensors", "positions", "ref", "cameras"):
        copy = tmp_path / "backup" / paths[kind].relative_to(tmp_path)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(paths[kind], copy)
    same(TotalCapture(tmp_path).take(*ONE), take)
    for kind in ("sensors", "positions", "ref", "cameras"):
        copy = tmp_path / "backup" / paths[kind].relative_to(tmp_path)
        kept = copy.read_bytes()
        copy.write_bytes(kept.replace(b"1", b"2", 1))
        with pytest.raises(FileFormatError) as caught:
            _ = TotalCapture(tmp_path).take(*ONE).cameras
        assert str(copy.relative_to(tmp_path)) in str(caught.value)
        assert str(caught.value).count(copy.name) >= 2
        copy.write_bytes(kept)


# --- what is not there ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_each_file_that_is_not_there_is_said_to_be_missing(
    kind: str, tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    paths[kind].unlink()
    dataset = TotalCapture(tmp_path)
    missing = dataset.missing([ONE])
    words = {"positions": "positions", "orientations": "orientations", "sensors": "", "ref": "ref",
             "bone": "bone", "cameras": "calibration.cal"}  # fmt: skip
    if kind in ("bvh", "aux", "sensors"):  # others stand in for these
        assert not missing
    else:
        (line,) = missing
        assert words[kind] in line
    found = dataset.take(*ONE)
    np.testing.assert_allclose(found.truth.p_world_joint, take.truth.p_world_joint, atol=1e-5)
    if kind in ("ref", "bone"):
        assert found.imus is None
        assert found.calibration is None
        assert words[kind] in said(found)
    if kind == "cameras":
        assert not found.cameras
        with pytest.raises((UnknownNameError, FileFormatError), match=r"camera"):
            found.recording(1)


def test_sensors_alone_are_no_take(tmp_path: Path, paths: dict[str, Path]) -> None:
    for kind in ("positions", "orientations", "bvh"):
        paths[kind].unlink()
    with pytest.raises(FileFormatError, match=r"S5 acting3 .*gt_skel_gbl_pos.txt.*no ground truth"):
        TotalCapture(tmp_path).take(*ONE)


def test_no_sensors_at_all_leave_the_ground_truth(tmp_path: Path, paths: dict[str, Path]) -> None:
    for kind in ("sensors", "aux", "ref", "bone"):
        paths[kind].unlink()
    found = TotalCapture(tmp_path).take(*ONE)
    assert found.imus is None
    assert "sensors" in said(found)
    assert found.recording(1).imus is None
    assert {check.subject for check in check_take(found)} == {"take"}


def test_another_bvh_file_beside_a_take_is_none_of_it(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    (paths["bvh"].parent / "acting3_exported.bvh").write_text("HIERARCHY")
    same(TotalCapture(tmp_path).take(*ONE), take)


def test_what_is_missing_is_listed_by_take(tmp_path: Path) -> None:
    paths = support.dataset(tmp_path, support.take("S4"), support.take())
    for kind in ("sensors", "aux", "ref"):
        paths[kind].unlink()
    lines = TotalCapture(tmp_path).missing([("S4", "acting3"), ONE, ("S1", "walking2")])
    assert len(lines) == 2
    first, second = sorted(lines)
    assert first.startswith("S1 walking2")
    assert second.startswith("S5 acting3")
    assert "ref" in second
    assert "sensors" in second


def test_an_empty_folder_or_none_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "holiday" / "pictures").mkdir(parents=True)
    for name in ("holiday", "file", "gone"):
        with pytest.raises((FileFormatError, OSError), match=name) as caught:
            TotalCapture(tmp_path / name)
        if name == "holiday":
            assert "gt_skel_gbl_pos" in str(caught.value) or "Total Capture" in str(caught.value)


def test_the_splits_are_those_of_the_papers() -> None:
    assert SUBJECTS == ("S1", "S2", "S3", "S4", "S5")
    assert len(TRAIN) == 27
    assert len(TEST) == 15
    assert not set(TRAIN) & set(TEST)
    assert {take for _, take in TEST} == {"walking2", "acting3", "freestyle3"}
    assert {subject for subject, _ in TRAIN} == {"S1", "S2", "S3"}
    known = {(s, t) for s, takes in source.TAKES.items() for t in takes}
    assert set(TRAIN) | set(TEST) <= known


def test_a_whole_train_and_test_list_is_missing_from_a_small_folder(root: Path) -> None:
    assert len(TotalCapture(root).missing()) == 41


# --- orientations that are not there -------------------------------------------------------------


def test_orientations_come_from_the_bvh_file_where_there_are_none(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    paths["orientations"].unlink()
    found = TotalCapture(tmp_path).take(*ONE)
    assert support.degrees_apart(found.truth.R_world_bone, take.truth.R_world_bone) < 0.01
    np.testing.assert_allclose(found.truth.p_world_joint, take.truth.p_world_joint, atol=1e-5)
    np.testing.assert_allclose(found.joint_offsets, take.joint_offsets, atol=1e-5)
    assert found.truth.orientation_observed.all()
    assert "bvh" in said(found).lower()


def test_the_bvh_file_stands_in_for_positions_and_orientations(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    paths["orientations"].unlink()
    paths["positions"].unlink()
    found = TotalCapture(tmp_path).take(*ONE)
    np.testing.assert_allclose(found.truth.p_world_joint, take.truth.p_world_joint, atol=2e-5)
    assert support.degrees_apart(found.truth.R_world_bone, take.truth.R_world_bone) < 0.01
    assert "bvh" in said(found).lower()


def test_a_bvh_file_of_another_take_does_not_stand_in_silently(
    tmp_path: Path, paths: dict[str, Path]
) -> None:
    paths["orientations"].unlink()
    other = support.take("S5", "acting3", seed=9)
    files.write_bvh(paths["bvh"], other.poses, other.joint_offsets)
    with pytest.raises(FileFormatError, match="BlenderZXY"):
        TotalCapture(tmp_path).take(*ONE)
    poses = support.motion()
    aside = replace(poses, p_world_joint=poses.p_world_joint + np.array([0.3, 0.4, 0.0]))
    files.write_bvh(paths["bvh"], aside, other.joint_offsets)
    with pytest.raises(FileFormatError, match=r"BlenderZXY_YmZ.bvh: .*500 mm.*another take"):
        TotalCapture(tmp_path).take(*ONE)


def test_without_either_they_come_from_positions_and_another_take_of_the_same_body(tmp_path: Path) -> None:
    support.dataset(tmp_path, support.take("S5", "freestyle1"))
    support.dataset(tmp_path, support.take(), orientations=False, bvh=False)
    found = TotalCapture(tmp_path).take(*ONE)
    np.testing.assert_allclose(found.joint_offsets, source.body(*ONE), atol=1e-4)
    # Only joints with several children fix a segment's three angles.
    observed = {NAMES[j] for j in np.flatnonzero(found.truth.orientation_observed.all(axis=0))}
    assert observed <= {"Hips", "Spine3"}
    assert "positions" in said(found)
    # Directions of bones are right, twist is not known.
    j, c = NAMES.index("RightArm"), NAMES.index("RightForeArm")
    bone = found.truth.R_world_bone[:, j] @ found.joint_offsets[c]
    p = support.motion().p_world_joint
    np.testing.assert_allclose(bone, p[:, c] - p[:, j], atol=1e-4)


def test_a_body_of_another_size_is_not_taken_over(tmp_path: Path) -> None:
    """S1's freestyle2 is 2 % larger than its other takes."""
    support.dataset(tmp_path, support.take("S1", "freestyle1"))
    support.dataset(tmp_path, support.take("S1", "freestyle2"), orientations=False, bvh=False)
    found = TotalCapture(tmp_path).take("S1", "freestyle2")
    lengths = np.linalg.norm(found.joint_offsets[1:], axis=1)
    expected = np.linalg.norm(source.body("S1", "freestyle2")[1:], axis=1)
    np.testing.assert_allclose(lengths, expected, atol=1e-4)
    assert found.notes


# --- files that do not fit or are broken ---------------------------------------------------------


@pytest.mark.parametrize("kind", ["positions", "orientations", "sensors"])
def test_a_cut_file_of_a_take_is_named_with_what_to_do(
    kind: str, tmp_path: Path, paths: dict[str, Path]
) -> None:
    data = paths[kind].read_bytes()
    paths[kind].write_bytes(data[: len(data) // 2])
    with pytest.raises(FileFormatError, match=rf"{paths[kind].name}.*(again|cut off)"):
        TotalCapture(tmp_path).take(*ONE)


def test_a_few_frames_more_or_less_are_cut_with_a_note_and_many_are_an_error(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    rows = support.lines(paths["positions"])
    whole = len(take.truth)
    paths["positions"].write_text("".join(rows[:-3]))
    found = TotalCapture(tmp_path).take(*ONE)
    assert len(found.truth) == whole - 3
    assert len(found.recording(1).keypoints) == whole - 3
    np.testing.assert_array_equal(found.truth.R_world_bone, take.truth.R_world_bone[:-3])
    assert str(whole) in said(found)
    assert str(whole - 3) in said(found)
    paths["positions"].write_text("".join(rows[:-20]))
    with pytest.raises(FileFormatError, match=rf"{whole - 20}.*{whole}|{whole}.*{whole - 20}"):
        TotalCapture(tmp_path).take(*ONE)


@pytest.mark.parametrize("short", [3, 20])
def test_sensor_data_that_end_early_are_said_to(
    short: int, tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    whole, imus = len(take.truth), support.take().imus
    cut = replace(
        imus,
        times=imus.times[:-short],
        R_inertial_sensor=imus.R_inertial_sensor[:-short],
        f_sensor=imus.f_sensor[:-short],
    )
    files.write_sensors(paths["sensors"], cut)
    found = TotalCapture(tmp_path).take(*ONE)
    assert f"{whole - short} frames" in said(found)
    assert len(found.truth) == whole
    bones = found.recording(1).bone_imus()
    assert bones is not None
    assert np.isfinite(bones.R_world_bone[: whole - short]).all()
    assert np.isnan(bones.R_world_bone[whole - short :]).all()


def test_vicon_quaternions_with_the_scalar_first_are_recognised(
    tmp_path: Path, paths: dict[str, Path]
) -> None:
    quat = files.quat_xyzw(files.tc_rotations(support.motion().R_world_bone))
    files.write_joints(paths["orientations"], np.roll(quat, 1, axis=-1))
    with pytest.raises(FileFormatError, match=r"gt_skel_gbl_ori.txt: .*w x y z"):
        TotalCapture(tmp_path).take(*ONE)


def test_orientations_of_another_take_are_refused(tmp_path: Path, paths: dict[str, Path]) -> None:
    other = support.motion(*ONE, 60, 9)
    quat = files.quat_xyzw(files.tc_rotations(other.R_world_bone))
    files.write_joints(paths["orientations"], quat)
    with pytest.raises(FileFormatError, match=r"gt_skel_gbl_ori.txt: .*mm"):
        TotalCapture(tmp_path).take(*ONE)


def test_joints_in_another_order_are_found_by_name(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    order = np.random.default_rng(0).permutation(21)
    names = [NAMES[i] for i in order]
    poses = support.motion()
    values = files.tc_positions(poses.p_world_joint)[:, order]
    files.write_joints(paths["positions"], values, names)
    same(TotalCapture(tmp_path).take(*ONE), take)


@pytest.mark.parametrize(("old", "new"), [("LeftFoot", "LeftToe"), ("LeftFoot\t", "")])
def test_a_joint_that_is_missing_is_named(old: str, new: str, tmp_path: Path, paths: dict[str, Path]) -> None:
    support.edit(paths["positions"], old, new)
    if not new:
        rows = support.lines(paths["positions"])
        cut = ["\t".join(row.split("\t")[:20]) + "\t\n" for row in rows[1:]]
        paths["positions"].write_text(rows[0] + "".join(cut))
    with pytest.raises(FileFormatError, match=r"gt_skel_gbl_pos.txt.*LeftFoot"):
        TotalCapture(tmp_path).take(*ONE)


def test_an_orientation_of_zeros_is_unknown_and_said_to_be(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    quat = files.quat_xyzw(files.tc_rotations(support.motion().R_world_bone))
    quat[33] = 0.0
    quat[40, 5] = 0.0
    files.write_joints(paths["orientations"], quat)
    found = TotalCapture(tmp_path).take(*ONE)
    unknown = np.isnan(found.truth.R_world_bone).any(axis=(2, 3))
    assert unknown[33].all()
    assert unknown[40, 5]
    assert unknown.sum() == 22
    np.testing.assert_allclose(found.joint_offsets, take.joint_offsets, atol=1e-5)
    assert "orientation" in said(found)


def test_positions_of_zeros_are_unknown_and_said_to_be(
    tmp_path: Path, paths: dict[str, Path], take: Take
) -> None:
    rows = support.lines(paths["positions"])
    rows[34] = "\t".join(["0.0 0.0 0.0"] * (len(rows[0].split("\t")) - 1)) + "\t\n"
    paths["positions"].write_text("".join(rows))
    found = TotalCapture(tmp_path).take(*ONE)
    unknown = np.isnan(found.truth.p_world_joint).any(axis=(1, 2))
    assert np.flatnonzero(unknown).tolist() == [33]
    np.testing.assert_allclose(found.joint_offsets, take.joint_offsets, atol=1e-4)
    assert "1 frames hold zeros alone in" in said(found)


@pytest.mark.parametrize("unit", [100 / 2.54, 1 / 39.37])
def test_a_body_in_another_unit_fails_the_check_of_its_height(take: Take, unit: float) -> None:
    """As metres or millimetres read as inches."""
    small = replace(take, joint_offsets=unit * take.joint_offsets)
    (bad,) = [check for check in failed(check_take(small)) if "height" in check.name]
    assert "are the file's positions in inches" in bad.message


def test_a_sensor_without_calibration_is_left_out_and_named(tmp_path: Path, paths: dict[str, Path]) -> None:
    rows = [row for row in support.lines(paths["ref"]) if not row.startswith("L_Foot")]
    rows[0] = "12\n"
    paths["ref"].write_text("".join(rows))
    found = TotalCapture(tmp_path).take(*ONE)
    assert found.imus is not None
    assert len(found.imus.names) == 12
    assert "L_Foot" not in found.imus.names
    assert "L_Foot" in said(found)


def test_a_sensor_whose_acceleration_is_all_zero_has_none(tmp_path: Path, paths: dict[str, Path]) -> None:
    imus = support.take().imus
    f = np.array(imus.f_sensor)
    s = imus.names.index("R_UpLeg")
    f[:, s] = 0.0
    files.write_sensors(paths["sensors"], imus_without_check(imus, f))
    found = TotalCapture(tmp_path).take(*ONE)
    assert found.imus is not None
    s = found.imus.names.index("R_UpLeg")
    assert np.isnan(found.imus.f_sensor[:, s]).all()
    assert np.isfinite(found.imus.R_inertial_sensor[:, s]).all()
    assert "R_UpLeg" in said(found)
    assert [check.subject for check in failed(check_take(found))] == ["sensor R_UpLeg"]


def imus_without_check(imus, f_sensor):  # type: ignore[no-untyped-def]
    """The sequence with a specific force that its class would refuse."""
    out = object.__new__(type(imus))
    for field in ("times", "R_inertial_sensor", "names"):
        object.__setattr__(out, field, getattr(imus, field))
    object.__setattr__(out, "f_sensor", f_sensor)
    return out


def test_acceleration_without_gravity_is_refused_by_its_unit(tmp_path: Path, paths: dict[str, Path]) -> None:
    imus = support.take().imus
    files.write_sensors(paths["sensors"], imus_without_check(imus, imus.f_sensor / 9.81))
    with pytest.raises(ValueError, match=r"gravity|9.81"):
        TotalCapture(tmp_path).take(*ONE)


# --- glitches and speed --------------------------------------------------------------------------


def long_take(frames: int) -> standin.StandInTake:
    """A take of many frames: the planted one forth and back, again and again."""
    planted = support.take("S4")
    there = np.arange(len(planted.poses))
    index = np.resize(np.concatenate([there, there[::-1]]), frames)
    times = np.arange(frames) / 60
    poses, imus = planted.poses, planted.imus
    return replace(
        planted,
        poses=PoseSequence(times, poses.p_world_joint[index], poses.R_world_bone[index], poses.names),
        imus=replace(
            imus, times=times, R_inertial_sensor=imus.R_inertial_sensor[index], f_sensor=imus.f_sensor[index]
        ),
    )


def test_a_take_of_4000_frames_is_read_in_four_seconds_and_its_glitches_are_invalid(tmp_path: Path) -> None:
    """S4's acting3 has two known glitches; two seconds are aimed at, on a busy machine it may be four."""
    support.dataset(tmp_path, long_take(4000), bvh=False, aux=False)
    began = time.perf_counter()
    found = TotalCapture(tmp_path).take("S4", "acting3")
    recording = found.recording(1)
    seconds = time.perf_counter() - began
    assert len(recording.keypoints) == 4000
    invalid = ~found.truth.valid.all(axis=1)
    assert invalid[657]
    assert invalid[2300:2307].all()
    assert invalid.sum() < 40
    assert np.isfinite(found.truth.p_world_joint).all()
    assert "657" in said(found) or "glitch" in said(found).lower()
    assert seconds < 4


def test_realistic_sensors_are_near_the_reference(tmp_path: Path) -> None:
    """What a user sees on sound data: small residuals, hardly a check that fails."""
    planted = standin.make_take(
        *ONE, support.motion(), source.body(*ONE), noise=ImuNoise(orientation_factor=0.5), seed=2
    )
    support.dataset(tmp_path, planted)
    checks = check_take(TotalCapture(tmp_path).take(*ONE))
    turned = [c for c in checks if c.subject.startswith("sensor ") and c.unit == "deg"]
    assert len(turned) == 13
    assert 1 < np.median([c.value for c in turned]) < 15


def test_keypoints_of_the_recording_are_a_sequence_of_this_camera(take: Take) -> None:
    keypoints = take.recording(7).keypoints
    assert isinstance(keypoints, KeypointSequence)
    np.testing.assert_array_equal(keypoints.camera.R_camera_world, take.cameras[7].R_camera_world)
