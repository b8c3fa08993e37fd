"""Points of a person in a webcam's or a video's images, as they come.

One thread reads the images and another detects. Of a webcam the newest image is examined and those that came
meanwhile are dropped and counted; of a video every image is. Stamps are the times at which images were taken,
so that the time that detection takes shows as lag.
"""

from __future__ import annotations

import threading
import time as system
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.live.person_points import PersonPoints
from rtof_kin.live.replay_clock import ReplayClock
from rtof_kin.live.samples import Clock, FrameSample, Sample
from rtof_kin.live.webcam import CaptureTimes, images_of, open_webcam
from rtof_kin.vision.person_detector import PersonDetector, choose_detector
from rtof_kin.vision.video import read_video
from rtof_kin.vision.video_file import upright_image
from rtof_kin.vision.video_metadata import read_video_metadata

_RECENT: Final = 30
"""Frames of which the latency is the median."""
_SLOW: Final = 0.5
"""[s] Latency from which on a video that detection cannot follow is told of."""
_FIRST_TOLD: Final = 30
"""Dropped images of a webcam that are told of first; then twice as many, and so on."""
_PATIENCE: Final = 2.0
"""[s] to wait for a thread that ends."""


@dataclass(frozen=True)
class _Image:
    """An image that waits for the detector."""

    time: float  # [s] stamp
    pixels: NDArray[np.uint8]
    taken: float  # [s] on the system's clock


