"""``frames.png``: some frames of the video with the people and their numbers; without it, stick figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.folder import new_file
from rtof_kin.setup.people import People
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.video import read_video

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE: Final = "frames.png"
_COLORS: Final = ("#e69f00", "#0072b2", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
_PANELS: Final = 6
_PANEL_INCHES, _MOST_PIXELS = 3.4, 720


def write_frames_picture(
    path: str | Path, people: People, layout: str, image_px: tuple[int, int], video: str | Path | None = None
) -> None:
    """Draw the people of a video at six instants.

    Args:
        path: .png file, replaced. video: whose frames are shown behind them; None: a plain background.

    Raises:
        FileFormatError: the video cannot be read.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = _instants(people)
    images = {} if video is None else _images(video, frames)
    joints = [_joints(people, n, layout) for n in range(len(people))]
    columns = 3 if image_px[0] >= image_px[1] else _PANELS
    rows = -(-len(frames) // columns)
    width = _PANEL_INCHES if columns == 3 else _PANEL_INCHES * 0.7
    panel = (width, width * image_px[1] / image_px[0])
    figure = Figure((columns * panel[0], rows * panel[1]), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, frame in zip(figure.subplots(rows, columns, squeeze=False).flat, frames, strict=False):
        _draw(axes, frame, people, joints, image_px, images.get(frame))
    for axes in figure.axes:
        axes.set_axis_off()
    with new_file(path, overwrite=True) as whole:
        figure.savefig(whole, dpi=150)


def _instants(people: People) -> list[int]:
    """Return, of equal parts of the recording, the frame of each in which most of the people is seen."""
    seen = people.detections.confidence.sum(axis=(1, 2))
    parts = np.array_split(np.arange(len(seen)), min(_PANELS, len(seen)))
    best = [int(part[np.argmax(seen[part] >= 0.98 * seen[part].max())]) for part in parts]
    return [frame for frame in best if seen[frame] > 0]


def _images(video: str | Path, frames: Sequence[int]) -> dict[int, NDArray[np.uint8]]:
    """Return frames of a video in RGB, small."""
    found = {}
    for frame in read_video(video):
        if frame.index in frames:
            step = max(1, max(frame.image.shape[:2]) // _MOST_PIXELS)
            found[frame.index] = frame.image[::step, ::step, ::-1]
        if frame.index >= max(frames):
            break
    return found


def _joints(people: People, column: int, layout: str) -> tuple[Array, tuple[tuple[int, int], ...]]:
    """Return the joints (T, J, 2) of a person, px, and the pairs of them that a bone connects."""
    regression, skeleton = LandmarkRegression.default(), SkeletonModel.default()
    uv, confidence = people.detections.uv_px[:, column], people.detections.confidence[:, column]
    found = regression.apply(layout, uv, confidence)
    names = [name for name in skeleton.names if name in found.names]
    bones = tuple(
        (names.index(skeleton.names[parent]), names.index(name))
        for name, parent in zip(skeleton.names, skeleton.parents, strict=True)
        if parent >= 0 and name in names and skeleton.names[parent] in names
    )
    return found.uv_px[:, [found.names.index(name) for name in names]], bones


def _draw(
    axes: Axes,
    frame: int,
    people: People,
    joints: Sequence[tuple[Array, Any]],
    image_px: tuple[int, int],
    image: NDArray[np.uint8] | None,
) -> None:
    width, height = image_px
    if image is None:
        axes.add_patch(_rectangle(width, height))
    else:
        axes.imshow(image, extent=(0, width, height, 0))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.text(
        0.02 * width,
        0.98 * height,
        f"{people.times[frame]:.2f} s",
        fontsize=8,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )
    for number, (uv, bones) in enumerate(joints, start=1):
        points, color = uv[frame], _COLORS[(number - 1) % len(_COLORS)]
        seen = points[np.isfinite(points).all(axis=-1)]
        if not len(seen):
            continue
        for a, b in bones:
            axes.plot(*points[[a, b]].T, color=color, linewidth=1.6, solid_capstyle="round")
        own = people.detections.uv_px[frame, number - 1]
        axes.plot(
            *own.T, linestyle="", marker="o", markersize=1.8, color="white", markeredgecolor=color, markeredgewidth=0.6
        )
        top = np.nanmin([seen[:, 1].min(), np.nanmin(own[:, 1])])
        axes.text(
            float(np.clip(seen[:, 0].mean(), 0.04 * width, 0.96 * width)),
            float(np.clip(top - 0.03 * height, 0.07 * height, height)),
            str(number),
            color="white",
            fontsize=9,
            fontweight="bold",
            ha="center",
            va="bottom",
            bbox={"boxstyle": "round,pad=0.2", "facecolor": color, "edgecolor": "none"},
        )


def _rectangle(width: int, height: int) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((0, 0), width, height, facecolor="#f4f4f2", edgecolor="#b0b0b0", linewidth=0.8)
