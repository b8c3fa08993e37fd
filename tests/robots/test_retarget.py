"""Real walking on humanoid robots of two packages on PyPI and on Unitree's names."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from clinical_support import walk
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from robots_support import G1, GR1, OTHERS, TALOS, h1_urdf
from scipy.spatial.transform import Rotation

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import Provenance
from rtof_kin.robots.retarget import FIGURES, Contacts, Retargeter, RobotMap, RobotMotion, sigmas

Array = NDArray[np.float64]
ROBOTS = {"talos": TALOS, "gr1": GR1, "g1": G1}


@pytest.fixture(scope="module")
def h1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("h1") / "h1.urdf"
    path.write_text(h1_urdf())
    return path


@pytest.fixture(scope="module", params=[*ROBOTS, "h1"])
def found(request: pytest.FixtureRequest) -> RobotMotion:
    urdf = ROBOTS[request.param] if request.param in ROBOTS else request.getfixturevalue("h1")
    motion = RobotMotion.of(MotionSource.of(walk()), urdf)
    assert motion.robot.map.name == request.param
    return motion


def places(found: RobotMotion, link: str, point: Array) -> Array:
    """(T, 3) m of a point of a link, by Pinocchio."""
    model, out = found.robot.model, []
    data, number = model.createData(), model.getFrameId(link, pin.FrameType.BODY)
    for q in found.q:
        pin.framesForwardKinematics(model, data, q)
        out.append(data.oMf[number].act(point))
    return np.array(out)


def test_feet_stand_where_they_landed_and_walk_as_far_as_the_person(found: RobotMotion) -> None:
    feet = [one for one in found.robot.map.link if one.sole_mm]
    for foot in feet:
        still = 0
        for point in np.array(foot.sole_mm) / 1000:
            at = places(found, foot.name, point)
            assert at[:, 2].min() > -0.002
            on_floor = np.abs(at[:, 2]) < 0.002
            speed = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1) * 40
            still += np.sum(on_floor[1:] & (speed < 0.01))
        assert still > 0.48 * len(found.q), foot.name
    figures = found.robot.track.figures()
    assert figures["stances"] >= 12
    assert figures["most_mm"] < 2
    assert np.abs(np.diff(found.q[:, :3], axis=0)).max() < 0.08  # m in a frame of 25 ms
    way = np.linalg.norm((found.q[-1] - found.q[0])[:2])
    person = np.linalg.norm((walk().q[-1] - walk().q[0])[:2])
    assert way == pytest.approx(found.robot.scale * person, rel=0.03)


def test_limits_of_angles_and_velocities_are_kept(found: RobotMotion) -> None:
    model, angles = found.robot.model, found.q[:, 7:]
    assert np.all(angles > model.lowerPositionLimit[7:] - 1e-6)
    assert np.all(angles < model.upperPositionLimit[7:] + 1e-6)
    rates = np.abs(np.diff(angles, axis=0)) / np.diff(found.times)[:, None]
    assert np.all(rates < model.velocityLimit[6:] * (1 + 1e-6))
    assert "limits broken in 0 of" in str(found.robot.track)
    assert not found.robot.track.failures


def test_knees_bend_when_the_persons_do(found: RobotMotion) -> None:
    joints = found.robot.joints
    knee = joints.index(
        next(n for n in joints if n in ("leg_left_4_joint", "left_knee_pitch_joint", "left_knee_joint"))
    )
    person = walk().q[:, 7 + walk().skeleton.dof_names.index("LeftLeg_y")]
    assert np.corrcoef(found.q[:, 7 + knee], person)[0, 1] > 0.85


@pytest.mark.parametrize("name", ROBOTS)
def test_usual_inverse_kinematics_slips_and_breaks_limits(name: str) -> None:
    usual = RobotMotion.of(MotionSource.of(walk()), ROBOTS[name], without="contacts, limits").robot.track.figures()
    assert usual["slip_mm"] > 10
    assert usual["outside"] + usual["fast"] > 0


@pytest.mark.parametrize(("name", "path"), [(name, path) for name, paths in OTHERS.items() for path in paths])
def test_other_robots_of_a_map_have_its_links(name: str, path: Path) -> None:
    assert Retargeter(walk().skeleton, path).map.name == name


def test_what_nobody_observed_is_followed_weakly() -> None:
    motion = walk()
    arm = motion.skeleton.index("LeftArm", "LeftForeArm", "LeftHand")
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA)
    provenance[:, arm] = Provenance.PRIOR
    turned = np.ones(provenance.shape, dtype=bool)
    turned[:, arm] = False
    poses = replace(motion.poses, provenance=provenance, orientation_observed=turned, direction_observed=turned)
    position, turn = sigmas(poses, motion.skeleton, None)
    for sigma, size in ((position, 0.3), (turn, 1.0)):
        assert sigma[:, arm].min() == size
        assert not np.delete(sigma, arm, axis=1).any()
    seen, unseen = (RobotMotion.of(MotionSource.of(replace(motion, poses=p))[:60], GR1) for p in (motion.poses, poses))
    joints, spread = seen.robot.joints, {}
    for side in ("left", "right"):
        column = 7 + joints.index(f"{side}_elbow_pitch_joint")
        spread[side] = np.abs(unseen.q[:, column]).mean() / np.abs(seen.q[:, column]).mean()
    assert spread["left"] < 0.7
    assert spread["right"] == pytest.approx(1.0, abs=0.1)


def test_robot_stays_where_the_pose_is_unknown_and_says_when() -> None:
    motion = walk()
    p, R = np.array(motion.poses.p_world_joint), np.array(motion.poses.R_world_bone)
    p[10:12], R[10:12] = np.nan, np.nan
    motion = motion.skeleton.motion(
        replace(motion.poses, p_world_joint=p, R_world_bone=R, valid=np.isfinite(p[..., 0]))
    )
    found = RobotMotion.of(MotionSource.of(motion)[:14], GR1)
    assert np.array_equal(found.q[11], found.q[9])
    assert found.robot.track.failures == [
        f"{t:.2f} s: the person's pose is unknown, the robot stays" for t in motion.times[10:12]
    ]


def test_contacts_need_no_known_floor_and_no_future() -> None:
    points = np.zeros((2, 2, 3))
    points[..., 2] = [[1.30, 1.30], [1.40, 1.44]]
    contacts = Contacts(None)
    for frame in range(10):
        standing = contacts.update(frame / 60, points.copy())
    assert contacts.floor == pytest.approx(1.30)
    assert standing.tolist() == [[True, True], [False, False]]
    for frame in range(10, 16):
        points[..., 0] += 0.02  # 1.2 m/s
        standing = contacts.update(frame / 60, points.copy())
    assert not standing.any()


def test_files_are_read_by_mujoco_and_in_the_shape_of_ros(h1: Path, tmp_path: Path) -> None:
    found = RobotMotion.of(MotionSource.of(walk())[:20], h1)
    found.write(tmp_path)
    saved = np.load(tmp_path / "robot_qpos.npz")
    spec = mujoco.MjSpec.from_file(str(h1))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data, last = mujoco.MjData(model), saved["qpos"][-1]
    assert saved["fps"] == pytest.approx(40)
    for name, angle in zip(saved["joint_names"], last[7:], strict=True):
        data.qpos[model.joint(str(name)).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, last[3:7])
    for link, point in (("left_ankle_link", [0.1, 0, -0.06]), ("right_elbow_link", [0.2, 0, 0])):
        body = data.body(link)
        in_base = body.xpos + body.xmat.reshape(3, 3) @ point
        np.testing.assert_allclose(
            last[:3] + turn.reshape(3, 3) @ in_base, places(found, link, np.array(point))[-1], atol=1e-6
        )
    joints, base = (json.loads((tmp_path / f"robot_{kind}_trajectory.json").read_text()) for kind in ("joint", "base"))
    assert joints["joint_names"] == list(found.robot.joints)
    assert joints["points"][3]["positions"] == found.q[3, 7:].tolist()
    assert base["joint_names"] == ["pelvis"]
    assert base["points"][-1]["time_from_start"] == {"sec": 0, "nanosec": 475000000}
    assert json.loads((tmp_path / FIGURES).read_text())["map"] == "h1"
    with (tmp_path / "robot.mcap").open("rb") as stream:
        read = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/tf", "/joint_states"])
        last_of = {channel.topic: message for _, channel, _, message in read}
    assert list(last_of["/joint_states"].position) == found.q[-1, 7:].tolist()
    placed = {"world": np.eye(4)}
    for one in last_of["/tf"].transforms:
        p, quat, own = one.transform.translation, one.transform.rotation, np.eye(4)
        own[:3, :3], own[:3, 3] = Rotation.from_quat([quat.x, quat.y, quat.z, quat.w]).as_matrix(), [p.x, p.y, p.z]
        placed[one.child_frame_id] = placed[one.header.frame_id] @ own
    for link in ("left_ankle_link", "right_elbow_link"):
        np.testing.assert_allclose(placed[link][:3, 3], places(found, link, np.zeros(3))[-1], atol=1e-9)


def test_wrong_maps_and_robots_are_refused_with_names(h1: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="link of talos.toml in the robot.*base_link"):
        Retargeter(walk().skeleton, h1, "talos")
    with pytest.raises(InvalidInputError, match=r"no map ships .*talos.*--map"):
        RobotMap.choose(None, {"base"})
    broken = tmp_path / "robot.urdf"
    broken.write_text("<robot")
    with pytest.raises(FileFormatError, match="not a readable URDF"):
        Retargeter(walk().skeleton, broken)
    text = model_path("robots/h1.toml").read_text()
    for old, new, why in (
        ("sole_mm", "soles_mm", "soles_mm"),
        ("left_elbow_joint", "left_elbow", "left_elbow"),
        ('parent = "torso_link"', 'parent = "head"', "before its parent head"),
        ("position_mm = 15", "", "needs sole_mm and position_mm"),
    ):
        own = tmp_path / "own.toml"
        own.write_text(text.replace(old, new))
        with pytest.raises((FileFormatError, UnknownNameError), match=why):
            Retargeter(walk().skeleton, h1, str(own))
