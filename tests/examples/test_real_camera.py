"""The example with a real camera: on a simulated session with known truth, and on eight real frames."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detector_support import flat, points_px, walking
from lifting_support import lifted_positions
from numpy.typing import NDArray

from lifting.predict import LiftedPoses
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import RtofError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_toml import read_camera_toml, write_camera_toml

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
sys.path.insert(0, str(EXAMPLES))

import multi_view  # noqa: E402
import pose2sim_trial  # noqa: E402
import real_camera  # noqa: E402
import real_camera_truth  # noqa: E402

Array = NDArray[np.float64]
FRAMES = 16
AZIMUTHS = np.radians([25.0, 140.0, 250.0])
HEIGHT = 1.72
CONFIG = f"[project]\nframe_rate = 30\n[markerAugmentation]\nparticipant_height = {HEIGHT}\n"


class NoisyTruth:
    """A lifter that returns the truth with a constant and a random error."""

    def __init__(self, motion: Motion):
        self.p = motion.poses.p_world_joint[:FRAMES]

    def predict(self, keypoints: KeypointSequence, joint_offsets: Array | None = None, **others: object) -> LiftedPoses:
        shake = np.random.default_rng(0).normal(0, 0.01, self.p.shape)
        seen = np.ones(FRAMES, dtype=np.bool_)
        return lifted_positions(keypoints.times, self.p + shake + 0.03, seen, walking().skeleton.names)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walking()


def around(motion: Motion) -> list[Camera]:
    middle = motion.poses.p_world_joint[:FRAMES, 0].mean(axis=0)
    places = [[4 * np.cos(a), 4 * np.sin(a), 0.7 + 0.1 * i] for i, a in enumerate(AZIMUTHS)]
    return [Camera.looking_at(middle + place, middle, 1250.0) for place in places]


def off(cameras: list[Camera], seed: int = 3) -> list[Camera]:
    """The cameras, each turned by about half a degree and moved by a centimetre or two."""
    rng = np.random.default_rng(seed)
    out = []
    for camera in cameras:
        R = so3.exp(rng.normal(0, np.radians(0.4), 3)) @ camera.R_camera_world
        centre = camera.center_world + rng.normal(0, 0.015, 3)
        out.append(replace(camera, R_camera_world=R, t_camera_world=-R @ centre))
    return out


def session(path: Path, motion: Motion, cameras: list[Camera], calibrated: list[Camera]) -> Path:
    """A folder as Pose2Sim has it: seen by `cameras`, calibrated as `calibrated`; a bystander in one."""
    rng = np.random.default_rng(1)
    trial = path / "session" / "P00" / "T01_Walk"
    (path / "session" / "Calibration").mkdir(parents=True)
    (path / "session" / "Config.toml").write_text(CONFIG)
    write_camera_toml(
        path / "session" / "Calibration" / "Calib.toml", {f"cam_{i + 1}": camera for i, camera in enumerate(calibrated)}
    )
    for i, camera in enumerate(cameras):
        folder = trial / "pose" / f"cam{i + 1}_json"
        folder.mkdir(parents=True)
        uv = points_px("body25b", motion, camera)[:FRAMES]
        uv = uv + rng.normal(0, 1.0, uv.shape)
        for t, points in enumerate(uv):
            people = [points] if i else [0.4 * points + [1300.0, 500.0], points]
            text = json.dumps({"people": [{"pose_keypoints_2d": flat(p)} for p in people]})
            (folder / f"cam{i + 1}.{t:05d}_keypoints.json").write_text(text)
    return path / "session"


@pytest.fixture(scope="module")
def folder(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cameras = around(motion)
    return session(tmp_path_factory.mktemp("walk"), motion, cameras, off(cameras))


# --- several views -------------------------------------------------------------------------------


def test_triangulation_is_robust_to_one_wrong_camera(motion: Motion) -> None:
    cameras = [replace(c, distortion=np.array([-0.05, 0.1, 1e-3, 0, 0])) for c in around(motion)]
    p = motion.poses.p_world_joint[:4]
    uv = np.stack([camera.project(p) for camera in cameras])
    found, error = multi_view.triangulate(cameras, uv, np.ones(uv.shape[:-1]))
    np.testing.assert_allclose(found, p, atol=1e-6)
    assert np.abs(error).max() < 1e-3
    uv[1, 2, 5] += [80.0, -40.0]
    found, _ = multi_view.triangulate(cameras, uv, np.ones(uv.shape[:-1]))
    assert np.linalg.norm(found[2, 5] - p[2, 5]) < 0.02
    uv[:2, 1, 7] = np.nan
    found, error = multi_view.triangulate(cameras, uv, np.ones(uv.shape[:-1]))
    assert np.isnan(found[1, 7]).all()
    assert np.isnan(error[:, 1, 7]).all()
    assert np.isfinite(found).all(axis=-1).sum() == found[..., 0].size - 1


# --- the session ---------------------------------------------------------------------------------


def test_two_people_are_distinguished_by_their_size(motion: Motion, tmp_path: Path) -> None:
    cameras = around(motion)
    root = session(tmp_path, motion, cameras, cameras)
    (root / "P00" / "Config.toml").write_text("[project]\nparticipant_height = [1.72, 1.2]\n")
    small = points_small(motion, cameras)
    for i, points in enumerate(small):
        for t, path in enumerate(sorted((root / "P00" / "T01_Walk" / "pose" / f"cam{i + 1}_json").iterdir())):
            people = json.loads(path.read_text())["people"]
            people.insert(i % 2, {"pose_keypoints_2d": flat(points[t])})
            path.write_text(json.dumps({"people": people}))
    tall = pose2sim_trial.read_trial(root, "T01_Walk")
    child = pose2sim_trial.read_trial(root, "T01_Walk", participant=2)
    assert (tall.height, child.height) == (1.72, 1.2)
    assert "participant 1 of 2" in tall.person
    assert "participant 2 of 2" in child.person
    assert "number 0 in cam_1, 1 in cam_2, 0 in cam_3," in child.person
    np.testing.assert_allclose(child.views[0].uv_px, small[0], atol=1e-3)
    with pytest.raises(RtofError, match=r"participant '3'.*Known: 1, 2"):
        pose2sim_trial.read_trial(root, "T01_Walk", participant=3)


def points_small(motion: Motion, cameras: list[Camera]) -> list[Array]:
    """The same motion, 0.7 times as large and a metre away: seen by cameras scaled about it."""
    shift = np.array([0.6, 0.6, 0.0])
    out = []
    for camera in cameras:  # 0.7 p + shift seen from c is p seen from (c - shift) / 0.7
        centre = (camera.center_world - shift) / 0.7
        R = camera.R_camera_world
        out.append(points_px("body25b", motion, replace(camera, t_camera_world=-R @ centre))[:FRAMES])
    return out


def test_incomplete_sessions_are_refused(folder: Path, tmp_path: Path) -> None:
    read = pose2sim_trial.read_trial
    with pytest.raises(RtofError, match="no trial called 'T09'; there are T01_Walk"):
        read(folder, "T09")
    root = shutil.copytree(folder, tmp_path / "s")
    pose = root / "P00" / "T01_Walk" / "pose"
    (root / "Config.toml").write_text("[project]\nparticipant_height = 'auto'\n")
    with pytest.raises(RtofError, match="participant_height is 'auto'.*by --height"):
        read(root, "T01_Walk")
    assert read(root, "Walk", height=1.6).height == 1.6
    (root / "Config.toml").write_text(CONFIG)
    calibration = root / "Calibration" / "Calib.toml"
    cameras = read_camera_toml(calibration)
    for name, right in {"cam_1": 0.8, "cam_3": -0.6}.items():  # of another session
        t = cameras[name].t_camera_world + np.array([right, 0.3, 0.0])
        cameras[name] = replace(cameras[name], t_camera_world=t)
    write_camera_toml(calibration, cameras, overwrite=True)
    with pytest.raises(RtofError, match="nobody was seen by all cameras at once.*in the same order"):
        read(root, "T01_Walk")
    shutil.rmtree(pose / "cam1_json")
    with pytest.raises(RtofError, match="2 folders of detections for 3 cameras"):
        read(root, "T01_Walk")
    shutil.rmtree(root / "Calibration")
    with pytest.raises(RtofError, match=r"no folder \*calib\* with a .toml in it"):
        read(root, "T01_Walk")


# --- the whole of it -----------------------------------------------------------------------------


def test_the_example_measures_the_planted_errors(
    folder: Path, motion: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = [str(folder), "--trial", "T01_Walk", "-o", str(out)]
    options = real_camera._parser().parse_args(arguments)
    real_camera.run(options, lifter=NoisyTruth(motion))
    printed = capsys.readouterr().out
    assert "followed participant 1 of 1 (1.72 m)" in printed
    assert "an illustration and no benchmark" in printed
    assert sorted(p.name for p in out.iterdir()) == [
        ".rtof_kin.json",
        "cameras.toml",
        "real_camera.json",
        "real_camera.png",
    ]
    assert (out / "real_camera.png").read_bytes()[:4] == b"\x89PNG"
    result = json.loads((out / "real_camera.json").read_text())
    assert set(result["scores"]) == {"cam_1", "cam_2", "cam_3"}
    for before, after in result["misfit_px"].values():
        assert after < 3.0 < before
    assert list(read_camera_toml(out / "cameras.toml")) == list(result["scores"])
    lift, rto = result["mean"]["lift"], result["mean"]["rto"]
    assert 10 < lift["relative_mm"] < 45  # the shake, and how well joints are triangulated
    assert 30 < lift["absolute_mm"] < 80
    assert rto["relative_mm"] < 45
    assert rto["fit_px"] < 6
    for figures in (lift, rto):
        assert max(figures["along_mm"], figures["across_mm"]) <= figures["relative_mm"]
        assert figures["relative_mm"] <= figures["along_mm"] + figures["across_mm"]
        assert figures["varying_mm"] < figures["relative_mm"]
    assert real_camera.main(arguments) == 2  # nothing is overwritten unasked


def test_the_triangulated_motion_is_the_planted_one(folder: Path, motion: Motion) -> None:
    trial = pose2sim_trial.read_trial(folder, "T01_Walk")
    assert trial.height == HEIGHT
    assert "number 1 in cam_1, 0 in cam_2, 0 in cam_3," in trial.person
    np.testing.assert_allclose(np.diff(trial.views[0].found.keypoints.times), 1 / 30)
    truth = real_camera_truth.triangulated(trial, motion.skeleton, adjust=True)
    p, p_true = truth.poses.p_world_joint, motion.poses.p_world_joint[:FRAMES]
    relative = np.linalg.norm((p - p[:, :1]) - (p_true - p_true[:, :1]), axis=-1)
    assert relative.mean() < 0.03
    bones = real_camera_truth.measured_bones(truth, motion.skeleton)
    for name in ("RightLeg", "LeftFoot", "RightForeArm", "LeftHand"):
        assert abs(bones[name] / motion.skeleton.bone_lengths[name] - 1) < 0.1
    as_filed = real_camera_truth.triangulated(trial, motion.skeleton, adjust=False)
    assert all(turn == move == 0 for turn, move in as_filed.moved.values())
    assert as_filed.misfit_px["cam_1"][0] == as_filed.misfit_px["cam_1"][1]
    assert truth.without_one_mm < as_filed.without_one_mm


def test_help_and_errors_of_the_example(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", ["real_camera.py", "--help"])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(EXAMPLES / "real_camera.py"), run_name="__main__")
    assert left.value.code == 0
    assert "--overwrite" in capsys.readouterr().out
    assert real_camera.main([str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "there are none: no folder pose/*_json" in capsys.readouterr().err
