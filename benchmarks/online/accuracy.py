"""Error against lag: the harness's motions, replayed causally, beside batch and a frame-by-frame baseline.

Every frame is scored, as in the harness. The last frames of a recording are estimated with what is left of
it, whatever the lag. *batch* is mode rtof of the whole recording as given, with default settings;
*causal SF2* the newest lift of each frame, corrected by the sensors frame by frame. *online* has the default
window of its lag. *window of 1 s* is one estimator with a longer window, of which every lag is looked at.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.harness import bootstrap, pooled
from benchmarks.online.causal import causal_sf2
from benchmarks.online.estimators import estimator, settings
from benchmarks.online.recordings import Job, batch, jobs, truth_of
from benchmarks.online.running import tracks, tracks_of_one_window
from rtof_kin.body.metrics import at_times, evaluate
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.protocols.tables import Cell, Table

LAGS = (0.0, 0.05, 0.1, 0.15, 0.25, 0.4, 0.6, 0.8, 1.0)
"""[s]"""
ONLINE, WINDOW, BATCH, CAUSAL = "online", "window of 1 s", "batch", "causal SF2"
COLUMNS = {
    name: harness.COLUMNS[name]
    for name in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg", "hips_deg", "trunk_deg", "angle_deg", "mpjae")
} | {"started_rr_mm": ("rr mm from 1 s on", 1), "root_mm": ("root mm", 1), "depth_mm": ("root depth mm", 1)}
BANDS = ("inside_relative", "inside_world")
GOALS = {0.0: 15.0, 0.25: 5.0}
"""By lag, s: most per cent above batch."""
_BEGUN = 1.0
"""[s] after which the beginning is over."""


def figures(
    poses: PoseSequence, truth: PoseSequence, skeleton: SkeletonModel, stated: Confidence | None = None
) -> dict[str, float]:
    """All figures of poses beside their truth."""
    found = dict(evaluate(poses, truth, skeleton)) | scoring.torso(poses, truth)
    begun = int(np.searchsorted(poses.times, truth.times[0] + _BEGUN))
    if len(poses) - begun >= 4:
        found["started_rr_mm"] = evaluate(poses[begun:], truth, skeleton)["mpjpe_rr_mm"]
    if stated is not None:
        found |= scoring.bands(replace(skeleton.motion(poses), confidence=stated), truth)
    return found


def root_figures(poses: PoseSequence, truth: PoseSequence, eye: Any) -> dict[str, float]:
    """Mean error of the root's position, and of its distance from the camera at `eye` (3,), mm."""
    p, p_true = poses.p_world_joint[:, 0], at_times(truth, poses.times).p_world_joint[:, 0]
    depth, depth_true = (np.linalg.norm(points - eye, axis=-1) for points in (p, p_true))
    return {
        "root_mm": 1e3 * float(np.nanmean(np.linalg.norm(p - p_true, axis=-1))),
        "depth_mm": 1e3 * float(np.nanmean(np.abs(depth - depth_true))),
    }


def measured(job: Job, lags: Sequence[float], confidence: bool, keep: Path | None) -> list[dict[str, Any]]:
    """Rows of one recording."""
    recording = job.recorded()
    truth, skeleton = truth_of(recording), recording.skeleton
    whole = batch(job, recording)
    own = tracks(recording, estimator, settings(confidence=confidence), tuple(GOALS))
    together = tracks_of_one_window(recording, estimator, settings(), lags) if lags else {}
    every = {(ONLINE, lag): one for lag, one in own.items()}
    every |= {(WINDOW, lag): one for lag, one in together.items()}
    poses = {key: one.poses for key, one in every.items()}
    stated = {key: one.confidence for key, one in every.items()}
    poses[BATCH, 0.0], stated[BATCH, 0.0] = whole.poses, whole.confidence
    poses[CAUSAL, 0.0] = causal_sf2(recording)
    if keep is not None:
        _keep(keep / f"{job.key}.npz", poses, truth)
    eye = recording.video.camera.center_world
    return [
        job.about
        | {"estimate": name, "lag": lag, "frames": len(one)}
        | figures(one, truth, skeleton, stated.get((name, lag)))
        | root_figures(one, truth, eye)
        for (name, lag), one in poses.items()
    ]


def _keep(path: Path, poses: dict[tuple[str, float], PoseSequence], truth: PoseSequence) -> None:
    """Write poses of a recording, to look at them."""
    arrays = {"true_times": truth.times, "true_p": truth.p_world_joint, "true_R": truth.R_world_bone}
    for (name, lag), one in poses.items():
        if name != WINDOW:
            label = f"{name}_{lag:g}".replace(" ", "_")
            arrays |= {f"{label}_times": one.times, f"{label}_p": one.p_world_joint}
            arrays[f"{label}_R"] = one.R_world_bone
    write_npz(path, arrays, overwrite=True)


