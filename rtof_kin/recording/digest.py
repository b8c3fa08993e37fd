"""SHA-256 of the numbers of a recording: what its reconstruction follows from, without any label."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from rtof_kin.formats.video_arrays import VIDEO_CONSTANTS
from rtof_kin.recording.files import TRUTH
from rtof_kin.recording.sensor_files import imu_arrays
from rtof_kin.recording.streams import Stream, Streams
from rtof_kin.recording.views import keypoint_file_arrays

_LABELS: Final = ("name", "session", "notes")
"""Fields and tables of ``recording.toml`` that nothing is computed from."""


def recording_digest(index: str, streams: Streams) -> str:
    """Return the SHA-256 of a recording's numbers; how its files hold them, and its labels, do not matter.

    Args:
        index: text of ``recording.toml``.
    """
    facts = {name: value for name, value in tomllib.loads(index).items() if name not in _LABELS}
    lines = [json.dumps(facts, sort_keys=True)]
    for number, view in enumerate((streams.keypoints, *streams.views)):
        lines += _of_stream(f"keypoints {number}", view, keypoint_file_arrays)
    lines += _of_stream("imus", streams.imus, imu_arrays)
    lines += _of_stream("truth", streams.truth, lambda part: {name: getattr(part, name) for name in TRUTH})
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _of_stream(kind: str, stream: Stream[Any] | None, arrays: Callable[[Any], Mapping[str, Any]]) -> list[str]:
    """Return a line with the digest of each array of a stream, whatever the blocks it is read in."""
    digests: dict[str, Any] = {}
    for block in () if stream is None else stream.blocks():
        for name, values in arrays(block).items():
            array, constant = np.ascontiguousarray(values), name in VIDEO_CONSTANTS
            if name not in digests:
                shape = array.shape if constant else array.shape[1:]
                digests[name] = hashlib.sha256(f"{array.dtype.str} {shape}".encode())
            elif constant:
                continue
            digests[name].update(array.tobytes())
    return [f"{kind} {name} {digest.hexdigest()}" for name, digest in sorted(digests.items())]
