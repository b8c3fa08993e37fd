"""The stand-in for Total Capture: its files, taken apart by NumPy and SciPy, say what they must."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import total_capture_support as support
from scipy.spatial.transform import Rotation

from benchmarks import total_capture_files as files
from benchmarks import total_capture_motion as source
from benchmarks import total_capture_standin as standin
from rtof_kin.core.errors import OutputExistsError

SEGMENT = {
    "Head": "Head",
    "Sternum": "Spine3",
    "Pelvis": "Hips",
    "L_UpArm": "LeftArm",
    "R_UpArm": "RightArm",
    "L_LowArm": "LeftForeArm",
    "R_LowArm": "RightForeArm",
    "L_UpLeg": "LeftUpLeg",
    "R_UpLeg": "RightUpLeg",
    "L_LowLeg": "LeftLeg",
    "R_LowLeg": "RightLeg",
    "L_Foot": "LeftFoot",
    "R_Foot": "RightFoot",
}
MOCAP = Path(__file__).parents[1] / "fixtures" / "mocap"


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of one perfect take."""
    return support.dataset(tmp_path_factory.mktemp("standin"))


def table(path: Path) -> tuple[list[str], np.ndarray]:
    """Names and (T, J, width) of a gt_skel file."""
    head, *rows = path.read_text().splitlines()
    names = head.split()
    return names, np.array([row.split() for row in rows], dtype=float).reshape(len(rows), len(names), -1)


def sensors(path: Path) -> dict[str, np.ndarray]:
    """(T, values) of every sensor of a .sensors file."""
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    found: dict[str, list[list[str]]] = {}
    for name, *values in rows:
        if values:
            found.setdefault(name, []).append(values)
    return {name: np.array(values, dtype=float) for name, values in found.items()}


def calibration(path: Path) -> dict[str, Rotation]:
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    return {name: Rotation.from_quat([float(q) for q in quat]) for name, *quat in rows}


# --- Vicon ---------------------------------------------------------------------------------------


def test_a_take_begins_in_the_documented_pose(paths: dict[str, Path]) -> None:
    names, p = table(paths["positions"])
    first = {name: 0.0254 * p[0, i] for i, name in enumerate(names)}
    across = first["RightHand"] - first["LeftHand"]
    np.testing.assert_allclose(across / np.linalg.norm(across), [1, 0, 0], atol=0.15)
    up = first["Head"] - first["Hips"]
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=0.2)
    assert 0.05 < first["RightFoot"][1] < 0.1
    _, quat = table(paths["orientations"])
    R = Rotation.from_quat(quat[0])
    # x right, y back, z down.
    np.testing.assert_allclose(R.apply([1, 0, 0]), np.tile([1, 0, 0], (21, 1)), atol=0.2)
    np.testing.assert_allclose(R.apply([0, 1, 0]), np.tile([0, 0, 1], (21, 1)), atol=0.2)
    np.testing.assert_allclose(R.apply([0, 0, 1]), np.tile([0, -1, 0], (21, 1)), atol=0.2)


# --- IMUs ----------------------------------------------------------------------------------------


def test_ref_imu_and_bone_close_to_the_vicon_orientation(paths: dict[str, Path]) -> None:
    names, _ = table(paths["positions"])
    _, quat = table(paths["orientations"])
    ref, bone = calibration(paths["ref"]), calibration(paths["bone"])
    measured = sensors(paths["sensors"])
    assert set(measured) == set(SEGMENT)
    for sensor, segment in SEGMENT.items():
        R_imu = Rotation.from_quat(measured[sensor][:, [1, 2, 3, 0]])
        R = ref[sensor] * R_imu * bone[sensor].inv()
        expected = Rotation.from_quat(quat[:, names.index(segment)])
        assert np.degrees((R.inv() * expected).magnitude().max()) < 0.01


# --- layouts, bodies, motion ---------------------------------------------------------------------


@pytest.mark.parametrize("layout", files.LAYOUTS)
def test_every_layout_has_six_files_per_take(layout: str, tmp_path: Path) -> None:
    one = standin.write_take(tmp_path, support.take(), layout)
    two = standin.write_take(tmp_path, support.take("S4"), layout)
    assert set(one) == {"positions", "orientations", "sensors", "aux", "ref", "bone"}
    assert len({*one.values(), *two.values()}) == 12
    assert all(path.is_file() for path in [*one.values(), *two.values()])


# --- detections ----------------------------------------------------------------------------------


def test_detections_follow_the_truth_late_and_camera_2_is_off(tmp_path: Path) -> None:
    take = support.take(frames=120)
    median = {}
    for number in (1, 2):
        camera = source.cameras()[number]
        path = standin.write_detections(tmp_path, take, number, camera, seed=0)
        assert path.name == f"TC_S5_acting3_cam{number}.npz"
        found = np.load(path)
        assert tuple((tmp_path / "landmarks.txt").read_text().split()) == take.poses.names
        assert found["uv_px"].shape == (len(take.poses), 21, 2)
        seen = found["confidence"] > 0
        assert np.array_equal(seen, np.isfinite(found["uv_px"]).all(axis=-1))
        error = found["uv_px"] - camera.project(take.poses.p_world_joint)
        median[number] = np.nanmedian(error, axis=(0, 1))
    assert np.abs(median[1]).max() < 8
    np.testing.assert_allclose(median[2], standin.CAMERA_2_BIAS_PX, atol=8)


# --- which clips, and the command ----------------------------------------------------------------


def test_the_command_refuses_wrong_folders_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        standin.main(["--help"])
    assert "NOT Total Capture" in capsys.readouterr().out
    common = ["--corpus", str(tmp_path / "nothing"), "--out"]
    assert standin.main([*common, str(tmp_path / "new")]) == 2
    assert "index.csv" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    assert standin.main([*common, str(tmp_path / "full")]) == 2
    assert "full: not an empty folder" in capsys.readouterr().err
    assert standin.main([*common, str(tmp_path / "new"), "--seconds", "0.1"]) == 2
    assert "--seconds 0.1: give 0.5 at least" in capsys.readouterr().err


def test_a_dataset_has_its_readme_and_all_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole way from an index of files to takes, of two subjects on either side of the split."""
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    rows = ["file,subject,tc_like,fps,quality"]
    for name, fps, subject in (("02_01_excerpt.bvh", 30, "CMU002"), ("02_01_excerpt.bvh", 30, "CMU007")):
        (corpus / f"{subject}.bvh").write_bytes((MOCAP / name).read_bytes())
        rows.append(f"{subject}.bvh,{subject},walking,{fps},")
    (corpus / "index.csv").write_text("\n".join(rows))
    monkeypatch.setattr(source, "TAKES", {"S1": ("walking1", "walking2")})
    seen = list(standin.write_dataset(corpus, tmp_path / "out", "vendor", detections=tmp_path / "detected"))
    assert [line.split(" frames from ")[1] for line in seen] == ["CMU007 (walking)", "CMU002 (walking)"]
    text = (tmp_path / "out" / "README.txt").read_text()
    assert "not Total Capture" in text
    assert "mocap.cs.cmu.edu" in text
    assert "NSF EIA-0196217" in text
    found = {p.name for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert "calibration.cal" in found
    assert "s1_walking2_Xsens.sensors" in found
    assert len(list((tmp_path / "detected").glob("TC_S1_walking?_cam?.npz"))) == 16
    with pytest.raises(OutputExistsError, match="detected: not an empty folder"):
        list(standin.write_dataset(corpus, tmp_path / "o2", detections=tmp_path / "detected"))