def rows_of(options: Namespace) -> list[dict[str, Any]]:
    """Rows of all recordings, in parallel; those of an interrupted run are taken from the folder `work`."""
    work, lags = jobs(options), () if options.goals else LAGS
    one = partial(measured, lags=lags, confidence=options.confidence, keep=options.keep)
    if options.keep is not None:
        options.keep.mkdir(parents=True, exist_ok=True)
    sources = [path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py"))]
    version = version_of(sources, lags, options.confidence, options.seconds)
    kept = RowFile(Path(options.work) / f"rows_{version[:12]}.jsonl", version)
    rows = kept.collect({job.key: partial(one, job) for job in work}, options.workers)
    return sorted(rows, key=lambda r: (int(r["sensors"]), r["motion"], r["camera"], r["estimate"], r["lag"]))


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """Against lag; ratios to batch; the ratios of every motion."""
    return [_against_lag(rows), _ratios(rows), _by_motion(rows)]


def _against_lag(rows: Sequence[dict[str, Any]]) -> Table:
    found: list[tuple[Cell, ...]] = []
    for sensors in dict.fromkeys(row["sensors"] for row in rows):
        for key in _estimates(rows):
            own = [r for r in rows if (r["sensors"], r["estimate"], r["lag"]) == (sensors, *key)]
            mean = pooled(own, (*COLUMNS, *BANDS))
            low, high = mean["rr_interval"]
            cells = (mean[name] for name in (*COLUMNS, *BANDS))
            found.append((sensors, key[0], f"{key[1]:g}", *cells, f"{low:.1f}-{high:.1f}"))
    headings, digits = zip(*COLUMNS.values(), strict=True)
    columns = ("IMUs", "estimate", "lag s", *headings)
    columns += ("inside 95 % bands, relative", "inside 95 % bands, world", "rr 95 %")
    return Table("lag", "Error against lag", columns, (0, 0, 0, *digits, 2, 2, 0), tuple(found))


def _estimates(rows: Iterable[dict[str, Any]]) -> list[tuple[str, float]]:
    """Estimates and lags, the baseline first and batch last."""
    order = (CAUSAL, ONLINE, WINDOW, BATCH)
    return sorted({(r["estimate"], r["lag"]) for r in rows}, key=lambda k: (order.index(k[0]), k[1]))


def paired(rows: Sequence[dict[str, Any]], sensors: str, lag: float, figure: str) -> tuple[list[str], Any, Any]:
    """Motions, online by batch, and the batch's weight (frames x error) of recordings of both."""
    own = {(r["estimate"], r["motion"], r["camera"], r["lag"]): r for r in rows if r["sensors"] == sensors}
    both = [
        (r, own[BATCH, name, camera, 0.0])
        for (estimate, name, camera, at), r in own.items()
        if estimate == ONLINE and at == lag
    ]
    ratio = np.array([online[figure] / whole[figure] for online, whole in both])
    weight = np.array([whole["frames"] * whole[figure] for _, whole in both])
    return [online["motion"] for online, _ in both], ratio, weight


def _ratios(rows: Sequence[dict[str, Any]]) -> Table:
    found: list[tuple[Cell, ...]] = []
    for sensors in dict.fromkeys(row["sensors"] for row in rows):
        for lag, most in GOALS.items():
            for figure, heading in (("mpjpe_rr_mm", "rr"), ("mpjpe_mm", "abs"), ("flexion_deg", "flexion")):
                names, ratio, weight = paired(rows, sensors, lag, figure)
                excess = 100 * (ratio - 1)
                low, high = bootstrap(names, excess, weight)
                by_motion = [np.mean(excess[np.array(names) == name]) for name in dict.fromkeys(names)]
                own = float(np.average(excess, weights=weight))
                goal = f"{most:g}" if figure == "mpjpe_rr_mm" else "-"
                found.append(
                    (
                        sensors,
                        f"{lag:g}",
                        heading,
                        own,
                        f"{low:.1f}-{high:.1f}",
                        float(np.mean(by_motion)),
                        float(np.max(by_motion)),
                        goal,
                    )
                )
    columns = ("IMUs", "lag s", "error", "above batch %, pooled", "95 %")
    columns += ("mean of motions %", "worst motion %", "goal %")
    notes = ("Intervals are 95 % bootstraps over motions.",)
    return Table("ratios", "Online above batch", columns, (0, 0, 0, 1, 0, 1, 1, 0), tuple(found), notes)


def _by_motion(rows: Sequence[dict[str, Any]]) -> Table:
    found: list[tuple[Cell, ...]] = []
    for sensors in dict.fromkeys(row["sensors"] for row in rows):
        parts = {lag: paired(rows, sensors, lag, "mpjpe_rr_mm") for lag in GOALS}
        whole = [r for r in rows if r["estimate"] == BATCH and r["sensors"] == sensors]
        for name in dict.fromkeys(parts[0.0][0]):
            mean = pooled([r for r in whole if r["motion"] == name], ("mpjpe_rr_mm",))["mpjpe_rr_mm"]
            cells = []
            for names, ratio, weight in parts.values():
                own = np.array(names) == name
                cells.append(100 * (float(np.average(ratio[own], weights=weight[own])) - 1))
            found.append((sensors, name, mean, *cells))
    headings = tuple(f"above batch %, lag {lag:g} s" for lag in GOALS)
    columns = ("IMUs", "motion", "batch rr mm", *headings)
    return Table("motions", "Online above batch, by motion", columns, (0, 0, 1, 1, 1), tuple(found))
