"""Total Capture: planted takes are read back, checks find what does not fit, missing data are reported."""

from __future__ import annotations

import shutil
from collections.abc import Callable
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
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnitError, UnknownNameError
from rtof_kin.datasets import total_capture_truth
from rtof_kin.datasets.total_capture import SUBJECTS, TEST, TRAIN, Take, TotalCapture, check_keypoints, check_take
from rtof_kin.datasets.total_capture_files import read_detections
from rtof_kin.simulation.mocap import NAMES, PARENTS

ONE = ("S5", "acting3")
SENSORS = SkeletonModel.default().sensors
QUAT_XYZW = files.quat_xyzw(files.tc_rotations(support.motion().R_world_bone))
KINDS = ("positions", "orientations", "sensors", "aux", "ref", "bone", "cameras")


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


def test_the_truth_is_read_in_link_axes_of_a_z_up_world(take: Take) -> None:
    planted = support.motion()
    assert take.truth.names == NAMES
    np.testing.assert_allclose(take.truth.p_world_joint, planted.p_world_joint, atol=1e-5)
    assert take.truth.valid.all()
    np.testing.assert_allclose(take.truth.times, np.arange(len(planted)) / 60, atol=1e-12)
    assert support.degrees_apart(take.truth.R_world_bone, planted.R_world_bone) < 1e-3
    assert take.truth.orientation_observed.all()
    np.testing.assert_allclose(take.joint_offsets, source.body(*ONE), atol=2e-6)
    assert take.spread_mm < 0.01
    assert take.skeleton.bone_lengths["RightForeArm"] == pytest.approx(0.3207, abs=1e-5)
    p = take.truth.p_world_joint[0]  # faces +y, the right hand at +x
    across = so3.unit(p[NAMES.index("RightHand")] - p[NAMES.index("LeftHand")])
    np.testing.assert_allclose(across, [1, 0, 0], atol=0.15)
    np.testing.assert_allclose(take.truth.R_world_bone[0, :, :, 0], np.tile([0, 1, 0], (21, 1)), atol=0.2)


def test_sensors_and_their_calibration_give_orientation_and_acceleration_of_bones(take: Take) -> None:
    found, planted = take.calibration, support.take().calibration
    assert set(found.sensors) == set(planted.sensors)
    planted = planted.select(found.sensors)
    assert found.joints == planted.joints
    assert support.degrees_apart(found.R_world_inertial, planted.R_world_inertial) < 1e-3
    assert support.degrees_apart(found.R_sensor_bone, planted.R_sensor_bone) < 1e-3
    usual = SkeletonModel.default().sensors
    np.testing.assert_array_equal(found.p_bone_sensor, [usual[name][1] for name in found.sensors])
    motion, bones = support.motion(), found.apply(take.imus)
    index = [NAMES.index(joint) for joint in bones.joints]
    assert support.degrees_apart(bones.R_world_bone, motion.R_world_bone[:, index]) < 0.01
    lever = np.einsum("tsij,sj->tsi", motion.R_world_bone[:, index], bones.p_bone_sensor)
    expected = np.diff(motion.p_world_joint[:, index] + lever, n=2, axis=0) * 3600
    a = bones.a_world
    smoothed = (a[:-2] + 4 * a[1:-1] + a[2:]) / 6
    np.testing.assert_allclose(smoothed[12:-1], expected[12:-1], atol=0.01)


# --- recordings ----------------------------------------------------------------------------------


