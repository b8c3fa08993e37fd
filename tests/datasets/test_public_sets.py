"""Adapters of public data sets, on small files in their formats that are made from a known motion."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import public_sets as made
import pytest
from public_sets import known

from rtof_kin.body.kinematics import hip_centres
from rtof_kin.clinical.angles import opensim_angles
from rtof_kin.core.errors import FileFormatError
from rtof_kin.datasets.marker_sets import CENTRES, SIZE_PX, Movi, OpenCapValidation
from rtof_kin.datasets.public_sets import PublicSet, Take, TakeInputs, Truth, hinge_table
from rtof_kin.datasets.sensor_sets import Gaitex, Vidimu
from rtof_kin.formats.cameras import read_camera


def only(adapter: PublicSet, key: str) -> Take:
    """The take of a name."""
    (found,) = [take for take in adapter.takes() if take.key == key]
    return found


def check_truth(truth: Truth, angles: dict[str, str], atol_deg: float = 1e-5) -> None:
    """Compare angles of a reference with those of the known motion, at the reference's times."""
    reference, _ = opensim_angles(truth.table)
    for coordinate, angle in angles.items():
        assert coordinate in truth.coordinates
        expected = np.interp(reference.times, known().angles.times, known().angles[angle])
        difference = np.degrees(reference[angle] - expected)
        assert np.nanmax(np.abs(difference)) < atol_deg, angle
        assert np.isfinite(difference).mean() > 0.95


def included(joints: tuple[str, str, str]) -> np.ndarray:
    """Angle, degrees, between the bones of three joints of the known motion."""
    poses = known().poses
    p, q, r = (poses.p_world_joint[:, poses.names.index(name)] for name in joints)
    cosine = np.sum((q - p) * (r - q), axis=1)
    cosine /= np.linalg.norm(q - p, axis=1) * np.linalg.norm(r - q, axis=1)
    return np.degrees(np.arccos(cosine))


# --- what is read ---------------------------------------------------------------------------------


def test_opencap_has_the_planted_angles_camera_and_height(tmp_path: Path) -> None:
    key = made.write_opencap(tmp_path / "LabValidation", trial="STSweakLegs1")
    (tmp_path / "LabValidation/subject2/VideoData/Session1/Cam1/static1").mkdir()
    adapter = OpenCapValidation(tmp_path)  # one folder above
    (take,) = adapter.takes()  # the static trial is no movement
    assert (take.key, take.subject, take.kind, take.camera) == (key, "subject2", "sit-to-stand", "Cam1")
    inputs = adapter.inputs(take)
    assert inputs.video is None
    assert inputs.height == pytest.approx(known().recording.skeleton.height, abs=1e-3)
    assert isinstance(inputs.camera, Path)
    camera = read_camera(inputs.camera)
    planted = known().video.camera
    np.testing.assert_allclose(camera.t_camera_world, planted.t_camera_world)
    np.testing.assert_allclose(camera.R_camera_world, planted.R_camera_world)
    np.testing.assert_allclose(camera.K, planted.K)
    check_truth(adapter.truth(take), made.COORDINATES)


def test_the_video_that_is_cut_to_the_reference_is_preferred(tmp_path: Path) -> None:
    key = made.write_opencap(tmp_path)
    adapter = OpenCapValidation(tmp_path)
    take = only(adapter, key)
    (take.folder / "walking1.avi").touch()
    assert adapter.truth(take).reach == 3.0
    (take.folder / "walking1_syncdWithMocap.avi").touch()
    video = adapter.inputs(take).video
    assert video is not None
    assert video.name == "walking1_syncdWithMocap.avi"
    assert adapter.truth(take).reach == 1.0


def test_vidimu_has_the_planted_orientations_without_the_pose_before(tmp_path: Path) -> None:
    key = made.write_vidimu(tmp_path)
    adapter = Vidimu(tmp_path)
    take = only(adapter, key)
    assert take.kind == "walk"
    inputs = adapter.inputs(take)
    assert inputs.sensors is not None
    thigh = inputs.sensors.select(["qsRUL"]).streams[0]
    poses = known().poses
    np.testing.assert_allclose(thigh.times, poses.times, atol=1e-3)
    assert thigh.R_inertial_sensor is not None
    planted = poses.R_world_bone[:, poses.names.index("RightUpLeg")]
    np.testing.assert_allclose(thigh.R_inertial_sensor, planted, atol=1e-9)
    truth = adapter.truth(take)
    assert truth.table.times[0] == pytest.approx(known().poses.times[2])  # without the rows of the pose
    assert truth.of_sensors  # no reference for the sensors themselves
    legs = {name: angle for name, angle in made.COORDINATES.items() if "knee" in name or "hip" in name}
    check_truth(truth, legs)
    assert "elbow_flex_r" not in truth.coordinates  # no sensor on the arms in A01


