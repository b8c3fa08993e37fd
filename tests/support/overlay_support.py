"""Outputs of a reconstruction with planted motions, and videos whose frames carry their number."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import planted
from measurements_support import write_measurements
from numpy.typing import NDArray

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.data.poses import Provenance
from rtof_kin.view.blocks import Nearby
from rtof_kin.view.projected_motion import PictureView

Image = NDArray[np.uint8]
CELL = 24
"""[px] size of a bit of a frame's number; they stand in a row in the middle of the left border."""
BITS = 6


def picture_view(seen: KeypointSequence) -> PictureView:
    """Return the view of a camera that is in memory."""
    return PictureView(seen.camera, seen.names, seen.video_times, Nearby(len(seen), lambda a, b: seen[a:b]))


def motion_with(
    skeleton: SkeletonModel,
    frames: int,
    how: dict[str, Provenance] | None = None,
    sigma: float | None = None,
    way: float = 0.0,
) -> Motion:
    """`planted.seen` where some joints have another provenance, positions a given error, m, and the person
    moves to the left by a way, m."""
    motion = planted.seen(skeleton, frames)
    moved = np.linspace(0, way, frames)[:, None, None] * np.array([0.0, 1.0, 0.0])
    motion = replace(motion, poses=replace(motion.poses, p_world_joint=motion.poses.p_world_joint + moved))
    provenance = motion.poses.provenance.copy()
    for name, value in (how or {}).items():
        (j,) = skeleton.index(name)
        provenance[:, j] = value
    motion = replace(motion, poses=replace(motion.poses, provenance=provenance))
    return motion if sigma is None else replace(motion, confidence=confidence(motion, sigma))


def confidence(motion: Motion, sigma: float) -> Confidence:
    """The same covariance for all joints, m, and 2 degrees for all relative orientations."""
    T, names, parents = len(motion.times), motion.poses.names, motion.skeleton.parents
    pairs = tuple((names[p], names[j]) for j, p in enumerate(parents) if p >= 0)
    position = np.tile(sigma**2 * np.eye(3), (T, len(names), 1, 1))
    turn = np.tile(np.radians(2.0) ** 2 * np.eye(3), (T, len(pairs), 1, 1))
    return Confidence(motion.times, names, position, position, pairs, turn)


def upright_camera(width_px: int, height_px: int) -> Camera:
    """A camera 4 m in front of a standing person of 1.8 m, who fills most of the picture."""
    focal = 1.3 * min(height_px, 2 * width_px)
    return Camera.looking_at([4.0, 0.6, 1.3], [0.0, 0.0, 0.95], focal, width_px, height_px)


def write_output(
    folder: Path,
    motion: Motion,
    cameras: Sequence[Camera] = (),
    *,
    video_offset: float = 0.0,
    faults: Sequence[StreamFault] = (),
    verdict: dict[str, Any] | None = None,
    mode: str = "rtof",
) -> Path:
    """What `reconstruct` writes and an overlay reads."""
    folder.mkdir(parents=True)
    write_motion(folder / "motion.h5", motion, mode=mode)
    poses = motion.poses
    views = []
    for camera in cameras:
        uv = camera.project(poses.p_world_joint)
        views.append(
            KeypointSequence(
                camera, poses.times, uv, np.ones(uv.shape[:2]), poses.names, own_times=poses.times + video_offset
            )
        )
    made = Measurements(poses.times, tuple(views), faults=tuple(faults))
    write_measurements(folder / "measurements.h5", made)
    summary = {"recording": "John Doe", "mode": mode} | ({"verdict": verdict} if verdict else {})
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def numbered(width: int, height: int, number: int, colour: tuple[int, int, int] = (90, 140, 60)) -> Image:
    """An image, BGR, of one colour with a number in white and black cells."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = colour
    for bit in range(BITS):
        top, left = height // 2 + CELL * (bit // 3), CELL * (bit % 3)
        image[top : top + CELL, left : left + CELL] = 255 * (number >> bit & 1)
    return image


def number_of(image: Image) -> int:
    """The number in an image of any size, by the height of the one it was drawn in."""
    found = 0
    for bit in range(BITS):
        top, left = image.shape[0] // 2 + CELL * (bit // 3), CELL * (bit % 3)
        cell = image[top + 6 : top + CELL - 6, left + 6 : left + CELL - 6]
        found |= int(cell.mean() > 127) << bit
    return found


def write_film(
    path: Path,
    images: Sequence[Image],
    times_ms: Sequence[int],
    *,
    rotation: int = 0,
    metadata: dict[str, str] | None = None,
    sound: bool = False,
) -> Path:
    """Write upright images, BGR, as a phone does: turned, with a matrix that undoes it, metadata, sound."""
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream("mpeg4", rate=30)
        turned = [np.ascontiguousarray(np.rot90(image, -rotation // 90)) for image in images]
        stream.height, stream.width = turned[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        if rotation:
            stream.set_display_rotation(rotation)
        tone = container.add_stream("aac", rate=48000) if sound else None
        for image, time_ms in zip(turned, times_ms, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if tone is not None:
            for start in range(0, 48 * times_ms[-1], 1024):
                samples = np.sin(np.arange(start, start + 1024) / 20).astype(np.float32)
                sound_frame = av.AudioFrame.from_ndarray(samples[None], format="fltp", layout="mono")
                sound_frame.sample_rate, sound_frame.pts = 48000, start
                container.mux(tone.encode(sound_frame))
            container.mux(tone.encode(None))
    return path


def read_film(path: Path) -> tuple[list[Image], list[float]]:
    """Images, RGB, and time stamps of all frames, s."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    return [frame.to_ndarray(format="rgb24") for frame in frames], [float(frame.time) for frame in frames]