def test_a_recording_has_the_projected_joints_and_the_sensors_asked_for(take: Take, tmp_path: Path) -> None:
    recording = take.recording(3, sensors=("L_LowArm", "Pelvis"))
    projected = source.cameras()[3].project(support.motion().p_world_joint)
    np.testing.assert_allclose(recording.video.uv_px, projected, atol=0.01)
    assert recording.video.names == NAMES
    assert recording.name == "S5 acting3 cam3"
    assert "Trumble" in recording.acknowledgement
    np.testing.assert_array_equal(recording.joint_offsets, take.joint_offsets)
    assert recording.posture is take.posture is not None  # the stand-in begins with a T-pose
    assert recording.skeleton.table.posture is take.posture
    assert take.recording(3, posture=False).posture is None
    bones = recording.bone_imus()
    assert bones.joints == ("LeftForeArm", "Hips")
    assert len(bones) == len(recording.video)
    recording.save(tmp_path / "saved")
    again = type(recording).load(tmp_path / "saved")
    np.testing.assert_array_equal(again.video.uv_px, recording.video.uv_px)
    whole = take.recording(1).imus
    assert len(whole.names) == 13


# --- a detector's 2D -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with detections of the perfect take by cameras 1 and 2."""
    folder = tmp_path_factory.mktemp("detected")
    for number in (1, 2):
        standin.write_detections(folder, support.take(), number, source.cameras()[number], seed=3)
    return folder


def test_detections_of_camera_2_fail_the_reprojection_check(take: Take, detected: Path) -> None:
    found = {n: read_detections(detected, *ONE, n, take.cameras[n]) for n in (1, 2)}
    recording = take.recording(1, found[1])
    np.testing.assert_array_equal(recording.video.uv_px, found[1].uv_px)
    assert not failed(check_keypoints(take, 1, found[1]))
    (bad,) = failed(check_keypoints(take, 2, found[2]))
    assert "camera 2" in bad.message
    assert "miscalibrated" in bad.message
    assert bad.value > bad.limit == 20
    short = take.recording(1, found[1][:50])  # a video that ends early
    assert len(short.video) == 50
    assert len(short.truth) == 50
    assert short.bone_imus() is not None
    for times in (found[1].times * 2, found[1].times + 0.5):
        with pytest.raises(InvalidInputError, match="S5 acting3: keypoints must begin at time 0"):
            take.recording(1, replace(found[1], times=times))


# --- checks --------------------------------------------------------------------------------------


def test_a_perfect_take_passes_every_check(take: Take) -> None:
    checks = check_take(take)
    assert not failed(checks)
    assert {check.subject for check in checks} == {"take", *(f"sensor {name}" for name in SENSORS)}


def exchanged(paths: dict[str, Path]) -> None:
    ref, bone = paths["ref"].read_bytes(), paths["bone"].read_bytes()
    paths["ref"].write_bytes(bone)
    paths["bone"].write_bytes(ref)


def of_another_take(paths: dict[str, Path]) -> None:
    files.write_imu_calibration(paths["ref"], paths["bone"], support.take("S5", "freestyle1", seed=4).calibration)


def scalar_last(paths: dict[str, Path]) -> None:
    rows = [row.split("\t") for row in support.lines(paths["sensors"])]
    rows = [[c[0], *c[2:5], c[1], *c[5:]] if len(c) == 8 else c for c in rows]
    paths["sensors"].write_text("".join("\t".join(cells) for cells in rows))


@pytest.mark.parametrize("spoil", [exchanged, of_another_take, scalar_last])
def test_wrong_calibration(spoil: Callable[[dict[str, Path]], None], tmp_path: Path, paths: dict[str, Path]) -> None:
    spoil(paths)
    bad = failed(check_take(TotalCapture(tmp_path).take(*ONE)))
    turned = [check for check in bad if check.unit == "deg"]
    assert len({check.subject for check in turned}) >= 10
    for check in turned:
        assert check.value > check.limit == 15
        assert check.subject in check.message
        assert "calibration of another take" in check.message


def test_a_take_that_does_not_begin_in_the_t_pose_fails_its_checks(take: Take) -> None:
    """Turned about the vertical, and with hanging arms."""
    turn = so3.about_axis("z", np.radians(120))
    truth = take.truth
    turned = replace(truth, p_world_joint=truth.p_world_joint @ turn.T, R_world_bone=turn @ truth.R_world_bone)
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
    assert "(RightArm to RightForeArm)" in bad[0].message
    assert bad[0].value == pytest.approx(70, abs=8)


