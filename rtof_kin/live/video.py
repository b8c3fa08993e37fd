"""Points of a person in a webcam's or a video's images, as they come.

Of a webcam the newest image is examined and those that came meanwhile are dropped and counted; of a video every image
is. Stamps are the times at which images were taken, so that the time that detection takes shows as lag.
"""

from __future__ import annotations

import errno
import math
import sys
import threading
import time
import time as system
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.core.packages import optional
from rtof_kin.live.person_points import PersonPoints
from rtof_kin.live.replay import ReplayClock
from rtof_kin.live.samples import Clock, FrameSample, Sample
from rtof_kin.vision.person_detector import Detector, choose_detector
from rtof_kin.vision.video import read_video
from rtof_kin.vision.video_metadata import read_video_metadata, upright_image

# Webcams by PyAV: opened on every system, images with the time at which they were taken.

_FORMATS: Final = {"linux": "v4l2", "darwin": "avfoundation", "win32": "dshow"}
_PERMISSION: Final = {
    "linux": "add yourself to the group video (sudo usermod -aG video $USER) and log in again",
    "darwin": "allow the terminal to use the camera: System Settings, Privacy and Security, Camera",
    "win32": "allow desktop programs to use the camera: Settings, Privacy, Camera",
}
_SYSTEM_CLOCK: Final = 1.0  # [s] Largest age of an image whose stamp is of the system's clock
_NO_IMAGE_YET: Final = 0.003  # [s] after which a camera that does not wait is asked again
_DRIFT: Final = 1e-4  # [s/s] Largest difference of the rates of a camera's clock and the system's


def device_of(camera: int | str, platform: str = sys.platform) -> tuple[str, str]:
    """Return name and format under which FFmpeg opens a camera. `platform`: as `sys.platform`. `SourceError`: the
    system is not known, or has no camera of that number.
    """
    system = "linux" if platform.startswith("linux") else platform
    if (kind := _FORMATS.get(system)) is None:
        raise SourceError(f"camera {camera}: cameras of {platform} are not read; send its points over LSL")
    if system == "linux":
        return (f"/dev/video{camera}" if isinstance(camera, int) else camera), kind
    if system == "win32":
        names = cameras_of(kind)
        if isinstance(camera, int) and camera >= len(names):
            raise _no_camera(camera, kind)
        return f"video={names[camera] if isinstance(camera, int) else camera}", kind
    return str(camera), kind


def cameras_of(kind: str) -> list[str]:
    """Return the names of the cameras of this machine, as far as FFmpeg lists them."""
    av = optional("av", "video")
    try:
        return [device.name for device in av.enumerate_input_devices(kind)]
    except (av.FFmpegError, ValueError, OSError, AttributeError):
        return []


def cameras_here() -> dict[str, str]:
    """Return the cameras of this machine as far as they are listed: number or device -> name."""
    names = cameras_of(kind := _FORMATS.get(sys.platform, ""))
    return {name if kind == "v4l2" else str(i): name for i, name in enumerate(names)}


def open_webcam(camera: int | str, size_px: tuple[int, int] | None = None) -> tuple[Any, Any]:
    """Open a camera and return PyAV's container and video stream.

    `size_px`: wanted width and height; the camera may give others. `SourceError`: there is no such camera, another
    program uses it, or it may not be used. `RtofError`: the extra is not installed.
    """
    av = optional("av", "video")
    name, kind = device_of(camera)
    wanted = {"framerate": "30"} | ({} if size_px is None else {"video_size": "{}x{}".format(*size_px)})
    for options in (wanted, {}):
        try:
            container = av.open(name, format=kind, options=options)
        except (av.FFmpegError, ValueError, OSError) as error:
            problem = _problem(camera, kind, error)
            if problem is None and options:
                continue  # it has no such size or rate: take its own
            raise problem or SourceError(f"camera {camera}: cannot be opened ({error})") from error
        if container.streams.video:
            return container, container.streams.video[0]
        container.close()
    raise SourceError(f"camera {camera}: gives no images; give the number of another one")


def _problem(camera: int | str, kind: str, error: Exception) -> SourceError | None:
    """Return what keeps a camera from being opened, if it is neither its size nor its rate."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTTY):
        return _no_camera(camera, kind)
    if number in (errno.EACCES, errno.EPERM):
        system = next(name for name, own in _FORMATS.items() if own == kind)
        return SourceError(f"camera {camera}: may not be used; {_PERMISSION[system]}")
    if number == errno.EBUSY:
        return SourceError(f"camera {camera}: another program uses it; close that one")
    return None


def _no_camera(camera: int | str, kind: str) -> SourceError:
    names = cameras_of(kind)
    there = f"there are {', '.join(names)}" if names else "none is connected"
    return SourceError(f"camera {camera}: there is no such camera ({there}); connect it, or give another")


def images_of(container: Any, stream: Any) -> Iterator[Any]:
    """Generate the frames of a camera; what is damaged is left out, and its end is the end.

    `container`, `stream`: of `open_webcam`.
    """
    av = optional("av", "video")
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                return
            yield from packet.decode()
        except av.InvalidDataError:
            continue
        except (av.FFmpegError, OSError) as error:
            if getattr(error, "errno", None) == errno.EAGAIN:
                time.sleep(_NO_IMAGE_YET)
                continue
            raise RtofError(f"the camera stopped: {error}") from error


class CaptureTimes:
    """Times at which images were taken, on the system's clock.

    Stamps of the driver count, which most systems give on their own clock; where they are of another one,
    the images that came earliest tell the difference.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._seen = self._last = -float("inf")

    def __call__(self, stamp: float | None, now: float) -> float:
        """Return when an image was taken, s; later than the one before.

        `stamp`: of the driver, s. now: when it arrived, s.
        """
        taken = now
        if stamp is not None:
            late = now - stamp
            if self._offset is None:
                self._offset = 0.0 if 0 <= late < _SYSTEM_CLOCK else late
            elif self._offset != 0.0:
                self._offset = min(self._offset + _DRIFT * (now - self._seen), late)
            taken = min(stamp + self._offset, now)
        self._seen, self._last = now, max(taken, self._last + 1e-6)
        return self._last


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
        detector: Detector,
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

    def _examine(self, detector: Detector) -> None:
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
        detector: Callable[[], Detector] = choose_detector,
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
        self.keep: Callable[[Image], None] | None = None
        """What keeps every image, in a thread; if it fails, the source stops, and keeps none when it goes on."""
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
        """Open camera and detector, and begin to read, unless that is done. `SourceError`: there is no such camera, it
        is in use or not allowed, the file is no video, there is no detector, or the images are not those of the
        calibrated camera.
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
        images, replay = self._kept(images), None if self.live else self._replay
        self.examination = Examination(images, first, detector, points, replay, self._now)

    def poll(self) -> list[Sample]:
        """Return the frames that were examined; without pace it waits for those of the clock's time. `SourceError`: the
        webcam stopped; it may be started again.
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

    def _kept(self, images: Images) -> Images:
        with closing(images):
            for image in images:
                if (keep := self.keep) is not None:
                    self.keep = None
                    keep(image)
                    self.keep = keep
                yield image

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
