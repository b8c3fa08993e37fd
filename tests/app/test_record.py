"""Recordings that are made live, on a page and by the process behind it, of replays and LSL streams."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from app_support import Server, Window
from browser_support import needs_browser
from detector_support import points_px, walking, watching
from full_disk import full_disk
from live_support import FakeEstimator, demo
from lsl_support import Sender, unique

from rtof_kin.app import record
from rtof_kin.app.record import SESSION, Session, Wish, make_files
from rtof_kin.app.store import State, Store
from rtof_kin.core import packages
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import RtofError, WritingError
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.vision.detections import Person
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.landmark_regression import recognise
from rtof_kin.vision.video import read_video

pytest.importorskip("nicegui")
pytest.importorskip("onnx")
from dot_detector import write_video

NAMES = "P07", "2026-02-03"
LSL = "[lab]\nKnownPeers = {127.0.0.1}\nSessionID = record\n[multicast]\nResolveScope = machine\n[log]\nlevel = -3\n"
SENDER = """
import itertools, sys, time, numpy, pylsl
labels, rows = sys.argv[2].split(","), numpy.load(sys.argv[1])
info = pylsl.StreamInfo("Dots", "IMU", len(labels), 60.0, "double64", "dots")
channels = info.desc().append_child("channels")
for label in labels:
    channels.append_child("channel").append_child_value("label", label)
outlet = pylsl.StreamOutlet(info)
for row in itertools.cycle(rows):
    outlet.push_sample(row)
    time.sleep(1 / 60)
"""
SERVER = """
import sys, time
from pathlib import Path
from rtof_kin.app.record import Session, Wish
if __name__ == "__main__":
    session = Session(Path(sys.argv[1]), Wish(sys.argv[2], countdown_s=0.0))
    time.sleep(60)
"""
ENDS = "qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of the demo's points, to be replayed as a camera."""
    folder, first = tmp_path_factory.mktemp("clip") / "clip", demo().times[0]
    part = demo().between(first, first + 20.0)
    replace(part, imus=None, calibration=None, truth=None).save(folder)
    return folder