def test_scaled_acceleration_fails_the_check_of_its_sensor(take: Take) -> None:
    f = np.array(take.imus.f_sensor)
    f[:, 0] *= 1.1
    (bad,) = failed(check_take(replace(take, imus=replace(take.imus, f_sensor=f))))
    assert bad.subject == f"sensor {take.imus.names[0]}"
    assert bad.value == pytest.approx(0.98, abs=0.15)
    assert bad.limit == 0.5


# --- layouts and names ---------------------------------------------------------------------------


def same(one: Take, two: Take) -> None:
    np.testing.assert_array_equal(one.truth.p_world_joint, two.truth.p_world_joint)
    np.testing.assert_array_equal(one.truth.R_world_bone, two.truth.R_world_bone)
    np.testing.assert_array_equal(one.imus.f_sensor, two.imus.f_sensor)
    np.testing.assert_array_equal(one.calibration.R_sensor_bone, two.calibration.R_sensor_bone)
    assert set(one.cameras) == set(two.cameras)


@pytest.mark.parametrize("layout", files.LAYOUTS)
def test_every_layout_and_spelling_is_the_same_dataset(layout: str, tmp_path: Path, take: Take) -> None:
    paths = support.dataset(tmp_path / "deep" / "down", support.take("S4"), support.take(), layout=layout)
    for n, path in enumerate(paths.values()):
        path.rename(path.with_name(path.name.upper() if n % 2 else path.name.title()))
    dataset = TotalCapture(tmp_path)
    assert dataset.takes == (("S4", "acting3"), ONE)
    found = dataset.take("s5", "Acting3")
    same(found, take)
    assert not found.missing


# --- what is not there ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_each_missing_file_is_reported(kind: str, tmp_path: Path, paths: dict[str, Path], take: Take) -> None:
    paths[kind].unlink()
    dataset = TotalCapture(tmp_path)
    if kind == "positions":
        with pytest.raises(FileFormatError, match="no ground truth"):
            dataset.take(*ONE)
        return
    missing = dataset.take(*ONE).missing
    if kind in ("aux", "sensors"):  # others replace these
        assert not missing
    else:
        (line,) = missing
        assert kind.removesuffix("s").replace("camera", "calibration.cal") in line
    found = dataset.take(*ONE)
    np.testing.assert_allclose(found.truth.p_world_joint, take.truth.p_world_joint, atol=1e-5)
    if kind in ("ref", "bone"):
        assert found.imus is None
        assert found.calibration is None
        assert kind in said(found)
    if kind == "cameras":
        assert not found.cameras
        with pytest.raises((UnknownNameError, FileFormatError), match=r"camera"):
            found.recording(1)


def test_a_take_without_truth_or_sensors(tmp_path: Path, paths: dict[str, Path]) -> None:
    for kind in ("sensors", "aux", "ref", "bone"):
        paths[kind].unlink()
    found = TotalCapture(tmp_path).take(*ONE)
    assert found.imus is None
    assert "sensors" in said(found)
    assert found.recording(1).imus is None
    assert {check.subject for check in check_take(found)} == {"take"}


# --- orientations that are not there -------------------------------------------------------------


def test_orientations_are_derived_from_positions(tmp_path: Path) -> None:
    support.dataset(tmp_path, support.take(), orientations=False)
    found = TotalCapture(tmp_path).take(*ONE)
    np.testing.assert_allclose(found.joint_offsets, source.body(*ONE), atol=1e-3)
    # Only joints with several children fix a segment's three angles.
    observed = {NAMES[j] for j in np.flatnonzero(found.truth.orientation_observed.all(axis=0))}
    assert observed <= {"Hips", "Spine3"}
    assert "positions" in said(found)
    # Directions of bones are right, twist is not known.
    j, c = NAMES.index("RightArm"), NAMES.index("RightForeArm")
    bone = found.truth.R_world_bone[:, j] @ found.joint_offsets[c]
    p = support.motion().p_world_joint
    np.testing.assert_allclose(bone, p[:, c] - p[:, j], atol=1e-4)


