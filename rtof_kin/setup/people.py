"""People of a video: numbered for the picture of a recording, and the one that the recording is of."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, blocks_of
from rtof_kin.core.errors import InvalidInputError, UndecidedError
from rtof_kin.core.files.arrays import read_npz, write_npz
from rtof_kin.core.files.folder import new_file
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.tracking import track_people
from rtof_kin.vision.video import read_video

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_LEAST_WEIGHT: Final = 0.05
"""Share of the most prominent person's weight below which somebody is a passer-by or a false detection."""
_RIVAL: Final = 0.4  # Share of the most prominent person's weight from which on the choice is left to the user
_FEWEST_POINTS: Final = 4  # Points at once that make a person
_DOUBLE: Final = 0.1  # Distance, relative to the diagonal of the person's box, within which two points are the same


@dataclass(frozen=True)
class People:
    """People of a video, person n in column n - 1."""

    detections: Detections  #: Those who count, by their numbers; NaN where one is not seen
    times: Array  #: (T,) s
    weights: tuple[float, ...]  #: Prominence of each, relative to the first

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def share(self) -> Array:
        """(P,) fraction of the frames in which each is seen."""
        return np.asarray(self.detections.present.mean(axis=0))

    def first_frame(self, number: int) -> int:
        """Return the first frame in which a person is seen. `number`: from 1."""
        return int(np.argmax(self.detections.present[:, number - 1]))


def number_people(detections: Detections, times: Array, image_px: tuple[float, float]) -> People:
    """Number the people, the most prominent first: large, in the middle and often seen. `times`: (T,) s.
    `InvalidInputError`: there is no person.
    """
    detections = _without_doubles(detections)
    points = (detections.confidence > 0).sum(axis=-1)
    tracks = track_people(detections, times, image_px)
    if points.max() < _FEWEST_POINTS:
        raise no_person()
    kept = [(track, weight) for track, weight in tracks if weight >= _LEAST_WEIGHT * tracks[0][1]]
    shape = (len(times), len(kept), detections.uv_px.shape[2])
    uv, confidence = np.empty((*shape, 2)), np.empty(shape)
    for number, (track, _) in enumerate(kept):
        for frames in blocks_of(len(times)):
            uv[frames, number], confidence[frames, number] = track.of(detections, frames)
    in_space = [p for track, _ in kept if (p := track.in_space(detections)) is not None]
    own = replace(
        detections,
        uv_px=uv,
        confidence=confidence,
        times=times,
        identity=np.broadcast_to(np.arange(len(kept)), shape[:2]),
        p_model=np.stack(in_space, axis=1) if in_space else None,
    )
    weights = tuple(weight / kept[0][1] for _, weight in kept)
    return People(own, times, weights)


def _without_doubles(detections: Detections) -> Detections:
    """Return the detections without those that a detector made twice of one person; the surer one stays."""
    if detections.uv_px.shape[1] == 1:
        return detections
    uv, confidence = np.array(detections.uv_px), np.array(detections.confidence)
    for p, q in combinations(range(uv.shape[1]), 2):
        # The frames (T,) in which both are one, by most of the points that both have.
        apart = np.linalg.norm(uv[:, p] - uv[:, q], axis=-1)
        size = np.linalg.norm(np.fmax.reduce(uv[:, p], axis=1) - np.fmin.reduce(uv[:, p], axis=1), axis=-1)
        both, near = np.isfinite(apart).sum(axis=1), (apart < _DOUBLE * size[:, None]).sum(axis=1)
        same = (both >= _FEWEST_POINTS) & (near > both / 2)
        surer = confidence[:, p].sum(axis=-1) >= confidence[:, q].sum(axis=-1)
        for gone, frames in ((q, same & surer), (p, same & ~surer)):
            uv[frames, gone], confidence[frames, gone] = np.nan, 0.0
    return replace(detections, uv_px=uv, confidence=confidence)


def write_people(path: Path, people: People) -> None:
    """Write an .npz file that `read_detector_file` reads too."""
    found = people.detections
    assert found.identity is not None
    write_npz(
        path,
        {
            **found.about,
            "uv_px": found.uv_px,
            "confidence": found.confidence,
            "times": people.times,
            "identity": found.identity,
            "weights": np.array(people.weights),
        },
    )


def read_people(path: Path) -> People:
    """Read what `write_people` wrote. `FileFormatError`: damaged."""
    found, weights = read_detector_file(path), read_npz(path, names=["weights"])["weights"]
    assert found.times is not None
    return People(found, found.times, tuple(weights.tolist()))


def no_person() -> InvalidInputError:
    """Return the error about a video without people."""
    return InvalidInputError(
        "no person was found in the video: film the whole person, in light, not smaller than a third of the "
        "image; or give the keypoints of another detector"
    )


def choose_person(people: People, number: int | None, picture: str) -> int:
    """Return the number of the person that the recording is of. `number`: as the user says, None where not said.
    `InvalidInputError`: there is no such person; `UndecidedError`: several are equally prominent and none was chosen.
    """
    if number is None:
        rivals = [n for n, weight in enumerate(people.weights, start=1) if weight >= _RIVAL]
        if len(rivals) > 1:
            raise UndecidedError(
                f"{len(rivals)} people are in the video: look at {picture} and choose one with {_options(rivals)}"
            )
        return 1
    if not 1 <= number <= len(people):
        known = _options(range(1, len(people) + 1))
        raise InvalidInputError(f"--person {number}: there is no such person; look at {picture} and choose {known}")
    return number


