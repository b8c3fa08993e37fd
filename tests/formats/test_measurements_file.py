"""``measurements.h5``: what is written is read back, also of a handheld camera."""

from dataclasses import replace

import npz_v1
import numpy as np
import pytest
from measurements_support import write_measurements
from scene_support import measured, walking

from rtof_kin.body.metrics import at_times
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.hdf5 import read_arrays
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MeasurementsReader, MeasurementsWriter, read_measurements
from rtof_kin.recording.recording import Recording

FRAMES = 12


@pytest.fixture(scope="module")
def keypoints():
    return Recording.load(model_path("demo")).video.landmarks[:FRAMES]


@pytest.fixture
def measurements(keypoints):
    recording, rng = Recording.load(model_path("demo")), np.random.default_rng(0)
    R = so3.exp(rng.normal(size=(FRAMES, 2, 3)))
    R[3, 1] = np.nan
    return Measurements(
        times=keypoints.times,
        views=(replace(keypoints, own_times=keypoints.times + 1.5),),
        sensors=("a", "b"),
        segments=("Spine", "Head"),
        R_world_sensor=R,
        R_bone_sensor=so3.exp(rng.normal(size=(2, 3))),
        p_bone_sensor=rng.normal(size=(2, 3)),
        truth=at_times(recording.truth, keypoints.times),
        faults=(StreamFault(FaultKind.STUCK, "Head", 0.1, 0.2),),
        floor_height=-0.5,
    )


@pytest.fixture
def filmed(keypoints):
    """Keypoints of a distorted camera that turns by up to 20 degrees."""
    camera = replace(keypoints.camera, distortion=np.array([-0.1, 0.02, 0.001, 0.0, 0.0]))
    turn = so3.exp(np.linspace(-0.17, 0.17, FRAMES)[:, None] * np.array([0.3, 1.0, 0.1]))
    return replace(keypoints, camera=camera), CameraMotion(keypoints.times, turn)


def test_what_is_written_is_read_back(measurements, tmp_path):
    write_measurements(tmp_path / "m.h5", measurements)
    found = read_measurements(tmp_path / "m.h5")
    assert (found.sensors, found.segments) == (measurements.sensors, measurements.segments)
    assert (found.faults, found.floor_height) == (measurements.faults, -0.5)
    np.testing.assert_allclose(found.R_world_sensor, measurements.R_world_sensor, atol=4e-5)
    np.testing.assert_allclose(found.R_bone_sensor, measurements.R_bone_sensor, atol=1e-6)
    np.testing.assert_array_equal(found.p_bone_sensor, measurements.p_bone_sensor)
    (view,), (own,) = found.views, measurements.views
    np.testing.assert_allclose(view.uv_px, own.uv_px, rtol=0, atol=1 / 128)
    np.testing.assert_allclose(view.confidence, own.confidence, rtol=0, atol=1 / 510)
    np.testing.assert_array_equal(view.video_times, own.times + 1.5)
    np.testing.assert_array_equal(view.camera.K, own.camera.K)
    np.testing.assert_allclose(found.truth.p_world_joint, measurements.truth.p_world_joint, atol=1e-5)
    off = so3.angle_between(found.truth.R_world_bone, measurements.truth.R_world_bone)
    assert np.degrees(np.nanmax(off)) < 0.01
    np.testing.assert_array_equal(found.truth.valid, measurements.truth.valid)


def test_file_of_version_1_is_read(measurements, filmed, tmp_path):
    given = replace(measurements, views=(stabilised(*filmed),))
    npz_v1.write_measurements(tmp_path / "m.npz", given)
    found = read_measurements(tmp_path / "m.npz")
    (view,), (own,) = found.views, given.views
    np.testing.assert_allclose(view.uv_px, own.uv_px, atol=1e-3)
    np.testing.assert_allclose(view.confidence, own.confidence, atol=1e-6)
    np.testing.assert_array_equal(view.turning.R_still_camera, own.turning.R_still_camera)
    np.testing.assert_allclose(found.R_world_sensor, given.R_world_sensor, atol=1e-6)
    np.testing.assert_allclose(found.truth.R_world_bone, given.truth.R_world_bone, atol=1e-6)
    assert (found.faults, found.floor_height) == (given.faults, -0.5)


def test_points_of_a_handheld_camera_return_to_its_video(filmed, measurements, tmp_path):
    seen, motion = filmed
    still = stabilised(seen, motion)
    assert np.nanmax(np.abs(still.uv_px - seen.uv_px)) > 50  # the test moves something
    kept = still.seen
    whole = np.arange(FRAMES)
    np.testing.assert_allclose(still.in_video(whole)[kept], seen.uv_px[kept], atol=1e-3)
    write_measurements(tmp_path / "m.h5", replace(measurements, views=(still,)))
    (view,) = read_measurements(tmp_path / "m.h5").views
    np.testing.assert_allclose(view.in_video(whole)[kept], seen.uv_px[kept], atol=0.012)