# --- files that do not fit or are broken ---------------------------------------------------------


def test_files_that_differ_by_few_frames_are_cut(tmp_path: Path, paths: dict[str, Path], take: Take) -> None:
    rows = support.lines(paths["positions"])
    whole = len(take.truth)
    paths["positions"].write_text("".join(rows[:-3]))
    found = TotalCapture(tmp_path).take(*ONE)
    assert len(found.truth) == len(found.recording(1).video) == whole - 3
    np.testing.assert_array_equal(found.truth.R_world_bone, take.truth.R_world_bone[:-3])
    assert f"{whole - 3} frames" in said(found)
    order = np.random.default_rng(0).permutation(21)
    values = files.tc_positions(support.motion().p_world_joint)[:, order]
    files.write_joints(paths["positions"], values, [NAMES[i] for i in order])  # another order of joints
    same(TotalCapture(tmp_path).take(*ONE), take)


def too_short(paths: dict[str, Path]) -> None:
    paths["positions"].write_text("".join(support.lines(paths["positions"])[:-20]))


def scalar_first(paths: dict[str, Path]) -> None:
    files.write_joints(paths["orientations"], np.roll(QUAT_XYZW, 1, axis=-1))


def another_motion(paths: dict[str, Path]) -> None:
    quat = files.quat_xyzw(files.tc_rotations(support.motion(*ONE, 60, 9).R_world_bone))
    files.write_joints(paths["orientations"], quat)


def other_joint(paths: dict[str, Path]) -> None:
    support.edit(paths["positions"], "LeftFoot", "LeftToe")


def without_gravity(paths: dict[str, Path]) -> None:
    imus = support.take().imus
    files.write_sensors(paths["sensors"], imus_without_check(imus, imus.f_sensor / 9.81))


def scaled(paths: dict[str, Path]) -> None:
    quat = QUAT_XYZW.copy()
    quat[7, 3] *= 1.1
    files.write_joints(paths["orientations"], quat)


def no_orientation_of_the_root(paths: dict[str, Path]) -> None:
    quat = QUAT_XYZW.copy()
    quat[:, 0] = 0
    files.write_joints(paths["orientations"], quat)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (too_short, r"gt_skel_gbl_ori.txt: 70 frames of positions and 90 of orientations"),
        (scalar_first, r"gt_skel_gbl_ori.txt: .*w x y z"),
        (another_motion, r"gt_skel_gbl_ori.txt: .*mm"),
        (other_joint, r"gt_skel_gbl_pos.txt.*LeftFoot"),
        (without_gravity, r"gravity|9.8"),
        (scaled, r"ori.txt: frame 8: the quaternion of Spine2 has norm 1.1"),
        (no_orientation_of_the_root, r"ori.txt: there is no frame in which"),
    ],
)
def test_files_that_are_damaged_or_do_not_fit_are_refused(
    spoil: Callable[[dict[str, Path]], None], message: str, tmp_path: Path, paths: dict[str, Path]
) -> None:
    spoil(paths)
    with pytest.raises((FileFormatError, UnitError), match=message):
        TotalCapture(tmp_path).take(*ONE)


