"""A motion as a recording of Rerun (.rrd): skeleton, bands, points in the image, video and angles on one time line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.core.array_types import Array
from rtof_kin.core.packages import optional
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import COLOURS, Provenance
from rtof_kin.formats.trial_results import Beside

_PALETTE: Final = np.array([(*COLOURS[kind], 255) for kind in sorted(Provenance)], dtype=np.uint8)
_CLEAR: Final = 50  #: Opacity of a band, of 255
_DETECTED: Final = (213, 94, 0)
_CURVES: Final = [[0, 114, 178], [150, 190, 220], [150, 190, 220]]  #: Of an angle, its lower and its upper limit
_SHOWN: Final = ("knee_flexion", "hip_flexion", "elbow_flexion")  #: Angles that are open at the start


def write_rrd(path: Path, motion: MotionSource, beside: Beside) -> float:
    """Write a motion in blocks to a new file, on its own clock: return 0.0. beside: curves, measurements and video."""
    rr, rrb = (optional(name, "connect", "a recording of Rerun") for name in ("rerun", "rerun.blueprint"))
    measured = beside.measurements if beside.measurements and len(beside.measurements) == len(motion) else None
    views = measured.read(0, 1).views if measured else ()
    places = [f"world/camera_{number}/image" for number in range(1, 1 + len(views))]
    log = rr.RecordingStream("rtof_kin")
    log.save(path, default_blueprint=_layout(rrb, places))
    log.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for place, view in zip(places, views, strict=True):
        camera = view.camera
        stand = rr.Transform3D(translation=camera.center_world, mat3x3=camera.R_camera_world.T)
        log.log(place.removesuffix("/image"), stand, static=True)
        size = [camera.width_px, camera.height_px]
        log.log(place, rr.Pinhole(image_from_camera=camera.K, resolution=size), static=True)

    def send(entity: str, times: Array, columns: Any, each: int) -> None:
        log.send_columns(entity, [rr.TimeColumn("time", duration=times)], columns.partition([each] * len(times)))

    for block in motion.blocks(confidence=True):
        poses, times, ends = block.motion.poses, block.motion.times, list(motion.skeleton.parents[1:])
        seen = np.where(poses.valid, poses.provenance, np.minimum(poses.provenance, Provenance.BRIDGED))
        colours = _PALETTE[seen].reshape(-1, 4)
        bone_colours = _PALETTE[np.minimum(seen[:, 1:], seen[:, ends])].reshape(-1, 4)
        J, p = seen.shape[1], poses.p_world_joint
        bones = np.stack([p[:, ends], p[:, 1:]], axis=2).reshape(-1, 2, 3)
        send("world/joints", times, rr.Points3D.columns(positions=p.reshape(-1, 3), colors=colours), J)
        send("world/bones", times, rr.LineStrips3D.columns(strips=bones, colors=bone_colours), J - 1)
        if block.motion.confidence is not None:
            radii = (BAND_95 * block.motion.confidence.relative_sigma).ravel()
            clear = np.concatenate([colours[:, :3], np.full_like(colours[:, :1], _CLEAR)], axis=1)
            send("world/bands", times, rr.Points3D.columns(positions=p.reshape(-1, 3), radii=radii, colors=clear), J)
        for place, view in zip(places, measured.read(block.start, block.stop).views if measured else (), strict=True):
            uv, own = view.in_video(slice(None)), view.project(p, slice(None))
            marks = rr.Points2D.columns(positions=uv.reshape(-1, 2), radii=np.where(view.seen, 3.0, 0.0).ravel())
            send(f"{place}/detected", times, marks, uv.shape[1])
            lines = np.stack([own[:, ends], own[:, 1:]], axis=2).reshape(-1, 2, 2)
            send(f"{place}/skeleton", times, rr.LineStrips2D.columns(strips=lines, colors=bone_colours), J - 1)
    for place in places:
        log.log(f"{place}/detected", rr.Points2D.from_fields(colors=[_DETECTED]), static=True)
    for names, times, degrees, sigma in beside.angles(motion) if beside.angles else ():
        limits = np.stack([degrees, degrees - BAND_95 * sigma, degrees + BAND_95 * sigma], axis=2)
        for number, name in enumerate(names):
            send(f"angles/{name}", times, rr.Scalars.columns(scalars=limits[:, number].ravel()), 3)
            if times[0] == motion.times[0]:
                style = rr.SeriesLines(colors=_CURVES, names=[name, f"{name} low", f"{name} high"], widths=[2, 1, 1])
                log.log(f"angles/{name}", style, static=True)
    for number, (time, data) in enumerate(beside.video() if beside.video and places else ()):
        if not number:
            log.log(places[0], rr.VideoStream(codec=rr.VideoCodec.H264), static=True)
        log.set_time("time", duration=time)
        log.log(places[0], rr.VideoStream.from_fields(sample=data))
    log.disconnect()
    return 0.0


def _layout(rrb: Any, places: Sequence[str]) -> Any:
    """Return what is open at the start: the room and the pictures, curves below them."""
    pictures = [rrb.Spatial2DView(origin=place, name=place.split("/")[1]) for place in places]
    curves = [
        rrb.TimeSeriesView(origin="angles", contents=[f"angles/{side}_{name}" for side in ("left", "right")], name=name)
        for name in _SHOWN
    ]
    above = rrb.Horizontal(rrb.Spatial3DView(origin="world", name="world"), *pictures)
    return rrb.Blueprint(rrb.Vertical(above, rrb.Horizontal(*curves), row_shares=[3, 1]), collapse_panels=True)
