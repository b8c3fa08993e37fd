"""``skeletons.png``: skeletons of the demo (red) over the truth (green), at a few instants from two sides."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from docs.pictures.studio import Studio, save
from rtof_kin.body.motion_file import MotionReader
from rtof_kin.core.resources import model_path
from rtof_kin.core.signals import interpolate
from rtof_kin.protocols.measures import plot_skeleton, views
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.document import ESTIMATE, TRUTH, subplots

INSTANTS = 5


def make(studio: Studio) -> list[Path]:
    recording = Recording.load(model_path("demo"))
    with MotionReader(studio.demo) as reader:
        poses, parents = reader.read(confidence=False).poses, reader.skeleton.parents
    assert recording.truth is not None
    truth = interpolate(recording.truth.times, recording.truth.p_world_joint, poses.times)
    figure, axes = subplots(2, INSTANTS, (2.6 * INSTANTS, 6.4))
    sides = views(recording.video.camera.R_camera_world)
    for column, frame in enumerate(np.linspace(0, len(poses) - 1, INSTANTS + 2).round().astype(int)[1:-1]):
        root = poses.p_world_joint[frame, 0]
        axes[0][column].set_title(f"{poses.times[frame]:.2f} s")
        for ax, (view, label) in zip(axes[:, column], sides, strict=True):
            plot_skeleton(ax, (truth[frame] - root) @ view.T, parents, TRUTH, "truth")
            plot_skeleton(ax, (poses.p_world_joint[frame] - root) @ view.T, parents, ESTIMATE, "rtof")
            up = "up [m]" if column == 0 else ""
            ax.set(aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.2, 1.0), xlabel=f"{label} [m]", ylabel=up)
    axes[0][0].legend(loc="lower left", fontsize=8)
    figure.suptitle(f"{recording.name}: from the camera (top), from its right (bottom)")
    figure.set_canvas(FigureCanvasAgg(figure))
    path = studio.folder / "skeletons.png"
    figure.savefig(path)
    with Image.open(path) as image:
        return [save(image, "skeletons.png")]