def test_zero_acceleration_and_the_first_frames_are_unknown(tmp_path: Path, paths: dict[str, Path]) -> None:
    imus = support.take(stamp=True).imus
    f = np.array(imus.f_sensor)
    f[:, imus.names.index("R_UpLeg")] = 0.0
    files.write_sensors(paths["sensors"], imus_without_check(imus, f))
    found = TotalCapture(tmp_path).take(*ONE)
    s = found.imus.names.index("R_UpLeg")
    assert np.isnan(found.imus.f_sensor[:, s]).all()
    assert np.isnan(found.imus.f_sensor[:10]).all()
    expected = imus.select(found.imus.names)
    np.testing.assert_allclose(found.imus.f_sensor[10:, :s], expected.f_sensor[10:, :s], rtol=1e-5, atol=1e-6)
    assert support.degrees_apart(found.imus.R_inertial_sensor, expected.R_inertial_sensor) < 1e-3
    assert "R_UpLeg" in said(found)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="gt_skel_gbl_pos"):
        TotalCapture(tmp_path)
    with pytest.raises(FileFormatError, match="no such folder"):
        TotalCapture(tmp_path / "gone")
    assert (len(SUBJECTS), len(TRAIN), len(TEST)) == (5, 27, 15)
    assert not set(TRAIN) & set(TEST)


def test_zero_position_or_orientation_is_unknown(tmp_path: Path, paths: dict[str, Path], take: Take) -> None:
    quat = QUAT_XYZW.copy()
    quat[33] = quat[40, 5] = 0.0
    files.write_joints(paths["orientations"], quat)
    rows = support.lines(paths["positions"])
    rows[21] = "\t".join(["0.0 0.0 0.0"] * (len(rows[0].split("\t")) - 1)) + "\t\n"
    paths["positions"].write_text("".join(rows))
    found = TotalCapture(tmp_path).take(*ONE)
    unknown = np.isnan(found.truth.R_world_bone).any(axis=(2, 3))
    assert unknown[33].all()
    assert unknown[40, 5]
    assert unknown.sum() == 22
    assert np.flatnonzero(np.isnan(found.truth.p_world_joint).any(axis=(1, 2))).tolist() == [20]
    np.testing.assert_allclose(found.joint_offsets, take.joint_offsets, atol=1e-4)
    assert "2 frames have joints without an orientation" in said(found)
    assert "1 frames" in said(found)
    files.write_joints(paths["orientations"], np.zeros((len(support.motion()), 21, 4)))
    found = TotalCapture(tmp_path).take(*ONE)
    assert not found.truth.orientation_observed.any()
    assert "gt_skel_gbl_ori.txt holds no orientation" in said(found)


def imus_without_check(imus, f_sensor):  # type: ignore[no-untyped-def]
    """The sequence with a specific force that its class would refuse."""
    out = object.__new__(type(imus))
    vars(out).update(vars(imus) | {"f_sensor": f_sensor})
    return out


