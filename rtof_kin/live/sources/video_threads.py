"""Reading and examining of images in two threads: `Examination` of one webcam or video, from start to end."""

from __future__ import annotations

import threading
import time as system
from collections import deque
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.live.samples import FrameSample
from rtof_kin.live.sources.person_points import PersonPoints
from rtof_kin.live.sources.replay_clock import ReplayClock
from rtof_kin.vision.person_detector import PersonDetector

_RECENT: Final = 30
"""Frames of which times are the median."""
_PATIENCE: Final = 2.0
"""[s] to wait for a thread that ends."""


@dataclass(frozen=True)
class Image:
    """An image that waits for the detector."""

    time: float
    """[s] its stamp."""
    pixels: NDArray[np.uint8]
    """(height, width, 3), BGR, upright."""
    taken: float
    """[s] on this machine's clock."""


Images = Generator[Image, None, None]


class _Slot:
    """Place of one image between two threads; `every`: a full one waits, else it is replaced."""

    def __init__(self, every: bool):
        self._every, self._ended = every, False
        self._image: Image | None = None
        self._changed = threading.Condition()
        self.dropped = 0

    def put(self, image: Image) -> bool:
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

    def take(self) -> Image | None:
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


class Examination:
    """Threads that read the images of one camera or file and examine them.

    Args:
        images: of it; closed at the end.
        replay: by which images are due; None for a webcam, of which the newest image is examined.
        now: this machine's clock, s.
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
        self._slot = _Slot(every=replay is not None)
        self._stop, self._changed = threading.Event(), threading.Condition()
        self._ended = False
        self._samples: deque[FrameSample] = deque()
        self._latency: deque[float] = deque(maxlen=_RECENT)
        self._detection: deque[float] = deque(maxlen=_RECENT)
        self.problems: deque[str] = deque()
        """What ended it, for people."""
        self.points = points
        self.examined = 0
        """Number of images."""
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
    def dropped(self) -> int:
        """Images that another one replaced."""
        return self._slot.dropped

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

        Args:
            until: latest stamp, s. wait: until it is known that no other frame has such a stamp.
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
        self._slot.end()
        self._end()
        for thread in self._threads:
            thread.join(_PATIENCE)

    def _end(self) -> None:
        with self._changed:
            self._ended = True
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
                    if not self._slot.put(image):
                        break
                    image = next(images, None)
        except Exception as error:  # of a foreign library
            self._problem("there are no further images", error)
        finally:
            self._slot.end()

    def _examine(self, detector: PersonDetector) -> None:
        """Detect the person in the images that are handed over."""
        try:
            with closing(detector):
                while (image := self._slot.take()) is not None and not self._stop.is_set():
                    self._one(image)
        except Exception as error:  # of a foreign detector
            self._problem("detection failed", error)
        finally:
            self._slot.end()
            self._end()

    def _one(self, image: Image) -> None:
        begun = system.perf_counter()
        uv, confidence = self.points.of(image.pixels, image.time)
        self._detection.append(system.perf_counter() - begun)
        self._latency.append(self._now() - image.taken)
        self.examined += 1
        with self._changed:
            self._samples.append(FrameSample(image.time, uv, confidence))
            self._changed.notify_all()

    def _problem(self, what: str, error: Any) -> None:
        self.problems.append(f"{what} ({error or type(error).__name__})")
