"""``motion.npz`` and ``measurements.npz`` by blocks: the same as whole, in little memory, small."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import npz_v1
import numpy as np
import planted
import pytest
from scene_support import measured, walking

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import WORLD, Confidence, per_axis
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.covariance_nodes import COLUMNS, ROWS, SPACING, TOLERANCE, NodeFinder, nodes, packed
from rtof_kin.formats.measurements_npz import MeasurementsReader, read_measurements_npz
from rtof_kin.formats.measurements_writer import MeasurementsWriter, write_measurements_npz
from rtof_kin.formats.motion_npz import MotionFile, MotionReader, read_motion_npz
from rtof_kin.formats.motion_writer import MotionWriter, write_motion_npz

FRAMES = 300
BLOCKS = (1, 16, 97, 300)


@pytest.fixture(scope="module")
def motion() -> Motion:
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


def assert_same(found: MotionFile, expected: MotionFile) -> None:
    for name in ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed"):
        np.testing.assert_array_equal(getattr(found.poses, name), getattr(expected.poses, name), name)
    np.testing.assert_array_equal(found.q, expected.q)
    assert found.confidence is not None
    assert expected.confidence is not None
    assert found.confidence.pairs == expected.confidence.pairs
    for name in ("position_covariance", "relative_covariance", "turn_covariance"):
        a, b = getattr(found.confidence, name), getattr(expected.confidence, name)
        np.testing.assert_allclose(a, b, rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("size", BLOCKS)
def test_file_does_not_depend_on_the_blocks_it_was_written_in(motion: Motion, tmp_path: Path, size: int) -> None:
    write_motion_npz(tmp_path / "whole.npz", motion, mode="rtof", first_frame=7)
    with MotionWriter(tmp_path / "m.npz", motion.skeleton, mode="rtof", first_frame=7) as writer:
        for start in range(0, FRAMES, size):
            writer.append(motion[start : start + size])
    assert (tmp_path / "m.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


@pytest.mark.parametrize("version", [1, 2])
def test_blocks_of_a_motion_are_parts_of_the_whole(motion: Motion, tmp_path: Path, version: int) -> None:
    path = tmp_path / "m.npz"
    (npz_v1.write_motion if version == 1 else write_motion_npz)(path, motion)
    whole = read_motion_npz(path)
    with MotionReader(path) as reader:
        assert (len(reader), reader.names) == (FRAMES, whole.poses.names)
        assert reader.rate_hz == pytest.approx(motion.poses.rate_hz)
        assert reader.available == 0
        places = [(290, 300), (0, 1), (40, 100), (140, 141), (0, 300)]
        for start, stop in places:
            part = MotionFile(
                whole.q[start:stop],
                whole.poses[start:stop],
                whole.dof_names,
                whole.joint_offsets,
                whole.first_frame,
                whole.mode,
                whole.skeleton,
                whole.confidence[start:stop],
            )
            assert_same(reader.block(start, stop), part)
            p, provenance = reader.root(start, stop)
            np.testing.assert_array_equal(p, part.poses.p_world_joint[:, 0])
            np.testing.assert_array_equal(provenance, part.poses.provenance[:, 0])
        blocks = list(reader.blocks(128, overlap=5))
        assert [len(block.q) for block in blocks] == [128, 133, 49]
        np.testing.assert_array_equal(np.concatenate([blocks[0].q, *(b.q[5:] for b in blocks[1:])]), whole.q)
        for start, stop in ((-1, 3), (3, 3), (299, 301)):
            with pytest.raises(InvalidInputError, match="it has 300"):
                reader.block(start, stop)


def test_covariances_are_near_and_unknown_where_they_were(motion: Motion, tmp_path: Path) -> None:
    write_motion_npz(tmp_path / "m.npz", motion)
    exact, found = motion.confidence, read_motion_npz(tmp_path / "m.npz").confidence
    assert exact is not None
    assert found is not None
    for name in ("position_covariance", "relative_covariance", "turn_covariance"):
        a, b = getattr(found, name), getattr(exact, name)
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b), name)
        np.testing.assert_allclose(per_axis(a), per_axis(b), rtol=TOLERANCE + 0.004, err_msg=name)
    with np.load(tmp_path / "m.npz") as arrays:
        at = arrays["covariance_frames"]
    assert np.diff(at).max() <= SPACING
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


@pytest.mark.parametrize("frames", [1, 2, SPACING, SPACING + 1, 100])
@pytest.mark.parametrize("size", [1, 7, SPACING, 100])
def test_nodes_do_not_depend_on_blocks(frames: int, size: int) -> None:
    rng = np.random.default_rng(frames)
    entries = np.exp(np.cumsum(0.1 * rng.normal(size=(frames, 3, 6)), axis=0))
    entries[rng.random((frames, 3)) < 0.01] = np.nan
    finder, found = NodeFinder(), []
    for start in range(0, frames, size):
        at, values = finder.add(entries[start : start + size])
        np.testing.assert_array_equal(values, entries[at])
        found += at.tolist()
    found += finder.end()[0].tolist()
    assert found == nodes(entries).tolist()
    assert (found[0], found[-1]) == (0, frames - 1)


@pytest.mark.parametrize("size", BLOCKS)
def test_poses_that_do_not_follow_from_the_angles_are_kept(motion: Motion, tmp_path: Path, size: int) -> None:
    p, R = motion.poses.p_world_joint.copy(), motion.poses.R_world_bone.copy()
    p[120:130, 6] += 0.02
    R[200, 3] = so3.exp([0.1, 0.0, 0.0]) @ R[200, 3]
    p[250:260], R[250:260] = np.nan, np.nan  # the angles stay
    moved = replace(motion, poses=replace(motion.poses, p_world_joint=p, R_world_bone=R, valid=None))
    with MotionWriter(tmp_path / "m.npz", motion.skeleton) as writer:
        for start in range(0, FRAMES, size):
            writer.append(moved[start : start + size])
    found = read_motion_npz(tmp_path / "m.npz")
    np.testing.assert_allclose(found.poses.p_world_joint, p, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.poses.R_world_bone, R, rtol=0, atol=1e-6)
    with np.load(tmp_path / "m.npz") as arrays:
        assert np.flatnonzero(arrays["poses_stored"]).tolist() == [*range(120, 130), 200, *range(250, 260)]
    with MotionReader(tmp_path / "m.npz") as reader:
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
    write_motion_npz(tmp_path / "m.npz", motion)
    found = read_motion_npz(tmp_path / "m.npz")
    np.testing.assert_allclose(found.poses.p_world_joint, p, rtol=0, atol=1e-6)
    exact, read = (np.diff(points, 2, axis=0) * 200.0**2 for points in (p, found.poses.p_world_joint))
    np.testing.assert_allclose(read, exact, rtol=0, atol=0.02)  # m/s^2, of 80
    assert np.sqrt(np.mean((read - exact) ** 2)) < 0.005


@pytest.mark.parametrize("what", ["body", "times", "confidence", "nothing"])
def test_frames_that_do_not_continue_are_refused(motion: Motion, tmp_path: Path, what: str) -> None:
    other = {
        "body": lambda: walking(4, start=99.0),
        "times": lambda: motion[100:110],
        "confidence": lambda: replace(motion[200:210], confidence=None),
    }
    message = {
        "body": "another body",
        "times": "do not follow",
        "confidence": "another confidence",
        "nothing": "at least one frame",
    }[what]
    with pytest.raises(InvalidInputError, match=message), MotionWriter(tmp_path / "m.npz", motion.skeleton) as writer:
        if what != "nothing":
            writer.append(motion[:200])
            made = other[what]()
            writer.append(replace(made, skeleton=made.skeleton.with_height(1.5)) if what == "body" else made)
    assert not list(tmp_path.iterdir())


# --- measurements --------------------------------------------------------------------------------


def part_of(m: Measurements, frames: slice) -> Measurements:
    return replace(
        m,
        times=m.times[frames],
        views=tuple(view[frames] for view in m.views),
        R_world_sensor=m.R_world_sensor[frames],
        truth=m.truth and m.truth[frames],
    )


@pytest.mark.parametrize("size", BLOCKS)
def test_measurements_are_written_and_read_by_blocks(motion: Motion, tmp_path: Path, size: int) -> None:
    given = measured(motion, cameras=2)
    write_measurements_npz(tmp_path / "whole.npz", given)
    with MeasurementsWriter(tmp_path / "m.npz") as writer:
        for start in range(0, FRAMES, size):
            writer.append(part_of(given, slice(start, start + size)))
    assert (tmp_path / "m.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    whole = read_measurements_npz(tmp_path / "m.npz")
    with MeasurementsReader(tmp_path / "m.npz") as reader:
        for start, block in zip(range(0, FRAMES, size), reader.blocks(size), strict=True):
            part = part_of(whole, slice(start, start + size))
            np.testing.assert_array_equal(block.R_world_sensor, part.R_world_sensor)
            np.testing.assert_array_equal(block.views[1].uv_px, part.views[1].uv_px)
            assert block.truth is not None
            np.testing.assert_array_equal(block.truth.R_world_bone, part.truth.R_world_bone)
        with pytest.raises(InvalidInputError, match="it has 300"):
            reader.block(299, 301)


def test_other_cameras_are_refused(motion: Motion, tmp_path: Path) -> None:
    given = measured(motion)
    other = replace(given.views[0], camera=replace(given.views[0].camera, width_px=640))
    first, second = (slice(0, 100), slice(100, 200))
    for second_part in (
        part_of(replace(given, views=(other,)), second),
        part_of(replace(given, truth=None), second),
        part_of(replace(given, p_bone_sensor=given.p_bone_sensor + 0.1), second),
        part_of(given, first),
    ):
        with pytest.raises(InvalidInputError, match=r"other cameras|do not follow"):  # noqa: SIM117
            with MeasurementsWriter(tmp_path / "m.npz") as writer:
                writer.append(part_of(given, first))
                writer.append(second_part)
    assert not list(tmp_path.iterdir())


LONG = """
    import resource, sys
    from dataclasses import replace
    from pathlib import Path

    import numpy as np
    from scene_support import measured, walking

    from rtof_kin.formats.measurements_npz import MeasurementsReader
    from rtof_kin.formats.measurements_writer import MeasurementsWriter
    from rtof_kin.formats.motion_npz import MotionReader
    from rtof_kin.formats.motion_writer import MotionWriter

    BLOCK, folder = 600, Path(sys.argv[1])

    def later(motion, seconds):
        times = motion.times + seconds
        known, poses = replace(motion.confidence, times=times), replace(motion.poses, times=times)
        return replace(motion, poses=poses, confidence=known)

    def pass_over(name, count):
        motion = walking(BLOCK, shaking=0.2)
        with MotionWriter(folder / f"{name}.npz", motion.skeleton) as writer, MeasurementsWriter(
            folder / f"{name}_measurements.npz"
        ) as beside:
            for number in range(count):
                part = later(motion, 12.0 * number)
                writer.append(part)
                beside.append(measured(part))
        with MotionReader(folder / f"{name}.npz") as reader, MeasurementsReader(
            folder / f"{name}_measurements.npz"
        ) as beside:
            assert len(reader) == len(beside) == count * BLOCK
            for block, other in zip(reader.blocks(BLOCK), beside.blocks(BLOCK), strict=True):
                np.testing.assert_allclose(block.q, motion.q, rtol=0, atol=3e-8)
                np.testing.assert_array_equal(other.times, block.poses.times)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    short = pass_over("short", 3)
    print(pass_over("long", 30) - short)
"""


def test_long_motions_pass_in_the_memory_of_a_block(tmp_path: Path) -> None:
    script = tmp_path / "long.py"
    script.write_text(textwrap.dedent(LONG))
    support = Path(__file__).parents[1] / "support"
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(support), *sys.path])},
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 30.0  # MiB; the frames of the long one take 150