def test_movi_has_the_planted_camera_and_flexion_of_each_motion(tmp_path: Path) -> None:
    key = made.write_movi(tmp_path / "MoVi", CENTRES)
    adapter = Movi(tmp_path)
    assert [take.kind for take in adapter.takes()] == ["other", "other", "walk", "walk"]
    take = only(adapter, key)
    inputs = adapter.inputs(take)
    assert inputs.span == pytest.approx((1.0, 1.0 + (len(known().poses.times) * 2 // 4 - 1) / 30), abs=0.1)
    camera, planted = inputs.camera, known().video.camera
    assert camera is not None
    assert not isinstance(camera, Path)
    assert (camera.width_px, camera.height_px) == SIZE_PX
    np.testing.assert_allclose(camera.R_camera_world, planted.R_camera_world)
    np.testing.assert_allclose(camera.t_camera_world, planted.t_camera_world)
    np.testing.assert_allclose(camera.K[:2], made.MOVI_SCALE * planted.K[:2])
    truth = adapter.truth(take)
    assert truth.coordinates == ("knee_angle_r", "knee_angle_l", "elbow_flex_r", "elbow_flex_l")
    knee = truth.table.rotation("knee_angle_r")
    assert knee is not None
    expected = included(("RightUpLeg", "RightLeg", "RightFoot"))
    there = np.interp(truth.table.times, known().poses.times, expected)
    np.testing.assert_allclose(np.degrees(knee), there, atol=0.05)  # positions are interpolated to 120 Hz


def test_missing_markers_of_movi_are_no_angles(tmp_path: Path) -> None:
    key = made.write_movi(tmp_path, tuple(name if "left" in name else "-" for name in CENTRES))
    adapter = Movi(tmp_path)
    table = adapter.truth(only(adapter, key)).table
    right, left = table.rotation("knee_angle_r"), table.rotation("knee_angle_l")
    assert right is not None
    assert left is not None
    assert np.isnan(right).all()
    assert np.isfinite(left).all()


def test_gaitex_has_the_planted_sensors_pose_and_flexion(tmp_path: Path) -> None:
    key = made.write_gaitex(tmp_path)
    adapter = Gaitex(tmp_path)
    take = only(adapter, key)
    assert take.kind == "walk"
    inputs = adapter.inputs(take)
    assert (inputs.pose, inputs.still) == ("T", (0.4, 1.4))
    assert "XSens_Hand_Right" not in inputs.places  # the second sensor of the right foot
    assert inputs.sensors is not None
    assert set(inputs.sensors.names) == set(inputs.places)
    truth = adapter.truth(take)
    knee = truth.table.rotation("knee_angle_l")
    assert knee is not None
    expected = included(("LeftUpLeg", "LeftLeg", "LeftFoot"))
    np.testing.assert_allclose(np.degrees(knee[150:]), expected, atol=1e-3)
    made.write_mot(take.folder / "ik_markers" / f"ik_{key}.mot", made.true_columns(), known().poses.times)
    check_truth(adapter.truth(take), {"ankle_angle_r": "right_ankle_dorsiflexion"})


def test_hip_centres_are_those_of_the_published_regressions() -> None:
    # Pelvis of 240 mm between the anterior and 140 mm between front and back markers, level, facing x.
    left, right = hip_centres(*(np.array([p]) for p in ([0.0, 0.12, 0.0], [0.0, -0.12, 0.0], [-0.14, 0.0, 0.0])))
    behind, below, beside = 0.24 * 140 + 9.9, 0.30 * 240 + 10.9, 0.33 * 240 + 7.3
    np.testing.assert_allclose(1000 * right, [[-behind, -beside, -below]])
    np.testing.assert_allclose(1000 * left, [[-behind, beside, -below]])


def test_a_straight_limb_has_no_flexion_and_a_right_angle_ninety_degrees() -> None:
    hip, knee = np.array([[0.0, 0.0, 2.0]] * 2), np.array([[0.0, 0.0, 1.0]] * 2)
    ankle = np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    table = hinge_table(np.array([0.0, 1.0]), {"left_hip": hip, "left_knee": knee, "left_ankle": ankle})
    assert table.names == ("knee_angle_l",)
    np.testing.assert_allclose(np.degrees(table.rotation("knee_angle_l")), [0.0, 90.0], atol=1e-9)


# --- what is wrong --------------------------------------------------------------------------------


def edited(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


RAW, MOT = "dataset/videoandimus/S40/S40_A01_T01.raw", "dataset/videoandimus/S40/ik_S40_A01_T01.mot"
TRIAL = "austra/ng/{}_austra_ng.{}"
IK = "subject2/OpenSimData/Mocap/IK/walking1.mot"
IMU, MARKERS = TRIAL.format("xsens_imu_data", "csv"), TRIAL.format("qualisys_marker_data", "csv")
OTHER_FLAGS = np.array([[1, 120], [121, 9999]])
CASES: list[tuple[str, Callable[[Path], object], str]] = [
    ("opencap", lambda r: (r / "subject2/sessionMetadata.yaml").unlink(), "the height of the person is missing"),
    ("opencap", lambda r: (r / "subject2/sessionMetadata.yaml").write_text("height_m: 175\n"), "person, m, found 175"),
    ("opencap", lambda r: (r / IK).unlink(), "inverse kinematics of the markers is missing; unpack OpenSimData"),
    ("opencap", lambda r: edited(r / IK, "knee_angle_r", "knee_r"), "no column knee_angle_r: is it another version"),
    ("vidimu", lambda r: edited(r / RAW, "QUAT,w,x,y,z", "sensor,w,x,y,z"), "timestamp, found sensor"),
    ("vidimu", lambda r: edited(r / RAW, "qsHIPS", "qsBACK"), "expected one of qsHIPS, qsRUL"),
    ("vidimu", lambda r: (r / MOT).unlink(), "trials that failed have none: leave them out by --takes"),
    ("vidimu", lambda r: made.write_mot(r / MOT, {"knee_angle_r": np.zeros(2)}, np.arange(2.0)), "has 2 rows: cut off"),
    ("movi", lambda r: made.write_movi(r, CENTRES, flags30=None), "no field flags30"),
    ("movi", lambda r: made.write_movi(r, CENTRES, flags120=OTHER_FLAGS), "flags120 ends after the"),
    ("movi", lambda r: made.write_movi(r, CENTRES[:7]), r"virtualMarkerLocation: .*, not \(T, 20, 3\)"),
    ("movi", lambda r: (r / "Extrinsics_PG1.npz").unlink(), "the calibration of the camera is missing"),
    ("gaitex", lambda r: edited(r / IMU, "XSens_Pelvis_QW", "XSens_Pelvis_W"), "no column XSens_Pelvis_QW"),
    ("gaitex", lambda r: edited(r / IMU, "time [s]", "time [ms]"), r"expected 'time \[s\]' as first column"),
    ("gaitex", lambda r: edited(r / MARKERS, "_[mm]", "_[m]"), "is it of another unit or version"),
    ("gaitex", lambda r: edited(r / MARKERS, "R_FME_", "R_FMX_"), "no marker R_FME"),
    (
        "gaitex",
        lambda r: edited(r / TRIAL.format("metadata", "json"), ": 0.4", ": null"),
        "start_ts: None is not a finite number",
    ),
]
ADAPTERS = {"opencap": OpenCapValidation, "vidimu": Vidimu, "movi": Movi, "gaitex": Gaitex}


def write(name: str, root: Path) -> str:
    """Write a set; return the name of its take."""
    if name == "movi":
        return made.write_movi(root, CENTRES)
    writers = {"opencap": made.write_opencap, "vidimu": made.write_vidimu, "gaitex": made.write_gaitex}
    return writers[name](root)


@pytest.mark.parametrize("name, damage, message", CASES, ids=[f"{c[0]}: {c[2]}" for c in CASES])
def test_a_missing_or_damaged_file_is_named_with_its_remedy(
    tmp_path: Path, name: str, damage: Callable[[Path], object], message: str
) -> None:
    key = write(name, tmp_path)
    damage(tmp_path)
    adapter: PublicSet = ADAPTERS[name](tmp_path)  # type: ignore[assignment]
    every = adapter.takes()  # it is listed all the same
    take = next((take for take in every if take.key == key), every[0])

    def read() -> tuple[TakeInputs, Truth]:
        return adapter.inputs(take), adapter.truth(take)

    with pytest.raises(FileFormatError, match=message):
        read()


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_folder_of_something_else_is_said_with_the_expected_layout(tmp_path: Path, name: str) -> None:

    with pytest.raises(FileFormatError, match="no take of .* in it; expected .*docs/validate.md"):
        ADAPTERS[name](tmp_path).takes()
    with pytest.raises(FileFormatError, match="there is no such folder"):
        ADAPTERS[name](tmp_path / "nowhere")


def test_a_quaternion_of_another_unit_is_refused(tmp_path: Path) -> None:
    key = made.write_gaitex(tmp_path)
    path = tmp_path / TRIAL.format("xsens_imu_data", "csv")
    lines = path.read_text().splitlines()
    scaled = [",".join(str(1000 * float(cell)) for cell in line.split(",")) for line in lines[1:]]
    path.write_text("\n".join([lines[0], *scaled]) + "\n")
    adapter = Gaitex(tmp_path)
    with pytest.raises(FileFormatError, match="quaternions have a norm of 1e.03, not 1"):
        adapter.inputs(only(adapter, key))


def test_metadata_name_a_sensor_that_the_file_must_have(tmp_path: Path) -> None:
    key = made.write_gaitex(tmp_path)
    path = tmp_path / TRIAL.format("metadata", "json")
    about = json.loads(path.read_text())
    about["inverse_kinematics"]["tibia_r"]["imu_name"] = "prop1"
    path.write_text(json.dumps(about))
    adapter = Gaitex(tmp_path)
    with pytest.raises(FileFormatError, match="no columns of prop1, which the metadata name"):
        adapter.inputs(only(adapter, key))
