"""Figure of the example: images, estimated joints and errors of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray
from pose2sim_trial import Trial
from real_camera_truth import Truth

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import RtofError
from rtof_kin.protocols.measures import STAGE_COLORS, views
from rtof_kin.reporting.document import TRUTH
from rtof_kin.vision.video import read_video

if TYPE_CHECKING:
    from real_camera import Estimate

Array = NDArray[np.float64]
CAMERA_COLORS = ("#0072b2", "#d55e00", "#7b4fa3", "#b58900", "#444444", "#cc79a7")
POINTS = "#ffd400"
_MARGIN = 0.3
"""Margin of the image crop around the person, in body heights."""


def draw(trial: Trial, truth: Truth, estimates: Sequence[Estimate], skeleton: SkeletonModel, path: Path) -> None:
    """Write the figure as PNG."""
    count = len(estimates)
    figure = Figure(figsize=(3.6 * count + 0.6, 14.6), layout="constrained", dpi=110)
    figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
    grid = figure.add_gridspec(3, 2 * count, height_ratios=(1.3, 1.0, 1.15))
    frame = int(np.argmax(np.isfinite(estimates[0].over_time["rto"])))
    middle = len(truth.poses) // 2
    for c, e in enumerate(estimates):
        cell = slice(2 * c, 2 * c + 2)
        _image(figure.add_subplot(grid[0, cell]), e, trial.videos[c], frame, skeleton)
        _from_the_side(figure.add_subplot(grid[1, cell]), e, truth, middle, skeleton, first=c == 0)
    _in_space(figure.add_subplot(grid[2, :count], projection="3d"), estimates, truth, middle, skeleton)
    _over_time(figure.add_subplot(grid[2, count:]), estimates, truth)
    T, rate_hz = len(truth.poses), truth.poses.rate_hz
    figure.suptitle(
        f"{trial.name}: each camera alone against the triangulation from {count} "
        f"({T / rate_hz:.1f} s, one person: an illustration)\nDetections and video: Pose2Sim's "
        "demonstration data, (c) 2022 perfanalytics, BSD-3",
        fontsize=12,
    )
    figure.savefig(path)


def _image(ax: Any, e: Estimate, video: Path | None, frame: int, skeleton: SkeletonModel) -> None:
    """Draw a frame with the detector's points and the rto skeleton."""
    image = _frame(video, frame)
    if image is not None:
        height, width = image.shape[:2]
        ax.imshow(0.35 + 0.65 * image / 255.0, extent=(0, width, height, 0))
    else:
        ax.set_facecolor("#f2f2f2")
    uv = e.camera.project(e.stages["rto"].p_world_joint[frame])
    _bones(ax, uv, skeleton, STAGE_COLORS["rto"], lw=3)
    seen = e.view.uv_px[frame][e.view.weight[frame] > 0]
    ax.plot(*seen.T, "o", color=POINTS, mec="black", ms=5, mew=0.7)
    everything = np.concatenate([uv, seen])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    reach = (0.5 + _MARGIN / 2) * float(np.ptp(everything[:, 1]))
    ax.set_xlim(middle[0] - 0.68 * reach, middle[0] + 0.68 * reach)
    ax.set_ylim(middle[1] + reach, middle[1] - reach)
    ax.set_aspect("equal")
    fit = e.scores["rto"]["fit_px"]
    ax.set_title(f"{e.view.name}, frame {frame}: detector, rto ({fit:.0f} px)", fontsize=10)
    ax.set_xlabel("u [px]")
    ax.set_ylabel("v [px]")