class _Slot:
    """Place of one image between two threads; `every`: a full one waits, else it is replaced."""

    def __init__(self, every: bool):
        self._every, self._ended = every, False
        self._image: _Image | None = None
        self._changed = threading.Condition()
        self.dropped = 0

    def put(self, image: _Image) -> bool:
        """Return False where nobody takes images any more."""
        with self._changed:
            while self._every and self._image is not None and not self._ended:
                self._changed.wait()
            if self._ended:
                return False
            self.dropped += self._image is not None
            self._image = image
            self._changed.notify_all()
            return True

    def take(self) -> _Image | None:
        """Wait for an image; None where there will be no more."""
        with self._changed:
            while self._image is None and not self._ended:
                self._changed.wait()
            image, self._image = self._image, None
            self._changed.notify_all()
            return image

    def end(self) -> None:
        """Let the last image be taken, and no more come."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()


class VideoSource:
    """Source of the points of one person in a webcam's or a video's images.

    Args:
        source: number or device of a webcam, or a video file.
        detector: used for nothing else, or the models for `choose_detector`; None: the one at hand.
        camera_px: width and height of the calibrated image; None: those of the video.
        layout: of the detector's points; None: by their number.
        replay: clock of a file, shared with other replays. clock: of the stamps.
        now: clock of a webcam's stamps, s; with LSL its `local_clock`.
    """

    def __init__(
        self,
        source: str | Path | int,
        detector: PersonDetector | str | Path | None = None,
        *,
        camera_px: tuple[int, int] | None = None,
        layout: str | None = None,
        replay: ReplayClock | None = None,
        clock: Clock = Clock.COMMON,
        now: Callable[[], float] = system.monotonic,
    ):
        self._source, self._given, self._camera_px, self._layout = source, detector, camera_px, layout
        self._live = is_webcam(source)
        self._replay, self._clock, self._now = replay or ReplayClock(), clock, now
        self._slot = _Slot(every=not self._live)
        self._stop, self._ended = threading.Event(), False
        self._ready = threading.Condition()
        self._samples: deque[FrameSample] = deque()
        self._latency: deque[float] = deque(maxlen=_RECENT)
        self._detection: deque[float] = deque(maxlen=_RECENT)
        self._notices: deque[str] = deque()
        self._tell_dropped, self._tell_late = _FIRST_TOLD, _SLOW
        self._points: PersonPoints | None = None
        self._threads: list[threading.Thread] = []
        self._examined = 0

    # --- what it says of itself --------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the file, or number of the webcam."""
        return f"camera {self._source}" if self._live else Path(str(self._source)).name

    @property
    def clock(self) -> Clock:
        """Clock of the stamps."""
        return self._clock

    @property
    def sensors(self) -> tuple[str, ...]:
        """None."""
        return ()

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points: the skeleton's landmarks, then the detector's own; known from `start` on."""
        return () if self._points is None else self._points.names

    @property
    def finished(self) -> bool:
        """Whether the video ended, or the webcam stopped, and all was polled."""
        with self._ready:
            return self._ended and not self._samples

    @property
    def latency_s(self) -> float:
        """Median time from the taking of an image to its points, s; NaN before the first."""
        return float(np.median(list(self._latency) or [np.nan]))

    @property
    def detection_s(self) -> float:
        """Median time that detection takes for an image, s; NaN before the first."""
        return float(np.median(list(self._detection) or [np.nan]))

    @property
    def dropped(self) -> int:
        """Images of a webcam that were not examined."""
        return self._slot.dropped

    # --- source ------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open camera and detector, and begin to read.

        Raises:
            SourceError: there is no such camera, it is in use or not allowed, the file is no video, there is
                no detector, or the images are not those of the calibrated camera.
        """
        with ExitStack() as opened:
            try:
                images = opened.enter_context(closing(self._webcam() if self._live else self._file()))
                first = next(images, None)
                if first is None:
                    raise SourceError(f"{self.name}: gives no image; see whether another program shows one")
                given = self._given
                chosen = choose_detector(given) if isinstance(given, str | Path | None) else given
                opened.enter_context(closing(chosen))
                size = (first.pixels.shape[1], first.pixels.shape[0])
                self._points = PersonPoints(chosen, size, self._camera_px, self._layout)
            except SourceError:
                raise
            except RtofError as error:
                raise SourceError(f"{error}") from error
            opened.pop_all()  # the threads release them
        self._run(self._read, images, first)
        self._run(self._detect, chosen, self._points)

    def _run(self, target: Callable[..., None], *args: Any) -> None:
        thread = threading.Thread(target=target, args=args, name=self.name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def poll(self) -> list[Sample]:
        """Return the frames that were examined; without pace it waits for those of the clock's time."""
        if self._live:
            with self._ready:
                due, self._samples = list(self._samples), deque()
                return list(due)
        now = self._replay.now(self)
        found: list[Sample] = []
        with self._ready:
            if not self._replay.paced:
                self._ready.wait_for(lambda: self._ended or (self._samples and self._samples[-1].time > now))
            while self._samples and self._samples[0].time <= now:
                found.append(self._samples.popleft())
        return found

    def notices(self) -> list[str]:
        """Return what was dropped or doubtful since the last call."""
        told = []
        while self._notices:
            told.append(self._notices.popleft())
        while self._points is not None and self._points.notices:
            told.append(f"{self.name}: {self._points.notices.popleft()}")
        if self.dropped >= self._tell_dropped:
            self._tell_dropped = 2 * self.dropped
            told.append(
                f"{self.name}: {self.dropped} of {self.dropped + self._examined} images were not examined, "
                f"as detection takes {1000 * self.detection_s:.0f} ms"
            )
        if not self._live and self._replay.paced and self.latency_s >= self._tell_late:
            self._tell_late = 2 * self.latency_s
            told.append(
                f"{self.name}: its points are {self.latency_s:.1f} s late and will be later, as detection "
                f"takes {1000 * self.detection_s:.0f} ms an image; lower the speed, or take a faster detector"
            )
        return told

    def close(self) -> None:
        """Stop the threads and release camera and detector."""
        self._stop.set()
        self._slot.end()
        with self._ready:
            self._ended = True
            self._ready.notify_all()
        for thread in self._threads:
            thread.join(_PATIENCE)
        self._samples.clear()

    # --- threads -----------------------------------------------------------------------------------

    def _file(self) -> Generator[_Image, None, None]:
        """Generate the images of the file."""
        seconds = read_video_metadata(str(self._source)).seconds
        self._replay.cover(self.name, 0.0, np.inf if seconds is None else seconds)
        for frame in read_video(str(self._source)):
            yield _Image(frame.time, frame.image, self._now())

    def _webcam(self) -> Generator[_Image, None, None]:
        """Generate the images of the webcam with the times at which they were taken."""
        assert not isinstance(self._source, Path)
        container, stream = open_webcam(self._source, self._camera_px)
        with closing(container):
            times = CaptureTimes()
            for frame in images_of(container, stream):
                taken = times(frame.time, self._now())
                yield _Image(taken, upright_image(frame, stream), taken)

    def _read(self, images: Generator[_Image, None, None], first: _Image) -> None:
        """Hand the images to the detector when they are due."""
        try:
            image: _Image | None = first
            while image is not None and not self._stop.is_set():
                if not self._live:
                    if not self._replay.wait(image.time, self._stop):
                        break
                    image = replace(image, taken=self._now() - self._replay.age(image.time))
                if not self._slot.put(image):
                    break
                image = next(images, None)
            if self._live and not self._stop.is_set():
                self._notices.append(f"{self.name}: stopped; connect it again and start anew")
        except Exception as error:
            self._notices.append(f"{self.name}: {error}; there are no further images")
        finally:
            images.close()
            self._slot.end()

    def _detect(self, detector: PersonDetector, points: PersonPoints) -> None:
        """Examine the images that are handed over."""
        with closing(detector):
            try:
                while (image := self._slot.take()) is not None and not self._stop.is_set():
                    begun = system.perf_counter()
                    uv, confidence = points.of(image.pixels, image.time)
                    self._detection.append(system.perf_counter() - begun)
                    self._latency.append(self._now() - image.taken)
                    self._examined += 1
                    with self._ready:
                        self._samples.append(FrameSample(image.time, uv, confidence))
                        self._ready.notify_all()
            except Exception as error:
                self._notices.append(f"{self.name}: detection failed ({error}); there are no further points")
            finally:
                self._slot.end()
                with self._ready:
                    self._ended = True
                    self._ready.notify_all()


def is_webcam(source: str | Path | int) -> bool:
    """Return whether a source is a webcam: a number or a device.

    Args:
        source: of `VideoSource`.
    """
    return isinstance(source, int) or str(source).startswith("/dev/video")
