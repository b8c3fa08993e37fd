"""Sensors of a take beside its video: what is found, left out and refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from setup_support import write_demo

from rtof_kin.calibration.clocks import ClockEstimate
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.reconstruction.lift import lift
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import sensors
from rtof_kin.setup.recording_text import Field, summaries
from rtof_kin.setup.sensors import SetupSensors, set_up_sensors

FIRST, LAST = 8, 16
"""[s] of the demo."""
DELAY = 0.07
"""[s] of the demo's simulated detector, which counts as part of the clocks' offset."""


@pytest.fixture(autouse=True)
def _unrefined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the self-calibration out, which takes longest and is tested elsewhere."""
    monkeypatch.setattr(sensors, "calibrate_recording", None)


class Take:
    """Eight seconds of the demo."""

    def __init__(self, folder: Path):
        _, self.file, self.segments = write_demo(folder, FIRST, LAST)
        self.recording = Recording.load(model_path("demo"))
        video = self.recording.video
        self.keypoints: KeypointSequence = video[np.searchsorted(video.times, FIRST) :][: 60 * (LAST - FIRST)]
        self.poses: PoseSequence = lift(self.keypoints, self.recording.skeleton).poses
        self.log: SensorLog = read_sensor_log(self.file)
        self.map = folder / "map.csv"
        self.map.write_text("".join(f"{name}, {joint}\n" for name, joint in self.segments.items()))

    def set_up(self, log: SensorLog, sensor_map: Path | None, start_utc: datetime | None = None) -> SetupSensors:
        return set_up_sensors(log, sensor_map, self.poses, self.keypoints, self.recording.skeleton, start_utc)

    def days_before(self, days: int) -> tuple[SensorLog, Path, datetime]:
        """Arguments of `set_up` where the files state other days."""
        start = datetime(2024, 1, 31, 12, tzinfo=UTC)
        return replace(self.log, start_utc=start - timedelta(days=days)), self.map, start


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Take:
    return Take(tmp_path_factory.mktemp("take"))


def still(log: SensorLog, *names: str) -> SensorLog:
    """The log with some sensors that lie on a table."""
    out = []
    for stream in log.streams:
        if stream.name in names:
            R = np.broadcast_to(np.eye(3), (len(stream), 3, 3))
            f = np.random.default_rng(0).normal([0, 0, 9.81], 0.05, (len(stream), 3))
            stream = replace(stream, R_inertial_sensor=R, f_sensor=f, quaternion_norm=None)
        out.append(stream)
    return replace(log, streams=tuple(out))


def test_clock_and_segments_are_found_and_the_sensors_begin_at_zero(take: Take) -> None:
    found = take.set_up(take.log, take.map)
    start = found.fields["start_s"]
    # The file begins three seconds before the video, on a clock that shows 37 s more.
    assert start.value == pytest.approx(FIRST - 3.0 + DELAY, abs=0.04)
    assert found.imus.times[0] == 0.0
    assert found.imus.names == take.log.names
    tables = found.fields["sensors"]
    for name, joint in take.segments.items():
        own = tables[name]
        assert own["joint"] == Field(joint, sensors.Origin.FILE, "map.csv")
        stated = own["mounting_sd_deg"]
        assert stated.value == pytest.approx(10.0)  # of lifted orientations alone, across the bone
    assert any("the sensors began 5.0" in sentence for _, sentence in summaries(found.fields))


def test_names_of_segments_need_no_map(take: Take) -> None:
    named = take.log.renamed(dict(take.segments))
    found = take.set_up(named, None)
    assert found.imus.names == tuple(take.segments.values())


def test_places_are_judged_around_the_video_and_by_all_of_a_long_one() -> None:
    times = np.arange(0.0, 3600.0, 0.5)
    log = SensorLog(Path("log"), "planted", (SensorStream("a", times, np.zeros((len(times), 3))),), Declaration())
    for start, stop, first, last in (
        (1000.0, 1020.0, 710.0, 1309.5),
        (0.0, 20.0, 0.0, 309.5),
        (500.0, 2500.0, 499.0, 2500.5),
    ):
        found = sensors._around(log, np.array([start, stop])).streams[0].times
        assert (found[0], found[-1]) == (first, last)


def test_unnamed_sensors_are_placed_by_motion_or_left_out_and_named(take: Take) -> None:
    found = take.set_up(take.log, None)
    tables = found.fields["sensors"]
    left = set(take.segments) - set(found.imus.names)
    assert len(left) < len(take.segments)
    for name in found.imus.names:
        own = tables[name]
        joint = own["joint"]
        assert joint.value == take.segments[name]
        assert "by its motion" in joint.note
    for name in left:
        assert any(name in doubt and "--map FILE" in doubt for doubt in found.doubts)
    assert found.places.keys() == take.segments.keys()
    assert all(found.places[name][1] < 0.95 for name in left)
    assert all(
        found.places[name] == (take.segments[name], pytest.approx(0.975, abs=0.025)) for name in found.imus.names
    )


