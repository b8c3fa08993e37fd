"""Opening of video files with PyAV (the optional extra ``video``), as data of unknown origin.

Only containers of cameras and screen recorders are opened: no playlist, whose entries could name other files
or servers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.packages import optional

_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,ogg,flv,mxf,dv"
_CONVERT = "convert it to MP4 (H.264) first"
_MOST_PIXELS = 64e6  # of one image: 8K has 33 million


@contextmanager
def open_video(path: str | Path) -> Iterator[tuple[Any, Any]]:
    """Yield the container and the first video stream of a file; errors of PyAV become `FileFormatError`.

    Raises:
        FileFormatError: no such file, not a video, or with images larger than any camera's.
        RtofError: the extra is not installed.
    """
    av = optional("av", "video")
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(path, "there is no such video")
    options = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
    try:
        with av.open(f"file:{path.resolve()}", options=options, metadata_errors="replace") as container:
            if not container.streams.video:
                raise FileFormatError(path, "has no video track; give a video file")
            stream = container.streams.video[0]
            if stream.codec_context is None or stream.width * stream.height == 0:
                raise FileFormatError(path, f"its video track is not readable; {_CONVERT}")
            if stream.width * stream.height > _MOST_PIXELS:
                raise FileFormatError(path, f"its images of {stream.width} x {stream.height} px are too large")
            yield container, stream
    except (av.FFmpegError, ValueError, OverflowError) as error:
        if isinstance(error, RtofError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise FileFormatError(path, f"not a readable video ({reason}); {_CONVERT}") from error


def turn_deg(frame: Any) -> int:
    """Return 0, 90, 180 or 270: counterclockwise turn that makes a frame upright."""
    return round(float(frame.rotation) / 90) * 90 % 360


def upright_size(frame: Any, stream: Any) -> tuple[int, int]:
    """Return width and height, px, of `upright_image`."""
    width, height = _square_width(frame, stream), frame.height
    return (height, width) if turn_deg(frame) % 180 else (width, height)


def upright_image(frame: Any, stream: Any) -> NDArray[np.uint8]:
    """Return the image of a frame, upright and with square pixels, (height, width, 3), BGR."""
    image = frame.to_ndarray(format="bgr24", width=_square_width(frame, stream), height=frame.height)
    return np.ascontiguousarray(np.rot90(image, turn_deg(frame) // 90))


def _square_width(frame: Any, stream: Any) -> int:
    """Return the width of a frame with square pixels."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return round(int(frame.width) * (aspect if 0.25 < aspect < 4 else 1.0))
