"""Points of a person in a webcam's or a video's images, as they come.

Of a webcam the newest image is examined and those that came meanwhile are dropped and counted; of a video every image
is. Stamps are the times at which images were taken, so that the time that detection takes shows as lag.
"""

from __future__ import annotations

import math
import threading
import time as system
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.live.person_points import PersonPoints
from rtof_kin.live.replay import ReplayClock
from rtof_kin.live.samples import Clock, FrameSample, Sample
from rtof_kin.live.webcam import CaptureTimes, images_of, open_webcam
from rtof_kin.vision.person_detector import PersonDetector, choose_detector
from rtof_kin.vision.video import read_video
from rtof_kin.vision.video_metadata import read_video_metadata, upright_image

_RECENT: Final = 30  # Frames of which times are the median
_PATIENCE: Final = 2.0  # [s] to wait for a thread that ends
_LATE: Final = 0.5  # [s] Latency of a video from which on it is told of
_DROPPED: Final = 30  # Images of a webcam from which on it is told that they are dropped


@dataclass(frozen=True)
class Image:
    """An image that waits for the detector."""

    time: float  #: [s] its stamp
    pixels: NDArray[np.uint8]  #: (height, width, 3), BGR, upright
    taken: float  #: [s] on this machine's clock


Images = Generator[Image, None, None]


