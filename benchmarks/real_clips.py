"""One camera alone, without sensors, on real clips with four: lift, and rto with joints and with raw points.

``python -m benchmarks real_clips --data DIR`` with DIR the folder of ``pose2sim_demo`` (OpenPose BODY_25B,
BSD-3) and ``caliscope_4cam`` (MediaPipe, BSD-2; the person sits, few pictures have the legs). The reference
is the robust triangulation of the detector's own points from all four cameras, whose poses are adjusted
first, so that no definition of a joint stands between: a mode's body predicts these points in the four
pictures, and the predictions are triangulated alike.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import numpy as np
import tomli_w

from benchmarks.command_line import study_parser
from benchmarks.harness import write_results
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import BAND_95, Confidence
from rtof_kin.data.keypoints import detector_point, layout_and_point
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.vision import image_points
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.image_points import DetectorPoint, ImagePoints, detector_points, read_detector_points
from rtof_kin.vision.keypoints import keypoints_from_detections
from rtof_kin.vision.layouts import detector_table

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "examples"))

from multi_view import triangulate  # noqa: E402
from pose2sim_trial import Trial, View, read_trial  # noqa: E402
from real_camera_truth import measured_bones, triangulated  # noqa: E402

Places = Mapping[str, DetectorPoint]
RATE_HZ = 30.0
"""Of caliscope_4cam."""
HEIGHTS = (1.21, 1.72)
"""[m] Of the two people of the trial with two, from its configuration."""
LARGEST_PX = 25.0
"""Largest median distance of a point's triangulation from its detections."""
LIMBS = ("ForeArm", "Hand", "Leg", "Foot")
USUAL = "marker-set places"
LEFT_OUT = {USUAL: ("measured", "view"), "measured places": ("view",), "measured, views": ()}
"""Tables of ``models/detector_points.toml`` that each kind of raw points does without."""
COLUMNS = {
    "relative_mm": "to the hips mm",
    "centred_mm": "to the mean point mm",
    "absolute_mm": "absolute mm",
    "own_places_mm": "own places mm",
    "shape_mm": "within parts mm",
    "own_px": "own picture px",
    "other_px": "other pictures px",
    "inside": "in 95 % bands",
}
NOTES = (
    "Distances of the detector's points, means over frames, points and the four cameras alone. To the hips, "
    "to the mean point: without the error of the hips' middle or of the mean of all points. Own places: the "
    "latter without each point's mean error in its segment. Within parts: of the distances between points "
    "next to one joint. Own picture, other pictures: median and mean distance from the detections there. In "
    "95 % bands: share of errors relative to the hips, per axis, in the bands of the joint next to the "
    "point; errors of the reference count in full.",
    "Lift and joints predict the points at marker-set places. Heights are the configuration's for adult and "
    "child, and from the triangulated limbs for caliscope, where two cameras at most see the hips.",
    "A few seconds of three people: differences of some millimetres between modes say nothing.",
)


def caliscope(folder: Path, height: float = 1.75) -> Trial:
    """The clip of ``caliscope_4cam``; its height is only a start."""
    cameras = read_camera_toml(folder / "config.toml", up="x")
    rows = np.genfromtxt(folder / "xy_HOLISTIC.csv", delimiter=",", skip_header=1)
    rows = rows[rows[:, 4] < len(detector_table().layout("mediapipe33"))]
    frame, port, point = rows[:, [0, 1, 4]].astype(int).T
    uv = np.full((len(cameras), frame.max() + 1, point.max() + 1, 2), np.nan)
    uv[port, frame, point] = rows[:, 5:7]
    times, views = np.arange(uv.shape[1]) / RATE_HZ, []
    for (name, camera), seen in zip(cameras.items(), uv, strict=True):
        weight = np.isfinite(seen[..., 0]).astype(float)
        people = Detections(seen[:, None], weight[:, None])
        found = keypoints_from_detections(people, times, camera, "mediapipe33")
        views.append(View(name, camera, found, seen, weight))
    return Trial("caliscope", tuple(views), height, "the only one", (None,) * len(views))