class Walker:
    """A detector that sees somebody walk."""

    name, points = "walker", 33

    def __init__(self) -> None:
        self.uv = points_px("mediapipe33", walking(), watching(walking())) / 10
        self.seen = 0

    def find(self, *_: object) -> list[Person]:
        self.seen += 1
        uv = self.uv[self.seen % len(self.uv)]
        return [Person(np.column_stack([uv, np.full(len(uv), 0.9)]))]

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of dark pictures."""
    camera = watching(walking())
    images = [np.zeros((camera.height_px // 10, camera.width_px // 10, 3), dtype=np.uint8) for _ in range(50)]
    return write_video(tmp_path_factory.mktemp("film") / "walk.mp4", images)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "workspace")
    store.add_person("P07", 1.73)
    store.add_visit(*NAMES)
    return store


def absent(name: str) -> NoReturn:
    raise ModuleNotFoundError(name=name)


def until(holds: Callable[[], bool], seconds: float = 40.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def chunks(folder: Path) -> int:
    return len(list((folder / SESSION / "live").glob("0*.npz")))


@needs_browser
@pytest.mark.slow
def test_a_replay_and_sensors_over_lsl_are_recorded_though_the_window_is_closed(
    tmp_path: Path, clip: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    imus = demo().imus
    assert imus is not None
    quat, two = so3.to_quat_wxyz(imus.R_inertial_sensor), imus.names[:2]
    labels = [f"{name}_{end}" for name in two for end in ENDS]
    np.save(tmp_path / "rows.npy", np.hstack([np.hstack([quat[:, s], imus.f_sensor[:, s]]) for s in (0, 1)]))
    (tmp_path / "lsl.cfg").write_text(LSL)
    monkeypatch.setenv("LSLAPICFG", str(tmp_path / "lsl.cfg"))
    with ExitStack() as ends:
        sender = subprocess.Popen([sys.executable, "-c", SENDER, str(tmp_path / "rows.npy"), ",".join(labels)])
        ends.callback(lambda: (sender.kill(), sender.wait()))
        server = Server(store.root)
        ends.callback(lambda: server.end())
        window = ends.enter_context(Window(tmp_path / "browser", 1024, 900))
        window.open(f"{server.address}people/P07")
        window.click("Record live")
        window.says(f"Dots: {', '.join(two)}")
        window.says("No picture is kept")
        window.click("Start")
        window.says("Choose a camera or sensors")
        window.fill("Name of the recording, as walk", "walk")
        window.fill("Camera: number, device or video file; empty: none", str(clip))
        window.fill("Countdown in s", "1")
        window.value("document.querySelector('[role=checkbox]').click()")
        window.press("Tab")
        window.click("Start")
        window.says("recording, 2 s", 60)
        figure = "document.querySelector('iframe').contentDocument"
        window.until(f"{figure}.documentElement.dataset.state === 'live'")
        window.until(f"{figure}.querySelectorAll('#stream-rows tr').length === 3")
        assert not window.layout_faults()
        window.open("about:blank")
        take = store.root.joinpath(*NAMES, "walk")
        until(lambda: chunks(take) > 2)
        window.open(f"{server.address}people/P07")
        window.click("Move walk to the trash")
        window.says("Something is being made of this")
        window.click("Record live")
        window.click("Stop")
        window.says("walk is recorded")
        window.click("walk is recorded; go on there")
        window.says("Ready: a detector's keypoints, files of sensors.")
        window.open(f"{server.address}people/P07")
        window.says("draft")
        assert not [error for error in window.errors if server.address in error]
    assert store.take(take).state is State.DRAFT
    assert read_sensor_log(store.sources(take).sensors).names == two
    assert {path.name for path in take.iterdir()} == {"files", "take.json"}
    assert not [path for path in take.rglob("*") if path.stat().st_mode & 0o077]


def test_a_process_ends_with_its_server_and_what_came_becomes_files_at_the_next_start(clip: Path, store: Store) -> None:
    take = store.add_take(*NAMES, "walk")
    server = subprocess.Popen([sys.executable, "-c", SERVER, str(take), str(clip)])
    until(lambda: server.poll() is not None or chunks(take) > 0)
    server.kill()
    server.wait()
    assert not store.files(take)
    until(lambda: record._recover(store) or bool(store.files(take)))  # as soon as the process holds it no more
    assert store.sources(take).keypoints == take / "files" / "keypoints.csv"
    assert store.take(take).size_px == (1920, 1080)
    assert not (take / SESSION).exists()


def test_a_process_that_is_lost_is_told_of(clip: Path, store: Store) -> None:
    session = Session(store.add_take(*NAMES, "walk"), Wish(str(clip)))
    session.process.kill()
    until(lambda: not session.runs())
    assert "what came is kept" in session.said


class Ends:
    """The server's end of the connection, which says to stop when something holds."""

    def __init__(self, holds: Callable[[], bool] = lambda: False):
        self.poll, self.told = holds, dict[str, Any]()
        self.send = self.told.update


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Record in this process as the other one does, without mathematics."""
    monkeypatch.setattr(record, "OnlineEstimator", lambda *_: FakeEstimator())

    def recorded(take: Path, wish: Wish, holds: Callable[[], bool] = lambda: False) -> None:
        with ExitStack() as stack:
            record._run(take, wish._replace(countdown_s=0.0), Ends(holds), stack)

    return recorded


@pytest.mark.parametrize("kept", [True, False])
def test_of_a_video_the_pictures_or_the_points_of_the_detector_are_kept(
    film: Path, store: Store, run: Callable[..., None], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "choose_detector", Walker)
    take = store.add_take(*NAMES, "walk")
    run(take, Wish(str(film), video=kept))
    make_files(take)
    sources = store.sources(take)
    if kept:
        assert (sources.keypoints, sources.video) == (None, take / "files" / "video.mkv")
        assert len(list(read_video(sources.video))) > 20
        return
    found = read_detector_file(sources.keypoints, *store.take(take).size_px)
    assert recognise(found.uv_px, found.confidence, found.names).layout.name == "mediapipe33"
    assert sources.video is None


def test_what_is_not_there_is_one_sentence(
    film: Path, store: Store, run: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    take = store.add_take(*NAMES, "walk")

    def none() -> NoReturn:
        raise RtofError("no detector of people is at hand: --model-dir DIR")

    monkeypatch.setattr(record, "choose_detector", none)
    for wish, said in (
        (Wish("9"), "camera 9: there is no such camera"),
        (Wish(str(film)), "models that find people in pictures are not on this machine"),
        (Wish("lsl:points"), "lsl:points: is neither a camera nor a file"),
    ):
        with pytest.raises(RtofError, match=said) as found:
            run(take, wish)
        assert "--" not in str(found.value)
    monkeypatch.setattr(packages, "import_module", absent)
    with pytest.raises(RtofError, match=r"pylsl, which is not installed: pip install"):
        run(take, Wish(streams=("Dots",)))
    assert "pip install" in record._found()[1][-1]


def test_sensors_alone_are_recorded_without_a_figure(store: Store, run: Callable[..., None]) -> None:
    name, take = unique("dots"), store.add_take(*NAMES, "walk")
    sender = Sender(name, [f"{sensor}_{end}" for sensor in ("pelvis", "head") for end in ENDS])

    def enough() -> bool:
        half = time.monotonic() % 60 / 2
        sender.send([np.cos(half), 0, 0, np.sin(half), 0, 0, 9.81] * 2)
        return chunks(take) > 0

    run(take, Wish(streams=(name,)), enough)
    make_files(take)
    found = read_sensor_log(store.sources(take).sensors)
    assert sorted(found.names) == ["head", "pelvis"]
    np.testing.assert_allclose(found.streams[0].f_sensor, [[0, 0, 9.81]] * len(found.streams[0].times))


def test_a_full_disk_leaves_what_was_recorded_for_another_attempt(
    clip: Path, store: Store, run: Callable[..., None]
) -> None:
    take = store.add_take(*NAMES, "walk")
    run(take, Wish(str(clip)), lambda: chunks(take) > 0)
    with full_disk(), pytest.raises(WritingError, match="cannot be written"):
        make_files(take)
    assert not store.files(take)
    make_files(take)
    assert store.sources(take).seen
    make_files(take)  # there is nothing left to do
