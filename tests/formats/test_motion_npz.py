"""``motion.npz``: round trip, and invalid files; `test_fuzz_readers` has damaged archives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import npz_v1
import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.confidence import WORLD, Confidence, per_axis
from rtof_kin.body.covariance_nodes import TOLERANCE
from rtof_kin.body.motion_file import SCHEMA_VERSION, read_motion_npz
from rtof_kin.body.motion_file import write_motion

BODY = SkeletonModel.default().with_height(1.82).with_mass(82.0, "female")


@pytest.fixture(scope="module")
def motion() -> Motion:
    motion = planted.moving(BODY, 12)
    poses = replace(
        motion.poses,
        provenance=np.random.default_rng(0).integers(0, 6, (12, 21), dtype=np.uint8),
        valid=np.broadcast_to(np.arange(12)[:, None] % 3 > 0, (12, 21)),
        orientation_observed=np.arange(21) % 2 == 0,
        direction_observed=np.arange(21) % 5 == 0,
    )
    return replace(motion, poses=poses)


@pytest.fixture
def path(tmp_path: Path, motion: Motion) -> Path:
    write_motion(tmp_path / "motion.npz", motion, first_frame=42, mode="rtof")
    return tmp_path / "motion.npz"


@pytest.fixture
def confident(motion: Motion) -> Motion:
    """The motion with a confidence, unknown in one frame."""
    T, J = motion.poses.p_world_joint.shape[:2]
    root = np.random.default_rng(0).normal(size=(3, T, J, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2)
    covariance[:, 3] = np.nan
    pairs = tuple((WORLD, name) for name in BODY.names)
    position, relative, turn = covariance
    return replace(motion, confidence=Confidence(motion.times, BODY.names, position, relative, pairs, turn))


def changed(path: Path, **changes: Any) -> Path:
    """The same file with some arrays replaced; None leaves one out."""
    with np.load(path) as archive:
        arrays = dict(archive) | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_written_motion_is_read_back(path: Path, motion: Motion) -> None:
    read = read_motion_npz(path)
    np.testing.assert_allclose(read.q, motion.q, rtol=0, atol=3e-8)
    np.testing.assert_array_equal(read.joint_offsets, BODY.joint_offsets)
    assert (read.first_frame, read.mode, read.skeleton) == (42, "rtof", "total_capture")
    assert (read.dof_names, read.poses.names) == (BODY.dof_names, motion.poses.names)
    assert read.motion().confidence is None
    for field in ("times", "provenance", "valid", "orientation_observed", "direction_observed"):
        np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
    np.testing.assert_allclose(read.poses.p_world_joint, motion.poses.p_world_joint, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.poses.R_world_bone, motion.poses.R_world_bone, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        read.q[0] = 0


def test_confidence_is_read_back(tmp_path: Path, confident: Motion) -> None:
    write_motion(tmp_path / "motion.npz", confident)
    given, read = confident.confidence, read_motion_npz(tmp_path / "motion.npz").motion().confidence
    assert (read.pairs, read.names) == (given.pairs, given.names)
    for field in ("position_covariance", "relative_covariance", "turn_covariance"):
        exact, found = getattr(given, field), getattr(read, field)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
        np.testing.assert_allclose(per_axis(found), per_axis(exact), rtol=TOLERANCE)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"confidence_pairs": np.array(["world", "Hips"])}, "confidence_pairs"),
        ({"confidence_pairs": np.array([["world", "Hip"]] * 21)}, "pairs 'Hip'"),
        ({"turn_covariance": None}, "'turn_covariance' is missing"),
        ({"position_covariance": np.zeros((12, 20, 6))}, "position_covariance: expected shape"),
        ({"position_covariance": np.zeros((12, 21, 5))}, "shape mismatch"),
        ({"covariance_frames": np.array([*range(11), 10])}, "do not increase from 0 to 11"),
        ({"covariance_frames": np.array([0, 11])}, "covariance_frames: 2 for 12 rows"),
        ({"covariance_frames": None}, "'covariance_frames' is missing"),
    ],
)
def test_invalid_confidence(tmp_path: Path, confident: Motion, changes: dict[str, Any], message: str) -> None:
    write_motion(tmp_path / "motion.npz", confident)
    with pytest.raises(FileFormatError, match=message):
        read_motion_npz(changed(tmp_path / "motion.npz", **changes))


def test_numpy_alone_can_read_it(path: Path, motion: Motion) -> None:
    with np.load(path, allow_pickle=False) as archive:
        assert int(archive["schema_version"]) == SCHEMA_VERSION
        assert archive["names"].tolist() == list(BODY.names)
        np.testing.assert_allclose(archive["q"], motion.q, rtol=0, atol=3e-8)


@pytest.mark.parametrize("named", ["motion", "confident"])
def test_file_of_version_1_is_read(tmp_path: Path, named: str, request: pytest.FixtureRequest) -> None:
    motion = request.getfixturevalue(named)
    npz_v1.write_motion(tmp_path / "m.npz", motion)
    file = read_motion_npz(tmp_path / "m.npz")
    read = file.motion()
    assert (file.first_frame, file.mode) == (42, "rtof")
    np.testing.assert_array_equal(read.q, motion.q)
    for field in ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "direction_observed"):
        np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
    if motion.confidence:
        expected = motion.confidence.turn_covariance
        np.testing.assert_allclose(read.confidence.turn_covariance, expected, rtol=1e-6)
    else:
        assert read.confidence is None
    older = changed(tmp_path / "m.npz", direction_observed=None)  # before this array existed
    assert not read_motion_npz(older).poses.direction_observed.any()


def test_motion_of_the_file_is_on_the_subjects_skeleton(path: Path) -> None:
    motion = read_motion_npz(path).motion()
    np.testing.assert_allclose(motion.skeleton.joint_offsets, BODY.joint_offsets, atol=1e-12)
    p, R = motion.skeleton.forward_kinematics(motion.q)
    np.testing.assert_array_equal(p, motion.poses.p_world_joint)
    np.testing.assert_array_equal(R, motion.poses.R_world_bone)


def test_mass_and_sex_are_kept_and_may_be_absent(path: Path) -> None:
    table = read_motion_npz(path).motion().skeleton.table
    assert (table.mass_kg, table.sex) == (82.0, "female")
    table = read_motion_npz(changed(path, mass_kg=None, sex=None)).motion().skeleton.table
    assert (table.mass_kg, table.sex) == (SkeletonModel.default().table.mass_kg, None)


def test_gaps_are_kept(tmp_path: Path, motion: Motion) -> None:
    p, R, q = (np.array(a) for a in (motion.poses.p_world_joint, motion.poses.R_world_bone, motion.q))
    p[3], R[3], q[3] = np.nan, np.nan, np.nan
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    write_motion(tmp_path / "m.npz", replace(motion, q=q, poses=poses))
    read = read_motion_npz(tmp_path / "m.npz")
    np.testing.assert_allclose(read.q, q, rtol=0, atol=3e-8)
    assert not read.poses.valid[3].any()


def test_skeleton_is_found_by_name(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.human36m(), 4)
    write_motion(tmp_path / "m.npz", motion)
    read = read_motion_npz(tmp_path / "m.npz")
    assert read.motion().skeleton.names == motion.skeleton.names
    changed(tmp_path / "m.npz", skeleton=np.array("horse"))
    with pytest.raises(FileFormatError, match="'horse'"):
        read_motion_npz(tmp_path / "m.npz")


ARRAYS = (
    "schema_version",
    "times",
    "q",
    "valid",
    "provenance",
    "orientation_observed",
    "direction_observed",
    "names",
    "dof_names",
    "joint_offsets",
    "first_frame",
    "mode",
    "skeleton",
)


@pytest.mark.parametrize("name", ARRAYS)
def test_missing_array_is_named(path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=f"'{name}' is missing"):
        read_motion_npz(changed(path, **{name: None}))


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("schema_version", np.array(99), "99 is newer than 2; update"),
        ("schema_version", np.array("one"), "invalid literal"),
        ("q", np.zeros((12, 5)), r"q: expected shape \(12, 67\), got \(12, 5\)"),
        ("q", np.full((12, 67), "x"), "q: no table of numbers"),
        ("q", np.ones((12, 67)), "frames 0 to 12: q: the root quaternion"),
        ("q", np.full((12, 67), 1e30), "q: holds a number beyond"),
        ("times", np.zeros(12), "time does not increase"),
        ("valid", np.ones((12, 20), dtype=bool), r"valid: expected shape \(12, 21\)"),
        ("valid", np.ones((11, 21), dtype=bool), "arrays of different lengths"),
        ("provenance", np.full((12, 21), 9, dtype=np.uint8), "a value is not one of"),
        ("poses_stored", np.ones(12, dtype=bool), "'p_world_joint' is missing"),
        ("joint_offsets", np.zeros((20, 3)), r"joint_offsets: expected shape \(21, 3\)"),
        ("names", np.array(["Hips"] * 21), "Hips"),
        ("dof_names", np.array(["a"]), "q: expected shape"),
        ("first_frame", np.arange(3), ""),
        ("mode", np.array({"code": print}, dtype=object), "mode: has type object"),
    ],
)
def test_invalid_array_is_refused_with_the_file(path: Path, name: str, value: Any, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"motion\.npz: .*{message}"):
        read_motion_npz(changed(path, **{name: value}))
