"""`VideoFrames`: small upright images of a video at any time, decoded in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.packages import optional
from rtof_kin.vision.video_metadata import open_video, slow_motion, upright_image

HEIGHT: Final = 360
"""[px] Largest height of the images."""
_AHEAD: Final = 2.0
"""[s] Up to which images are decoded one after the other instead of sought."""
_ROUNDING: Final = 0.004
"""[s] By which a stamp may be before that of its image."""
Image = NDArray[np.uint8]


class VideoFrames:
    """Decodes the image that was asked for last."""

    def __init__(self, path: str | Path, receive: Callable[[Image], None]):
        """Open the video and start the thread; end it with `close`.

        Args:
            receive: called in the thread with (height, width, 3) RGB images.

        Raises:
            FileFormatError: not a readable video, or one without times. RtofError: the extra is missing.
        """
        self.path, self._receive = Path(path), receive
        self._wanted: float | None = None
        self._changed = threading.Condition()
        self._ended = False
        self.problem: RtofError | None = None
        with open_video(self.path) as (container, stream):
            frame = next(container.decode(stream), None)
            if frame is None or frame.time is None:
                raise FileFormatError(self.path, "has no times of its images; convert it first")
            self._first, self._slowed = float(frame.time), slow_motion(container, stream)
            self.size = upright_image(frame, stream).shape[1::-1]
        self._thread = threading.Thread(target=self._run, name=f"images of {self.path.name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def request(self, time: float) -> None:
        """Ask for the image at a time; an earlier request that waits is dropped.

        Args:
            time: s since the first frame, real time, as `KeypointSequence.video_times`.
        """
        with self._changed:
            self._wanted = time
            self._changed.notify()

    def close(self) -> None:
        """Stop."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(10.0)

    def _run(self) -> None:
        try:
            with open_video(self.path) as (container, stream):
                stream.thread_type = "AUTO"
                self._serve(_Decoder(container, stream), stream)
        except RtofError as error:
            self.problem = error

    def _serve(self, decoder: _Decoder, stream: Any) -> None:
        while True:
            with self._changed:
                while self._wanted is None and not self._ended:
                    self._changed.wait()
                if self._ended:
                    return
                wanted, self._wanted = self._wanted, None
            assert wanted is not None
            frame = decoder.at(self._first + wanted * self._slowed)
            if frame is not None:
                self._receive(_small(upright_image(frame, stream)))


class _Decoder:
    """The last frame at or before a stamp, and the frames after it."""

    def __init__(self, container: Any, stream: Any):
        self._container, self._stream = container, stream
        self._frames = container.decode(stream)
        self._held: Any = None
        self._next: Any = None
        self._shown: Any = None

    def at(self, stamp: float) -> Any:
        """Return the frame shown at a stamp, s; None if it is the one returned last."""
        av, held = optional("av", "video"), self._held
        stamp += _ROUNDING
        if held is None or not held.time <= stamp <= held.time + _AHEAD:
            self._container.seek(int(stamp / self._stream.time_base), stream=self._stream, backward=True)
            self._frames, self._held, self._next = self._container.decode(self._stream), None, None
        try:
            self._advance(stamp)
        except (av.InvalidDataError, av.EOFError):
            self._frames = iter(())
        if self._held is self._shown:
            return None
        self._shown = self._held
        return self._held

    def _advance(self, stamp: float) -> None:
        while True:
            if self._next is None:
                self._next = next((f for f in self._frames if f.time is not None), None)
            if self._next is None or (self._held is not None and self._next.time > stamp + 1e-6):
                return
            self._held, self._next = self._next, None


def _small(image_bgr: Image) -> Image:
    """Return an image of at most `HEIGHT`, RGB, by means over blocks of pixels."""
    step = max(int(np.ceil(image_bgr.shape[0] / HEIGHT)), 1)
    h, w = (side // step * step for side in image_bgr.shape[:2])
    if step > 1:
        parts = image_bgr[:h, :w].reshape(h // step, step, w // step, step, 3)
        image_bgr = parts.mean(axis=(1, 3), dtype=np.float32).astype(np.uint8)
    return np.ascontiguousarray(image_bgr[..., ::-1])
