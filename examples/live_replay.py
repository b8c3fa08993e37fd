"""A recording as live streams: ``python examples/live_replay.py [FOLDER] [SECONDS]``, by default the demo.

Two sources, camera and sensors, share a clock and lose a tenth of their samples on purpose; one sensor is
dead for a second. `rtof-kin live` does the same with webcams and streams of the network.
"""

import sys

import numpy as np

from rtof_kin import Recording
from rtof_kin.core.resources import model_path
from rtof_kin.live.estimator import OnlineEstimator
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.replay import Faults, RecordingReplay, ReplayClock
from rtof_kin.live.session import LiveSession

recording = Recording.load(sys.argv[1] if len(sys.argv) > 1 else model_path("demo"))
seconds = float(sys.argv[2]) if len(sys.argv) > 2 else 5.0

clock = ReplayClock(speed=1.0)
dead = ((recording.calibration.sensors[0], clock.first + 2.0, clock.first + 3.0),)
camera = RecordingReplay.of_recording(recording, clock, sensors=False, faults=Faults(loss=0.1, seed=1))
sensors = RecordingReplay.of_recording(recording, clock, video=False, faults=Faults(loss=0.1, dead=dead))


class Lag:
    """Collects the age of every pose when it is ready, and prints messages."""

    def __init__(self):
        self.lags, self.frames = [], []

    def send(self, estimate):
        self.lags.append(estimate.lag_s)
        self.frames.append(estimate.seconds)

    def tell(self, sentence):
        print(sentence)

    def close(self):
        pass


lag = Lag()
estimator = OnlineEstimator(recording, camera.landmarks, OnlineSettings(lag_s=0.1))
session = LiveSession(recording, [camera, sensors], estimator, sinks=[lag])
summary = session.run(lambda: clock.time - clock.first > seconds, clock=lambda: clock.time)
print(f"{summary.frames} poses in {summary.seconds:.1f} s")
print(f"lag {1000 * np.median(lag.lags):.0f} ms, of which 100 ms are asked for")
print(f"a frame takes {1000 * np.median(lag.frames):.1f} ms, 99 % below {summary.frame_ms_p99:.1f} ms")
