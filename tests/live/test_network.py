"""A whole session over LSL of this machine: a recording is sent with faults to the real estimator."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from live_support import demo

from rtof_kin.core import rotations as so3
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.estimator import OnlineEstimator
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.replay import Faults, RecordingReplay, ReplayClock
from rtof_kin.live.samples import FrameSample, OnlineEstimate, Sample, Source
from rtof_kin.live.session import LiveSession
from rtof_kin.recording.recording import Recording

SECONDS = 4.5
RATE_HZ = 30.0
"""Poses per second: few, so that a slow machine estimates them all."""
DYING, FREEZING = (1.2, 2.2), (2.6, 3.4)
"""[s] of the stream in which a sensor is dead, and the picture stands still."""
DEAD = "L_LowLeg"
FAULTS = Faults(0.1, 0.05, ((DEAD, *DYING),), FREEZING, seed=1)
LATEST = 1.0
"""[s] after which a fault must have been told."""


class UnhurriedClock:
    """The machine's clock, which hardly moves while the session waits for the processor.

    So what is seen is the network and the session, however busy the machine is.
    """

    def __init__(self) -> None:
        self.time, self._read = 0.0, time.monotonic()

    def __call__(self) -> float:
        """Time, s; the session asks before and after every step."""
        now = time.monotonic()
        self.time, self._read = self.time + min(now - self._read, 0.02), now
        return self.time


class Heard:
    """Sink that notes when it was told what."""

    def __init__(self, clock: UnhurriedClock) -> None:
        self.clock = clock
        self.estimates, self.told = list[OnlineEstimate](), list[tuple[float, str]]()

    def send(self, estimate: OnlineEstimate) -> None:
        self.estimates.append(estimate)

    def tell(self, sentence: str) -> None:
        self.told.append((self.clock.time, sentence))

    def close(self) -> None:
        """Nothing to close."""


@contextmanager
def sent(send: Callable[[Sample], None], clock: UnhurriedClock) -> Iterator[Callable[[], float]]:
    """Send the demo in the time of a clock from a thread; gives the time at which it began, or infinity."""
    replay = RecordingReplay.of_recording(demo(), ReplayClock(now=lambda: clock.time), faults=FAULTS)
    ending, began = threading.Event(), [math.inf]

    def relay() -> None:
        replay.start()
        began[0] = clock.time
        while not ending.wait(0.002):
            for sample in replay.poll():
                send(sample)

    thread = threading.Thread(target=relay)
    thread.start()
    try:
        yield lambda: began[0]
    finally:
        ending.set()
        thread.join()
        replay.close()


def run(sources: list[Source], send: Callable[[Sample], None], folder: Path) -> None:
    """Run a session and check what it says, estimates and records."""
    clock, setup = UnhurriedClock(), demo()
    heard = Heard(clock)
    estimator = OnlineEstimator(setup, setup.video.names, OnlineSettings(rate_hz=RATE_HZ, lag_s=0.1))
    session = LiveSession(setup, sources, estimator, sinks=[heard], recorder=Recorder(folder, setup), patience_s=20.0)
    with sent(send, clock) as began:
        deadline = time.monotonic() + 120.0
        summary = session.run(lambda: time.monotonic() > deadline or clock.time - began() > SECONDS, clock=clock)
    assert summary.frames > 0.7 * RATE_HZ * SECONDS

    def first(word: str, about: str, after: float) -> float:
        """Time, s of the stream, of the first sentence with a word about a stream."""
        times = [t - began() for t, sentence in heard.told if word in sentence and about in sentence]
        found = [t for t in times if t > after]
        assert found, (word, about, [sentence for _, sentence in heard.told])
        return found[0]

    assert first("sample for", DEAD, DYING[0]) < DYING[0] + LATEST
    assert first("back again", DEAD, DYING[1]) < DYING[1] + LATEST
    assert first("same numbers", VIDEO, FREEZING[0]) < FREEZING[0] + LATEST
    assert first("back again", VIDEO, FREEZING[1] - 0.1) < FREEZING[1] + LATEST
    p = np.concatenate([estimate.poses.p_world_joint for estimate in heard.estimates])
    assert np.isfinite(p).all()
    truth = setup.truth
    assert truth is not None
    span = np.ptp(truth.p_world_joint[:300, 0], axis=0)
    assert (np.ptp(p[:, 0], axis=0) < span + 2.0).all()  # the root strays while the picture stands still
    recorded = Recording.load(folder)
    assert recorded.imus is not None
    assert DEAD in recorded.imus.names
    assert len(recorded.video) > 0.6 * 60 * SECONDS  # of 0.9, less what stood still


def test_a_session_over_lsl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lsl_support import Sender, unique

    from rtof_kin.live import lsl
    from rtof_kin.live.lsl import LslFrameSource, LslImuSource

    monkeypatch.setattr(lsl, "_SETTLE_S", 0.0)
    imus, video = demo().imus, demo().video
    assert imus is not None
    channels = ("qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z")
    senders = {name: Sender(unique(name), [f"{name}_{channel}" for channel in channels]) for name in imus.names}
    points = [f"{name}_{what}" for name in video.names for what in ("x", "y", "confidence")]
    camera = Sender(unique("points"), points)
    began = time.monotonic()
    from pylsl import local_clock

    offset = local_clock()

    def send(sample: Sample) -> None:
        if isinstance(sample, FrameSample):
            uv = np.where(np.isfinite(sample.uv_px), sample.uv_px, 0.0)
            camera.send(np.column_stack([uv, sample.confidence]).ravel(), offset + sample.time)
        else:
            quat = so3.to_quat_wxyz(sample.R_inertial_sensor)
            senders[sample.sensor].send([*quat, *sample.f_sensor], offset + sample.time)

    names = [sender._outlet.get_info().name() for sender in senders.values()]
    sources: list[Source] = [LslFrameSource(camera._outlet.get_info().name())]
    sources += [LslImuSource(name) for name in names]
    starts = [threading.Thread(target=source.start) for source in sources]
    for thread in starts:
        thread.start()
    for thread in starts:
        thread.join()
    offset += time.monotonic() - began
    run(sources, send, tmp_path / "take")
