"""``motion.npz``: round trip, and invalid files; `test_fuzz_readers` has damaged archives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.observability import observed_dofs
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.formats.motion_npz import SCHEMA_VERSION, read_motion_npz, write_motion_npz

BODY = SkeletonModel.default().with_height(1.82)


@pytest.fixture(scope="module")
def motion() -> MotionSequence:
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
def path(tmp_path: Path, motion: MotionSequence) -> Path:
    write_motion_npz(tmp_path / "motion.npz", motion, first_frame=42, mode="rtof")
    return tmp_path / "motion.npz"


@pytest.fixture
def confident(motion: MotionSequence) -> MotionSequence:
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


def test_written_motion_is_read_back(path: Path, motion: MotionSequence) -> None:
    read = read_motion_npz(path)
    np.testing.assert_array_equal(read.q, motion.q)
    np.testing.assert_array_equal(read.joint_offsets, BODY.joint_offsets)
    np.testing.assert_array_equal(read.singular, motion.report.singular)
    assert (read.first_frame, read.mode, read.skeleton) == (42, "rtof", "total_capture")
    assert (read.dof_names, read.poses.names) == (BODY.dof_names, motion.poses.names)
    assert read.motion().confidence is None
    for field in (
        "times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed",
        "direction_observed",
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
    with pytest.raises(ValueError, match="read-only"):
        read.q[0] = 0


def test_confidence_is_read_back_to_single_precision(tmp_path: Path, confident: MotionSequence) -> None:
    write_motion_npz(tmp_path / "motion.npz", confident)
    given, read = confident.confidence, read_motion_npz(tmp_path / "motion.npz").motion().confidence
    assert (read.pairs, read.names) == (given.pairs, given.names)
    for field in ("position_covariance", "relative_covariance", "turn_covariance"):
        np.testing.assert_allclose(getattr(read, field), getattr(given, field), rtol=1e-6)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"confidence_pairs": np.array(["world", "Hips"])}, "confidence_pairs"),
        ({"confidence_pairs": np.array([["world", "Hip"]] * 21)}, "pairs 'Hip'"),
        ({"turn_covariance": None}, "'turn_covariance' is missing"),
        ({"position_covariance": np.zeros((12, 20, 3, 3))}, "position_covariance: expected shape"),
    ],
)
def test_invalid_confidence(
    tmp_path: Path, confident: MotionSequence, changes: dict[str, Any], message: str
) -> None:
    write_motion_npz(tmp_path / "motion.npz", confident)
    with pytest.raises(FileFormatError, match=message):
        read_motion_npz(changed(tmp_path / "motion.npz", **changes))


def test_numpy_alone_can_read_it(path: Path, motion: MotionSequence) -> None:
    with np.load(path, allow_pickle=False) as archive:
        assert int(archive["schema_version"]) == SCHEMA_VERSION
        assert archive["names"].tolist() == list(BODY.names)
        np.testing.assert_array_equal(archive["dof_observed"], observed_dofs(motion))


def test_file_without_observed_directions_is_read(path: Path) -> None:
    assert not read_motion_npz(changed(path, direction_observed=None)).poses.direction_observed.any()


def test_motion_of_the_file_is_on_the_subjects_skeleton(path: Path) -> None:
    motion = read_motion_npz(path).motion()
    np.testing.assert_allclose(motion.skeleton.joint_offsets, BODY.joint_offsets, atol=1e-12)
    p, R = motion.skeleton.forward_kinematics(motion.q)
    np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(R, motion.poses.R_world_bone, atol=1e-9)


def test_gaps_are_kept(tmp_path: Path, motion: MotionSequence) -> None:
    p, R, q = (np.array(a) for a in (motion.poses.p_world_joint, motion.poses.R_world_bone, motion.q))
    p[3], R[3], q[3] = np.nan, np.nan, np.nan
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    write_motion_npz(tmp_path / "m.npz", replace(motion, q=q, poses=poses))
    read = read_motion_npz(tmp_path / "m.npz")
    np.testing.assert_array_equal(read.q, q)
    assert not read.poses.valid[3].any()


def test_skeleton_is_found_by_name(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.human36m(), 4)
    write_motion_npz(tmp_path / "m.npz", motion)
    read = read_motion_npz(tmp_path / "m.npz")
    assert read.motion().skeleton.names == motion.skeleton.names
    changed(tmp_path / "m.npz", skeleton=np.array("horse"))
    with pytest.raises(UnknownNameError, match="'horse'"):
        read_motion_npz(tmp_path / "m.npz").motion()


ARRAYS = (
    "schema_version", "times", "q", "p_world_joint", "R_world_bone", "valid", "provenance",
    "orientation_observed", "singular", "names", "dof_names", "joint_offsets", "first_frame",
    "mode", "skeleton",
)  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_missing_array_is_named(path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=f"'{name}' is missing"):
        read_motion_npz(changed(path, **{name: None}))


@pytest.mark.parametrize("name, value, message", [
    ("schema_version", np.array(99), "99 is newer than 1; update"),
    ("schema_version", np.array("one"), "invalid literal"),
    ("q", np.zeros((12, 5)), r"q: expected shape \(12, 67\), got \(12, 5\)"),
    ("q", np.full((12, 67), "x"), "q: not an array of numbers"),
    ("q", np.full((12, 67), 1e30), "q: holds a number beyond"),
    ("times", np.zeros(12), "time does not increase"),
    ("p_world_joint", np.zeros((12, 20, 3)), r"p_world_joint: expected shape \(12, 21, 3\)"),
    ("R_world_bone", np.zeros((12, 21, 3, 3)), "rotation"),
    ("joint_offsets", np.zeros((20, 3)), r"joint_offsets: expected shape \(21, 3\)"),
    ("singular", np.zeros((12, 3), dtype=bool), r"singular: expected shape \(12, 21\)"),
    ("names", np.array(["Hips"] * 21), "Hips"),
    ("dof_names", np.array(["a"]), "q: expected shape"),
    ("first_frame", np.arange(3), ""),
    ("mode", np.array({"code": print}, dtype=object), "mode: has type object"),
])  # fmt: skip
def test_invalid_array_is_refused_with_the_file(path: Path, name: str, value: Any, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"motion\.npz: .*{message}"):
        read_motion_npz(changed(path, **{name: value}))
