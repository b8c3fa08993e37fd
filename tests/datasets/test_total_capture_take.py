"""A take of Total Capture: conversions by hand, checks of itself, of cameras and of keypoints, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import total_capture_support as support

from benchmarks import total_capture_files as files
from rtof_kin.body.kinematics import positions
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.plausibility import Check
from rtof_kin.datasets.total_capture import CAMERAS, Take, TotalCapture
from rtof_kin.datasets.total_capture_checks import check_camera, check_keypoints, check_take
from rtof_kin.simulation.mocap import NAMES, PARENTS

ONE = ("S5", "acting3")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("perfect")
    support.dataset(folder)
    return folder


@pytest.fixture(scope="module")
def take(root: Path) -> Take:
    return TotalCapture(root).take(*ONE)


def failed(checks: list[Check]) -> list[Check]:
    return [check for check in checks if not check.passed]


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
    assert found.imus is not None
    assert found.calibration is not None
    bones = found.calibration.apply(found.imus)
    assert bones.joints == ("Hips",)
    np.testing.assert_allclose(bones.R_world_bone[:, 0], np.tile(quarter, (T, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(bones.a_world[10:, 0], 0, atol=1e-4)
    assert any("not in s1_walking1_Xsens.sensors: Head, Sternum" in note for note in found.notes)


# --- checks --------------------------------------------------------------------------------------


def test_noisy_keypoints_pass_the_reprojection_check(take: Take) -> None:
    (check,) = check_keypoints(take, 1, take.recording(1, noise_px=3.0).video)
    assert check.passed
    assert (check.subject, check.unit, check.limit) == ("camera 1", "px", 20)
    assert check.value == pytest.approx(3 * np.sqrt(2 * np.log(2)), rel=0.05)


def test_camera_2_fails_its_check_without_keypoints(take: Take) -> None:
    for camera in CAMERAS:
        bad = failed(check_camera(camera))
        assert [check.subject for check in bad] == (["camera 2"] if camera == 2 else [])
        assert ("miscalibrated" in take.recording(camera).notes) == (camera == 2)
    (bad_2,) = failed(check_camera(2))
    assert "(+20, -8) px" in bad_2.message
    assert "ground-truth 2D is not affected" in bad_2.message


def test_a_slipped_sensor_is_distinguished_from_the_calibration_of_another_take(take: Take) -> None:
    assert take.calibration is not None
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


def test_the_limb_that_is_not_in_the_t_pose_is_named(take: Take) -> None:
    R = np.array(take.truth.R_world_bone)
    arm = [NAMES.index("LeftForeArm"), NAMES.index("LeftHand")]
    R[:, arm] = R[:, arm] @ so3.about_axis("z", np.radians(40))
    p = positions(PARENTS, take.joint_offsets, take.truth.p_world_joint[:, 0], R)
    bent = replace(take.truth, p_world_joint=p, R_world_bone=R)
    (bad,) = failed(check_take(replace(take, truth=bent, imus=None, calibration=None)))
    assert "(LeftForeArm to LeftHand)" in bad.message
    assert bad.value == pytest.approx(40, abs=6)


def test_bones_of_a_take_without_orientations_are_checked_by_their_length(tmp_path: Path) -> None:
    paths = support.dataset(tmp_path, orientations=False, bvh=False)
    found = TotalCapture(tmp_path).take(*ONE)
    assert not found.truth.orientation_observed.any()
    (bones,) = [check for check in check_take(found) if "bone lengths" in check.name]
    assert bones.passed
    p = files.tc_positions(support.motion().p_world_joint)
    p[::2, NAMES.index("Head")] += 1.0
    files.write_joints(paths["positions"], p)
    assert any(
        "bone lengths" in check.name for check in failed(check_take(TotalCapture(tmp_path).take(*ONE)))
    )


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "error", "message"), [
    ({"camera": 9}, UnknownNameError, r"camera '9'.*1, 2, 3"),
    ({"sensors": ("L_Hand",)}, UnknownNameError, r"sensor.*'L_Hand'.*Head"),
    ({"noise_px": -1.0}, InvalidInputError, "noise_px: -1"),
    ({"noise_px": np.nan}, InvalidInputError, "noise_px: nan"),
    ({"noise_px": 2.0, "seed": -1}, InvalidInputError, "seed: -1 is negative"),
])  # fmt: skip
def test_wrong_options_are_refused(
    options: dict[str, Any], error: type[Exception], message: str, take: Take, root: Path
) -> None:
    with pytest.raises(error, match=message):
        take.recording(**{"camera": 1} | options)
    with pytest.raises(UnknownNameError, match="'S4 acting3'"):
        TotalCapture(root).take("S4", "acting3")


def test_keypoints_need_their_camera_and_get_no_noise(take: Take) -> None:
    keypoints = take.recording(1).video
    with pytest.raises(UnknownNameError, match=r"camera '9'.*1, 2, 3"):
        check_keypoints(take, 9, keypoints)
    with pytest.raises(InvalidInputError, match="not to a detector's"):
        take.recording(1, keypoints, noise_px=2.0)
    with pytest.raises(UnknownNameError, match=r"camera '1'.*calibration\.cal"):
        replace(take, cameras={}).recording(1)
    whole = len(take.truth)
    notes = take.recording(1, keypoints[: whole - 20]).notes
    assert f"video of {whole - 20} frames, reference of {whole}" in notes
