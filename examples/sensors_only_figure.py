"""Figure of the example without a camera: skeletons over time, root path, ankle heights, knee flexion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rtof_kin.body.metrics import flexion
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.result import Reconstruction

Array = NDArray[np.float64]
LEFT, RIGHT, TRUNK = "#0072b2", "#d55e00", "#444444"
INSTANTS, APART = 16, 0.9
FEET = ("LeftFoot", "RightFoot")


def draw(result: Reconstruction, path: Path) -> None:
    """Write the figure as PNG."""
    poses, skeleton = result.motion.poses, result.motion.skeleton
    figure = Figure(figsize=(15, 11), layout="constrained", dpi=90)
    figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
    grid = figure.add_gridspec(4, 2, height_ratios=(0.8, 0.8, 1, 1))
    for row, (side, label) in enumerate((("side", "forward"), ("front", "left"))):
        _skeletons(figure.add_subplot(grid[row, :]), poses, skeleton.parents, side, label)
    _path(figure.add_subplot(grid[2:, 0]), result)
    _feet(figure.add_subplot(grid[2, 1]), poses)
    _knees(figure.add_subplot(grid[3, 1]), poses, flexion(poses.p_world_joint, skeleton))
    figure.suptitle(f"{result.recording.name}: {len(result.recording.imus.names)} sensors, no camera")
    figure.savefig(path)


def _color(name: str) -> str:
    return LEFT if name.startswith("Left") else RIGHT if name.startswith("Right") else TRUNK


def _skeletons(ax: Any, poses: PoseSequence, parents: tuple[int, ...], side: str, label: str) -> None:
    """Draw skeletons side by side, each seen from its right or from its back."""
    frames = np.linspace(0, len(poses) - 1, INSTANTS + 2).round().astype(int)[1:-1]
    for k, frame in enumerate(frames):
        axis = poses.R_world_bone[frame, 0, :, 0 if side == "side" else 1] * [1, 1, 0]
        axis = axis / np.linalg.norm(axis) * (1 if side == "side" else -1)
        p = poses.p_world_joint[frame]
        across = (p - p[0]) @ axis + APART * k
        toes = p + poses.R_world_bone[frame] @ np.array([0.15, 0, -0.06])
        for j, parent in enumerate(parents):
            if parent >= 0:
                ax.plot(across[[parent, j]], p[[parent, j], 2], color=_color(poses.names[j]), lw=2)
            if poses.names[j] in FEET:
                tip = (toes[j] - p[0]) @ axis + APART * k
                ax.plot([across[j], tip], [p[j, 2], toes[j, 2]], color=_color(poses.names[j]), lw=2)
        ax.text(APART * k, -0.12, f"{poses.times[frame] - poses.times[0]:.1f} s", ha="center", fontsize=8)
    ax.axhline(0, color="0.8", lw=1, zorder=0)
    ax.set_aspect("equal")
    ax.set_ylabel("up [m]")
    seen = "from its right, forward to the right" if side == "side" else "from its back"
    ax.set_xlabel(f"{label} [m], {APART} m between instants; each {seen}")


def _path(ax: Any, result: Reconstruction) -> None:
    poses = result.motion.poses
    ax.plot(*poses.p_world_joint[:, 0, :2].T, color=TRUNK, label="root")
    for name in FEET:
        p = poses.p_world_joint[:, poses.names.index(name)]
        ax.plot(*p[:, :2].T, color=_color(name), lw=0.7, label=name)
    sigma = result.root_sigma[-1]
    ax.set_title(f"from above; at the end the place has a standard deviation of {sigma:.2f} m per axis")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)


def _feet(ax: Any, poses: PoseSequence) -> None:
    for name in FEET:
        height = poses.p_world_joint[:, poses.names.index(name), 2]
        ax.plot(poses.times, height, color=_color(name), label=name)
    ax.axhline(0.08, color="0.7", lw=0.8)
    ax.set_ylabel("ankle's height [m]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)


def _knees(ax: Any, poses: PoseSequence, bent: Array) -> None:
    for name in ("LeftLeg", "RightLeg"):
        ax.plot(poses.times, np.degrees(bent[:, poses.names.index(name)]), color=_color(name), label=name)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("knee flexion [deg]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
