"""Single real cameras of a Pose2Sim trial, each compared with the triangulation from all cameras.

    python examples/real_camera.py FOLDER [--trial NAME] [-o OUT]

FOLDER is a session of Pose2Sim's demonstration data (BSD-3) with its detections:
``Pose2Sim/S00_Demo_Session`` of github.com/perfanalytics/pose2sim at commit a948c205. The body size is
scaled from the height in its Config.toml. The other cameras influence an estimate only through the pose of
its camera, which bundle adjustment changes by about a degree; with ``--cameras file`` not at all. The clip
has 1.7 s: an illustration, no benchmark.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pose2sim_trial import Trial, View, read_trial
from real_camera_figure import draw
from real_camera_truth import Truth, measured_bones, triangulated
from rich.table import Table

from rtof_kin.body.metrics import evaluate
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli.terminal import err, out, progress
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.folder import check_replaceable, new_folder
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
MARKER = "real_camera.json"
DRAWN_PX = 1.0
"""Smallest plausible median inconsistency of a detector between cameras."""
MEASURED = "rto+"
"""Label of rto with the triangulated bone lengths."""
COLUMNS = {
    "relative_mm": "rel.",
    "absolute_mm": "abs.",
    "procrustes_mm": "aligned",
    "varying_mm": "varying",
    "along_mm": "along",
    "across_mm": "across",
    "fit_px": "fit",
}
"""Heading by figure."""
CAPTION = """Mean joint errors [mm]. rel.: relative to the root; of these, varying: without each joint's
mean over the clip, along and across: the camera's view. abs.: absolute. aligned: after each frame's best
similarity (Procrustes). fit: median distance of the skeleton from the joints in the image [px].
rto+: with the bone lengths of the triangulation, which a single camera does not observe."""


@dataclass(frozen=True)
class Estimate:
    """Results of a single camera."""

    view: View
    camera: Camera
    """Camera with the pose used."""
    stages: dict[str, PoseSequence]
    """Poses by mode: lift, rto and `MEASURED`."""
    scores: dict[str, dict[str, float]]
    """Values by mode and figure of `COLUMNS`."""
    over_time: dict[str, Array]
    """Mean error (T,) relative to the root by mode, mm; NaN where there is no truth."""


def estimate(
    view: View,
    camera: Camera,
    truth: Truth,
    skeleton: SkeletonModel,
    progress: Progress,
    lifter: LifterLike | None = None,
) -> Estimate:
    """Lift and optimise the keypoints of one camera, and compare with the triangulation.

    Args:
        view: its keypoints. camera: with the pose to use. truth: the triangulation.
        skeleton: scaled from the height. progress: called with (stage, steps done, steps in all).
        lifter: default: the shipped one.
    """
    keypoints = replace(view.found.keypoints, camera=camera)
    stages: dict[str, PoseSequence] = {}
    bodies = {"rto": skeleton, MEASURED: skeleton.with_bone_lengths(measured_bones(truth, skeleton))}
    for mode, body in bodies.items():
        recording = Recording(view.name, keypoints, joint_offsets=body.joint_offsets)
        result = reconstruct(recording, body, "rto", lifter=lifter, progress=progress)
        stages.setdefault("lift", result.stages["lift"])
        stages[mode] = result.stages["rto"]
    scored = {mode: _score(poses, truth, view, camera, skeleton) for mode, poses in stages.items()}
    scores, over_time = ({mode: both[i] for mode, both in scored.items()} for i in (0, 1))
    return Estimate(view, camera, stages, scores, over_time)  # type: ignore[arg-type]


def _score(
    poses: PoseSequence, truth: Truth, view: View, camera: Camera, skeleton: SkeletonModel
) -> tuple[dict[str, float], Array]:
    metrics = evaluate(poses, truth.poses, skeleton)
    known = np.isfinite(metrics.over_time["mpjpe_rr_mm"])
    p, p_true = poses.p_world_joint[known], truth.poses.p_world_joint[known]
    off = 1000 * ((p - p[:, :1]) - (p_true - p_true[:, :1]))
    ray = p_true - camera.center_world
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = np.sum(off * ray, axis=-1)
    points = view.found.keypoints.select(skeleton.names)
    fit = np.linalg.norm(camera.project(poses.p_world_joint) - points.uv_px, axis=-1)
    figures = {
        "relative_mm": metrics["mpjpe_rr_mm"],
        "absolute_mm": metrics["mpjpe_mm"],
        "procrustes_mm": metrics["mpjpe_pa_mm"],
        "varying_mm": float(np.linalg.norm(off - off.mean(axis=0), axis=-1).mean()),
        "along_mm": float(np.abs(along).mean()),
        "across_mm": float(np.linalg.norm(off - along[..., None] * ray, axis=-1).mean()),
        "fit_px": float(np.nanmedian(fit)),
    }
    return figures, metrics.over_time["mpjpe_rr_mm"]


# --- printed sentences --------------------------------------------------------------------------------


def said_of_truth(trial: Trial, truth: Truth, adjusted: bool) -> list[str]:
    """Describe the trial and its triangulation."""
    T, rate_hz = len(truth.poses), truth.poses.rate_hz
    misfit = ", ".join(
        f"{name} {before:.0f}" + (f" -> {after:.0f}" if adjusted else "")
        for name, (before, after) in truth.misfit_px.items()
    )
    said = [
        f"{trial.name}: {T} frames at {rate_hz:.0f} Hz; one clip of {T / rate_hz:.1f} s, an illustration "
        "and no benchmark",
        f"followed {trial.person}",
        *(f"{view.name}: {view.found.summary}" for view in trial.views),
        f"median distance of the detector's points from the other cameras' triangulation, px: {misfit}",
    ]
    if max(after for _, after in truth.misfit_px.values()) < DRAWN_PX:
        said.append("too consistent for a detector: these points are synthetic")
    if adjusted:
        moved = ", ".join(f"{n} {a:.1f} deg, {b:.0f} mm" for n, (a, b) in truth.moved.items())
        said.append(f"changes of the cameras by bundle adjustment: {moved}")
    said.append(
        f"triangulation: joints change by {truth.without_one_mm:.0f} mm without one of the cameras; bone "
        f"lengths of the limbs, constant in truth, have a standard deviation of "
        f"{truth.bone_spread_mm:.0f} mm"
    )
    return said


def said_of_scores(estimates: Sequence[Estimate], truth: Truth, skeleton: SkeletonModel) -> list[str]:
    """Describe what limits the scores."""
    rto = {key: _mean(estimates, "rto", key) for key in COLUMNS}
    bones = measured_bones(truth, skeleton)
    off = np.median([abs(length / skeleton.bone_lengths[n] - 1) for n, length in bones.items()])
    return [
        f"rto errs by {rto['along_mm']:.0f} mm along the view and {rto['across_mm']:.0f} mm across it: "
        "one camera does not observe depth, the lifter estimates it",
        f"of {rto['relative_mm']:.0f} mm, {rto['varying_mm']:.0f} vary; the rest is constant over the clip: "
        "biases of detector and lifter in this posture, and the person's proportions",
        f"bones scaled from the height differ from the triangulated ones by {100 * off:.0f} % in the "
        f"median; with the latter it is {_mean(estimates, MEASURED, 'relative_mm'):.0f} mm",
        "the absolute error includes the distance, with the errors of the person's size and lean",
    ]


def _mean(estimates: Sequence[Estimate], mode: str, key: str) -> float:
    return float(np.mean([e.scores[mode][key] for e in estimates]))


def score_table(estimates: Sequence[Estimate]) -> Table:
    """Return a table with a row per camera and mode, and the means."""
    title = "each camera alone against the triangulation from all"
    table = Table("camera", "mode", *COLUMNS.values(), title=title)
    for e in estimates:
        for mode, figures in e.scores.items():
            name = e.view.name if mode == "lift" else ""
            table.add_row(name, mode, *(f"{figures[key]:.0f}" for key in COLUMNS))
        table.add_section()
    for mode in estimates[0].scores:
        table.add_row(
            "mean" if mode == "lift" else "", mode, *(f"{_mean(estimates, mode, key):.0f}" for key in COLUMNS)
        )
    return table


# --- command ---------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    """Run the example and return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        run(options)
    except RtofError as error:
        err.print(f"error: {error}", style="bold red", soft_wrap=True)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="session of Pose2Sim's demo data")
    parser.add_argument("--trial", default="S00_P00_T01_BalancingTrial", metavar="NAME", help="whose folder")
    parser.add_argument(
        "--participant",
        type=int,
        metavar="N",
        help="of several heights in Config.toml, the one to track, from 1; default: the tallest",
    )
    parser.add_argument("--height", type=float, metavar="M", help="m; default: of Config.toml")
    parser.add_argument(
        "--cameras",
        choices=("adjusted", "file"),
        default="adjusted",
        help="adjusted to the detections, or as in the file",
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("out/real_camera"), metavar="OUT")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier OUT")
    return parser