def _from_the_side(ax: Any, e: Estimate, truth: Truth, frame: int, skeleton: SkeletonModel, first: bool) -> None:
    """Draw the joints seen from the right of the camera, where depth errors are visible."""
    view, label = views(e.camera.R_camera_world)[1]
    floor = e.camera.center_world * [1.0, 1.0, 0.0]
    styles = {"triangulation": (TRUTH, 3.0)}
    styles |= {mode: (STAGE_COLORS[mode], 2.0) for mode in ("lift", "rto")}
    points = {"triangulation": truth.poses.p_world_joint[frame]}
    points |= {mode: e.stages[mode].p_world_joint[frame] for mode in ("lift", "rto")}
    for name, (color, lw) in styles.items():
        _bones(ax, (points[name] - floor) @ view.T, skeleton, color, lw)
    flat = np.concatenate([(p - floor) @ view.T for p in points.values()])
    middle = (flat[:, 0].min() + flat[:, 0].max()) / 2
    ax.set_xlim(middle - 0.95, middle + 0.95)
    ax.set_ylim(-0.1, 2.0)
    ax.set_aspect("equal")
    ax.grid(alpha=0.3)
    along, across = (e.scores["rto"][key] for key in ("along_mm", "across_mm"))
    ax.set_title(f"rto: {along:.0f} mm along the view, {across:.0f} across", fontsize=10)
    ax.set_xlabel(f"{label} [m]")
    if first:
        ax.set_ylabel(f"up [m]; from its right, {truth.poses.times[frame]:.2f} s")
        lines = [Line2D([], [], color=color, lw=lw, label=name) for name, (color, lw) in styles.items()]
        ax.legend(handles=lines, loc="best", fontsize=8)


def _in_space(ax: Any, estimates: Sequence[Estimate], truth: Truth, frame: int, skeleton: SkeletonModel) -> None:
    """Draw the triangulation and every camera's rto in world, with the directions to the cameras."""
    every = [truth.poses.p_world_joint[frame]]
    _bones(ax, every[0], skeleton, TRUTH, 4)
    lines = [Line2D([], [], color=TRUTH, lw=4, label="triangulation")]
    for e, color in zip(estimates, CAMERA_COLORS, strict=False):
        every.append(e.stages["rto"].p_world_joint[frame])
        _bones(ax, every[-1], skeleton, color, 1.8)
        lines.append(Line2D([], [], color=color, lw=1.8, label=f"rto of {e.view.name}"))
    points = np.concatenate(every)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2 * [1, 1, 0]
    for e, color in zip(estimates, CAMERA_COLORS, strict=False):
        towards = (e.camera.center_world - middle) * [1, 1, 0]
        end = middle + 0.85 * towards / np.linalg.norm(towards)
        ax.plot(*np.stack([middle, end]).T, color=color, lw=1.5, ls="--")
        ax.plot(*end, marker="o", color=color, ms=5)
    for axis, m in zip("xy", middle, strict=False):
        getattr(ax, f"set_{axis}lim")(m - 0.9, m + 0.9)
    ax.set_zlim(0, 1.8)
    ax.set_box_aspect((1, 1, 1), zoom=1.1)
    ax.view_init(elev=12, azim=-60)
    for axis in "xyz":
        getattr(ax, f"set_{axis}label")(f"{axis} [m]")
        getattr(ax, f"{axis}axis").set_major_locator(MultipleLocator(0.5))
    ax.legend(handles=lines, loc="upper left", fontsize=8)
    time = truth.poses.times[frame]
    ax.set_title(f"in world at {time:.2f} s; dashed: towards the cameras", fontsize=10)


def _over_time(ax: Any, estimates: Sequence[Estimate], truth: Truth) -> None:
    for e, color in zip(estimates, CAMERA_COLORS, strict=False):
        for mode, style in (("lift", {"ls": ":", "lw": 1.2}), ("rto", {"ls": "-", "lw": 2})):
            mean = e.scores[mode]["relative_mm"]
            label = f"{e.view.name} {mode}: mean {mean:.0f} mm"
            ax.plot(truth.poses.times, e.over_time[mode], color=color, label=label, **style)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("mean joint error relative to the root [mm]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, ncols=2, loc="lower right")
    ax.set_title("error over time", fontsize=10)


def _bones(ax: Any, points: Array, skeleton: SkeletonModel, color: str, lw: float) -> None:
    """Draw the bones between joints (J, 2) or (J, 3) as one line with gaps."""
    gap = np.full(points.shape[1], np.nan)
    bones = [[points[p], points[j], gap] for j, p in enumerate(skeleton.parents) if p >= 0]
    ax.plot(*np.reshape(bones, (-1, len(gap))).T, color=color, lw=lw, alpha=0.9)


def _frame(video: Path | None, frame: int) -> NDArray[np.uint8] | None:
    """Return a frame (height, width, 3) in RGB; None without a video or the extra `video`."""
    if video is None:
        return None
    try:
        for found in read_video(video):
            if found.index == frame:
                return np.ascontiguousarray(found.image[..., ::-1])
    except RtofError:  # extra `video` not installed
        return None
    return None
