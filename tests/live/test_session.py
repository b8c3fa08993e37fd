"""A session tells every disturbance within a second, once, and goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_support import (
    UNPLUGGED,
    FakeEstimator,
    FakeSink,
    FakeSource,
    Told,
    count,
    demo,
    drive,
    first,
    frame_samples,
    imu_samples,
    name_of,
    shaken,
)

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample
from rtof_kin.live.session import LiveSession
from rtof_kin.recording.recording import Recording

LANDMARKS = demo().video.names


def on_time(samples: list[Sample]) -> list[tuple[float, Sample]]:
    return [(sample.time, sample) for sample in samples]


def camera(seconds: float = 6.0) -> FakeSource:
    return FakeSource("camera", on_time(frame_samples(seconds)), landmarks=LANDMARKS)


def sensors(seconds: float = 6.0) -> FakeSource:
    return FakeSource("imus", on_time(imu_samples(seconds)))


def session_of(*sources: FakeSource, **options: object) -> LiveSession:
    return LiveSession(demo(), sources, FakeEstimator(), in_background=False, **options)


def estimator_of(session: LiveSession) -> FakeEstimator:
    assert isinstance(session._estimator, FakeEstimator)
    return session._estimator


def run(*sources: FakeSource, stop: float = 6.0, **options: object) -> tuple[LiveSession, list[Told]]:
    session = session_of(*sources, **options)
    return session, drive(session, sources, stop)


def test_undisturbed_session_says_nothing() -> None:
    session, told = run(sensors(), camera())
    assert told == []
    summary = session.finish(6.0)
    assert summary.frames > 340
    assert 0 < summary.frame_ms_p50 <= summary.frame_ms_p99
    assert {s.lost for s in summary.streams.values()} == {0}
    assert {one["state"] for one in session.status()["sensors"]} == {"ok"}
    assert session.status()["camera"]["state"] == "ok"


def test_loss_is_told_once_within_a_second() -> None:
    imus = FakeSource("imus", shaken(imu_samples(8.0), 0.0, 0.1, seed=3))
    session, told = run(imus, camera(8.0), stop=8.0)
    names = demo().calibration.sensors
    for name in names:
        assert count(told, name, "do not come") == 1
    assert np.median([first(told, name, "do not come") for name in names]) < 1.2
    lost = [session.finish(8.0).streams[name].lost for name in names]
    assert np.mean(lost) == pytest.approx(0.1 * 480, abs=15)


def test_jitter_out_of_order_is_told_once_within_a_second() -> None:
    imus = FakeSource("imus", shaken(imu_samples(6.0), 0.05, 0.0, seed=4))
    session, told = run(imus, camera())
    for name in demo().calibration.sensors:
        assert first(told, name, "late") < 1.3
        assert count(told, name, "late") == 1
    assert count(told, "do not come") == 0
    times = estimator_of(session).times
    assert np.all(np.diff(times) > 0)


def test_sensor_that_dies_and_comes_back() -> None:
    arrivals = [(t, s) for t, s in on_time(imu_samples(6.0)) if not (name_of(s) == "L_LowArm" and 2.0 < t < 4.0)]
    session, told = run(FakeSource("imus", arrivals), camera())
    assert 2.0 < first(told, "L_LowArm", "no usable sample") < 3.0
    assert 4.0 <= first(told, "L_LowArm", "back again") < 4.2
    assert len(told) == 2
    assert session.finish(6.0).streams["L_LowArm"].lost == pytest.approx(120, abs=2)


@pytest.mark.parametrize("how", ["same picture", "no frames"])
def test_camera_that_freezes(how: str) -> None:
    def frozen(sample: Sample) -> Sample:
        stuck = frame_samples(3.0)[-1]
        assert isinstance(sample, FrameSample)
        assert isinstance(stuck, FrameSample)
        return replace(stuck, time=sample.time) if 2.0 < sample.time < 4.0 else sample

    arrivals = [(s.time, frozen(s)) for s in frame_samples(6.0)]
    if how == "no frames":
        arrivals = [(t, s) for t, s in arrivals if not 2.0 < t < 4.0]
    sources = [sensors(), FakeSource("camera", arrivals, landmarks=LANDMARKS)]
    session = session_of(*sources)
    told = drive(session, sources, 3.5)
    assert session.status()["camera"]["state"] == "frozen"
    told += drive(session, sources, 6.0, 3.5)
    assert 2.0 < first(told, VIDEO) < 3.0
    assert 4.0 <= first(told, VIDEO, "back again") < 4.3
    assert len(told) == 2
    pushed = [s for s in estimator_of(session).pushed if isinstance(s, FrameSample)]
    assert sum(2.5 < s.time < 4.0 for s in pushed) == 0


def test_sensor_that_repeats_itself_is_left_out() -> None:
    stuck = next(s for s in imu_samples(3.0) if name_of(s) == "R_UpLeg" and s.time > 2.0)
    arrivals = [
        (t, replace(stuck, time=s.time) if name_of(s) == "R_UpLeg" and 2.0 < t < 4.0 else s)
        for t, s in on_time(imu_samples(6.0))
    ]
    session, told = run(FakeSource("imus", arrivals), camera())
    assert 2.0 < first(told, "R_UpLeg", "same numbers") < 3.0
    assert 4.0 <= first(told, "R_UpLeg", "back again") < 4.3
    pushed = [s for s in estimator_of(session).pushed if name_of(s) == "R_UpLeg"]
    assert sum(2.6 < s.time < 3.9 for s in pushed) == 0


@pytest.mark.parametrize("leap", [-100.0, 30.0])
@pytest.mark.parametrize("clock", list(Clock))
def test_clock_that_jumps(leap: float, clock: Clock) -> None:
    shift = 500.0 if clock is Clock.OWN else 0.0
    arrivals = [(t, replace(s, time=t + shift + (leap if t > 3.0 else 0.0))) for t, s in on_time(imu_samples(6.0))]
    session, told = run(FakeSource("imus", arrivals, clock), camera())
    assert 3.0 < first(told, "imus", "jumped") < 4.0
    assert count(told, "jumped") == 1
    assert len(told) == 1
    pushed = estimator_of(session).pushed
    times = np.array([s.time for s in pushed if name_of(s) == "L_UpArm"])
    assert np.all(np.diff(times) > 0)
    assert np.diff(times).max() < 0.15


def test_stream_that_never_starts() -> None:
    missing = FakeSource("lsl:phone", [])
    missing.silent = True
    _session, told = run(sensors(), camera(), missing, patience_s=0.9)
    assert 0.9 <= first(told, "lsl:phone", "nothing has come") < 1.1
    assert len(told) == 1


def test_sensor_of_the_calibration_that_never_comes() -> None:
    arrivals = [(t, s) for t, s in on_time(imu_samples(4.0)) if name_of(s) != "L_LowLeg"]
    _session, told = run(FakeSource("imus", arrivals), camera(), stop=4.0)
    assert first(told, "L_LowLeg", "nothing has come") < 3.2
    assert len(told) == 1


@pytest.mark.parametrize("factor", [1 / STANDARD_GRAVITY, 100.0])
def test_wrong_units_are_told_after_the_first_seconds(factor: float) -> None:
    arrivals = [
        (t, replace(s, f_sensor=s.f_sensor * factor)) for t, s in on_time(imu_samples(5.5)) if isinstance(s, ImuSample)
    ]
    session, told = run(FakeSource("imus", arrivals), camera(), stop=5.5)
    assert 4.5 < first(told, "imus", "specific force") < 5.5
    assert count(told, "specific force") == 1
    if factor < 1:
        assert count(told, "acceleration_unit = g") == 1
    assert len(estimator_of(session).pushed) > 1000


def test_unusable_numbers_are_left_out_and_told_once() -> None:
    def broken(s: Sample) -> Sample:
        if isinstance(s, FrameSample):
            return s
        if s.sensor == "L_UpArm" and s.time > 1:
            return replace(s, R_inertial_sensor=2 * s.R_inertial_sensor)
        if s.sensor == "R_UpArm" and s.time > 1:
            return replace(s, f_sensor=np.array([np.inf, 0, 0]))
        return s

    session, told = run(FakeSource("imus", [(s.time, broken(s)) for s in imu_samples(2.0)]), stop=2.0)
    for name, word in (("L_UpArm", "rotation"), ("R_UpArm", "finite")):
        assert first(told, name, word) < 1.1
        assert count(told, name, word) == 1
        assert session.finish(2.0).streams[name].left_out == pytest.approx(60, abs=1)


def test_unknown_sensor_is_told_with_the_closest_name() -> None:
    arrivals = [
        (t, replace(s, sensor="l_lowarm") if name_of(s) == "L_LowArm" else s) for t, s in on_time(imu_samples(2.0))
    ]
    session, told = run(FakeSource("imus", arrivals), stop=2.0)
    assert first(told, "l_lowarm", "did you mean L_LowArm") < 0.1
    assert "l_lowarm" not in {name_of(s) for s in estimator_of(session).pushed}


def test_unknown_landmark_is_told_with_the_closest_name() -> None:
    names = ["Hip", *LANDMARKS[1:]]
    _, told = run(FakeSource("camera", on_time(frame_samples(1.0)), landmarks=names), stop=1.0)
    assert count(told, "Hip:", "did you mean Hips") == 1


def test_stream_of_two_sources_is_taken_from_the_first() -> None:
    other = FakeSource("phone", [(s.time, s) for s in imu_samples(1.0) if name_of(s) == "R_LowLeg"])
    second = FakeSource("second", on_time(frame_samples(1.0)), landmarks=LANDMARKS[:5])
    session, told = run(sensors(1.0), camera(1.0), other, second, stop=1.0)
    assert count(told, "phone", "R_LowLeg", "imus") == count(told, "second", VIDEO, "camera") == 1
    assert len(told) == 2
    assert session.finish(1.0).streams["R_LowLeg"].received == pytest.approx(60, abs=1)


def test_names_of_points_may_come_with_the_first_frame(tmp_path: Path) -> None:
    samples = [(s.time, s) for s in imu_samples(1.0)] + [(s.time + 0.3, s) for s in frame_samples(0.7)]
    source = FakeSource("sensors", samples)
    recorder = Recorder(tmp_path / "walk", demo(), in_background=False)
    session = session_of(source, recorder=recorder)
    drive(session, [source], 0.3)
    source.landmarks = LANDMARKS
    drive(session, [source], 1.2, 0.3)
    session.finish(1.2)
    assert len(Recording.load(tmp_path / "walk").video) == len(frame_samples(0.7))


def test_source_that_fails_is_tried_again() -> None:
    imus, video = sensors(), camera()
    session = session_of(imus, video)
    told = drive(session, [imus, video], 2.0)
    imus.failures, imus.refusals = [UNPLUGGED], [UNPLUGGED]
    told += drive(session, [imus, video], 6.0, 2.0)
    assert count(told, "unplugged") == 1
    assert count(told, "imus: goes on") == 1
    assert imus.starts == 3
    assert len(estimator_of(session).pushed) > 2000


def test_source_that_does_not_start_does_not_stop_the_rest() -> None:
    imus = sensors()
    imus.refusals = [OSError("the device is taken")] * 20
    session, told = run(imus, camera())
    assert count(told, "the device is taken") == 1
    assert session.finish(6.0).frames > 300


def test_sink_that_fails_is_dropped() -> None:
    good, bad = FakeSink(), FakeSink()
    bad.failure = OSError("connection lost")
    session, told = run(sensors(2.0), stop=2.0, sinks=[bad, good])
    assert count(told, "connection lost") == 1
    assert any("connection lost" in text for text in good.told)
    assert len(good.estimates) > 100
    session.finish(2.0)
    assert (good.closes, bad.closes) == (1, 1)


def test_clock_that_is_ahead_does_not_carry_the_others_away() -> None:
    samples = imu_samples(3.0)
    ahead = [(s.time + 0.1, replace(s, time=s.time + 40)) for s in samples if name_of(s) == "L_UpArm"]
    rest = FakeSource("imus", on_time([s for s in samples if name_of(s) != "L_UpArm"]))
    session, told = run(rest, FakeSource("other", ahead), stop=3.0)
    assert count(told, "L_UpArm", "ahead") == 1
    assert max(estimator_of(session).times) < 3.1


def test_two_sources_of_one_name_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="imus"):
        session_of(sensors(), sensors())


def test_run_ends_with_the_sources_and_closes_them() -> None:
    imus = sensors(0.3)
    ticks = iter(np.arange(0, 10, 0.01))

    def clock() -> float:
        imus.now = float(next(ticks))
        return imus.now

    sink = FakeSink()
    session = LiveSession(demo(), [imus], FakeEstimator(), sinks=[sink], in_background=False)
    summary = session.run(clock=clock, period_s=0.0)
    assert summary.frames == len(sink.estimates) > 10
    assert imus.closes == sink.closes == 1


def test_run_in_background_starts_sources_in_threads() -> None:
    imus = sensors(0.3)
    imus.now = 1.0
    summary = LiveSession(demo(), [imus], FakeEstimator()).run(period_s=0.001)
    assert summary.streams["L_UpArm"].received == 18