def run(options: argparse.Namespace, lifter: LifterLike | None = None) -> None:
    """Read, triangulate, estimate, print and draw.

    Raises:
        RtofError: invalid folder, or OUT exists.
    """
    check_replaceable(options.output, MARKER, options.overwrite)
    trial = read_trial(options.folder, options.trial, options.height, options.participant)
    skeleton = SkeletonModel.default().with_height(trial.height)
    truth = triangulated(trial, skeleton, options.cameras == "adjusted")
    said = said_of_truth(trial, truth, options.cameras == "adjusted")
    out.print(*said, sep="\n", highlight=False, soft_wrap=True)
    with progress() as tell:
        estimates = [
            estimate(view, camera, truth, skeleton, _named(tell, view.name), lifter)
            for view, camera in zip(trial.views, truth.cameras, strict=True)
        ]
    out.print(score_table(estimates))
    limits = said_of_scores(estimates, truth, skeleton)
    out.print(CAPTION, *limits, sep="\n", highlight=False, soft_wrap=True)
    with new_folder(options.output, MARKER, options.overwrite) as folder:
        draw(trial, truth, estimates, skeleton, folder / "real_camera.png")
        write_camera_toml(folder / "cameras.toml", {e.view.name: e.camera for e in estimates})
        result = {
            "trial": trial.name,
            "cameras": options.cameras,
            "said": said + limits,
            "scores": {e.view.name: e.scores for e in estimates},
            "mean": {mode: {k: _mean(estimates, mode, k) for k in COLUMNS} for mode in estimates[0].scores},
            "misfit_px": truth.misfit_px,
            "moved_deg_mm": truth.moved,
        }
        (folder / MARKER).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    out.print(f"wrote {options.output}: cameras.toml, {MARKER}, real_camera.png", soft_wrap=True)


def _named(tell: Progress, camera: str) -> Progress:
    return lambda stage, done, total: tell(f"{camera} {stage}", done, total)


if __name__ == "__main__":
    sys.exit(main())
