"""Motion capture carried over to the package's skeleton: planted postures, real walks, corpora."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted as planted_motions
import pytest

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh, write_bvh
from rtof_kin.formats.motion_views import joint_tree
from rtof_kin.simulation import mocap
from rtof_kin.simulation.mocap_families import (
    NAMES,
    PARENTS,
    lead_in,
    recognise_family,
    recognise_unit,
    restored_offsets,
)

DATA = Path(__file__).parents[1] / "fixtures" / "mocap"
WALK = DATA / "02_01_excerpt.bvh"  # at 30 Hz, its first frame an added T-pose
FILES = (WALK, DATA / "10_01_excerpt.bvh", DATA / "14_14_excerpt.bvh", DATA / "16_15.amc")
CMU_UNIT_M = 0.0254 / 0.45


def index(name):
    return NAMES.index(name)


def local(clip):
    return kinematics.local_rotations(PARENTS, clip.poses.R_world_bone)


@pytest.fixture
def planted(tmp_path):
    """A clip of one frame in which only the CMU bones named are turned, by degrees."""

    def plant(**angles):
        frame = (DATA / "16_15.amc").read_text().split("\n2\n")[0].splitlines()
        lines = []
        for line in frame:
            name, *words = line.split()
            if words:
                values = angles.get(name, [0] * len(words))
                line = " ".join([name, *map(str, values)])
            lines.append(line)
        path = tmp_path / "planted.amc"
        path.write_text("\n".join(lines) + "\n")
        return mocap.read_mocap(path, asf=DATA / "16.asf")

    return plant


@pytest.mark.parametrize(
    ("bone", "angles", "joint", "axis", "degrees"),
    [
        ("ltibia", [50], "LeftLeg", "y", 50),
        ("rtibia", [50], "RightLeg", "y", 50),
        ("lradius", [70], "LeftForeArm", "z", -70),
        ("rradius", [70], "RightForeArm", "z", 70),
        ("root", [0, 0, 0, 0, 90, 0], "Hips", "z", 90),
        ("root", [0, 0, 0, 20, 0, 0], "Hips", "y", 20),
        ("root", [0, 0, 0, 0, 0, 10], "Hips", "x", 10),
    ],
)
def test_a_planted_angle_is_found_about_the_axis_of_its_joint(planted, bone, angles, joint, axis, degrees):
    R = local(planted(**{bone: angles}))[0, index(joint)]
    np.testing.assert_allclose(R, so3.about_axis(axis, np.radians(degrees)), atol=1e-6)


@pytest.mark.parametrize(("bone", "joint", "spread"), [("lfemur", "Left", 20), ("rfemur", "Right", -20)])
def test_legs_spread_at_rest_are_spread(planted, bone, joint, spread):
    R = local(planted(**{bone: [-40, 0, 0]}))[0, index(joint + "UpLeg")]
    expected = so3.euler_to_matrix("xyz", np.radians([spread, -40, 0]))
    np.testing.assert_allclose(R, expected, atol=1e-6)


def test_the_root_moves_in_metres_with_z_up_and_its_rest_facing_x(planted):
    p = planted(root=[1, 2, 3, 0, 0, 0]).poses.p_world_joint[0]
    np.testing.assert_allclose(p[index("Hips")], np.array([3, 1, 2]) * CMU_UNIT_M, atol=1e-12)
    assert p[index("LeftArm"), 1] > p[index("RightArm"), 1]


def test_arms_that_hang_in_the_rest_pose_hang():
    path = DATA / "14_14_excerpt.bvh"
    motion = read_bvh(path)
    rest = replace(motion[:1], R_parent_joint=np.tile(np.eye(3), (1, len(motion.names), 1, 1)))
    clip = mocap.map_motion(rest, recognise_family(path, motion), CMU_UNIT_M, 120.0, "rest")
    p = clip.poses.p_world_joint[0]
    for side in ("Left", "Right"):
        arm = p[index(side + "Hand")] - p[index(side + "Arm")]
        np.testing.assert_allclose(so3.unit(arm), [0, 0, -1], atol=1e-9)
    # Thumbs point forward when arms hang from a T-pose with the palms down.
    R = clip.poses.R_world_bone[0]
    np.testing.assert_allclose(R[index("LeftHand")], so3.about_axis("x", -np.pi / 2), atol=1e-9)


def test_pronation_turns_the_hand_and_not_the_forearm(planted):
    flat, turned = planted(), planted(lwrist=[40])
    before, after = local(flat)[0], local(turned)[0]
    np.testing.assert_allclose(after[index("LeftForeArm")], np.eye(3), atol=1e-9)
    hand = after[index("LeftHand")] @ before[index("LeftHand")].T
    np.testing.assert_allclose(hand, so3.about_axis("y", np.radians(-40)), atol=1e-9)
    np.testing.assert_allclose(turned.poses.p_world_joint, flat.poses.p_world_joint, atol=1e-9)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_positions_are_exactly_rigid_and_limbs_lie_on_their_axes(path):
    clip = mocap.read_mocap(path)
    poses, offsets = clip.poses, clip.joint_offsets
    p = kinematics.positions(PARENTS, offsets, poses.p_world_joint[:, 0], poses.R_world_bone)
    np.testing.assert_allclose(p, poses.p_world_joint, atol=1e-9)
    for side, sign in (("Left", 1), ("Right", -1)):
        for joint in ("Leg", "Foot"):
            np.testing.assert_allclose(so3.unit(offsets[index(side + joint)]), [0, 0, -1], atol=1e-9)
        for joint in ("ForeArm", "Hand"):
            outward = so3.unit(offsets[index(side + joint)])
            np.testing.assert_allclose(outward, [0, sign, 0], atol=1e-9)
        assert sign * offsets[index(side + "UpLeg"), 1] > 0.05
        assert 0.6 < -offsets[index(side + "Leg"), 2] - offsets[index(side + "Foot"), 2] < 1.0
        arm = offsets[index(side + "ForeArm")] + offsets[index(side + "Hand")]
        assert sign * arm[1] > 0.4


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_joints_keep_the_positions_of_the_source(path):
    motion = read_asf_amc(DATA / "16.asf", path) if path.suffix == ".amc" else read_bvh(path)
    family = recognise_family(path, motion)
    unit_m = recognise_unit(path, motion, family)
    rigid = replace(motion, offsets=restored_offsets(motion, family))[lead_in(motion, family) :]
    p_source = rigid.forward_kinematics()[0][..., [2, 0, 1]] * unit_m
    p = mocap.read_mocap(path, output_rate_hz=None).poses.p_world_joint
    for m, (start, stop, share) in enumerate(family.at):
        a, b = p_source[:, motion.index(start)], p_source[:, motion.index(stop)]
        error = np.linalg.norm(p[:, m] - (a + share * (b - a)), axis=-1).max()
        of_leg = NAMES[m].endswith(("Hips", "Leg", "Foot"))
        assert error < (1e-9 if of_leg else 0.045), NAMES[m]


def test_a_walk_flexes_knees_about_y_and_goes_where_the_pelvis_faces():
    clip = mocap.read_mocap(WALK)
    for side in ("Left", "Right"):
        angles = np.degrees(so3.log(local(clip)[:, index(side + "Leg")]))
        assert np.abs(angles[:, [0, 2]]).max() < 1
        assert -1 < angles[:, 1].min() < 25
        assert 50 < angles[:, 1].max() < 75
    p = clip.poses.p_world_joint[:, 0]
    way = np.arctan2(*(p[-1] - p[0])[[1, 0]])
    facing = so3.heading(clip.poses.R_world_bone[:, 0]) - way
    assert abs(np.degrees(np.angle(np.exp(1j * facing).mean()))) < 15
    for joint, most in (("Hips", 10), ("Spine3", 10), ("Head", 30)):
        up = clip.poses.R_world_bone[:, index(joint), 2, 2]
        assert np.degrees(np.arccos(up)).max() < most


def test_frames_that_a_converter_added_are_left_out():
    assert len(mocap.read_mocap(WALK, output_rate_hz=None).poses) == len(read_bvh(WALK)) - 1
    assert len(mocap.read_mocap(DATA / "10_01_excerpt.bvh", output_rate_hz=None).poses) == 3
    motion = read_bvh(WALK)
    R = motion.R_parent_joint.copy()
    R[1:4] = np.eye(3)
    family = recognise_family(WALK, motion)
    assert lead_in(replace(motion, R_parent_joint=R), family) == 4


def test_the_unit_is_the_one_that_gives_a_human_leg():
    motion = read_bvh(WALK)
    family = recognise_family(WALK, motion)
    for unit_m in (1.0, 0.01, 0.0254, CMU_UNIT_M):
        scaled = replace(motion, offsets=motion.offsets * CMU_UNIT_M / unit_m)
        assert recognise_unit(WALK, scaled, family) == pytest.approx(unit_m)
    with pytest.raises(FileFormatError, match=r"legs are .* units long, human in no unit"):
        recognise_unit(WALK, replace(motion, offsets=motion.offsets * 300), family)
    forced = mocap.read_mocap(WALK, unit_m=2 * CMU_UNIT_M)
    plain = mocap.read_mocap(WALK)
    np.testing.assert_allclose(forced.joint_offsets, 2 * plain.joint_offsets, atol=1e-12)


def test_resampling_takes_every_nth_frame_or_interpolates_rigidly():
    fast = mocap.read_mocap(WALK, rate_hz=120, output_rate_hz=None).poses
    half = mocap.read_mocap(WALK, rate_hz=120, output_rate_hz=60).poses
    assert half.rate_hz == pytest.approx(60)
    np.testing.assert_array_equal(half.p_world_joint, fast.p_world_joint[::2])
    source = mocap.read_mocap(WALK, output_rate_hz=None)
    clip = mocap.resample_clip(source, 75.0)
    assert source.poses.rate_hz == pytest.approx(30.0, abs=1e-9)
    assert clip.poses.rate_hz == pytest.approx(75)
    shared = clip.poses.p_world_joint[::5]
    np.testing.assert_allclose(shared, source.poses.p_world_joint[::2][: len(shared)], atol=1e-9)
    R = clip.poses.R_world_bone
    p = kinematics.positions(PARENTS, clip.joint_offsets, clip.poses.p_world_joint[:, 0], R)
    np.testing.assert_allclose(p, clip.poses.p_world_joint, atol=1e-9)
    step, whole = (
        so3.angle_between(M[1, index("LeftLeg")], M[0, index("LeftLeg")]) for M in (R, source.poses.R_world_bone)
    )
    assert step / whole == pytest.approx(0.4, abs=0.05)


def test_a_skeleton_is_found_beside_its_motion(tmp_path):
    for name in ("16.asf", "gs_charleston.asf", "35_01.asf"):
        (tmp_path / name).touch()
    assert mocap.find_asf(tmp_path / "16_21.amc").name == "16.asf"
    assert mocap.find_asf(tmp_path / "gs_charleston2.amc").name == "gs_charleston.asf"
    assert mocap.find_asf(tmp_path / "35_01.amc").name == "35_01.asf"
    with pytest.raises(FileFormatError, match=r"no \.asf skeleton beside it; name one with asf="):
        mocap.find_asf(tmp_path / "17_01.amc")


@pytest.mark.parametrize("prefix", ["", "mixamorig:", "Actor_1_", "take|"])
def test_names_of_another_vendor_are_mapped_and_prefixes_removed(prefix, tmp_path):
    path, same = tmp_path / "vendor.bvh", mocap.read_mocap(WALK).poses.p_world_joint
    text = WALK.read_text().replace("ROOT ", f"ROOT {prefix}").replace("JOINT ", f"JOINT {prefix}")
    path.write_text(text)
    np.testing.assert_array_equal(mocap.read_mocap(path).poses.p_world_joint, same)
    path.write_text(text.replace(f"JOINT {prefix}LeftUpLeg", "JOINT thigh.L"))
    clip = mocap.read_mocap(path, names={"thigh.L": f"{prefix}LeftUpLeg"})
    np.testing.assert_array_equal(clip.poses.p_world_joint, same)
    with pytest.raises(UnknownNameError, match="unknown joint 'thigh.R'"):
        mocap.read_mocap(path, names={"thigh.R": "RightUpLeg"})


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("walk.fbx", "", "", r"read from \.bvh and \.amc files"),
        ("a.bvh", "LHipJoint", "Hip", r"unknown skeleton .*known families: cmu_bvh.*names=\.\.\."),
        ("b.bvh", "JOINT RightFoot", "JOINT RFoot", "family cmu_bvh without RightFoot"),
    ],
)
def test_unknown_files_and_skeletons_are_refused(name, old, new, message, tmp_path):
    (tmp_path / name).write_text(WALK.read_text().replace(old, new))
    with pytest.raises(FileFormatError, match=message):
        mocap.read_mocap(tmp_path / name)


@pytest.fixture
def corpus(tmp_path):
    """A folder of three recordings with an index."""
    (tmp_path / "cmu_amc").mkdir()
    shutil.copy(WALK, tmp_path / "walk.bvh")
    header, frame = (DATA / "16_15.amc").read_text().split("\n2\n")[0].split("\n1\n")
    still = "".join(f"\n{number}\n{frame}" for number in range(1, 13))
    (tmp_path / "cmu_amc" / "gs_backflip.amc").write_text(header + still + "\n")
    shutil.copy(DATA / "16.asf", tmp_path / "cmu_amc" / "gs_backflip.asf")
    (tmp_path / "index.csv").write_text(
        "file,subject,tc_like,fps,quality,note\n"
        "walk.bvh,CMU002,walking,15,max joint speed 4 m/s,slow\n"
        "cmu_amc/gs_backflip.asf,unknown,skeleton,,,\n"
        'cmu_amc/gs_backflip.amc,unknown,freestyle,120,"GLITCH, perhaps",\n'
    )
    return tmp_path


def test_a_corpus_has_the_labels_and_rates_of_its_index_and_a_floor(corpus):
    walk, flip = mocap.read_corpus(corpus, min_seconds=0)
    assert (walk.name, walk.subject, walk.category) == ("walk", "CMU002", "walking")
    assert (flip.subject, flip.category, flip.quality) == ("unknown", "freestyle", "GLITCH, perhaps")
    assert [clip.name for clip in mocap.read_corpus(corpus, {"CMU002"})] == ["walk"]
    frames = len(read_bvh(WALK)) - 1
    assert walk.poses.times[-1] == pytest.approx((frames - 1) / 15, abs=1 / 60)
    assert len(flip.poses) == 12  # all of them: corrected to 60 Hz
    for clip in (walk, flip):
        ankles = clip.poses.p_world_joint[:, [index("LeftFoot"), index("RightFoot")], 2]
        assert np.percentile(ankles.min(axis=1), 5) == pytest.approx(mocap.ANKLE_HEIGHT, abs=0.01)


def test_unknown_subjects_and_missing_columns_are_refused(corpus):
    with pytest.raises(UnknownNameError, match=r"unknown subject 'CMU003'\. Did you mean 'CMU002'"):
        list(mocap.read_corpus(corpus, ["CMU003"]))
    (corpus / "index.csv").write_text("file,subject,tc_like,quality\n")
    with pytest.raises(FileFormatError, match=r"index\.csv, line 1: no column fps"):
        list(mocap.read_corpus(corpus))


@pytest.mark.parametrize("height", [0.37, 0.8])  # 11 and 24 m/s, where the knee makes 2
def test_a_spike_is_cut_out_and_a_clean_clip_is_left_alone(height):
    clip = mocap.read_mocap(WALK, output_rate_hz=None)
    assert mocap.without_spikes(clip) == [clip]
    p = clip.poses.p_world_joint.copy()
    p[20, index("LeftLeg")] += [0, 0, height]
    spiked = replace(clip, poses=replace(clip.poses, p_world_joint=p))
    first, second = mocap.without_spikes(spiked)
    assert (first.name, second.name) == ("02_01_excerpt[0:18]", "02_01_excerpt[23:50]")
    np.testing.assert_array_equal(second.poses.p_world_joint, p[23:])
    assert second.poses.times[0] == 0


def test_fast_motion_of_the_body_and_flipped_segments_are_cut_out():
    clip = mocap.read_mocap(WALK, output_rate_hz=None)
    flight = np.interp(np.arange(len(clip.poses)), [15, 35], [0, 20 * 0.7])  # 21 m/s at 30 Hz
    p = clip.poses.p_world_joint + flight[:, None, None] * [0, 1, 0]
    pieces = mocap.without_spikes(replace(clip, poses=replace(clip.poses, p_world_joint=p)))
    assert [len(piece.poses) for piece in pieces] == [14, 13]
    fine = mocap.resample_clip(clip, 120.0)
    for whole, joint, frames, angle, lengths in (
        (clip, "Head", slice(20, 21), 2.5, [18, 27]),
        (fine, "LeftFoot", slice(40, 80), np.pi, [38, len(fine.poses) - 82]),
        (fine, "LeftHand", slice(40, 80), np.pi, [len(fine.poses)]),
    ):
        R = whole.poses.R_world_bone.copy()
        R[frames, index(joint)] = R[frames, index(joint)] @ so3.about_axis("z", angle)
        pieces = mocap.without_spikes(replace(whole, poses=replace(whole.poses, R_world_bone=R)))
        assert [len(piece.poses) for piece in pieces] == lengths, joint


def test_rest_poses_after_the_artificial_frame_are_left_out(tmp_path):
    lines = WALK.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    lines[first - 2] = f"Frames: {len(lines) - first + 9}"
    rest = " ".join("0" for _ in lines[first].split())
    (tmp_path / WALK.name).write_text("\n".join([*lines[: first + 1], *([rest] * 9), *lines[first + 1 :]]))
    longer, usual = (mocap.read_mocap(path).poses for path in (tmp_path / WALK.name, WALK))
    np.testing.assert_array_equal(longer.R_world_bone, usual.R_world_bone)


def test_the_own_export_comes_back_as_the_same_motion(tmp_path):
    motion = planted_motions.moving(SkeletonModel.default().with_height(1.9), 40)
    write_bvh(tmp_path / "motion.bvh", joint_tree(motion), len(motion.q))
    clip = mocap.read_mocap(tmp_path / "motion.bvh", output_rate_hz=None)
    assert clip.rig == "rtof_kin"
    np.testing.assert_allclose(clip.joint_offsets, motion.skeleton.joint_offsets, atol=1e-9)
    np.testing.assert_allclose(clip.poses.p_world_joint, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(clip.poses.R_world_bone, motion.poses.R_world_bone, atol=1e-9)
