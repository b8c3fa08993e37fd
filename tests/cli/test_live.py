"""The command live: what it shows, records and says, with an estimator that does no mathematics."""

from __future__ import annotations

import io
import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from live_support import FakeEstimator, demo, imu_samples
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import McapRecord
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rich.console import Console

from rtof_kin.calibration.result import (
    Quantity,
    SelfCalibration,
    read_self_calibration_toml,
    write_self_calibration_toml,
)
from rtof_kin.cli.live import LiveDisplay
from rtof_kin.core.resources import model_path
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.open_sources import McapSink
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.vision.detections import Person

DEMO = model_path("demo")
Cli = Callable[..., Any]


class Walking:
    """A detector that finds one person who walks."""

    name = "walking"
    points = 33

    def __init__(self) -> None:
        self._uv = 0.1 * points_px("mediapipe33", walking(), watching(walking()))

    def find(self, image: Any, time: float) -> list[Person]:
        at = min(round(25 * time), len(self._uv) - 1)
        return [Person(np.column_stack([self._uv[at], np.full(33, 0.9)]))]

    def close(self) -> None:
        pass


@pytest.fixture
def estimator(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Put an estimator without mathematics in the place of the real one; what it was made of."""
    made: dict[str, Any] = {}

    def make(
        setup: Recording, landmarks: tuple[str, ...], settings: Any, lifter: Any, calibration: Any
    ) -> FakeEstimator:
        made.update(setup=setup, landmarks=landmarks, settings=settings, lifter=lifter)
        fake: Any = FakeEstimator()
        fake.calibration = calibration
        return fake

    monkeypatch.setattr("rtof_kin.live.estimator.OnlineEstimator", make)
    return made


def test_a_replay_is_recorded_as_a_recording_that_can_be_reconstructed(
    cli: Cli, estimator: dict[str, Any], tmp_path: Path
) -> None:
    take = tmp_path / "take"
    options = ("--speed", "inf", "--seconds", 3, "--lag", 0.1, "--video-delay", 0.02, "-o", take)
    done = cli.ok("live", DEMO, "--camera", DEMO, "--imus", DEMO, *options)
    done.says(f"rtof-kin reconstruct {take}", "video: ", "poses in 3.0 s")
    assert estimator["landmarks"] == demo().video.names
    assert (estimator["settings"].lag_s, estimator["settings"].video_delay_s) == (0.1, 0.02)
    recorded = Recording.load(take)
    assert recorded.imus is not None
    assert set(recorded.imus.names) == set(demo().imus.names)  # type: ignore[union-attr]
    assert 175 <= len(recorded.video) <= 181
    again = cli("live", DEMO, "--imus", DEMO, "-o", take)
    assert (again.code, str(take) in again.err) == (2, True)


def test_a_line_a_second_and_every_message_are_printed_where_there_is_no_terminal(
    cli: Cli, estimator: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtof_kin.cli.live._LINE_EVERY", 0.05)
    done = cli.ok("live", DEMO, "--imus", DEMO, "--seconds", 4, "--speed", "inf")
    assert estimator["landmarks"] == ()
    done.says("8 of 8 streams ok", "knee flexion", "lag 0 ms")


@pytest.mark.usefixtures("estimator")
def test_mcap_is_written_as_poses_come_and_no_file_is_replaced(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "new" / "take.mcap"
    options = ("live", DEMO, "--imus", DEMO, "--seconds", 3, "--speed", "inf", "--mcap", file)
    cli.ok(*options)
    with file.open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/joint_states"]))
    assert 175 <= len(found) <= 181
    assert list(found[0][3].name) == list(demo().skeleton.dof_names)
    again = cli(*options)
    assert (again.code, "take.mcap" in again.err) == (2, True)
    sink, fake = McapSink(tmp_path / "killed.mcap", demo().skeleton), FakeEstimator()
    fake.advance(0.0)
    for estimate in fake.advance(5.0):
        sink.send(estimate)
        sink.tell("a sentence")
    left = (tmp_path / "killed.mcap").read_bytes()  # of a session that is killed now
    sink.close()
    names = [type(one).__name__ for one in complete(left)]
    assert 4 * 60 * 5 < names.count("Message") < 5 * 60 * 5


def complete(left: bytes) -> Iterator[McapRecord]:
    with suppress(EndOfFile):
        yield from StreamReader(io.BytesIO(left)).records


def test_what_is_refined_begins_with_an_earlier_calibration_and_is_written(
    cli: Cli, estimator: dict[str, Any], tmp_path: Path
) -> None:
    delay = Quantity("delay", "video", np.array([0.02]), np.array([0.002]), np.array([0.05]), 0.99)
    earlier = SelfCalibration((delay,))
    write_self_calibration_toml(tmp_path / "earlier.toml", earlier)
    take = tmp_path / "take"
    opened = ("--refine", "delay,mounting", "--calibration", tmp_path / "earlier.toml")
    options = (*opened, "--seconds", 1, "--speed", "inf")
    done = cli.ok("live", DEMO, "--camera", DEMO, "--imus", DEMO, *options, "-o", take)
    assert estimator["settings"].refined is not None
    assert "20 ms" in done.out
    written = read_self_calibration_toml(take / "calibration.toml")
    np.testing.assert_array_equal(written.quantities[0].value, delay.value)


def test_the_persons_file_is_used_and_not_recorded(cli: Cli, estimator: dict[str, Any], tmp_path: Path) -> None:
    file, options = tmp_path / "P07.toml", ("--seconds", 1, "--speed", "inf", "--subject", tmp_path / "P07.toml")
    file.write_text('subject = "P07"\nheight_m = { value = 1.74 }\nposture_deg = { Spine = { value = [0, 10, 0] } }\n')
    cli.ok("live", DEMO, "--camera", DEMO, *options, "-o", tmp_path / "take")
    assert (estimator["setup"].height, estimator["setup"].posture.joints) == (1.74, ("Spine",))
    take = Recording.load(tmp_path / "take")
    assert take.height is take.posture is None
    file.write_text('subject = "P07"\njoint_offsets_m = { LeftLeg = { value = [0, 0, -0.6] } }\n')
    cli.ok("live", DEMO, "--camera", DEMO, *options).says("doubtful P07.toml has another joint_offsets_m.LeftLeg")


def test_a_video_is_examined_by_the_detector_of_the_options(
    cli: Cli, estimator: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("onnx")
    from dot_detector import write_video

    asked: list[tuple[Path | None, str]] = []

    def of(setup: SetupSettings, fetch: str | None) -> Walking:
        asked.append((setup.model_dir, setup.provider))
        return Walking()

    monkeypatch.setattr("rtof_kin.cli.live.detector_of", of)
    images = [np.zeros((108, 192, 3), dtype=np.uint8)] * 50
    film = write_video(tmp_path / "film.mp4", images)
    take = tmp_path / "take"
    options = ("--speed", "inf", "--fps", 25, "--model-dir", "models", "--provider", "cuda", "-o", take)
    done = cli.ok("live", DEMO, "--camera", film, *options)
    assert asked == [(Path("models"), "cuda")]
    assert "video: 50 samples" in done.out
    assert "L_UpArm" not in done.out
    assert estimator["setup"].calibration is None
    assert "mediapipe33:Nose" in estimator["landmarks"]
    recorded = Recording.load(take)
    assert (len(recorded.video), recorded.imus) == (50, None)


@pytest.mark.usefixtures("estimator")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_and_signals_end_the_session_and_finish_the_recording(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sent: signal.Signals
) -> None:
    advance, steps = FakeEstimator.advance, iter(range(1000))

    def interrupted(self: FakeEstimator, *arguments: Any, **how: Any) -> list[OnlineEstimate]:
        if next(steps) == 50:
            os.kill(os.getpid(), sent)
        return advance(self, *arguments, **how)

    before = signal.getsignal(sent)
    monkeypatch.setattr(FakeEstimator, "advance", interrupted)
    take = tmp_path / "take"
    done = cli.ok("live", DEMO, "--imus", DEMO, "-o", take)
    assert "rtof-kin reconstruct" in done.out
    assert Recording.load(take).imus is not None
    assert signal.getsignal(sent) is before


def test_a_killed_session_is_finished_and_reconstruct_says_how(cli: Cli, tmp_path: Path) -> None:
    take = tmp_path / "take"
    recorder = Recorder(take, demo(), in_background=False)
    for sample in imu_samples(1.0):
        recorder.add(Arrived("demo", sample, sample.time, sample.time))
    recorder.close()  # as far as a killed one comes
    assert (
        f"rtof-kin live --finish {take} makes a recording of it"
        in cli.refused("reconstruct", take, "-o", tmp_path / "out").err
    )
    done = cli.ok("live", "--finish", take)
    assert f"next rtof-kin reconstruct {take} -o OUT" in done.out
    assert len(Recording.load(take).imus or ()) >= 59
    again = cli("live", "--finish", take)
    assert (again.code, "is a recording already" in again.err) == (2, True)
    assert cli("live", DEMO, "--finish", take).code == cli("live").code == 2


@pytest.mark.usefixtures("estimator")
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "--camera"),
        (("--camera", "absent.mp4"), "absent.mp4"),
        (("--imus", "absent.csv"), "absent.csv"),
        (("--imus", DEMO, "--lag", "3"), "lag_s"),
        (("--imus", DEMO, "--send", "pigeon"), "pigeon"),
        (("--camera", "0", "--speed", "2"), "speed 2"),
    ],
)
def test_wrong_words_end_in_one_line(cli: Cli, arguments: tuple[Any, ...], named: str) -> None:
    done = cli.refused("live", DEMO, *arguments)
    assert "error:" in done.err
    assert named in done.err


@pytest.mark.usefixtures("estimator")
def test_the_page_is_shown_in_the_browser_where_asked_for(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("websockets")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    done = cli.ok("live", DEMO, "--imus", DEMO, "--seconds", 1, "--speed", "inf", "--browser")
    (url,) = opened
    printed = re.search(r"(http://127\.0\.0\.1:\d+/)([\w-]{20,})/", done.err)
    assert printed is not None
    assert url.startswith(printed[1])
    assert printed[2] not in url  # other users see with what the browser was started


def test_a_terminal_shows_streams_angles_and_messages() -> None:
    screen, now = io.StringIO(), [0.0]
    console = Console(file=screen, force_terminal=True, width=100, markup=False, color_system=None)
    display = LiveDisplay(console, demo().skeleton, lambda: now[0])
    truth = demo().truth
    assert truth is not None
    row = {
        "name": "L_UpArm",
        "state": "lost",
        "rate_hz": 60.0,
        "loss_percent": 12.0,
        "latency_ms": 3.0,
        "sentence": "no sample for 0.5 s",
    }
    status = {"sensors": [row], "camera": row | {"name": "video", "state": "ok"}, "rate_hz": 60.0}
    with display:
        assert not display.due()
        for i in range(10):
            display.send(OnlineEstimate(truth[i : i + 1], 0.25, 0.004))
        display.tell("5.0 s: L_UpArm: no sample for 0.5 s")
        now[0] = 1.0
        assert display.due()
        display.show(status)
        assert not display.due()
    shown = screen.getvalue()
    figures = ("60 Hz", "lag 250 ms", "frame 4.0 ms")
    for text in ("L_UpArm", "lost", "5.0 s: L_UpArm: no sample for 0.5 s", "video", "knee flexion", *figures):
        assert text in shown
