"""Figures of a reconstruction: skeletons with the reference, error over time, joint angles over time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.body.metrics import BEGUN_TOGETHER, comparable, flexion, hinges
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reporting import document
from rtof_kin.reporting.document import Figure, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

ESTIMATE: Final = "#c0392b"
TRUTH: Final = "#2e8b57"
STAGE_COLORS: Final = {
    "lift": "#8c8c8c",
    "sf2": "#e69f00",
    "rto": "#0072b2",
    "rtof": "#c0392b",
    "start": "#e69f00",
    "imu": "#c0392b",
}


def write_figures(result: Reconstruction, folder: str | Path) -> None:
    """Write all figures that apply as PNG."""
    drawn = [
        Figure("skeletons", "Skeletons at a few instants from two sides", partial(skeletons, result)),
        Figure("joint_angles", "Flexion of knees and elbows over time", partial(joint_angles, result)),
    ]
    if result.stage_metrics:
        drawn.append(Figure("error_over_time", "Error of each stage over time", partial(error_over_time, result)))
    document.write_figures(drawn, Path(folder))


def skeletons(result: Reconstruction, instants: int = 5) -> Plot:
    """Plot the estimated skeleton (red) and the reference (green) at a few instants, from two sides.

    Positions are relative to the estimate's root, seen from the camera and from its right; without a
    camera, from the front and the right. See `comparable` for mode imu.
    """
    poses, parents = result.motion.poses, result.motion.skeleton.parents
    truth = _truth_at(result)
    if result.recording.truth is not None:
        poses = comparable(poses, result.recording.truth, result.mode)
    frames = np.linspace(0, len(poses) - 1, instants + 2).round().astype(int)[1:-1]
    figure, axes = subplots(2, instants, (2.6 * instants, 6.4))
    sides, title = _sides(result)
    for column, frame in enumerate(frames):
        root = poses.p_world_joint[frame, 0]
        axes[0][column].set_title(f"{poses.times[frame]:.2f} s")
        for ax, (view, label) in zip(axes[:, column], sides, strict=True):
            if truth is not None:
                plot_skeleton(ax, (truth[frame] - root) @ view.T, parents, TRUTH, "truth")
            p = (poses.p_world_joint[frame] - root) @ view.T
            plot_skeleton(ax, p, parents, ESTIMATE, result.mode)
            ax.set_aspect("equal")
            ax.set_xlim(-1.1, 1.1)
            ax.set_ylim(-1.2, 1.0)
            ax.set_xlabel(f"{label} [m]")
            ax.set_ylabel("up [m]" if column == 0 else "")
    axes[0][0].legend(loc="lower left", fontsize=8)
    if truth is not None and result.mode == "imu":
        title = f"{title}\n{BEGUN_TOGETHER}"
    figure.suptitle(f"{result.recording.name}: {title}")
    return figure


def error_over_time(result: Reconstruction) -> Plot:
    """Plot the mean joint error of each stage over time, absolute and relative to the root, by a reference."""
    figure, axes = subplots(2, 1, (11, 6), sharex=True)
    titles = {"mpjpe_rr_mm": "relative to the root", "mpjpe_mm": "absolute"}
    for ax, (key, title) in zip(axes.flat, titles.items(), strict=True):
        for stage, metrics in result.stage_metrics.items():
            label = f"{stage}: mean {metrics[key]:.1f} mm"
            times = result.stages[stage].times
            ax.plot(times, metrics.over_time[key], color=STAGE_COLORS[stage], lw=1, label=label)
        _shade_gaps(ax, result)
        ax.set_ylabel(f"joint error, {title} [mm]")
        ax.set_ylim(bottom=0)
        ax.legend(loc="upper right", fontsize=8)
        ax.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    figure.suptitle(f"{result.recording.name}: mean per joint position error of each stage")
    return figure


def joint_angles(result: Reconstruction) -> Plot:
    """Plot flexion of knees and elbows over time, with the reference if there is one."""
    skeleton, poses = result.motion.skeleton, result.motion.poses
    truth = _truth_at(result)
    joints = hinges(skeleton)
    estimated = np.degrees(flexion(poses.p_world_joint, skeleton))
    true = None if truth is None else np.degrees(flexion(truth, skeleton))
    figure, axes = subplots(len(joints), 1, (11, 2.0 * len(joints)), sharex=True)
    for ax, j in zip(axes.flat, joints, strict=True):
        names = (dof.clinical.removeprefix("-") for dof in skeleton.table.joints[j].dofs)
        name = next(name for name in names if name.endswith("flexion"))
        if true is not None:
            ax.plot(poses.times, true[:, j], color=TRUTH, lw=1.5, label="truth")
            off = np.abs(estimated[:, j] - true[:, j])
            if np.isfinite(off).any():
                name += f" (error {np.nanmean(off):.1f} deg)"
        ax.plot(poses.times, estimated[:, j], color=ESTIMATE, lw=1, label=result.mode)
        _shade_gaps(ax, result)
        ax.set_title(name, fontsize=9)
        ax.set_ylabel("[deg]")
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper right", fontsize=8)
    axes[-1, 0].set_xlabel("time [s]")
    figure.suptitle(f"{result.recording.name}: flexion angles (0 = straight)")
    return figure


def _sides(result: Reconstruction) -> tuple[list[tuple[Array, str]], str]:
    """`views` of the camera, or of the subject without one, and their description."""
    if result.keypoints is not None:
        camera = result.keypoints.camera
        return views(camera.R_camera_world), "from the camera (top), from its right (bottom)"
    forward = np.array([*result.motion.poses.R_world_bone[:, 0, :2, 0].mean(axis=0), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    (front, _), (side, _) = views(np.stack([np.cross(down, -forward), down, -forward]))
    return [(front, "left"), (side * [[-1.0], [1.0]], "forward")], "from the front (top) and the right"


def views(R_camera_world: Array) -> list[tuple[Array, str]]:
    """Return the projections (2, 3) of a camera's view (3, 3) and of the view from its right, with axis labels."""
    R = R_camera_world
    looks_down = np.hypot(*R[2, :2]) < 0.1  # then the top of the image is ahead
    forward = -R[1] if looks_down else R[2].copy()
    forward[2] = 0.0
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    return [(np.stack([right, up]), "right"), (np.stack([forward, up]), "away from camera")]


def plot_skeleton(ax: Any, points: Array, parents: Sequence[int], color: str, label: str | None = None) -> None:
    """Draw the bones between joints (J, 2)."""
    for child, parent in enumerate(parents):
        if parent >= 0:
            x, y = points[[parent, child]].T
            ax.plot(x, y, color=color, lw=2, alpha=0.85, label=label if child == 1 else None)


def _truth_at(result: Reconstruction) -> Array | None:
    """Reference joint positions (T, J, 3) at the motion's times, or None."""
    truth = result.recording.truth
    if truth is None:
        return None
    return signals.interpolate(truth.times, truth.p_world_joint, result.motion.times)


def _shade_gaps(ax: Any, result: Reconstruction) -> None:
    """Shade frames without a valid pose."""
    times = result.motion.times
    for start, stop in signals.runs(~result.motion.poses.valid.any(axis=1)):
        ax.axvspan(times[start], times[stop - 1], color="0.85", zorder=0)
