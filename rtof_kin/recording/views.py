"""Several cameras in a recording's folder: ``[camera]`` and ``[keypoints]``, and further ``[[views]]``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.files.section import Section
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.video_arrays import video_arrays
from rtof_kin.recording.camera_motion_files import filmed_stream
from rtof_kin.recording.camera_table import camera_table
from rtof_kin.recording.sources import Source
from rtof_kin.recording.streams import Stream


def view_streams(
    sections: Sequence[Section], skeleton: SkeletonModel, source: Source
) -> tuple[Stream[KeypointSequence], ...]:
    """Open further cameras, each with a table ``camera`` and a table ``keypoints``.

    Args:
        sections: tables ``[[views]]``.
    """
    views = []
    for section in sections:
        filmed, _ = filmed_stream(section.table("camera"), section.table("keypoints"), skeleton, source)
        views.append(filmed)
        section.close()
    return tuple(views)


def camera_and_keypoints(keypoints: KeypointSequence, which: int) -> dict[str, Any]:
    """Return the tables ``camera`` and ``keypoints`` that are read back exactly.

    Args:
        keypoints: written to `keypoint_file`. which: camera, 0 for the first.
    """
    seen = {"file": keypoint_file(which), "landmarks": list(keypoints.names)}
    return {"camera": camera_table(keypoints.camera), "keypoints": seen}


def keypoint_file_arrays(keypoints: KeypointSequence) -> dict[str, Any]:
    """Return the arrays of a `keypoint_file`."""
    arrays = {"uv_px": keypoints.uv_px, "confidence": keypoints.confidence, "times": keypoints.times}
    return arrays | video_arrays(keypoints)


def keypoint_file(which: int) -> str:
    """Return the name of the file with a camera's keypoints.

    Args:
        which: camera, 0 for the first.
    """
    return f"keypoints_{which + 1}.npz" if which else "keypoints.npz"
