"""One real motion with gaps in every format, read by other programs' readers."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pinocchio as pin
import pyarrow.parquet as pq
import pygltflib
import pytest
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory as Ros2
from numpy.typing import NDArray
from opensim_support import read_by_opensim
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.errors import InvalidInputError, RtofError, UnknownNameError
from rtof_kin.core.rotations import angle_between
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS
from rtof_kin.formats.markers import read_c3d
from rtof_kin.formats.motion_files import DEFAULT, FORMATS, motion_columns, write_motion_files
from rtof_kin.simulation.mocap import read_mocap

Array = NDArray[np.float64]
WALK = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"
METRES = RADIANS = 1e-6
T, START = 60, 2.0
BRIDGED, UNKNOWN, HAND_UNSEEN = slice(20, 26), slice(40, 43), slice(5, 9)
NEVER_TURNED, WRIST = "LeftHand", {"LeftHand_y", "LeftHand_x", "LeftHand_z"}
LEG_UNSEEN, LEG = slice(28, 38), ("LeftLeg", "LeftFoot")
FINGERS = list(SkeletonModel.default().landmarks).index("LeftHandEnd")
SEEN = [(0, 20), (26, 40), (43, T)]
PIECES = list(enumerate(SEEN, 1))
R_GROUND_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""OpenSim's ground: x forward, y up, z right."""
R_BVH_WORLD = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""x left, y up, z forward."""


@pytest.fixture(scope="module")
def motion() -> Motion:
    """A second of walking: bridged once, unknown once, a hand and a leg unobserved for a while, and the
    orientation of the other hand unobserved throughout."""
    clip = read_mocap(WALK)
    poses = replace(clip.poses[:T], times=START + np.arange(T) / 60)
    p, R = np.array(poses.p_world_joint), np.array(poses.R_world_bone)
    p[UNKNOWN], R[UNKNOWN] = np.nan, np.nan
    valid = np.isfinite(p).all(axis=-1)
    valid[BRIDGED] = False
    valid[HAND_UNSEEN, poses.names.index("RightHand")] = False
    provenance = np.where(valid, Provenance.CAMERA, Provenance.BRIDGED)
    provenance[LEG_UNSEEN, [poses.names.index(n) for n in LEG]] = Provenance.PRIOR
    turned = np.tile([name != NEVER_TURNED for name in poses.names], (T, 1))
    turned[LEG_UNSEEN, [poses.names.index(n) for n in LEG]] = False
    poses = replace(
        poses, p_world_joint=p, R_world_bone=R, valid=valid, provenance=provenance, orientation_observed=turned
    )
    return SkeletonModel.default().with_offsets(clip.joint_offsets).motion(poses)


@pytest.fixture(scope="module")
def folder(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_motion_files(tmp_path_factory.mktemp("files"), motion, tuple(FORMATS))


@pytest.fixture(scope="module")
def opensim(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Array]:
    return read_by_opensim(folder, tmp_path_factory.mktemp("opensim") / "found.npz")


def landmarks(motion: Motion, only_seen: bool = True) -> Array:
    """(T, L, 3) in world; NaN where unobserved."""
    skeleton, poses = motion.skeleton, motion.poses
    p = np.array(skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone))
    if only_seen:
        for i, (joint, _) in enumerate(skeleton.landmarks.values()):
            p[poses.provenance[:, skeleton.names.index(joint)] != Provenance.CAMERA, i] = np.nan
        p[:, FINGERS] = np.nan
    return p


def assert_near(found: Any, expected: Array, tolerance: float = METRES) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)  # NaN at the same places


@pytest.mark.parametrize(("number", "piece"), PIECES)
def test_opensim_poses_markers_and_bodies_by_the_mot(
    motion: Motion, opensim: dict[str, Array], number: int, piece: tuple[int, int]
) -> None:
    frames, name = slice(*piece), f"motion_{number}.mot"
    assert list(opensim["marker_names"]) == list(motion.skeleton.landmarks)
    assert list(opensim["body_names"]) == list(motion.skeleton.names)
    assert_near(opensim[f"{name}/times"], motion.times[frames], 1e-12)
    assert opensim[f"{name}/rows"] == len(motion.times[frames])
    seen = [i for i in range(len(motion.skeleton.landmarks)) if i != FINGERS]
    everywhere = landmarks(motion, only_seen=False)[frames, seen]
    assert_near(opensim[f"{name}/markers"][:, seen], everywhere @ R_GROUND_WORLD.T)
    R_world_bone = R_GROUND_WORLD.T @ opensim[f"{name}/bodies"]
    off = angle_between(R_world_bone, motion.poses.R_world_bone[frames])
    assert np.delete(off, motion.skeleton.index(NEVER_TURNED), axis=1).max() < RADIANS
    left_out = {"LeftHand_y", "wrist_flex_l", "wrist_dev_l"}
    assert set(opensim["coordinates"]) - set(opensim[f"{name}/columns"]) == left_out


@pytest.mark.parametrize(("number", "piece"), PIECES)
def test_opensim_reads_states_with_velocities(
    motion: Motion, opensim: dict[str, Array], number: int, piece: tuple[int, int]
) -> None:
    frames, name = slice(*piece), f"motion_{number}.sto"
    p_ground = landmarks(motion, only_seen=False)[frames] @ R_GROUND_WORLD.T
    assert_near(opensim[f"{name}/times"], motion.times[frames], 1e-12)
    assert_near(opensim[f"{name}/markers"], p_ground)
    velocities = np.gradient(p_ground, 1 / 60, axis=0)[1:-1]
    off = opensim[f"{name}/velocities"][1:-1] - velocities
    assert np.abs(off).max() < 0.03 * np.abs(velocities).max()  # both are central differences


def test_opensim_reads_markers_and_gaps(motion: Motion, opensim: dict[str, Array]) -> None:
    assert list(opensim["motion.trc/names"]) == list(motion.skeleton.landmarks)
    assert_near(opensim["motion.trc/times"], motion.times, 1e-9)
    found = opensim["motion.trc/markers"]
    assert_near(found, landmarks(motion) @ R_GROUND_WORLD.T)
    assert np.isnan(found[BRIDGED]).all()
    assert np.isnan(found[UNKNOWN]).all()
    hand = list(motion.skeleton.landmarks).index("RightHandEnd")
    assert np.isnan(found[HAND_UNSEEN, hand]).all()
    assert np.isfinite(found[HAND_UNSEEN, 0]).all()


@pytest.mark.parametrize("ending", ["mot", "sto"])
def test_header_names_unobserved_joints_and_coordinates(folder: Path, ending: str) -> None:
    head, _ = (folder / f"motion_2.{ending}").read_text().split("endheader")
    assert "Unobserved joints" in head
    assert "LeftLeg 71.4 %, LeftFoot 71.4 %." in head
    assert "knee_angle_l 71.4 %" in head
    last, _ = (folder / f"motion_3.{ending}").read_text().split("endheader")
    assert "Unobserved joints" not in last
    assert "Unobserved coordinates" in last
    assert "LeftHand_y 100 %, wrist_flex_l 100 %, wrist_dev_l 100 %." in last


def test_ezc3d_reads_points_with_residual_minus_one_in_gaps(folder: Path, motion: Motion) -> None:
    file = ezc3d.c3d(str(folder / "motion.c3d"))
    point = file["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["mm"]
    assert list(point["LABELS"]["value"]) == list(motion.skeleton.landmarks)
    assert_near(file["data"]["points"][:3].transpose(2, 1, 0) / 1000, landmarks(motion))
    residual = file["data"]["meta_points"]["residuals"][0].T
    np.testing.assert_array_equal(residual == -1, np.isnan(landmarks(motion)[..., 0]))
    assert file["header"]["points"]["first_frame"] == round(START * 60)


@pytest.mark.parametrize(("number", "piece"), PIECES)
def test_other_bvh_reader(folder: Path, motion: Motion, number: int, piece: tuple[int, int]) -> None:
    file, p, R = bvh_poses(folder / f"motion_{number}.bvh")
    poses = motion.poses[slice(*piece)]
    assert file.frame_time == pytest.approx(1 / 60)
    assert file.get_joints_names() == list(motion.skeleton.names)
    for j, name in enumerate(file.get_joints_names()):
        assert_near(p[name] / 100 @ R_BVH_WORLD, poses.p_world_joint[:, j])
        R_world_bone = R_BVH_WORLD.T @ R[name] @ R_BVH_WORLD
        assert angle_between(R_world_bone, poses.R_world_bone[:, j]).max() < RADIANS


LAFAN1_TRUNK = ("Spine", "Spine1", "Spine2", "Neck", "Head")
LAFAN1_ARM = ("Shoulder", "Arm", "ForeArm", "Hand")
LAFAN1 = [
    "Hips",
    *(f"{side}{name}" for side in ("Left", "Right") for name in ("UpLeg", "Leg", "Foot", "Toe")),
    *LAFAN1_TRUNK,
    *(f"{side}{name}" for side in ("Left", "Right") for name in LAFAN1_ARM),
]
"""As in ``walk1_subject1.bvh`` of that data set."""


@pytest.mark.parametrize(("number", "piece"), PIECES)
def test_lafan1_has_its_names_order_channels_and_axes(
    folder: Path, motion: Motion, number: int, piece: tuple[int, int]
) -> None:
    file, p, R = bvh_poses(folder / f"motion_{number}_lafan1.bvh")
    names, poses, skeleton = file.get_joints_names(), motion.poses[slice(*piece)], motion.skeleton
    assert names == LAFAN1
    assert [file.joint_parent(name).name for name in ("LeftToe", "Neck", "RightShoulder")] == [
        "LeftFoot",
        "Spine2",
        "Spine2",
    ]
    assert {tuple(file.joint_channels(n)) for n in names[1:]} == {("Zrotation", "Yrotation", "Xrotation")}
    marks = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    for name in names:
        ours = {"Spine2": "Spine3", "LeftToe": "LeftToeBase", "RightToe": "RightToeBase"}.get(name, name)
        at = marks[:, list(skeleton.landmarks).index(ours)]
        above = name in LAFAN1_TRUNK[2:] or name.endswith(LAFAN1_ARM)
        assert_near(p[name] / 100 @ R_BVH_WORLD, at, 0.0005 if above else METRES)
    bones = {"LeftLeg": "LeftFoot", "RightArm": "RightForeArm", "LeftForeArm": "LeftHand", "LeftFoot": "LeftToe"}
    for name, end in bones.items():  # x of the file's joints is along the bone
        along = (p[end] - p[name]) / np.linalg.norm(p[end] - p[name], axis=1, keepdims=True)
        assert_near(R[name][:, :, 0], along)
    forward = {"Hips": (1, 1), "Head": (1, 1), "RightLeg": (1, 1), "LeftArm": (1, -1), "RightHand": (1, -1)}
    for name, (axis, sign) in forward.items():
        found = R_BVH_WORLD.T @ R[name][:, :, axis, None] * sign
        assert_near(found[..., 0], poses.R_world_bone[:, skeleton.names.index(name), :, 0])


def bvh_poses(path: Path) -> tuple[Any, dict[str, Array], dict[str, Array]]:
    """A file read by another package, and positions (T, 3) and orientations (T, 3, 3) of its joints in its world."""
    bvh = pytest.importorskip("bvh", reason="of the extra dev")
    file = bvh.Bvh(path.read_text())
    p: dict[str, Array] = {}
    R: dict[str, Array] = {}
    for j, name in enumerate(file.get_joints_names()):
        values = np.array(file.frames_joint_channels(name, file.joint_channels(name)))
        axes = [channel[0] for channel in file.joint_channels(name) if "rotation" in channel]
        turn = Rotation.from_euler("".join(axes), values[:, -3:], degrees=True).as_matrix()
        if j == 0:
            p[name], R[name] = values[:, :3], turn
        else:
            parent = file.joint_parent(name).name
            p[name] = p[parent] + R[parent] @ np.array(file.joint_offset(name))
            R[name] = R[parent] @ turn
    return file, p, R


def test_csv_has_numbers_under_names_with_units(folder: Path, motion: Motion) -> None:
    with (folder / "motion.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    units = [name.partition(" ")[2] for name in rows[0]]
    assert set(units) == {"[s]", "[m]", "[1]", "[rad]", ""}
    assert_near(
        [float(row["LeftLeg_y [rad]"] or "nan") for row in rows],
        motion.q[:, 7 + motion.skeleton.dof_names.index("LeftLeg_y")],
        0,
    )
    assert [row["Hips_seen_by"] for row in rows[18:22]] == ["camera"] * 2 + ["bridged"] * 2
    assert [row["RightHand_valid"] for row in rows[4:6]] == ["1", "0"]
    unknown = {name for name, cell in rows[UNKNOWN.start].items() if cell}
    assert unknown == {"time [s]"} | {n for n in rows[0] if n.endswith(("_valid", "_seen_by"))}
    assert {row[f"{n}_valid"] for row in rows for n in ("LeftHand_x", "LeftHandEnd")} == {"0"}
    assert [row["LeftLeg_y_valid"] for row in rows[27:39]] == ["1", *"0" * 10, "1"]


def test_data_frame_has_units_names_and_nulls(folder: Path, motion: Motion) -> None:
    table = pq.read_table(folder / "motion.parquet")
    assert b"z up" in table.schema.metadata[b"convention"]
    offsets = json.loads(table.schema.metadata[b"joint_offsets_m"])
    assert_near(list(offsets.values()), motion.skeleton.joint_offsets, 0)
    assert table.schema.field("LeftLeg_y").metadata == {
        b"unit": b"rad",
        b"clinical": b"left knee flexion",
        b"opensim": b"knee_angle_l",
    }

    def values(names: Iterable[str]) -> Array:
        return np.stack([table[name].to_numpy(zero_copy_only=False) for name in names], axis=-1)

    names = [*BASE_COLUMNS, *motion.skeleton.dof_names]
    assert {table[name].null_count for name in names} == {UNKNOWN.stop - UNKNOWN.start}
    assert_near(values(names), motion.q, 0)
    everywhere = landmarks(motion, only_seen=False)
    for i, name in enumerate(motion.skeleton.landmarks):
        assert_near(values(f"p_{name}_{axis}" for axis in "xyz"), everywhere[:, i], 0)
    np.testing.assert_array_equal(values(f"{n}_valid" for n in motion.skeleton.names), motion.poses.valid)


def test_ros_messages_on_the_urdf_reproduce_the_motion(folder: Path, motion: Motion) -> None:
    model = pin.buildModelFromUrdf(str(folder / "skeleton.urdf"), pin.JointModelFreeFlyer())
    data, played = model.createData(), []
    for number in (1, 2):  # bridged frames are played, unknown ones end the first message
        joints, base = (
            json.loads((folder / f"ros_{kind}_trajectory_{number}.json").read_text()) for kind in ("joint", "base")
        )
        for joint_point, base_point in zip(joints["points"], base["points"], strict=True):
            (transform,) = base_point["transforms"]
            q = pin.neutral(model)
            q[:3] = [transform["translation"][axis] for axis in "xyz"]
            q[3:7] = [transform["rotation"][axis] for axis in "xyzw"]
            for name, angle in zip(joints["joint_names"], joint_point["positions"], strict=True):
                q[model.joints[model.getJointId(name)].idx_q] = angle
            pin.framesForwardKinematics(model, data, q)
            stamp = joint_point["time_from_start"]
            t = round((stamp["sec"] + 1e-9 * stamp["nanosec"]) * 60)
            for j, link in enumerate(motion.skeleton.names):
                p = data.oMf[model.getFrameId(link, pin.FrameType.BODY)].translation
                assert_near(p, motion.poses.p_world_joint[t, j])
            played.append(t)
    assert played == [t for t in range(T) if not UNKNOWN.start <= t < UNKNOWN.stop]


@pytest.mark.parametrize(("number", "piece"), PIECES)
def test_glb_animates_the_joints_and_keeps_the_rules_of_gltf(
    folder: Path, motion: Motion, number: int, piece: tuple[int, int]
) -> None:
    file, tracks = animated(folder / f"motion_{number}.glb")
    poses = motion.poses[slice(*piece)]
    names, p, R = [node.name for node in file.nodes], {}, {}
    assert names == list(motion.skeleton.names)
    parents = {child: j for j, node in enumerate(file.nodes) for child in node.children or []}
    for j in range(len(names)):
        times, quat = tracks[j, "rotation"]
        assert_near(times, poses.times - poses.times[0], 1e-6)
        assert_near(np.linalg.norm(quat, axis=1), np.ones(len(quat)), 1e-6)
        turn, up = Rotation.from_quat(quat).as_matrix(), parents.get(j)
        R[j] = turn if up is None else R[up] @ turn
        p[j] = tracks[0, "translation"][1] if up is None else p[up] + R[up] @ np.array(file.nodes[j].translation)
        assert_near(p[j] @ R_BVH_WORLD, poses.p_world_joint[:, j], 1e-5)
        assert_near(R_BVH_WORLD.T @ R[j] @ R_BVH_WORLD, poses.R_world_bone[:, j], 1e-5)
        seen = tracks[j, "weights"][1].reshape(-1, 2)[:, 1] == 0
        np.testing.assert_array_equal(seen, poses.valid[:, j] & (poses.provenance[:, j] == Provenance.CAMERA))
    scene = trimesh.load(folder / f"motion_{number}.glb")
    assert all(mesh.volume > 0 for mesh in scene.geometry.values() if mesh.area)  # faces look outwards
    assert scene.extents[1] > 1.4  # standing along y


def animated(path: Path) -> tuple[Any, dict[tuple[int, str], tuple[Array, Array]]]:
    """The file, and times and values of each animated property of a node, after a check of its buffers."""
    file = pygltflib.GLTF2().load(str(path))
    blob, sizes = file.binary_blob(), {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    assert file.buffers[0].byteLength == len(blob)
    ends = [(view.byteOffset, view.byteOffset + view.byteLength) for view in file.bufferViews]
    assert ends[-1][1] == len(blob)
    assert all(one[1] == other[0] and one[1] % 4 == 0 for one, other in pairwise(ends))
    values = []
    for accessor in file.accessors:
        start, stop = ends[accessor.bufferView]
        own = np.frombuffer(blob[start:stop], "<f4" if accessor.componentType == pygltflib.FLOAT else "<u4")
        own = own.reshape(accessor.count, sizes[accessor.type])
        if accessor.min:
            assert_near([accessor.min, accessor.max], [own.min(axis=0), own.max(axis=0)], 0)
        values.append(own.astype(float))
    (animation,), tracks = file.animations, {}
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        assert file.accessors[sampler.input].min == [0.0]
        tracks[channel.target.node, channel.target.path] = values[sampler.input][:, 0], values[sampler.output]
    return file, tracks


def test_mcap_and_bag_place_every_link_and_say_what_was_observed(folder: Path, motion: Motion) -> None:
    found: dict[str, dict[int, Any]] = {}
    with (folder / "motion.mcap").open("rb") as stream:
        for _, channel, raw, message in make_reader(stream, decoder_factories=[Ros2()]).iter_decoded_messages():
            found.setdefault(channel.topic, {})[round(raw.log_time * 60e-9 - 60 * START)] = message
    with AnyReader([folder / "motion_bag"]) as reader:
        kinds = {one.topic: (one.msgtype, one.msgcount) for one in reader.connections}
        bag = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/bands"]
    assert kinds["/tf"] == ("tf2_msgs/msg/TFMessage", len(found["/tf"]))
    assert kinds["/bands"] == ("rtof_kin_msgs/msg/Bands", T)
    np.testing.assert_array_equal([one.seen_by for one in bag], motion.poses.provenance)
    known = [t for t in range(T) if not UNKNOWN.start <= t < UNKNOWN.stop]
    assert list(found["/tf"]) == list(found["/joint_states"]) == known
    names, poses = list(motion.skeleton.names), motion.poses
    for t in known[::7]:
        state, p, R = found["/joint_states"][t], {"world": np.zeros(3)}, {"world": np.eye(3)}
        assert_near(state.position, motion.q[t, 7:], 0)
        assert list(state.name) == list(motion.skeleton.dof_names)
        for one in found["/tf"][t].transforms:
            parent, child, place = one.header.frame_id, one.child_frame_id, one.transform
            turn = [getattr(place.rotation, axis) for axis in "xyzw"]
            p[child] = p[parent] + R[parent] @ [getattr(place.translation, axis) for axis in "xyz"]
            R[child] = R[parent] @ Rotation.from_quat(turn).as_matrix()
        assert_near([p[name] for name in names], poses.p_world_joint[t], 1e-9)
        assert_near([R[name] for name in names], poses.R_world_bone[t], 1e-9)
    model = pin.buildModelFromXML(found["/robot_description"].popitem()[1].data)
    assert {frame.name for frame in model.frames} >= {*p} - {"world"}
    assert list(found["/bands"]) == list(range(T))
    seen = np.array([[*one.seen_by] for one in found["/bands"].values()])
    np.testing.assert_array_equal(seen, poses.provenance)
    np.testing.assert_array_equal([one.valid for one in found["/bands"].values()], poses.valid)
    knee = motion.skeleton.dof_names.index("LeftLeg_y")
    assert [one.observed[knee] for one in found["/bands"].values()][27:39] == [True, *[False] * 10, True]
    cloud = found["/joints"][LEG_UNSEEN.start]
    numbers = {7: "<f4", 2: "u1"}
    layout = {"names": [f.name for f in cloud.fields], "formats": [numbers[f.datatype] for f in cloud.fields]}
    points = np.frombuffer(bytes(cloud.data), np.dtype({**layout, "itemsize": cloud.point_step}))
    assert_near(points["z"], poses.p_world_joint[LEG_UNSEEN.start, :, 2])
    grey = points["rgb"].copy().view("u4") == 0x969696
    assert {name for name, own in zip(names, grey, strict=True) if own} == {*LEG}


def test_index_describes_every_file(folder: Path, motion: Motion) -> None:
    index = json.loads((folder / "files.json").read_text())
    written = {path.name for path in folder.iterdir()} - {"files.json", "joint_trajectory.json"}
    assert set(index["files"]) == written
    assert {facts["format"] for facts in index["files"].values()} == {"urdf", *FORMATS}
    gaps = [[BRIDGED.start, BRIDGED.stop], [UNKNOWN.start, UNKNOWN.stop]]
    assert (index["frames"], index["gaps"]) == (T, gaps)
    assert [index["files"][f"motion_{n}.mot"]["frames"] for n in (1, 2, 3)] == [list(s) for s in SEEN]
    assert index["files"]["motion_2.mot"]["time_zero_s"] == 0.0
    assert index["files"]["motion_2.bvh"]["time_zero_s"] == pytest.approx(motion.times[26])
    assert index["from_prior"] == {
        "RightHand": pytest.approx(4 / 51),
        "LeftLeg": pytest.approx(10 / 51),
        "LeftFoot": pytest.approx(10 / 51),
    }
    for ending in ("mot", "sto", "bvh"):
        assert index["files"][f"motion_2.{ending}"]["from_prior"] == {joint: pytest.approx(10 / 14) for joint in LEG}
        assert index["files"][f"motion_3.{ending}"]["dofs_from_prior"] == dict.fromkeys(WRIST, 1.0)
    unseen = index["landmarks_from_prior"] | index["dofs_from_prior"]
    assert unseen["LeftHandEnd"] == unseen["LeftHand_x"] == 1.0
    assert unseen["LeftToe"] == unseen["LeftLeg_y"] == pytest.approx(10 / 51)
    assert "LeftArm_x" not in unseen
    assert set(index["files"]["motion_2.mot"]["left_out"]) == WRIST
    assert index["dofs"]["RightUpLeg_y"]["opensim"] == "-hip_flexion_r"
    assert index["landmarks"]["RightHeel"] == "RightFoot"


def test_motion_without_gaps_is_one_file_of_each_format(motion: Motion, tmp_path: Path) -> None:
    write_motion_files(tmp_path, motion[:20], ("mot", "sto", "bvh", "ros"))
    assert {path.name for path in tmp_path.iterdir()} == {
        "files.json",
        "skeleton.urdf",
        "motion.mot",
        "motion.sto",
        "motion.bvh",
        "ros_joint_trajectory.json",
        "ros_base_trajectory.json",
    }


def test_c3d_with_any_first_time_states_its_offset(motion: Motion, tmp_path: Path) -> None:
    for start in (0.0252, -3.0, 1.7e9):
        poses = replace(motion.poses, times=start + np.arange(T) / 60)
        folder = tmp_path / str(start)
        folder.mkdir()
        write_motion_files(folder, replace(motion, poses=poses), ["c3d"])
        zero = json.loads((folder / "files.json").read_text())["files"]["motion.c3d"]["time_zero_s"]
        assert_near(read_c3d(folder / "motion.c3d").times + zero, poses.times, 1e-5)


def test_unknown_format_is_named_with_the_known_ones(motion: Motion, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="'mott'. Did you mean 'mot'.*parquet"):
        write_motion_files(tmp_path, motion, ["csv", "mott"])
    assert not list(tmp_path.iterdir())


def test_uneven_times_are_refused_by_formats_without_times(motion: Motion, tmp_path: Path) -> None:
    times = np.array(motion.times)
    times[7] += 0.004
    uneven = replace(motion, poses=replace(motion.poses, times=times))
    write_motion_files(tmp_path, uneven, DEFAULT)
    with pytest.raises(InvalidInputError, match="frame 7 is 4.0 ms .*resample"):
        write_motion_files(tmp_path, uneven, ["trc"])


def test_bridged_motion_has_nothing_for_opensim(motion: Motion, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"nothing for \.mot"):
        write_motion_files(tmp_path, motion[BRIDGED], ["mot"])


def test_parquet_extra(motion: Motion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(RtofError, match=r"\[parquet\]"):
        write_motion_files(tmp_path, motion, ["parquet"])


def test_columns_have_different_names_and_a_row_per_frame(motion: Motion) -> None:
    columns = motion_columns(motion)
    names = [column.name for column in columns]
    # A revolute LeftLeg_y and the y of the landmark LeftLeg are two things.
    assert len(set(names)) == len(names) == 1 + 7 + 60 + 3 * 33 + 2 * 21 + 1 + 60 + 12
    assert {len(column.values) for column in columns} == {60}
    assert {column.unit for column in columns} == {"s", "m", "1", "rad", ""}
    hip = columns[names.index("RightUpLeg_y")]
    assert hip.also == {"clinical": "-right hip flexion", "opensim": "-hip_flexion_r"}


def test_npz_has_the_arrays_of_the_result_and_is_read_as_a_motion(motion: Motion, folder: Path) -> None:
    with np.load(folder / "motion.npz") as arrays:
        assert arrays["names"].tolist() == list(motion.skeleton.names)
        assert_near(arrays["q"], motion.q)
    assert_near(Motion.load(folder / "motion.npz").poses.p_world_joint, motion.poses.p_world_joint)
