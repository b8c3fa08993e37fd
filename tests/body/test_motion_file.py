"""``motion.h5``: round trip, frames, precision, and invalid files; `test_fuzz_readers` has damaged ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import npz_v1
import numpy as np
import planted
import pytest
from scene_support import walking

from rtof_kin.body.motion_file import (
    ABOUT,
    COLUMNS,
    NODE_SPACING,
    NODE_TOLERANCE,
    ROWS,
    MotionReader,
    MotionWriter,
    packed,
    write_motion,
)
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.hdf5 import read_arrays
from rtof_kin.data.confidence import WORLD, Confidence, per_axis
from rtof_kin.data.poses import Provenance

FRAMES = 300
BLOCKS = (1, 16, 97, 300)
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
    write_motion(tmp_path / "motion.h5", motion, first_frame=42, mode="rtof")
    return tmp_path / "motion.h5"


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
    """The same arrays in an .npz of an earlier version, some replaced; None leaves one out."""
    arrays, out = read_arrays(path) | changes, path.with_suffix(".npz")
    np.savez(out, **{name: value for name, value in arrays.items() if value is not None})
    return out


def test_written_motion_is_read_back(path: Path, motion: Motion) -> None:
    with MotionReader(path) as reader:
        assert (reader.first_frame, reader.mode, reader.skeleton.name) == (42, "rtof", "total_capture")
    for read in (Motion.load(path), Motion.load(changed(path))):
        np.testing.assert_allclose(read.q, motion.q, rtol=0, atol=3e-8)
        np.testing.assert_allclose(read.skeleton.joint_offsets, BODY.joint_offsets, atol=1e-12)
        assert (read.skeleton.dof_names, read.poses.names) == (BODY.dof_names, motion.poses.names)
        assert read.confidence is None
        for field in ("times", "provenance", "valid", "orientation_observed", "direction_observed"):
            np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
        p, R = read.skeleton.forward_kinematics(read.q)
        np.testing.assert_array_equal(p, read.poses.p_world_joint)
        np.testing.assert_array_equal(R, read.poses.R_world_bone)
        np.testing.assert_allclose(p, motion.poses.p_world_joint, rtol=0, atol=1e-6)
        with pytest.raises(ValueError, match="read-only"):
            read.q[0] = 0


def test_confidence_is_read_back(tmp_path: Path, confident: Motion) -> None:
    write_motion(tmp_path / "motion.h5", confident)
    given, read = confident.confidence, Motion.load(tmp_path / "motion.h5").confidence
    assert (read.pairs, read.names) == (given.pairs, given.names)
    for field in ("position_covariance", "relative_covariance", "turn_covariance"):
        exact, found = getattr(given, field), getattr(read, field)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
        np.testing.assert_allclose(per_axis(found), per_axis(exact), rtol=NODE_TOLERANCE)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"confidence_pairs": np.array(["world", "Hips"])}, "confidence_pairs"),
        ({"confidence_pairs": np.array([["world", "Hip"]] * 21)}, "pairs 'Hip'"),
        ({"turn_covariance": None}, "'turn_covariance' is missing"),
        ({"position_covariance": np.zeros((12, 20, 6))}, "position_covariance: expected shape"),
        ({"position_covariance": np.zeros((12, 21, 5))}, "shape mismatch"),
        ({"covariance_frames": np.array([*range(11), 10])}, "do not increase from 0 to 11"),
        ({"covariance_frames": np.array([0, 11])}, "arrays of different lengths"),
        ({"covariance_frames": None}, "'covariance_frames' is missing"),
    ],
)
def test_invalid_confidence(tmp_path: Path, confident: Motion, changes: dict[str, Any], message: str) -> None:
    write_motion(tmp_path / "motion.h5", confident)
    with pytest.raises(FileFormatError, match=message):
        Motion.load(changed(tmp_path / "motion.h5", **changes))


def test_h5py_alone_can_read_it(path: Path, motion: Motion) -> None:
    with h5py.File(path) as file:
        assert file.attrs["mode"] == b"rtof"
        assert [name.decode() for name in file.attrs["names"]] == list(BODY.names)
        np.testing.assert_allclose(file["q"][3:5], motion.q[3:5], rtol=0, atol=3e-8)
        for name, dataset in file.items():
            assert {key: text.decode() for key, text in dataset.attrs.items()} == ABOUT[name]
    kinds = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in Provenance)
    assert ABOUT["provenance"]["shape"] == f"(T, J): {kinds}"


@pytest.mark.parametrize("named", ["motion", "confident"])
def test_file_of_version_1_is_read(tmp_path: Path, named: str, request: pytest.FixtureRequest) -> None:
    motion = request.getfixturevalue(named)
    npz_v1.write_motion(tmp_path / "m.npz", motion)
    with MotionReader(tmp_path / "m.npz") as file:
        read = file.read()
        assert (file.first_frame, file.mode) == (42, "rtof")
        np.testing.assert_array_equal(file.root(3, 9)[0], motion.poses.p_world_joint[3:9, 0])
    np.testing.assert_array_equal(read.q, motion.q)
    for field in ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "direction_observed"):
        np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
    if motion.confidence:
        expected = motion.confidence.turn_covariance
        np.testing.assert_allclose(read.confidence.turn_covariance, expected, rtol=1e-6)
    else:
        assert read.confidence is None
    older = changed(tmp_path / "m.npz", direction_observed=None)  # before this array existed
    assert not Motion.load(older).poses.direction_observed.any()


def test_mass_and_sex_are_kept_and_may_be_absent(path: Path) -> None:
    table = Motion.load(path).skeleton.table
    assert (table.mass_kg, table.sex) == (82.0, "female")
    table = Motion.load(changed(path, mass_kg=None, sex=None)).skeleton.table
    assert (table.mass_kg, table.sex) == (SkeletonModel.default().table.mass_kg, None)


def test_gaps_are_kept(tmp_path: Path, motion: Motion) -> None:
    p, R, q = (np.array(a) for a in (motion.poses.p_world_joint, motion.poses.R_world_bone, motion.q))
    p[3], R[3], q[3] = np.nan, np.nan, np.nan
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    write_motion(tmp_path / "m.h5", replace(motion, q=q, poses=poses))
    read = Motion.load(tmp_path / "m.h5")
    np.testing.assert_allclose(read.q, q, rtol=0, atol=3e-8)
    assert not read.poses.valid[3].any()


@pytest.mark.parametrize(
    "name", ["schema_version", "times", "q", "provenance", "direction_observed", "names", "skeleton"]
)
def test_missing_array_is_named(path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=f"'{name}' is missing"):
        Motion.load(changed(path, **{name: None}))


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("schema_version", np.array(99), "99 is newer than 2; update"),
        ("q", np.zeros((12, 5)), r"q: expected shape \(12, 67\), got \(12, 5\)"),
        ("q", np.ones((12, 67)), "frames 0 to 12: q: the root quaternion"),
        ("times", np.zeros(12), "time does not increase"),
        ("valid", np.ones((12, 20), dtype=bool), r"valid: expected shape \(12, 21\)"),
        ("valid", np.ones((11, 21), dtype=bool), "arrays of different lengths"),
        ("provenance", np.full((12, 21), 9, dtype=np.uint8), "a value is not one of"),
        ("poses_stored", np.ones(12, dtype=bool), "'p_world_joint' is missing"),
        ("joint_offsets", np.zeros((20, 3)), r"joint_offsets: expected shape \(21, 3\)"),
        ("names", np.array(["Hips"] * 21), "Hips"),
        ("dof_names", np.array(["a"]), "dof_names: are not those"),
        ("mode", np.array({"code": len}, dtype=object), "mode: has type object"),
    ],
)
def test_invalid_array_is_refused_with_the_file(path: Path, name: str, value: Any, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"motion\.npz: .*{message}"):
        Motion.load(changed(path, **{name: value}))


@pytest.fixture(scope="module")
def walk() -> Motion:
    """A walk whose confidence varies, jumps, and is unknown of some joints for a while."""
    motion = walking(FRAMES, shaking=0.2)
    rng, known = np.random.default_rng(0), motion.confidence
    assert known is not None
    size = np.exp(np.cumsum(0.02 * rng.normal(size=(FRAMES, 21)), axis=0))
    size[140:, 4] *= 9.0
    position = known.position_covariance * size[..., None, None]
    relative = known.relative_covariance * size[..., None, None]
    turn = known.turn_covariance * size[:, :2, None, None]
    position[50:77, 3] = relative[50:77, 3] = turn[33, 1] = np.nan
    confidence = Confidence(motion.times, known.names, position, relative, known.pairs, turn)
    return replace(motion, confidence=confidence)


def assert_same(found: Motion, expected: Motion) -> None:
    for name in ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed"):
        np.testing.assert_array_equal(getattr(found.poses, name), getattr(expected.poses, name), name)
    np.testing.assert_array_equal(found.q, expected.q)
    assert found.confidence.pairs == expected.confidence.pairs
    for name in ("position_covariance", "relative_covariance", "turn_covariance"):
        a, b = getattr(found.confidence, name), getattr(expected.confidence, name)
        np.testing.assert_allclose(a, b, rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("size", BLOCKS)
def test_numbers_do_not_depend_on_the_blocks_they_were_written_in(walk: Motion, tmp_path: Path, size: int) -> None:
    for name, step in (("whole", FRAMES), ("a", size), ("b", size)):
        with MotionWriter(tmp_path / f"{name}.h5", walk.skeleton, mode="rtof", first_frame=7) as writer:
            for start in range(0, FRAMES, step):
                writer.append(walk[start : start + step])
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    found, whole = read_arrays(tmp_path / "a.h5"), read_arrays(tmp_path / "whole.h5")
    assert set(found) == set(whole)
    for name in found:
        np.testing.assert_array_equal(found[name], whole[name])


@pytest.mark.parametrize("version", [1, 2])
def test_slice_of_a_motion_is_part_of_the_whole(walk: Motion, tmp_path: Path, version: int) -> None:
    path = tmp_path / ("m.npz" if version == 1 else "m.h5")
    (npz_v1.write_motion if version == 1 else write_motion)(path, walk)
    whole = Motion.load(path)
    with MotionReader(path) as reader:
        assert (len(reader), reader.rate_hz) == (FRAMES, pytest.approx(walk.poses.rate_hz))
        for start, stop in [(290, 300), (0, 1), (40, 100), (140, 141), (0, 300)]:
            assert_same(reader.read(start, stop), whole[start:stop])
            p, provenance = reader.root(start, stop)
            np.testing.assert_array_equal(p, whole.poses.p_world_joint[start:stop, 0])
            np.testing.assert_array_equal(provenance, whole.poses.provenance[start:stop, 0])
        assert reader.read(5, 9, confidence=False).confidence is None
        for start, stop in ((-1, 3), (3, 3), (299, 301)):
            with pytest.raises(InvalidInputError, match="it has 300"):
                reader.read(start, stop)
    assert_same(Motion.load(path, 40, 100), whole[40:100])


def test_covariances_are_near_and_unknown_where_they_were(walk: Motion, tmp_path: Path) -> None:
    write_motion(tmp_path / "m.h5", walk)
    exact, found = walk.confidence, Motion.load(tmp_path / "m.h5").confidence
    assert exact is not None
    assert found is not None
    for name in ("position_covariance", "relative_covariance", "turn_covariance"):
        a, b = getattr(found, name), getattr(exact, name)
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b), name)
        np.testing.assert_allclose(per_axis(a), per_axis(b), rtol=NODE_TOLERANCE + 0.004, err_msg=name)
    arrays = read_arrays(tmp_path / "m.h5")
    at = arrays["covariance_frames"]
    assert np.diff(at).max() <= NODE_SPACING
    assert {139, 140} <= set(at.tolist())  # the jump
    assert {49, 50, 76, 77, 32, 33, 34} <= set(at.tolist())


def test_rounded_covariances_stay_valid_and_are_rounded_once() -> None:
    rng = np.random.default_rng(0)
    thin = rng.normal(size=(5000, 3, 2))
    matrices = thin @ np.swapaxes(thin, -1, -2)  # of rank two
    entries = matrices[..., ROWS, COLUMNS][:, None]
    once = packed(entries)
    back = np.empty((5000, 1, 3, 3))
    back[..., (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)] = back[..., (0, 1, 2, 1, 2, 2), (0, 1, 2, 0, 0, 1)] = once
    Confidence(np.arange(5000.0), ("a",), back, back, ((WORLD, "a"),), back)  # raises if one is not
    np.testing.assert_allclose(per_axis(back[:, 0]), per_axis(matrices), rtol=0.006)
    np.testing.assert_array_equal(packed(once.astype(float)), once)


@pytest.mark.parametrize("size", BLOCKS)
def test_poses_that_do_not_follow_from_the_angles_are_kept(walk: Motion, tmp_path: Path, size: int) -> None:
    p, R = walk.poses.p_world_joint.copy(), walk.poses.R_world_bone.copy()
    p[120:130, 6] += 0.02
    R[200, 3] = so3.exp([0.1, 0.0, 0.0]) @ R[200, 3]
    p[250:260], R[250:260] = np.nan, np.nan  # the angles stay
    moved = replace(walk, poses=replace(walk.poses, p_world_joint=p, R_world_bone=R, valid=None))
    with MotionWriter(tmp_path / "m.h5", walk.skeleton) as writer:
        for start in range(0, FRAMES, size):
            writer.append(moved[start : start + size])
    found = Motion.load(tmp_path / "m.h5")
    np.testing.assert_allclose(found.poses.p_world_joint, p, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.poses.R_world_bone, R, rtol=0, atol=1e-6)
    arrays = read_arrays(tmp_path / "m.h5")
    assert np.flatnonzero(arrays["poses_stored"]).tolist() == [*range(120, 130), 200, *range(250, 260)]
    with MotionReader(tmp_path / "m.h5") as reader:
        np.testing.assert_allclose(reader.root(0, FRAMES)[0], p[:, 0], rtol=0, atol=1e-6)


def test_joints_far_from_the_origin_are_as_precise(tmp_path: Path) -> None:
    """Accelerations at 200 Hz, which are the second derivatives of what was rounded."""
    skeleton = SkeletonModel.default()
    times = np.arange(200) / 200.0
    q = np.tile(skeleton.n_pose(), (200, 1))
    q[:, :3] += np.array([100.0, -100.0, 1.0]) + np.outer(np.sin(6 * times), [1.0, 2.0, 0.1])
    q[:, 7:] += 0.4 * np.sin(7 * times)[:, None]
    p, R = skeleton.forward_kinematics(q)
    poses = planted.moving(skeleton, 200).poses
    poses = replace(poses, times=times, p_world_joint=p, R_world_bone=R)
    motion = Motion(skeleton, q, poses, skeleton.check(q))
    write_motion(tmp_path / "m.h5", motion)
    found = Motion.load(tmp_path / "m.h5")
    np.testing.assert_allclose(found.poses.p_world_joint, p, rtol=0, atol=1e-6)
    exact, read = (np.diff(points, 2, axis=0) * 200.0**2 for points in (p, found.poses.p_world_joint))
    np.testing.assert_allclose(read, exact, rtol=0, atol=0.02)  # m/s^2, of 80
    assert np.sqrt(np.mean((read - exact) ** 2)) < 0.005


@pytest.mark.parametrize("what", ["body", "times", "confidence", "nothing"])
def test_frames_that_do_not_continue_are_refused(walk: Motion, tmp_path: Path, what: str) -> None:
    other = {
        "body": lambda: walking(4, start=99.0),
        "times": lambda: walk[100:110],
        "confidence": lambda: replace(walk[200:210], confidence=None),
    }
    message = {
        "body": "another body",
        "times": "do not follow",
        "confidence": "another confidence",
        "nothing": "at least one frame",
    }[what]
    with pytest.raises(InvalidInputError, match=message), MotionWriter(tmp_path / "m.h5", walk.skeleton) as writer:
        if what != "nothing":
            writer.append(walk[:200])
            made = other[what]()
            writer.append(replace(made, skeleton=made.skeleton.with_height(1.5)) if what == "body" else made)
    assert not list(tmp_path.iterdir())
