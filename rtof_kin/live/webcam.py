"""Webcams by PyAV: opened on every system, images with the time at which they were taken."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Iterator
from typing import Any, Final

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.core.packages import optional

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
    """Return name and format under which FFmpeg opens a camera. `platform`: as `sys.platform`.

    Raises:
        SourceError: the system is not known, or has no camera of that number.
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


def open_webcam(camera: int | str, size_px: tuple[int, int] | None = None) -> tuple[Any, Any]:
    """Open a camera and return PyAV's container and video stream.

    `size_px`: wanted width and height; the camera may give others.

    Raises:
        SourceError: there is no such camera, another program uses it, or it may not be used.
        RtofError: the extra is not installed.
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
