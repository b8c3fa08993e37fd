"""``motion.npz``: round trip, and files that are not what they claim."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.observability import observed_dofs
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.poses import Provenance
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


def known(motion: MotionSequence, seed: int = 0) -> MotionSequence:
    """The motion with a confidence, of which a frame is not known."""
    T, J = motion.poses.p_world_joint.shape[:2]
    root = np.random.default_rng(seed).normal(size=(3, T, J, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2)
    covariance[:, 3] = np.nan
    pairs = tuple((WORLD, name) for name in BODY.names)
    return replace(motion, confidence=Confidence(
        motion.times, BODY.names, covariance[0], covariance[1], pairs, covariance[2]
    ))  # fmt: skip


def test_a_confidence_comes_back_to_single_precision(tmp_path: Path, motion: MotionSequence) -> None:
    given = known(motion).confidence
    assert given is not None
    write_motion_npz(tmp_path / "motion.npz", known(motion))
    read = read_motion_npz(tmp_path / "motion.npz").motion().confidence
    assert read is not None
    assert (read.pairs, read.names) == (given.pairs, given.names)
    for field in ("position_covariance", "relative_covariance", "turn_covariance"):
        np.testing.assert_allclose(getattr(read, field), getattr(given, field), rtol=1e-6)


def test_a_file_without_confidence_has_none(path: Path) -> None:
    assert read_motion_npz(path).motion().confidence is None


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"confidence_pairs": np.array(["world", "Hips"])}, "confidence_pairs: expected pairs of names"),
        ({"confidence_pairs": np.array([["world", "Hip"]] * 21)}, "unknown segment in .* pairs 'Hip'"),
        ({"turn_covariance": None}, "the array 'turn_covariance' is missing"),
        ({"position_covariance": np.zeros((12, 20, 3, 3))}, "position_covariance: expected shape"),
        ({"relative_covariance": np.full((12, 21, 3, 3), -1.0)}, "a variance is negative"),
    ],
)  # fmt: skip
def test_a_confidence_that_is_damaged_is_refused(
    tmp_path: Path, motion: MotionSequence, changes: dict[str, Any], message: str
) -> None:
    write_motion_npz(tmp_path / "motion.npz", known(motion))
    with pytest.raises(FileFormatError, match=message):
        read_motion_npz(changed(tmp_path / "motion.npz", **changes))


@pytest.fixture
def path(tmp_path: Path, motion: MotionSequence) -> Path:
    write_motion_npz(tmp_path / "motion.npz", motion, first_frame=42, mode="rtof")
    return tmp_path / "motion.npz"


def changed(path: Path, **changes: Any) -> Path:
    """The same file with some arrays other than they were; None leaves one out."""
    with np.load(path) as archive:
        arrays = dict(archive) | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_what_was_written_is_read(path: Path, motion: MotionSequence) -> None:
    read = read_motion_npz(path)
    np.testing.assert_array_equal(read.q, motion.q)
    np.testing.assert_array_equal(read.joint_offsets, BODY.joint_offsets)
    np.testing.assert_array_equal(read.singular, motion.report.singular)
    assert (read.first_frame, read.mode, read.skeleton) == (42, "rtof", "total_capture")
    assert read.dof_names == BODY.dof_names
    assert read.poses.names == motion.poses.names
    for field in (
        "times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed",
        "direction_observed",
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(read.poses, field), getattr(motion.poses, field), field)
    assert Provenance(read.poses.provenance[0, 0]) in Provenance


def test_the_file_says_which_degrees_of_freedom_were_observed(path: Path, motion: MotionSequence) -> None:
    with np.load(path) as arrays:
        observed = arrays["dof_observed"]
    np.testing.assert_array_equal(observed, observed_dofs(motion))
    assert 0 < observed.mean() < 1


def test_a_file_from_before_directions_is_read(path: Path) -> None:
    assert not read_motion_npz(changed(path, direction_observed=None)).poses.direction_observed.any()


def test_the_motion_of_the_file_is_that_of_the_subjects_own_skeleton(path: Path) -> None:
    motion = read_motion_npz(path).motion()
    np.testing.assert_allclose(motion.skeleton.joint_offsets, BODY.joint_offsets, atol=1e-12)
    p, R = motion.skeleton.forward_kinematics(motion.q)
    np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(R, motion.poses.R_world_bone, atol=1e-9)


def test_a_motion_with_gaps_keeps_them(tmp_path: Path, motion: MotionSequence) -> None:
    p, R, q = (np.array(a) for a in (motion.poses.p_world_joint, motion.poses.R_world_bone, motion.q))
    p[3], R[3], q[3] = np.nan, np.nan, np.nan
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    write_motion_npz(tmp_path / "m.npz", replace(motion, q=q, poses=poses))
    read = read_motion_npz(tmp_path / "m.npz")
    assert np.isnan(read.q[3]).all()
    assert not read.poses.valid[3].any()
    assert np.isfinite(np.delete(read.q, 3, axis=0)).all()


def test_another_skeleton_is_known_by_name(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.human36m(), 4)
    write_motion_npz(tmp_path / "m.npz", motion)
    read = read_motion_npz(tmp_path / "m.npz")
    assert read.motion().skeleton.names == motion.skeleton.names
    changed(tmp_path / "m.npz", skeleton=np.array("horse"))
    with pytest.raises(UnknownNameError, match="unknown skeleton 'horse'"):
        read_motion_npz(tmp_path / "m.npz").motion()


def test_the_arrays_read_cannot_be_written_to(path: Path) -> None:
    read = read_motion_npz(path)
    for array in (read.q, read.joint_offsets, read.singular, read.poses.p_world_joint):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_numpy_alone_can_read_it(path: Path) -> None:
    with np.load(path, allow_pickle=False) as archive:
        assert int(archive["schema_version"]) == SCHEMA_VERSION
        assert archive["names"].tolist() == list(BODY.names)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"nowhere\.npz: there is no such file"):
        read_motion_npz(tmp_path / "nowhere.npz")


def test_a_newer_schema_asks_for_an_update(path: Path) -> None:
    with pytest.raises(FileFormatError, match="schema version 99 is newer than 1; update rtof_kin"):
        read_motion_npz(changed(path, schema_version=np.array(99)))


ARRAYS = (
    "schema_version", "times", "q", "p_world_joint", "R_world_bone", "valid", "provenance",
    "orientation_observed", "singular", "names", "dof_names", "joint_offsets", "first_frame",
    "mode", "skeleton",
)  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_is_missing_is_named(path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=f"the array '{name}' is missing"):
        read_motion_npz(changed(path, **{name: None}))


@pytest.mark.parametrize("name, value, message", [
    ("q", np.zeros((12, 5)), r"q: expected shape \(12, 67\), got \(12, 5\)"),
    ("q", np.zeros((11, 67)), "q: expected shape"),
    ("q", np.full((12, 67), "x"), "q: not an array of numbers"),
    ("times", np.zeros(12), "time does not increase"),
    ("times", np.zeros(0), "empty"),
    ("p_world_joint", np.zeros((12, 20, 3)), r"p_world_joint: expected shape \(12, 21, 3\)"),
    ("R_world_bone", np.zeros((12, 21, 3, 3)), "not a rotation matrix"),
    ("joint_offsets", np.zeros((20, 3)), r"joint_offsets: expected shape \(21, 3\)"),
    ("singular", np.zeros((12, 3), dtype=bool), r"singular: expected shape \(12, 21\)"),
    ("provenance", np.zeros(12), "provenance: expected shape"),
    ("names", np.array("Hips"), "names"),
    ("names", np.array(["Hips"] * 21), "Hips .*more than once"),
    ("dof_names", np.array(["a"]), "q: expected shape"),
    ("schema_version", np.array("one"), "invalid literal"),
    ("first_frame", np.arange(3), ""),
])  # fmt: skip
def test_an_array_that_does_not_fit_is_refused_with_the_file(
    path: Path, name: str, value: NDArray[Any], message: str
) -> None:
    with pytest.raises(FileFormatError, match=rf"motion\.npz: .*{message}"):
        read_motion_npz(changed(path, **{name: value}))


def test_pickled_objects_are_never_read(path: Path) -> None:
    changed(path, mode=np.array({"code": print}, dtype=object))
    with pytest.raises(FileFormatError, match="mode: has type object.*pickled objects are never"):
        read_motion_npz(path)


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def scrambled(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(b ^ 0x5A for b in data[middle : middle + 400]) + data[middle + 400 :]


def one_array(data: bytes) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    return stream.getvalue()


def text_instead_of_arrays(data: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in ARRAYS:
            archive.writestr(f"{name}.npy", "hello")
    return stream.getvalue()


def claims_too_much(data: bytes) -> bytes:
    stream, header = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2**50, 67)}
    )
    with zipfile.ZipFile(stream, "w") as archive:
        for name in ARRAYS:
            archive.writestr(f"{name}.npy", header.getvalue())
    return stream.getvalue()


def encrypted(data: bytes) -> bytes:
    """The flag of encryption set in every entry of the archive's directory and before it."""
    out = bytearray(data)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = out.find(signature)
        while at >= 0:
            out[at + flags] |= 1
            at = out.find(signature, at + 4)
    return bytes(out)


