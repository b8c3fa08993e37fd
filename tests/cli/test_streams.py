"""export --video: film, points and skeleton on one time line, read by Rerun's and MCAP's packages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pygltflib
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.data.confidence import BAND_95
from rtof_kin.formats.measurements_file import MEASUREMENTS, read_measurements
from rtof_kin.view.film_files import Mp4Writer

FRAMES = 6


@pytest.fixture(scope="module")
def exported(reconstructed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with a short film that gets brighter."""
    from rtof_kin.cli import main

    folder = tmp_path_factory.mktemp("streams")
    with Mp4Writer(folder / "film.mp4", (192, 108), 30.0) as film:
        for number in range(FRAMES):
            film.write(np.full((108, 192, 3), 20 + 30 * number, dtype=np.uint8), number / 30)
    options = ("--to", "rrd,mcap,glb", "--video", str(folder / "film.mp4"))
    assert not main(["export", str(reconstructed), str(folder / "out"), *options])
    return folder / "out"


@pytest.fixture(scope="module")
def rows(exported: Path) -> Callable[..., Any]:
    """Values of a component of an entity in all frames, with their times, s."""
    chunks = list(RrdReader(str(exported / "motion.rrd")).stream())

    def read(entity: str, component: str) -> tuple[np.ndarray, list[Any]]:
        found = [c.to_record_batch() for c in chunks if c.entity_path == entity]
        found = [one for one in found if component in one.schema.names and "time" in one.schema.names]
        times = np.concatenate([one["time"].cast(pa.int64()).to_numpy() for one in found]) * 1e-9
        return times, [row for one in found for row in one[component].to_pylist()]

    return read


def test_rerun_has_skeleton_bands_and_colours(rows: Callable[..., Any], reconstructed: Path) -> None:
    motion = Motion.load(reconstructed)
    times, points = rows("/world/joints", "Points3D:positions")
    np.testing.assert_allclose(times, motion.times, atol=1e-8)
    np.testing.assert_allclose(points, motion.poses.p_world_joint, atol=1e-6)
    _, bones = rows("/world/bones", "LineStrips3D:strips")
    last = motion.skeleton.names.index("LeftFoot")
    ends = motion.poses.p_world_joint[5, [motion.skeleton.parents[last], last]]
    np.testing.assert_allclose(bones[5][last - 1], ends, atol=1e-6)
    _, colours = rows("/world/joints", "Points3D:colors")
    assert len({*np.ravel(colours)}) == len(np.unique(np.where(motion.poses.valid, motion.poses.provenance, 2)))
    assert motion.confidence is not None
    _, radii = rows("/world/bands", "Points3D:radii")
    np.testing.assert_allclose(radii, BAND_95 * motion.confidence.relative_sigma, rtol=1e-4)


def test_rerun_has_angles_with_bands(rows: Callable[..., Any], reconstructed: Path) -> None:
    angles = clinical_angles(Motion.load(reconstructed)).select(["left_knee_flexion"])
    _, found = rows("/angles/left_knee_flexion", "Scalars:scalars")
    assert angles.sigma is not None
    value, half = np.degrees(angles.values), BAND_95 * np.degrees(angles.sigma)
    np.testing.assert_allclose(found, np.hstack([value, value - half, value + half]), atol=1e-9)


def test_rerun_has_the_points_of_the_picture_and_the_film(rows: Callable[..., Any], reconstructed: Path) -> None:
    view = read_measurements(reconstructed / MEASUREMENTS).views[0]
    place = "/world/camera_1/image"
    _, found = rows(f"{place}/detected", "Points2D:positions")
    np.testing.assert_allclose(found, view.uv_px, atol=1e-3)
    _, skeleton = rows(f"{place}/skeleton", "LineStrips2D:strips")
    motion = Motion.load(reconstructed)
    projected = view.camera.project(motion.poses.p_world_joint[7])
    bones = np.stack([motion.skeleton.parents, np.arange(21)], axis=1)[1:]
    np.testing.assert_allclose(skeleton[7], projected[bones], atol=1e-3)
    times, samples = rows(place, "VideoStream:sample")
    assert_film([bytes(row[0]) for row in samples])
    np.testing.assert_allclose(times, view.times[0] - view.video_times[0] + np.arange(FRAMES) / 30, atol=1e-3)


def test_mcap_has_the_film_and_the_bands(exported: Path, reconstructed: Path) -> None:
    known = Motion.load(reconstructed).confidence
    with (exported / "motion.mcap").open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    film = [message for _, channel, _, message in found if channel.topic == "/video"]
    assert {message.format for message in film} == {"h264"}
    assert_film([bytes(message.data) for message in film])
    bands = [message for _, channel, _, message in found if channel.topic == "/bands"]
    assert known is not None
    np.testing.assert_allclose([one.position_sigma for one in bands], known.position_sigma, rtol=1e-12)
    np.testing.assert_allclose([one.rotation_sigma for one in bands], known.orientation_sigma, rtol=1e-12)


def test_octahedra_of_the_glb_reach_to_the_band(exported: Path, reconstructed: Path) -> None:
    known = Motion.load(reconstructed).confidence
    assert known is not None
    file = pygltflib.GLTF2().load(str(exported / "motion.glb"))
    (animation,), blob = file.animations, file.binary_blob()
    hand = known.names.index("LeftHand")
    track = next(one for one in animation.channels if (one.target.node, one.target.path) == (hand, "weights"))
    accessor = file.accessors[animation.samplers[track.sampler].output]
    view = file.bufferViews[accessor.bufferView]
    weights = np.frombuffer(blob, "<f4", accessor.count, view.byteOffset).reshape(-1, 2)
    np.testing.assert_allclose(weights[:, 0], BAND_95 * known.relative_sigma[:, hand], rtol=1e-5)


def assert_film(samples: list[bytes]) -> None:
    """Each is one picture of the camera's size, decoded at once, as long as they come in order."""
    decoder = av.CodecContext.create("h264", "r")
    decoder.options = {"flags": "low_delay"}
    pictures = [picture for data in samples for picture in decoder.decode(av.Packet(data))]
    pictures += decoder.decode(None)
    assert samples[0][:4] == b"\0\0\0\1"
    assert len(pictures) == len(samples) == FRAMES
    assert {(one.width, one.height) for one in pictures} == {(1920, 1080)}
    means = [one.to_ndarray(format="gray").mean() for one in pictures]
    np.testing.assert_allclose(np.diff(means), 30, atol=6)
