"""``placement.png`` and ``placement_axes.png``: where the sensors sit, and the axes of their segments."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

from docs.pictures.studio import DOCS, Studio
from rtof_kin import SkeletonModel

EIGHT = ("L_UpArm", "R_UpArm", "L_LowArm", "R_LowArm", "L_UpLeg", "R_UpLeg", "L_LowLeg", "R_LowLeg")
TEN = (*EIGHT, "Pelvis", "Sternum")
COLOURS = {"eight limb sensors": "#d62728", "ten: + trunk": "#1f77b4", "thirteen: + head, feet": "#7f7f7f"}


AXES = {"x, forward in the T-pose": "#d55e00", "y, left": "#009e73", "z, up": "#0072b2"}
AZIMUTH, ELEVATION = np.radians(35.0), np.radians(12.0)
"""[rad] from which the axes are seen: before the subject, to the left, a little from above."""


def make(studio: Studio) -> list[Path]:
    return [places(), axes()]


def axes() -> Path:
    """Draw T-pose and N-pose with the axes of every segment that carries a sensor, at the sensor's place."""
    path = DOCS / "placement_axes.png"
    skeleton = SkeletonModel.default()
    view = np.array(
        [
            [-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0],
            [-np.cos(AZIMUTH) * np.sin(ELEVATION), -np.sin(AZIMUTH) * np.sin(ELEVATION), np.cos(ELEVATION)],
        ]
    )
    figure, panels = plt.subplots(1, 2, figsize=(9, 5.6), sharey=True, width_ratios=(1.5, 1.0))
    poses = (("T-pose: all alike", skeleton.t_pose()), ("N-pose: turned with the arms", skeleton.n_pose()))
    for ax, (title, q) in zip(panels, poses, strict=True):
        p, R = (array[0] for array in skeleton.forward_kinematics(q[None]))
        seen = p @ view.T
        for joint, parent in enumerate(skeleton.parents):
            if parent >= 0:
                ax.plot(*seen[[parent, joint]].T, color="0.8", lw=6, solid_capstyle="round", zorder=1)
        for segment, lever in skeleton.sensors.values():
            (j,) = skeleton.index(segment)
            place = p[j] + R[j] @ np.asarray(lever)
            for axis, colour in enumerate(AXES.values()):
                ends = np.stack([place, place + 0.13 * R[j][:, axis]]) @ view.T
                ax.plot(*ends.T, color=colour, lw=2, zorder=2)
            ax.scatter(*(view @ place), s=24, marker="s", color="0.2", zorder=3)
        ax.set_title(title)
        ax.set_aspect("equal")
        ax.set_xlabel("across the view [m]")
    panels[0].set_ylabel("up in the view [m]")
    for label, colour in AXES.items():
        panels[0].plot([], [], color=colour, lw=2, label=label)
    panels[0].scatter([], [], s=24, marker="s", color="0.2", label="sensor")
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def places() -> Path:
    """Draw the T-pose with the sensors and their names, from the front and from the left."""
    path = DOCS / "placement.png"
    skeleton = SkeletonModel.default()
    p, R = skeleton.forward_kinematics(skeleton.t_pose()[None])
    p, R = p[0], R[0]
    figure, axes = plt.subplots(1, 2, figsize=(9, 5.2), sharey=True, width_ratios=(2.2, 1.0))
    # World: x forward, y left, z up. Seen from the front, the subject's left is on the right.
    for ax, across, title in ((axes[0], 1, "from the front"), (axes[1], 0, "from the subject's left")):
        for joint, parent in enumerate(skeleton.parents):
            if parent >= 0:
                ends = p[[parent, joint]]
                ax.plot(ends[:, across], ends[:, 2], color="0.75", lw=6, solid_capstyle="round", zorder=1)
        for name, (segment, lever) in skeleton.sensors.items():
            (j,) = skeleton.index(segment)
            place = p[j] + R[j] @ np.asarray(lever)
            group = (
                "eight limb sensors" if name in EIGHT else "ten: + trunk" if name in TEN else "thirteen: + head, feet"
            )
            ax.scatter(place[across], place[2], s=60, marker="s", color=COLOURS[group], zorder=2)
            if across == 1:
                right, low = place[1] < 0, "UpArm" in name  # labels of an arm would overlap
                offset = (-7 if right else 7, -14 if low else 7)
                ax.annotate(
                    name,
                    (place[1], place[2]),
                    offset,
                    textcoords="offset points",
                    fontsize=8,
                    ha="right" if right else "left",
                )
        ax.set_title(title)
        ax.set_xlim((-0.9, 0.9) if across == 1 else (-0.4, 0.4))
        ax.set_aspect("equal")
        ax.set_xlabel(f"{'y (left)' if across == 1 else 'x (forward)'} [m]")
    axes[0].set_ylabel("z (up) [m]")
    for label, colour in COLOURS.items():
        axes[0].scatter([], [], s=60, marker="s", color=colour, label=label)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