@pytest.mark.parametrize("damage", [
    cut, scrambled, one_array, text_instead_of_arrays, claims_too_much, encrypted,
    lambda data: b"", lambda data: b"PK\x03\x04", lambda data: b"\x00" * 4096,
])  # fmt: skip
def test_a_damaged_file_is_refused_with_its_name(path: Path, damage: Callable[[bytes], bytes]) -> None:
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(FileFormatError, match=r"motion\.npz"):
        read_motion_npz(path)


def test_flipped_bytes_raise_the_one_known_error_or_do_no_harm(path: Path) -> None:
    data, rng = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 8):
            damaged[at] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(damaged))
        try:
            read_motion_npz(path)
        except FileFormatError:
            refused += 1
    assert refused > 50


def test_a_file_that_would_fill_the_memory_is_refused_before_it_does(path: Path) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w") as archive:
        archive.writestr("q.npy", b"x")
    data = bytearray(bomb.getvalue())
    at = data.find(b"PK\x01\x02") + 24  # uncompressed size in the directory
    data[at : at + 4] = (2**32 - 2).to_bytes(4, "little")
    entry = bytes(data[data.find(b"PK\x01\x02") : data.find(b"PK\x05\x06")])
    end = bytearray(data[data.find(b"PK\x05\x06") :])
    body = bytes(data[: data.find(b"PK\x01\x02")]) + 3 * entry
    end[8:10] = end[10:12] = (3).to_bytes(2, "little")
    end[12:16] = (3 * len(entry)).to_bytes(4, "little")
    path.write_bytes(body + bytes(end))
    with pytest.raises(FileFormatError, match="would fill more than 8192 MiB of memory"):
        read_motion_npz(path)


def test_a_folder_is_no_motion(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="a folder, not an NPZ archive"):
        read_motion_npz(tmp_path)
