"""Milliseconds from a camera's image to the angles on another program's socket, by stage.

A recorded video stands in for a webcam: each image is decoded when its stamp is due, the newest one is examined and
those that come meanwhile are dropped. The whole live session runs: decoding and detection in their threads, the
estimator at lag 0 and the rate of the video, the WebSocket, and a client on this machine. What a camera takes to
expose, read out and transfer an image comes on top. It needs the extras `live`, `video` and a detector (`mediapipe`);
SETUP is a folder of ``rtof-kin run VIDEO ... --only recording``.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from websockets.sync.client import connect

from benchmarks import harness
from benchmarks.command_line import rounded, study_parser
from benchmarks.online.speed import host
from rtof_kin.live.estimator import OnlineEstimator
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.samples import OnlineEstimate, Sample
from rtof_kin.live.session import LiveSession
from rtof_kin.live.video import Image, VideoSource
from rtof_kin.live.websocket_server import WebSocketServer
from rtof_kin.protocols.tables import Table
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.person_detector import Detector, choose_detector
from rtof_kin.vision.video import read_video

STAGES = {
    "decode": "decoding",
    "wait": "until the detector takes it",
    "detect": "detection of the person",
    "points": "landmarks of her points, until the session takes them",
    "lift": "lift",
    "solve": "fusion, solving and the rest of the session",
    "message": "message, until a client has it",
    "total": "all, photon to angle",
}
WARM = 1.0
"""[s] of a video that do not count."""
PERIOD = 0.004
"""[s] between two steps of a session, as `LiveSession.run` has it."""
Marks = dict[str, float]


class Watched(VideoSource):
    """A video in place of a webcam.

    Attributes:
        marks: by stamp of an image, when what was done with it, s on the monotonic clock. taken: stamps of the images
            whose points the session has. ready: it begins after the first image. over: whether it has ended.
    """

    def __init__(self, video: Path, camera_px: tuple[int, int]) -> None:
        super().__init__(0, self._watched, camera_px=camera_px)
        self._video, self.over = video, False
        self.marks: defaultdict[float, Marks] = defaultdict(dict)
        self.taken = list[float]()
        self.ready = threading.Event()

    def _watched(self) -> Detector:
        detector = choose_detector()
        find = detector.find

        def timed(image: Any, stamp: float) -> Any:
            self.marks[stamp]["begun"] = time.monotonic()
            found = find(image, stamp)
            self.marks[stamp]["found"] = time.monotonic()
            return found

        detector.find = timed  # type: ignore[assignment, method-assign]
        return detector

    def _webcam(self) -> Generator[Image, None, None]:
        stamps, images = [frame.time for frame in read_video(str(self._video))], read_video(str(self._video))
        now = time.monotonic()
        self.marks[now] |= {"age": 0.0, "decoded": now}
        yield Image(now, next(images).image, now)
        self.ready.wait()
        begun = time.monotonic() - stamps[0]
        for stamp in stamps[1:]:
            exposed = begun + stamp
            time.sleep(max(0.0, exposed - time.monotonic()))
            image = next(images)
            self.marks[exposed] |= {"age": stamp, "decoded": time.monotonic()}
            yield Image(exposed, image.image, exposed)
        self.over = True

    def poll(self) -> list[Sample]:
        """The samples, whose stamps are marked as taken."""
        samples = super().poll()
        for sample in samples:
            self.marks[sample.time]["taken"] = time.monotonic()
            self.taken.append(sample.time)
        return samples


class Client(threading.Thread):
    """A program that listens: the time at which each pose came, by its stamp's `key`."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self.came: dict[int, float] = {}
        self._connection = connect(url.replace("http", "ws"), compression=None, proxy=None)

    def run(self) -> None:
        """Listen until the server ends."""
        for text in self._connection:
            now, message = time.monotonic(), json.loads(text)
            if "header" in message:
                stamp = message["header"]["stamp"]
                self.came[key(stamp["sec"] + 1e-9 * stamp["nanosec"])] = now


def key(seconds: float) -> int:
    """A time in steps of 10 us, which survive a message."""
    return round(seconds * 1e5)


