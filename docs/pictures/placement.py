"""``placement.png``: where the sensors sit, on the T-pose from the front and from the left."""

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


def make(studio: Studio) -> list[Path]:
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
                "eight limb sensors"
                if name in EIGHT
                else "ten: + trunk"
                if name in TEN
                else "thirteen: + head, feet"
            )
            ax.scatter(place[across], place[2], s=60, marker="s", color=COLOURS[group], zorder=2)
            if across == 1:
                right, low = place[1] < 0, "UpArm" in name  # labels of an arm would overlap
                offset = (-7 if right else 7, -14 if low else 7)
                ax.annotate(
                    name, (place[1], place[2]), offset, textcoords="offset points", fontsize=8,
                    ha="right" if right else "left",
                )  # fmt: skip
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
    return [path]