def test_sensors_that_do_not_move_are_left_out_and_named_or_refused(take: Take) -> None:
    first = take.log.names[0]
    found = take.set_up(still(take.log, first), take.map)
    assert first not in found.imus.names
    assert found.doubts[0] == (f"{first}: does not move and is left out; check that it was on the person and recording")
    with pytest.raises(InvalidInputError, match="none of its 8 sensors moves; give the file of the sensors"):
        take.set_up(still(take.log, *take.log.names), take.map)


def test_sensors_of_another_time_are_doubted(take: Take) -> None:
    rng = np.random.default_rng(1)
    streams = []
    for stream in take.log.streams:  # the same motions, but not at the same time
        cut = int(rng.integers(100, 500))
        arrays = {n: np.roll(getattr(stream, n), cut, axis=0) for n in ("R_inertial_sensor", "f_sensor")}
        streams.append(replace(stream, **arrays))
    found = take.set_up(replace(take.log, streams=tuple(streams)), take.map)
    assert any("check that" in doubt or "sure" in doubt for doubt in found.doubts)


@pytest.mark.parametrize(("explained", "days", "doubt"), [(0.1, 0, ""), (0.4, 1100, "too short")])
def test_sensors_of_another_take_or_day_stop_the_setup(
    take: Take, monkeypatch: pytest.MonkeyPatch, explained: float, days: int, doubt: str
) -> None:
    clock = ClockEstimate(-3.0, 0.0, 0.01, 50.0, doubt, explained=explained)
    monkeypatch.setattr(sensors, "find_clock", lambda *_, **__: clock)
    with pytest.raises(InvalidInputError, match="do not move as the video shows") as error:
        take.set_up(*take.days_before(days))
    assert ("1100 days apart" in str(error.value)) == bool(days)


def test_sensors_that_fit_but_state_another_day_are_doubted_first(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "find_clock", lambda *_, **__: ClockEstimate(-3.0, 0.0, 0.01, 50.0))
    found = take.set_up(*take.days_before(9))
    assert found.doubts[0] == (
        "video and sensors are of different days: the video of 2024-01-31, the sensors of 2024-01-22, 9 days apart"
    )


def test_a_clock_in_doubt_claims_no_milliseconds(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    doubtful = ClockEstimate(-3.0, 0.0, 2.4, 0.1, "the motion repeats itself", explained=0.6)
    monkeypatch.setattr(sensors, "find_clock", lambda *_, **__: doubtful)
    found = take.set_up(take.log, take.map)
    start = found.fields["start_s"]
    assert (start.origin, start.summary) == (
        sensors.Origin.ASSUMED,
        "the sensors began 3.0 s before the video, ± 2.4 s, other offsets fit too",
    )
    assert " ms" not in start.note
    assert found.doubts[0] == "when the sensors began is in doubt: the motion repeats itself"


def test_a_file_that_ended_before_the_video_is_refused(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    early = ClockEstimate(-20.0, 0.0, 0.005, 10.0)
    monkeypatch.setattr(sensors, "find_clock", lambda *_, **__: early)
    sentence = "from -20.0 to -6.0 s of the video's clock, the video from 8.0 to 16.0 s; give the files of one"
    with pytest.raises(InvalidInputError, match=sentence):
        take.set_up(take.log, take.map)


@pytest.mark.parametrize(
    ("begun", "doubt", "searched"),
    [
        (None, "", [(0.0, 600.0)]),
        (-40.0, "", [(-40.0, 68.0)]),
        (3600.0, "the movements agree nowhere", [(3600.0, 68.0), (0.0, 600.0)]),
    ],
)
def test_the_clock_is_searched_first_where_the_files_say_that_they_began(
    take: Take, monkeypatch: pytest.MonkeyPatch, begun: float | None, doubt: str, searched: list[object]
) -> None:
    """A time zone that was forgotten is no harm: all offsets are searched then."""
    asked = list[tuple[float, float]]()

    def find(*_: object, around: float = 0.0, reach: float, **__: object) -> ClockEstimate:
        asked.append((around, round(reach)))
        right = ClockEstimate(-3.0, 0.0, 0.01, 50.0, "")
        return replace(right, doubt=doubt) if around == begun else right

    monkeypatch.setattr(sensors, "find_clock", find)
    start = datetime(2026, 1, 31, 12, tzinfo=UTC)
    log = take.log if begun is None else replace(take.log, start_utc=start + timedelta(seconds=begun))
    found = take.set_up(log, take.map, start)
    assert asked == searched
    assert not any(doubt and doubt in sentence for sentence in found.doubts)