def played(setup: Recording, video: Path) -> tuple[list[Marks], int]:
    """Play a video through a session: the stages of each image that led to a pose, ms, and how many were dropped."""
    camera = setup.video.camera
    source = Watched(video, (camera.width_px, camera.height_px))
    source.start()
    assert source.examination is not None
    settings, server = OnlineSettings(rate_hz=round(setup.video.rate_hz)), WebSocketServer(setup.skeleton)
    estimator = OnlineEstimator(setup, source.landmarks, settings)
    lifting, sent, send = [0.0], dict[int, float](), server.send
    for name in ("put", "lift"):
        setattr(estimator._lifter, name, _timed(getattr(estimator._lifter, name), lifting))

    def noted(estimate: OnlineEstimate) -> None:
        sent[key(float(estimate.poses.times[0]))] = time.monotonic()
        send(estimate)

    server.send = noted  # type: ignore[method-assign]
    client = Client(server.url)
    client.start()
    session = LiveSession(setup, [source], estimator, sinks=[server])
    found = list[tuple[float, int]]()  # stamp of an image, key of the pose that it led to
    source.ready.set()
    while not source.over:
        arrival, lifting[0], before = time.monotonic(), 0.0, len(source.taken)
        estimates = session.step(arrival)
        if len(source.taken) > before and estimates:
            stamp = source.taken[-1]
            source.marks[stamp]["lift"] = lifting[0]
            found.append((stamp, key(float(estimates[-1].poses.times[0]))))
        time.sleep(max(0.0, PERIOD - (time.monotonic() - arrival)))
    dropped = source.examination.dropped
    time.sleep(WARM)  # the last message comes
    session.finish(time.monotonic())
    rows = [
        _stages(stamp, source.marks[stamp], sent[pose], client.came[pose])
        for stamp, pose in found
        if source.marks[stamp]["age"] > WARM and pose in client.came
    ]
    return rows, dropped


def _timed(function: Callable[..., Any], spent: list[float]) -> Callable[..., Any]:
    def timed(*given: Any) -> Any:
        begun = time.monotonic()
        out = function(*given)
        spent[0] += time.monotonic() - begun
        return out

    return timed


def _stages(exposed: float, own: Marks, sent: float, came: float) -> Marks:
    """Durations of `STAGES`, ms, of an image's marks and of the times at which its pose was sent and came, s."""
    parts = {
        "decode": own["decoded"] - exposed,
        "wait": own["begun"] - own["decoded"],
        "detect": own["found"] - own["begun"],
        "points": own["taken"] - own["found"],
        "lift": own["lift"],
        "solve": sent - own["taken"] - own["lift"],
        "message": came - sent,
    }
    return {name: 1e3 * value for name, value in (parts | {"total": came - exposed}).items()}


def table(rows: Sequence[Marks], dropped: int, machine: dict[str, Any], detector: str) -> Table:
    """Percentiles of the stages."""
    lines = []
    for name, words in STAGES.items():
        values = [row[name] for row in rows]
        lines.append((words, *np.percentile(values, (50, 90, 99)).tolist()))
    notes = (
        f"{len(rows)} images, and {dropped} that were dropped; {detector}. Percentiles of stages do not add up.",
        *(f"{name.replace('_', ' ')}: {value}" for name, value in machine.items()),
    )
    return Table(
        "stages", "Photon to angle", ("stage", "p50 ms", "p90 ms", "p99 ms"), (0, 1, 1, 1), tuple(lines), notes
    )


def main() -> None:
    """Command line."""
    parser = study_parser("online.photon", __doc__, motion=False, page="online_photon.json")
    parser.add_argument("--setup", type=Path, required=True, help="folder of the recording of this camera and person")
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=3, help="how often the video is played")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    setup, machine = Recording.load(options.setup), host()
    plays = [played(setup, options.video) for _ in range(options.repeats)]
    rows, dropped = [row for found, _ in plays for row in found], sum(count for _, count in plays)
    text = table(rows, dropped, machine, choose_detector().name).markdown()
    content = {"command": "python -m benchmarks online.photon --setup SETUP --video VIDEO", "rows": rounded(rows)}
    harness.write_results(options.out, content, text.rstrip())
    print(text)


if __name__ == "__main__":
    main()