def clips(folder: Path) -> Iterator[tuple[str, Clip]]:
    """Yield the clips of the folder by name; adult and child are of one trial."""
    for number, who in enumerate(("child", "adult"), start=1):
        trial = read_trial(folder / "pose2sim_demo", "S00_P01_T02_Participants1-2", HEIGHTS, number)
        yield who, Clip.of(trial)
    yield "caliscope", Clip.of(caliscope(folder / "caliscope_4cam"), scale=True)


@dataclass(frozen=True)
class Clip:
    """One person, with the reference in pictures without distortion."""

    views: tuple[View, ...]
    cameras: tuple[Camera, ...]
    """Adjusted, with distortion."""
    skeleton: SkeletonModel
    points: tuple[str, ...]
    """L used points of the detector, as keypoints name them."""
    uv_px: Array
    """(C, T, L, 2) detections."""
    weight: Array
    """(C, T, L); 0 where there is no reference."""

    @staticmethod
    def of(trial: Trial, scale: bool = False) -> Clip:
        """Triangulate and adjust the cameras; `scale` the body to the limbs where its height is unknown."""
        skeleton = SkeletonModel.default().with_height(trial.height)
        truth = triangulated(trial, skeleton, adjust=True)
        if scale:
            bones = measured_bones(truth, skeleton)
            sizes = [bones[n] / skeleton.bone_lengths[n] for n in bones if n.endswith(LIMBS)]
            skeleton = skeleton.with_height(trial.height * float(np.median(sizes)))
        layout = trial.views[0].found.recognition.layout
        used = [name for name in layout.points if name in detector_points(layout.name)]
        at = [layout.points.index(name) for name in used]
        pairs = list(zip(truth.cameras, trial.views, strict=True))
        uv = np.stack([c.normalise(v.uv_px[:, at]) @ c.K[:2, :2].T + c.K[:2, 2] for c, v in pairs])
        weight = np.stack([view.weight[:, at] for view in trial.views])
        names = tuple(detector_point(layout.name, name) for name in used)
        clip = Clip(trial.views, truth.cameras, skeleton, names, uv, weight)
        error = np.linalg.norm(clip.triangulate(uv)[1], axis=-1)
        known = np.isfinite(error).any(axis=0)
        sure = np.nanmedian(np.where(known, error, np.inf), axis=0) < LARGEST_PX
        return replace(clip, weight=weight * sure)

    @property
    def lenses(self) -> list[Camera]:
        """The cameras without distortion."""
        return [camera.undistorted() for camera in self.cameras]

    def triangulate(self, uv_px: Array) -> tuple[Array, Array]:
        """Points (T, L, 3) of pictures (C, T, L, 2), and their reprojection errors."""
        return triangulate(self.lenses, uv_px, self.weight)


def kinds_of_places(layout: str) -> dict[str, Places]:
    """The points of a layout by kind of places; one kind where none were measured."""
    data, out = load_toml(model_path("detector_points.toml")), dict[str, Places]()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "points.toml"
        for kind, left_out in LEFT_OUT.items():
            if kind == USUAL or layout in data["measured"]:
                kept = {name: part for name, part in data.items() if name not in left_out}
                path.write_text(tomli_w.dumps(kept), encoding="utf-8")
                out[kind] = read_detector_points(path, layout)
    return out


@contextmanager
def used(places: Places) -> Iterator[None]:
    """Take these places of points instead of those that ship."""
    with mock.patch.object(image_points, "detector_points", return_value=places):
        yield


def measure(name: str, clip: Clip) -> list[dict[str, Any]]:
    """A row for every camera and mode."""
    kinds, rows = kinds_of_places(layout_and_point(clip.points[0])[0]), []
    for c, (camera, view) in enumerate(zip(clip.cameras, clip.views, strict=True)):
        seen = replace(view.found.keypoints, camera=camera)
        for kind, places in {"joints": kinds[USUAL], **kinds}.items():
            keypoints = seen.landmarks if kind == "joints" else seen
            recording = Recording(view.name, keypoints, joint_offsets=clip.skeleton.joint_offsets)
            with used(places):
                result = reconstruct(recording, clip.skeleton, "rto")
                points = image_points.image_points(clip.skeleton, clip.points)
            stages = {kind: (result.motion.poses, result.motion.confidence)}
            if kind == "joints":
                stages = {"lift": (result.stages["lift"], None), **stages}
            for mode, (poses, confidence) in stages.items():
                figures = score(clip, c, points, poses, confidence)
                rows.append({"clip": name, "camera": view.name, "mode": mode, **figures})
    return rows


