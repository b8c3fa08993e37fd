"""Words of a command line become sources and sinks, or one sentence that says what to write."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from live_support import demo

from rtof_kin.core.errors import CalibrationError, RtofError, SourceError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.live.open_sources import open_sinks, open_sources
from rtof_kin.live.replay import RecordingReplay
from rtof_kin.live.samples import Clock
from rtof_kin.live.video import VideoSource

DEMO = str(model_path("demo"))
CLOSING = ExitStack()


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    """Closes what a test opened."""
    with CLOSING:
        yield


def opened(cameras: list[str], sensors: list[str], **how: Any) -> Any:
    setup = how.pop("setup", demo())
    return open_sources(
        cameras, sensors, setup, CLOSING, detector=lambda: pytest.fail("a detector is asked for"), **how
    )


def test_a_recording_is_replayed_with_its_frames_and_its_sensors_apart() -> None:
    streams = opened([DEMO], [DEMO], speed=4.0)
    camera, sensors = streams.sources
    assert camera.landmarks == demo().video.names
    assert camera.sensors == () == sensors.landmarks
    assert sensors.sensors == demo().imus.names
    assert {camera.clock, sensors.clock} == {Clock.COMMON}
    assert camera.name != sensors.name
    assert streams.replayed


def test_beside_a_live_stream_replays_have_a_clock_of_their_own() -> None:
    streams = opened(["0"], [DEMO])
    camera, sensors = streams.sources
    assert isinstance(camera, VideoSource)
    assert (camera.clock, sensors.clock) == (Clock.COMMON, Clock.OWN)
    assert not streams.replayed
    with pytest.raises(SourceError, match="speed 2"):
        opened(["0"], [DEMO], speed=2.0)


def test_files_are_videos_for_the_camera_and_sensors_for_imus(tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"")
    file = tmp_path / "walk.csv"
    rows = [f"{i / 100:.2f},0,0,9.81,0,0,0" for i in range(300)]
    file.write_text("\n".join(["time," + ",".join(f"chest_{w}{a}" for w in "fw" for a in "xyz"), *rows]))
    camera, sensors = opened([str(video)], [str(file)]).sources
    assert isinstance(camera, VideoSource)
    assert isinstance(sensors, RecordingReplay)
    assert (camera.name, sensors.name) == ("walk.mp4", "walk.csv (sensors)")
    keypoints = tmp_path / "walk.npz"
    uv = points_px("coco17", walking(), watching(walking()))[:, None]
    np.savez(keypoints, uv_px=uv, confidence=np.ones(uv.shape[:3]), times=np.arange(len(uv)) / 30)
    (camera,) = opened([str(keypoints)], []).sources
    assert "coco17:Nose" in camera.landmarks
    keypoints.write_bytes(b"")
    with pytest.raises(SourceError, match="walk.npz"):
        opened([str(keypoints)], [])


@pytest.mark.parametrize(
    ("cameras", "sensors", "names"),
    [
        ([], [], "--camera.*--imus"),
        (["0", "1"], [], "0, 1"),
        ([], [DEMO, DEMO], "demo.*twice"),
        (["absent.mp4"], [], "absent.mp4.*webcam"),
        ([], ["absent.csv"], "absent.csv.*lsl:NAME"),
        (["lsl:"], [], "lsl:"),
        ([str(Path(__file__).parent)], [], "recording.toml"),
    ],
)
def test_other_words_are_refused_with_those_that_there_are(cameras: list[str], sensors: list[str], names: str) -> None:
    with pytest.raises(SourceError, match=f"(?s){names}"):
        opened(cameras, sensors)


def test_a_setup_must_have_the_camera_that_is_used(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="demo has no camera"):
        opened(["0"], [], setup=replace(demo(), keypoints=None))
    camera = replace(demo().video.camera, width_px=320, height_px=240)
    other = replace(demo(), keypoints=replace(demo().video, camera=camera))
    with pytest.raises(SourceError, match=r"1920 x 1080.*320 x 240"):
        opened([DEMO], [], setup=other)
    h36m = replace(
        demo(),
        skeleton_table="human36m",
        joint_offsets=np.empty((0, 3)),
        imus=None,
        calibration=None,
        keypoints=demo().video.select(["Hip", "Neck"]),
        truth=None,
    )
    with pytest.raises(RtofError, match="human36m"):
        opened(["0"], [], setup=h36m)


def test_sensors_are_renamed_by_serial_number_segment_or_name(tmp_path: Path) -> None:
    given = demo().imus
    assert given is not None
    serials = ("00B42279", "00B4227D", *given.names[2:])
    other = replace(demo(), imus=replace(given, names=serials), calibration=None, keypoints=None, truth=None)
    other.save(tmp_path / "take")
    (tmp_path / "map.csv").write_text("sensor,segment\n2279,left upper arm\n00B4227D,R_UpArm\n")
    (source,) = opened([], [str(tmp_path / "take")], names=tmp_path / "map.csv", speed=float("inf")).sources
    assert source.sensors == given.names
    source.start()
    found = set()
    while not source.finished:
        found |= {sample.sensor for sample in source.poll()}
    assert found == set(given.names)
    (tmp_path / "map.csv").write_text("2279,pelvis\n")
    with pytest.raises(UnknownNameError, match="pelvis"):
        opened([], [DEMO], names=tmp_path / "map.csv")
    with pytest.raises(CalibrationError, match="demo"):
        opened([], [DEMO], names=tmp_path / "map.csv", setup=replace(demo(), imus=None, calibration=None))


def test_a_damaged_recording_is_named(tmp_path: Path) -> None:
    copy = tmp_path / "take"
    shutil.copytree(DEMO, copy)
    (copy / "imus.npz").write_bytes(b"no arrays")
    with pytest.raises(RtofError, match="imus.npz"):
        opened([], [str(copy)])


@pytest.mark.parametrize("words", [["tcp"], ["ws:door"], ["lsl", "lsl"]])
def test_other_outputs_are_refused_with_those_that_there_are(words: list[str]) -> None:
    with pytest.raises(SourceError, match=words[0]):
        open_sinks(words, demo())


def test_streams_of_lsl_share_its_clock() -> None:
    pytest.importorskip("pylsl")
    camera, sensors = opened(["lsl:eyes"], ["lsl:dots"]).sources
    assert (camera.name, sensors.name) == ("lsl:eyes", "lsl:dots")
    assert camera.clock is sensors.clock is Clock.COMMON