def test_known_glitches_of_the_reference_are_invalid(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert total_capture_truth._GLITCHES["S4", "acting3"] == ((655, 659), (2300, 2306))
    monkeypatch.setitem(total_capture_truth._GLITCHES, ONE, ((20, 25), (40, 41)))
    found = TotalCapture(root).take(*ONE)
    assert np.flatnonzero(~found.truth.valid.all(axis=1)).tolist() == [*range(18, 28), *range(38, 44)]
    assert np.isfinite(found.truth.p_world_joint).all()
    assert "glitch" in said(found)


def test_noise_depends_on_take_camera_and_seed(take: Take) -> None:
    def noise(own: Take, camera: int = 1, seed: int = 0) -> np.ndarray:
        noisy = own.recording(camera, noise_px=5.0, seed=seed).video.uv_px
        return np.ravel(noisy - own.recording(camera).video.uv_px)

    one = noise(take)
    assert one.std() == pytest.approx(5.0, rel=0.05)
    np.testing.assert_array_equal(one, noise(take))
    for other in (noise(take, seed=1), noise(take, 4), noise(replace(take, name="acting1"))):
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.1


def test_wrong_names_and_noise_on_detections_are_refused(take: Take, root: Path) -> None:
    keypoints = take.recording(1).video
    with pytest.raises(UnknownNameError, match=r"sensor.*'L_Hand'.*Head"):
        take.recording(1, sensors=("L_Hand",))
    with pytest.raises(UnknownNameError, match="'S4 acting3'"):
        TotalCapture(root).take("S4", "acting3")
    with pytest.raises(UnknownNameError, match=r"camera '9'.*1, 2, 3"):
        check_keypoints(take, 9, keypoints)
    with pytest.raises(InvalidInputError, match="not to a detector's"):
        take.recording(1, keypoints, noise_px=2.0)


# --- conversions, by hand ------------------------------------------------------------------------


def test_a_sensor_written_by_hand_gives_its_bone_and_no_acceleration(tmp_path: Path) -> None:
    """Facing -Z: segments are Rot_x(90), a sensor turned with its segment, gravity along +y."""
    half, T = np.sqrt(0.5), 12
    folder = tmp_path / "S1" / "walking1"
    folder.mkdir(parents=True)
    rest = np.zeros((21, 3))
    for j, parent in enumerate(PARENTS[1:], 1):
        rest[j] = rest[parent] + [1, 2, -3]
    files.write_joints(folder / "gt_skel_gbl_pos.txt", np.tile(rest, (T, 1, 1)))
    files.write_joints(folder / "gt_skel_gbl_ori.txt", np.tile([half, 0, 0, half], (T, 21, 1)))
    # The inertial frame is Rot_x(-90) from the world, the sensor Rot_z(90) from its segment. So
    # R_imu = Rot_x(180) Rot_z(90), w x y z = (0, h, -h, 0), and up is -z in the sensor.
    frames = [f"{k}\nPelvis\t0\t{half}\t{-half}\t0\t0\t0\t-9.80665\n" for k in range(1, T + 1)]
    (folder / "s1_walking1_Xsens.sensors").write_text(f"1\t{T}\n" + "".join(frames))
    (folder / "s1_walking1_calib_imu_ref.txt").write_text(f"1\nPelvis {-half} 0 0 {half}\n")
    (folder / "s1_walking1_calib_imu_bone.txt").write_text(f"1\nPelvis 0 0 {half} {half}\n")
    found = TotalCapture(tmp_path).take("S1", "walking1")
    quarter = so3.about_axis("z", np.pi / 2)
    np.testing.assert_allclose(found.truth.R_world_bone[:, 0], np.tile(quarter, (T, 1, 1)), atol=1e-5)
    bones = found.calibration.apply(found.imus)
    assert bones.joints == ("Hips",)
    np.testing.assert_allclose(bones.R_world_bone[:, 0], np.tile(quarter, (T, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(bones.a_world[10:, 0], 0, atol=1e-4)
    assert any("not in s1_walking1_Xsens.sensors: Head, Sternum" in note for note in found.notes)


def test_a_slipped_sensor_is_distinguished_from_the_calibration_of_another_take(take: Take) -> None:
    R = np.array(take.calibration.R_sensor_bone)
    turn = so3.about_axis("x", np.radians(30))
    R[4] = R[4] @ turn
    (bad,) = failed(check_take(replace(take, calibration=replace(take.calibration, R_sensor_bone=R))))
    assert bad.subject == f"sensor {take.calibration.sensors[4]}"
    assert bad.value == pytest.approx(30, abs=0.01)
    assert "slipped" in bad.message
    R[:9] = R[:9] @ turn
    bads = failed(check_take(replace(take, calibration=replace(take.calibration, R_sensor_bone=R))))
    assert len(bads) == 9
    assert all("9 of 13 sensors fail this: is it the calibration of another take?" in b.message for b in bads)


def test_bones_of_a_take_without_orientations_are_checked_by_their_length(tmp_path: Path) -> None:
    paths = support.dataset(tmp_path, orientations=False)
    found = TotalCapture(tmp_path).take(*ONE)
    assert not found.truth.orientation_observed.any()
    (bones,) = [check for check in check_take(found) if "bone lengths" in check.name]
    assert bones.passed
    p = files.tc_positions(support.motion().p_world_joint)
    p[::2, NAMES.index("Head")] += 1.0
    files.write_joints(paths["positions"], p)
    assert any("bone lengths" in check.name for check in failed(check_take(TotalCapture(tmp_path).take(*ONE))))