def test_a_point_is_projected_where_the_turned_camera_sees_it(filmed):
    seen, motion = filmed
    still = stabilised(seen, motion)
    point = seen.camera.center_world + seen.camera.R_camera_world.T @ [0.3, -0.2, 4.0]
    frame = FRAMES - 1
    R_still_own = motion.R_first_still.T @ motion.R_first_camera[frame]
    R = R_still_own.T @ still.camera.R_camera_world
    own = replace(seen.camera, R_camera_world=R, t_camera_world=-R @ seen.camera.center_world)
    np.testing.assert_allclose(still.project(point[None], [frame])[0], own.project(point), atol=1e-6)


def test_cut_and_resampled_keypoints_keep_their_place_in_the_video(filmed):
    seen, motion = filmed
    still = stabilised(replace(seen, own_times=2 * seen.times + 3), motion)
    cut = still[4:8]
    np.testing.assert_allclose(cut.in_video(slice(None)), still.in_video(slice(4, 8)))
    middle = (seen.times[:-1] + seen.times[1:]) / 2
    between = still.resample(middle)
    np.testing.assert_allclose(between.video_times, 2 * middle + 3)
    np.testing.assert_allclose(
        between.turning.R_still_camera,
        motion.R_first_still.T
        @ so3.exp((np.linspace(-0.17, 0.17, FRAMES)[:-1] + 0.17 / (FRAMES - 1))[:, None] * np.array([0.3, 1.0, 0.1])),
        atol=1e-9,
    )


def test_damaged_and_newer_files_are_refused(measurements, tmp_path):
    path = tmp_path / "m.npz"
    write_measurements(tmp_path / "m.h5", measurements)
    arrays = read_arrays(tmp_path / "m.h5")
    for name, array, what in (
        ("times", None, "times"),
        ("header", np.array("{"), "Expecting"),
        ("header", np.array('{"schema_version": 9}'), "newer"),
        ("view_0_uv_px", np.zeros((2, 2)), "different lengths"),
        ("view_0_uv_px", np.zeros((FRAMES, 2)), "uv_px"),
        ("view_0_uv_px", None, "view_0_uv_px' is missing"),
        ("rotvec_world_sensor", np.zeros((FRAMES, 2, 4)), "rotvec_world_sensor"),
        ("rotvec_world_sensor", None, "rotvec_world_sensor' is missing"),
    ):
        changed = {k: v for k, v in arrays.items() if k != name} | ({} if array is None else {name: array})
        write_npz(path, changed, overwrite=True)
        with pytest.raises(FileFormatError, match=what):
            read_measurements(path)


@pytest.fixture(scope="module")
def walk():
    return walking(300, shaking=0.2)


def part_of(m, frames):
    return replace(
        m,
        times=m.times[frames],
        views=tuple(view[frames] for view in m.views),
        R_world_sensor=m.R_world_sensor[frames],
        truth=m.truth and m.truth[frames],
    )


@pytest.mark.parametrize("size", [1, 97, 300])
def test_measurements_are_written_and_read_by_slices(walk, tmp_path, size):
    given = measured(walk, cameras=2)
    write_measurements(tmp_path / "whole.h5", given)
    with MeasurementsWriter(tmp_path / "m.h5") as writer:
        for start in range(0, 300, size):
            writer.append(part_of(given, slice(start, start + size)))
    found, expected = read_arrays(tmp_path / "m.h5"), read_arrays(tmp_path / "whole.h5")
    assert all(np.array_equal(found[name], expected[name], equal_nan=name != "header") for name in {*found, *expected})
    whole = read_measurements(tmp_path / "m.h5")
    with MeasurementsReader(tmp_path / "m.h5") as reader:
        block, part = reader.read(50, 70), part_of(whole, slice(50, 70))
        np.testing.assert_array_equal(block.R_world_sensor, part.R_world_sensor)
        np.testing.assert_array_equal(block.views[1].uv_px, part.views[1].uv_px)
        np.testing.assert_array_equal(block.truth.R_world_bone, part.truth.R_world_bone)
        with pytest.raises(InvalidInputError, match="it has 300"):
            reader.read(299, 301)


def test_other_cameras_are_refused(walk, tmp_path):
    given = measured(walk)
    other = replace(given.views[0], camera=replace(given.views[0].camera, width_px=640))
    first, second = (slice(0, 100), slice(100, 200))
    for second_part in (
        part_of(replace(given, views=(other,)), second),
        part_of(replace(given, truth=None), second),
        part_of(replace(given, p_bone_sensor=given.p_bone_sensor + 0.1), second),
        part_of(given, first),
    ):
        with pytest.raises(InvalidInputError, match=r"other cameras|do not follow"):  # noqa: SIM117
            with MeasurementsWriter(tmp_path / "m.h5") as writer:
                writer.append(part_of(given, first))
                writer.append(second_part)
    assert not list(tmp_path.iterdir())


def test_nothing_measured_is_read_back(tmp_path):
    write_measurements(tmp_path / "m.h5", Measurements(np.array([0.0, 0.1])))
    found = read_measurements(tmp_path / "m.h5")
    assert (found.views, found.sensors, found.truth, found.faults) == ((), (), None, ())