def _options(numbers: Sequence[int]) -> str:
    return " or ".join(f"--person {n}" for n in numbers)


PICTURE: Final = "frames.png"
_COLORS: Final = ("#e69f00", "#0072b2", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
_BOXES: Final = "People"  # Entry of the picture's text where everybody is
_PANELS: Final = 6
_PANEL_INCHES, _MOST_PIXELS = 3.4, 720


def write_frames_picture(
    path: str | Path, people: People, layout: str, image_px: tuple[int, int], video: str | Path | None = None
) -> None:
    """Draw the people of a video at six instants.

    `path`: .png file, replaced. video: whose frames are shown behind them; None: a plain background.
    `FileFormatError`: the video cannot be read.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Of equal parts of the recording, the frame of each in which most of the people is seen.
    seen = people.detections.confidence.sum(axis=(1, 2))
    parts = np.array_split(np.arange(len(seen)), min(_PANELS, len(seen)))
    best = [int(part[np.argmax(seen[part] >= 0.98 * seen[part].max())]) for part in parts]
    frames = [frame for frame in best if seen[frame] > 0]
    images = {} if video is None else _images(video, frames)
    joints = [_joints(people, n, layout, frames) for n in range(len(people))]
    columns = 3 if image_px[0] >= image_px[1] else _PANELS
    rows = -(-len(frames) // columns)
    width = _PANEL_INCHES if columns == 3 else _PANEL_INCHES * 0.7
    panel = (width, width * image_px[1] / image_px[0])
    figure = Figure((columns * panel[0], rows * panel[1]), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for i, frame in enumerate(frames):
        shown = [(uv[i], bones) for uv, bones in joints]
        _draw(panels[i], f"{people.times[frame]:.2f} s", shown, image_px, images.get(frame))
    for axes in figure.axes:
        axes.set_axis_off()
    figure.draw_without_rendering()  # places the panels
    boxes = []
    for i, axes in enumerate(figure.axes[: len(frames)]):
        for number, (uv, _) in enumerate(joints, start=1):
            seen_px = uv[i][np.isfinite(uv[i]).all(axis=-1)]
            if len(seen_px):
                corners = [seen_px.min(axis=0), seen_px.max(axis=0)]
                (x0, y1), (x1, y0) = figure.transFigure.inverted().transform(axes.transData.transform(corners))
                boxes.append((number, *(round(float(v), 4) for v in (x0, 1 - y1, x1, 1 - y0))))
    with new_file(path, overwrite=True) as whole:
        figure.savefig(whole, metadata={_BOXES: json.dumps(boxes)})


def people_in_picture(path: str | Path) -> list[tuple[float, ...]]:
    """Return number, left, top, right and bottom, as shares of the picture, of everybody in it, once for each instant.

    `path`: what `write_frames_picture` wrote; nobody is in another picture, or in one of an earlier version.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            boxes = json.loads(image.info.get(_BOXES, "[]"))
            return [(int(number), float(x0), float(y0), float(x1), float(y1)) for number, x0, y0, x1, y1 in boxes]
    except (OSError, ValueError, TypeError):
        return []


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


def _joints(people: People, column: int, layout: str, frames: Sequence[int]) -> tuple[Array, list[tuple[int, int]]]:
    """Return the joints (n, J, 2) of a person in some frames, px, and the pairs of them that a bone connects."""
    skeleton = SkeletonModel.default()
    uv, confidence = people.detections.uv_px[frames, column], people.detections.confidence[frames, column]
    try:
        found = LandmarkRegression.default().apply(layout, uv, confidence)
    except InvalidInputError:  # not seen in these
        return np.full((len(frames), 1, 2), np.nan), []
    index = {name: i for i, name in enumerate(found.names) if name in skeleton.names}
    parents = (skeleton.names[parent] if parent >= 0 else "" for parent in skeleton.parents)
    pairs = zip(parents, skeleton.names, strict=True)
    return found.uv_px, [(index[a], index[b]) for a, b in pairs if a in index and b in index]


def _draw(
    axes: Axes,
    time: str,
    people: Sequence[tuple[Array, list[tuple[int, int]]]],
    image_px: tuple[int, int],
    image: NDArray[np.uint8] | None,
) -> None:
    """Draw the joints (J, 2) and bones of each person over an image, with their numbers."""
    width, height = image_px
    plain = np.full((1, 1, 3), 244, dtype=np.uint8)
    axes.imshow(plain if image is None else image, extent=(0, width, height, 0))
    label = {"boxstyle": "round,pad=0.2", "edgecolor": "none"}
    white = {**label, "facecolor": "white", "alpha": 0.8}
    axes.text(0.02 * width, 0.98 * height, time, fontsize=8, bbox=white)
    for number, (uv, bones) in enumerate(people, start=1):
        seen, color = uv[np.isfinite(uv).all(axis=-1)], _COLORS[(number - 1) % len(_COLORS)]
        if not len(seen):
            continue
        for a, b in bones:
            axes.plot(*uv[[a, b]].T, color=color, linewidth=1.6, solid_capstyle="round")
        x = float(np.clip(seen[:, 0].mean(), 0.04 * width, 0.96 * width))
        y = float(np.clip(seen[:, 1].min() - 0.03 * height, 0.07 * height, height))
        own = {**label, "facecolor": color}
        axes.text(x, y, str(number), color="white", fontsize=9, fontweight="bold", ha="center", va="bottom", bbox=own)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
