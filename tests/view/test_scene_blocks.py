"""Motions and measurements are read by blocks: the numbers of the file, in little memory, soon."""

from __future__ import annotations

import io
import zipfile
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from fuzz_damage import damaged
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_support import measured, walking, written

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.formats.measurements_file import MEASUREMENTS, read_measurements
from rtof_kin.body.motion_file import MOTION, read_motion_npz
from rtof_kin.view.scene.measurement_blocks import MeasurementBlocks
from rtof_kin.view.scene.motion_blocks import MotionBlocks


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = walking(1300)
    return written(tmp_path_factory.mktemp("blocks"), motion, measured(motion))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("order", ["C", "F"])
def test_rows_are_those_of_numpy_wherever_they_begin(tmp_path: Path, save: object, order: str) -> None:
    rng = np.random.default_rng(0)
    table = np.array(rng.normal(size=(1000, 3, 4)), order=order)
    flags = rng.random((1000, 2)) > 0.5
    save(tmp_path / "a.npz", table=table, flags=flags, other=np.zeros(7))  # type: ignore[operator]
    blocks = NpzBlocks(tmp_path / "a.npz", ["table", "flags", "absent"], spacing=9000)
    assert (blocks.length, blocks.available, "absent" in blocks) == (1000, 0, False)
    np.testing.assert_array_equal(blocks.whole("flags"), flags)
    blocks.scan()
    for start, stop in ((0, 1), (63, 65), (64, 64), (500, 900), (999, 1000), (0, 1000)):
        np.testing.assert_array_equal(blocks.rows("table", start, stop), table[start:stop])
        np.testing.assert_array_equal(blocks.rows("flags", start, stop), flags[start:stop])
    with pytest.raises(IndexError):
        blocks.rows("table", 0, 1001)
    blocks.close()


def test_damaged_files_are_told_and_nothing_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, table=np.random.default_rng(0).normal(size=(4000, 4)))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with closing(NpzBlocks(path, ["table"])) as blocks, pytest.raises(FileFormatError, match="table: damaged"):
        blocks.scan()
    np.savez(path, table=np.array([{}], dtype=object))
    with pytest.raises(FileFormatError, match="no table of numbers"):
        NpzBlocks(path, ["table"])
    np.savez(path, table=np.zeros((4, 2)), other=np.zeros(5))
    with pytest.raises(FileFormatError, match="different lengths"):
        NpzBlocks(path, ["table", "other"])
    path.write_bytes(b"no archive")
    with pytest.raises(FileFormatError, match="NPZ archive"):
        NpzBlocks(path, ["table"])
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 9)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("table.npy", buffer.getvalue())
    with pytest.raises(FileFormatError, match="not that of its bytes"):
        NpzBlocks(path, ["table"])


def test_frames_of_a_motion_are_those_of_its_reader(out: Path) -> None:
    whole = read_motion_npz(out / MOTION).motion()
    with MotionBlocks(out / MOTION) as blocks:
        np.testing.assert_array_equal(blocks.times, whole.times)
        blocks.wait(len(blocks))
        part = blocks.frames(700, 1100)
        np.testing.assert_array_equal(part.q, whole.q[700:1100])
        np.testing.assert_array_equal(part.poses.provenance, whole.poses.provenance[700:1100])
        np.testing.assert_array_equal(part.poses.R_world_bone, whole.poses.R_world_bone[700:1100])
        assert part.confidence is not None
        assert whole.confidence is not None
        np.testing.assert_array_equal(
            part.confidence.position_covariance, whole.confidence.position_covariance[700:1100]
        )
        p, kinds = blocks.root(0, 1300, 13)
        np.testing.assert_array_equal(p, whole.poses.p_world_joint[::13, 0])
        assert set(kinds.tolist()) == {5}
        assert [blocks.frame_at(t) for t in (-9.0, 2.0, 2.011, 2.029, 99.0)] == [0, 0, 1, 1, 1299]


def test_frames_of_measurements_are_those_of_their_reader(out: Path) -> None:
    whole = read_measurements(out / MEASUREMENTS)
    with MeasurementBlocks(out / MEASUREMENTS) as blocks:
        assert (blocks.length, blocks.first.sensors, blocks.first.floor_height) == (1300, ("thigh", "arm"), 0.02)
        while blocks.available < 900:
            pass
        part = blocks.frames(600, 900)
        np.testing.assert_array_equal(part.R_world_sensor, whole.R_world_sensor[600:900])
        np.testing.assert_array_equal(part.views[0].uv_px, whole.views[0].uv_px[600:900])
        assert part.truth is not None
        assert whole.truth is not None
        np.testing.assert_array_equal(part.truth.p_world_joint, whole.truth.p_world_joint[600:900])


def test_file_that_is_replaced_meanwhile_is_read_to_its_end(out: Path, tmp_path: Path) -> None:
    path = tmp_path / MOTION
    path.write_bytes((out / MOTION).read_bytes())
    with MotionBlocks(path) as blocks:
        path.unlink()
        path.write_bytes(b"another")
        blocks.wait(len(blocks))
        assert len(blocks.frames(1290, 1300).times) == 10


def test_motion_of_a_newer_schema_or_without_arrays_is_refused(out: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(out / MOTION))
    np.savez(tmp_path / "a.npz", **(arrays | {"schema_version": np.array(99)}))
    with pytest.raises(FileFormatError, match="update rtof_kin"):
        MotionBlocks(tmp_path / "a.npz")
    del arrays["valid"]
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(FileFormatError, match="'valid' is missing"):
        MotionBlocks(tmp_path / "b.npz")
    with pytest.raises(FileFormatError, match="no such file"):
        MotionBlocks(tmp_path / "c.npz")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = walking(20)
    return written(tmp_path_factory.mktemp("small"), motion, measured(motion))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bytes_raise_errors_of_the_package_only(data: st.DataObject, small: Path) -> None:
    name = data.draw(st.sampled_from([MOTION, MEASUREMENTS]))
    path = small / f"damaged_{name}"
    path.write_bytes(data.draw(damaged((small / name).read_bytes())))
    with suppress(RtofError):
        if name == MOTION:
            with MotionBlocks(path) as motion:
                motion.wait(len(motion), 5.0)
                motion.frames(0, len(motion))
        else:
            with MeasurementBlocks(path) as measurements:
                while measurements.available < measurements.length:
                    pass
                measurements.frames(0, measurements.length)
