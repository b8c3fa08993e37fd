"""The motion beside its video, on one time line with the curves: a page to look at, and to choose ranges in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.analysis import analyse
from rtof_kin.core.signals import runs
from rtof_kin.formats.measurements_file import MeasurementsReader, measurements_path
from rtof_kin.reporting.audit_results import headline
from rtof_kin.reporting.document import badge
from rtof_kin.reporting.html import render
from rtof_kin.reporting.page import SCRIPTS, bands_note
from rtof_kin.reporting.plot_data import angle_curves, packed, player_data, shown_frames
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.reporting.summary_lines import summary_lines


def review(folder: str | Path, video: str = "") -> str:
    """Return the page of a reconstruction; it posts the chosen range, ``{range: [start or null, stop or null]}`` in s,
    to the page around it.

    Args:
        folder: written by `export`. video: address of the video on the same server; '' where there is none.

    Raises:
        FileFormatError: the folder's files are missing or damaged.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    with MotionReader(folder) as motion:
        analysis, shown = analyse(motion), shown_frames(motion.times)
        player = player_data(motion, shown, summary.inputs.get("floor_height_m"))
        image, offset = _image(folder, motion, shown)
        start, stop = motion.times[[0, -1]]
        mended = [(max(one.start_s, start), min(one.stop_s, stop)) for one in motion.corrections]
        seen = motion.masks.valid[shown].any(axis=1)
    lines = summary_lines(analysis, summary, headline(summary.results or ()), summary.session)
    feet = analysis.gait.events.feet.items()
    return render(
        "review.html",
        styles=("page.css", "report.css", "review.css"),
        scripts=(*SCRIPTS, "review.js"),
        data={
            "angles": angle_curves(analysis, shown),
            "player": player,
            "image": image,
            "offset": offset,
            "strikes": [{"at": float(at), "side": side} for side, foot in feet for at in foot.strikes],
            "mended": mended,
            "gone": runs(~seen),
            "unplayable": "This browser cannot play the video; the motion is shown without it.",
        },
        title=f"{summary.session.subject or summary.recording}: review",
        summary=[(line.label, badge(line.grade) if line.grade else "", line.text) for line in lines],
        picture="Yellow: detected points." if image else "There was no camera.",
        bands=bands_note(analysis),
        video=video,
    )


def _image(folder: Path, motion: MotionSource, shown: slice) -> tuple[dict[str, Any] | None, float]:
    """Return joints and detected points of the frames that are shown, px of the first camera, and how much later a
    frame is on the video's clock, s; None without a camera.
    """
    path, step = measurements_path(folder), shown.step or 1
    if not path.is_file():
        return None, 0.0
    joints, found, view = [], [], None
    with MeasurementsReader(path) as measured:
        for block in motion.blocks():
            views = measured.read(block.start, block.stop).views
            if not views:
                return None, 0.0
            own = slice(-block.start % step, None, step)
            frames = np.arange(block.stop - block.start)[own]
            poses = block.motion.poses[block.own][own]
            p = np.where(poses.valid[..., None], poses.p_world_joint, np.nan)
            joints.append(views[0].project(p, frames))
            found.append(np.where(views[0].seen[own, :, None], views[0].in_video(frames), np.nan))
            view = view or views[0]
    assert view is not None  # a motion has a frame
    return {
        "width": view.camera.width_px,
        "height": view.camera.height_px,
        "uv": packed(np.concatenate(joints), 1),
        "detected": packed(np.concatenate(found), 1),
        "landmarks": len(view.names),
    }, float(view.video_times[0] - view.times[0])