def score(
    clip: Clip, camera: int, points: ImagePoints, poses: PoseSequence, confidence: Confidence | None
) -> dict[str, float | None]:
    """Errors of the predicted points; see `NOTES`."""
    p, R = poses.p_world_joint, poses.R_world_bone
    at = points.positions(p, R)
    uv = np.stack([lens.project(at) + points.displaced(lens, p, R) for lens in clip.lenses])
    (found, _), (true, _) = clip.triangulate(uv), clip.triangulate(clip.uv_px)
    error = 1000 * (found - true)
    hips = [i for i, name in enumerate(clip.points) if name.endswith("Hip")]
    relative = error - error[:, hips].mean(axis=1, keepdims=True)
    centred = error - np.nanmean(error, axis=1, keepdims=True)
    local = np.einsum("tlji,tlj->tli", R[:, [j for j, _ in points.on]], centred)
    ever = np.isfinite(local).any(axis=(0, 2))
    local = local[:, ever] - np.nanmean(local[:, ever], axis=0)
    off_px = np.where(clip.weight > 0, np.linalg.norm(uv - clip.uv_px, axis=-1), np.nan)
    figures = {
        "relative_mm": _mean(relative),
        "centred_mm": _mean(centred),
        "absolute_mm": _mean(error),
        "own_places_mm": _mean(local),
        "shape_mm": _shape_mm(points, found, true),
        "own_px": float(np.nanmedian(off_px[camera])),
        "other_px": float(np.nanmean(np.delete(off_px, camera, axis=0))),
    }
    if confidence is not None:
        variance = np.einsum("tjii->tji", confidence.relative_covariance)[:, list(points.anchors)]
        known = np.isfinite(relative) & (variance > 0)
        inside = np.abs(relative) <= 1000 * BAND_95 * np.sqrt(np.maximum(variance, 0))
        figures["inside"] = float(inside[known].mean()) if known.any() else None
    return figures


def _mean(error: Array) -> float | None:
    known = np.isfinite(error).all(axis=-1)
    return float(np.linalg.norm(error[known], axis=-1).mean()) if known.any() else None


def _shape_mm(points: ImagePoints, found: Array, true: Array) -> float:
    """Mean error of the distances between points next to one joint."""
    pairs = combinations(range(len(points.names)), 2)
    first, second = np.array([(i, k) for i, k in pairs if points.anchors[i] == points.anchors[k]]).T
    apart = [np.linalg.norm(p[:, first] - p[:, second], axis=-1) for p in (found, true)]
    return 1000 * float(np.nanmean(np.abs(apart[0] - apart[1])))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Means over the cameras as Markdown."""
    cells = []
    for clip, mode in dict.fromkeys((row["clip"], row["mode"]) for row in rows):
        own = [row for row in rows if (row["clip"], row["mode"]) == (clip, mode)]
        values = [[row.get(figure) for row in own] for figure in COLUMNS]
        cells.append((clip, mode, *(None if None in v else float(np.mean(v)) for v in values)))
    digits = (0, 0, *(2 if figure == "inside" else 0 for figure in COLUMNS))
    title = "Single cameras against the triangulation of the detector's points"
    return Table("real_clips", title, ("clip", "mode", *COLUMNS.values()), digits, tuple(cells), NOTES).markdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("real_clips", __doc__, motion=False)
    parser.add_argument("--data", type=Path, required=True, help="folder of the clips")
    options = parser.parse_args(arguments)
    rows = [row for name, clip in clips(options.data) for row in measure(name, clip)]
    result = {"command": "python -m benchmarks real_clips --data DIR", "rows": rows}
    print(write_results(options.out, result, table(rows)))


if __name__ == "__main__":
    main()