class Examination:
    """Threads that read the images of one camera or file and examine them.

    `images`: of it; closed at the end. `replay`: by which images are due; None for a webcam, of which the newest image
    is examined. `now`: this machine's clock, s.
    """

    def __init__(
        self,
        images: Images,
        first: Image,
        detector: PersonDetector,
        points: PersonPoints,
        replay: ReplayClock | None,
        now: Callable[[], float],
    ):
        self._replay, self._now = replay, now
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._waiting: Image | None = None  # of the reading thread, for the detector
        self._all_read = self._ended = False
        self._samples: deque[FrameSample] = deque()
        self._latency: deque[float] = deque(maxlen=_RECENT)
        self._detection: deque[float] = deque(maxlen=_RECENT)
        self.problems: deque[str] = deque()
        """What ended it."""
        self.points = points
        self.examined = self.dropped = 0
        """Numbers of images, and of those that another one replaced."""
        self._threads = [
            threading.Thread(target=target, args=args, daemon=True)
            for target, args in ((self._read, (images, first)), (self._examine, (detector,)))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def ended(self) -> bool:
        """Whether all was examined and taken."""
        with self._changed:
            return self._ended and not self._samples

    @property
    def latency_s(self) -> float:
        """Median time from the taking of an image to its points, s; NaN before the first."""
        return float(np.median(list(self._latency) or [np.nan]))

    @property
    def detection_s(self) -> float:
        """Median time that an image takes, s; NaN before the first."""
        return float(np.median(list(self._detection) or [np.nan]))

    def take(self, until: float = np.inf, wait: bool = False) -> list[FrameSample]:
        """Return the frames that were examined, oldest first.

        `until`: latest stamp, s. wait: until it is known that no other frame has such a stamp.
        """
        found: list[FrameSample] = []
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._ended or (self._samples and self._samples[-1].time > until))
            while self._samples and self._samples[0].time <= until:
                found.append(self._samples.popleft())
        return found

    def close(self) -> None:
        """Stop the threads; may be called twice."""
        self._stop.set()
        self._end(True)
        for thread in self._threads:
            thread.join(_PATIENCE)

    def _end(self, examined: bool) -> None:
        """Let the image that waits be the last one, or nothing more come at all."""
        with self._changed:
            self._all_read, self._ended = True, self._ended or examined
            self._changed.notify_all()

    def _read(self, images: Images, first: Image) -> None:
        """Hand images to the detector when they are due."""
        try:
            with closing(images):
                image: Image | None = first
                while image is not None and not self._stop.is_set():
                    if self._replay is not None:
                        if not self._replay.wait(image.time, self._stop):
                            break
                        image = replace(image, taken=self._now() - self._replay.age(image.time))
                    with self._changed:
                        if self._replay is not None:  # every image of a file, the newest one of a webcam
                            self._changed.wait_for(lambda: self._waiting is None or self._all_read)
                        if self._all_read:
                            break
                        self.dropped += self._waiting is not None
                        self._waiting = image
                        self._changed.notify_all()
                    image = next(images, None)
        except Exception as error:  # of a foreign library
            self.problems.append(f"there are no further images ({error or type(error).__name__})")
        finally:
            self._end(False)

    def _examine(self, detector: PersonDetector) -> None:
        """Detect the person in the images that are handed over."""
        try:
            with closing(detector):
                while (image := self._next()) is not None and not self._stop.is_set():
                    begun = system.perf_counter()
                    uv, confidence = self.points.of(image.pixels, image.time)
                    self._detection.append(system.perf_counter() - begun)
                    self._latency.append(self._now() - image.taken)
                    self.examined += 1
                    with self._changed:
                        self._samples.append(FrameSample(image.time, uv, confidence))
                        self._changed.notify_all()
        except Exception as error:  # of a foreign detector
            self.problems.append(f"detection failed ({error or type(error).__name__})")
        finally:
            self._end(True)

    def _next(self) -> Image | None:
        """Wait for an image; None where there will be no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._all_read)
            image, self._waiting = self._waiting, None
            self._changed.notify_all()
            return image


class VideoSource:
    """Source of the points of one person in a webcam's or a video's images; it may be started again.

    Args:
        source: number or device of a webcam, or a video file.
        detector: gives the detector; by default the one at hand.
        camera_px: width and height of the calibrated image; None: those of the video.
        now: clock of a webcam's stamps, s; with LSL its `local_clock`.
    """

    def __init__(
        self,
        source: str | Path | int,
        detector: Callable[[], PersonDetector] = choose_detector,
        *,
        camera_px: tuple[int, int] | None = None,
        replay: ReplayClock | None = None,
        clock: Clock = Clock.COMMON,
        now: Callable[[], float] = system.monotonic,
    ):
        self._source, self._detector, self._camera_px = source, detector, camera_px
        self.live = is_webcam(source)
        """Whether it is a webcam."""
        self.name = f"camera {source}" if self.live else Path(str(source)).name
        """Name of the file, or number of the webcam."""
        self._replay, self.clock, self._now = replay or ReplayClock(), clock, now
        self.examination: Examination | None = None
        """What goes on in threads; None before `start`."""
        self._closed = False
        self._slow = False  # whether it was told of

    # --- what it says of itself --------------------------------------------------------------------

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points: the skeleton's landmarks, then the detector's own; known from `start` on."""
        return () if self.examination is None else self.examination.points.names

    @property
    def finished(self) -> bool:
        """Whether the video ended and all was polled."""
        return self._closed or (self.examination is not None and not self.live and self.examination.ended)

    @property
    def latency_s(self) -> float:
        """Median time from the taking of an image to its points, s; NaN before the first."""
        return math.nan if self.examination is None else self.examination.latency_s

    # --- source ------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open camera and detector, and begin to read, unless that is done.

        Raises:
            SourceError: there is no such camera, it is in use or not allowed, the file is no video, there is
                no detector, or the images are not those of the calibrated camera.
        """
        if self.examination is not None and not self._closed:
            return
        with ExitStack() as opened:
            try:
                images = opened.enter_context(closing(self._webcam() if self.live else self._file()))
                first = next(images, None)
                if first is None:
                    raise SourceError(f"{self.name}: gives no image; see whether another program shows one")
                detector = opened.enter_context(closing(self._detector()))
                size = (first.pixels.shape[1], first.pixels.shape[0])
                points = PersonPoints(detector, size, self._camera_px)
            except SourceError:
                raise
            except RtofError as error:
                raise SourceError(f"{error}") from error
            opened.pop_all()  # from here on the threads release them
        self._slow = self._closed = False
        self.examination = Examination(images, first, detector, points, None if self.live else self._replay, self._now)

    def poll(self) -> list[Sample]:
        """Return the frames that were examined; without pace it waits for those of the clock's time.

        Raises:
            SourceError: the webcam stopped; it may be started again.
        """
        run = self.examination
        if run is None or self._closed:
            return []
        if not self.live:
            return list(run.take(self._replay.now(self), wait=not self._replay.paced))
        found = run.take()
        if run.ended and not found:
            why = run.problems.popleft() if run.problems else "it gives no further images"
            raise SourceError(f"{self.name}: stopped: {why}; see whether it is connected")
        return list(found)

    def notices(self) -> list[str]:
        """Return what was dropped or doubtful since the last call."""
        run, told = self.examination, list[str]()
        if run is None:
            return []
        for said in (run.points.notices, *([] if self.live else [run.problems])):
            while said:
                told.append(said.popleft())
        took = f"detection takes {1000 * run.detection_s:.0f} ms an image"
        if not self._slow and self.live and run.dropped >= _DROPPED:
            self._slow = True
            told.append(f"{run.dropped} of {run.dropped + run.examined} images were not examined, as {took}")
        if not self._slow and not self.live and self._replay.paced and run.latency_s >= _LATE:
            self._slow = True
            told.append(
                f"its points are {run.latency_s:.1f} s late and will be later, as {took}; lower the speed, "
                "or take a faster detector"
            )
        return [f"{self.name}: {sentence}" for sentence in told]

    def close(self) -> None:
        """Stop the threads and release camera and detector."""
        self._closed = True
        if self.examination is not None:
            self.examination.close()

    # --- images ------------------------------------------------------------------------------------

    def _file(self) -> Images:
        seconds = read_video_metadata(str(self._source)).seconds
        self._replay.cover(self.name, 0.0, np.inf if seconds is None else seconds)
        for frame in read_video(str(self._source)):
            yield Image(frame.time, frame.image, self._now())

    def _webcam(self) -> Images:
        """Generate the images of the webcam with the times at which they were taken."""
        assert not isinstance(self._source, Path)
        container, stream = open_webcam(self._source, self._camera_px)
        with closing(container):
            times = CaptureTimes()
            for frame in images_of(container, stream):
                taken = times(frame.time, self._now())
                yield Image(taken, upright_image(frame, stream), taken)


def is_webcam(source: str | Path | int) -> bool:
    """Return whether a source is a webcam: a number or a device. `source`: of `VideoSource`."""
    return isinstance(source, int) or str(source).startswith("/dev/video")
