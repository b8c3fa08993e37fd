"""Distance of a detector's points from the skeleton's joints, mapped plainly and by the fitted adapter.

``python -m benchmarks detectors --corpus DIR`` with DIR the folder of free motion (see README.md here).
Motion of the validation subjects of split.toml, on the shipped skeleton with bone lengths varied by 5 %
and each detector's points by 1 cm, seen from 4 m all around with f = 1250 px. *exact*: projections.
*noisy*: each coordinate off by a constant (6 px) and from frame to frame (5 px). *gaps*: noisy, and a
quarter of the points unseen. The two mappings see the same points; the mean is over the joints that both
give. *all joints* is the adapter's mean over whatever it gives.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.command_line import study_parser, table_head
from benchmarks.harness import mocap_people, write_results
from benchmarks.views import Views, ViewSettings
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.resources import model_path
from rtof_kin.simulation.mocap import MocapClip, read_corpus
from rtof_kin.vision.landmark_regression import LandmarkRegression, RegressedLandmarks, recognise
from rtof_kin.vision.layouts import mirrored

FOCAL_PX, DISTANCE, RATE_HZ, VIEWS, SEED = 1250.0, 4.0, 5.0, 4, 1
BIAS_PX, WHITE_PX, HIDDEN = 6.0, 5.0, 0.25
KINDS = ("exact", "noisy", "gaps")


def measure(clips: list[MocapClip], adapter: LandmarkRegression) -> list[dict[str, Any]]:
    """A row for each layout and kind of 2D: mean errors in px, and how often the layout is recognised."""
    settings = replace(ViewSettings(), distance=(DISTANCE, DISTANCE), tilt_share=0.0)
    views, rng = Views(adapter.table, settings), np.random.default_rng(SEED)
    seen = [
        views.see(clip.poses.p_world_joint[:, 0], clip.poses.R_world_bone, rng) for clip in clips for _ in range(VIEWS)
    ]
    layouts = [name for name in adapter.table.layouts if name not in ("joints", "landmarks")]
    return [_row(adapter, views, seen, name, kind) for name in layouts for kind in KINDS]


def _row(
    adapter: LandmarkRegression, views: Views, seen: list[tuple[Array, Array]], layout: str, kind: str
) -> dict[str, Any]:
    rng = np.random.default_rng(SEED)
    names = views.skeleton.names
    index = [views.names.index(point) for point in adapter.table.layout(layout).points]
    errors: dict[str, list[Array]] = {"adapter": [], "naive": [], "sigma": []}
    recognised = []
    for points, depth in seen:
        uv, confidence = _observed(points[:, index] * FOCAL_PX, kind, rng)
        truth = points[:, : len(names)] * FOCAL_PX
        known = np.where(confidence[..., None] > 0, uv, np.nan)
        adapted = adapter.apply(layout, uv, confidence)
        scale = (depth / DISTANCE)[:, None]
        errors["adapter"].append(_distance(adapted, truth, names) * scale)
        errors["naive"].append(_distance(_nearest_points(adapter, layout, known), truth, names) * scale)
        errors["sigma"].append(adapted.sigma_px[:, : len(names)] * scale)
        recognised.append(_recognised(uv, confidence, layout))
    all_errors = {key: np.concatenate(value) for key, value in errors.items()}
    both = np.isfinite(all_errors["adapter"]) & np.isfinite(all_errors["naive"])
    return {
        "layout": layout,
        "kind": kind,
        "naive_px": float(all_errors["naive"][both].mean()),
        "adapter_px": float(all_errors["adapter"][both].mean()),
        "adapter_median_px": float(np.median(all_errors["adapter"][both])),
        "all_joints_px": float(np.nanmean(all_errors["adapter"])),
        "given": float(np.isfinite(all_errors["adapter"]).mean()),
        "expected_px": float(np.sqrt(2 * np.nanmean(all_errors["sigma"] ** 2))),
        "rms_px": float(np.sqrt(np.nanmean(all_errors["adapter"] ** 2))),
        "recognised": float(np.mean(recognised)),
        "per_joint_px": {
            key: dict(zip(names, np.nanmean(all_errors[key], axis=0).round(2).tolist(), strict=True))
            for key in ("naive", "adapter")
        },
    }


def _nearest_points(adapter: LandmarkRegression, layout: str, uv: Array) -> RegressedLandmarks:
    """The plain mapping of detectors.toml: each joint at the nearest point, or between two."""
    data, points = tomllib.loads(model_path("detectors.toml").read_text()), adapter.table.layout(layout).points
    at: dict[str, Array] = {}
    for joint, lists in data["naive"].items():
        for change in (str, mirrored):
            named = [[change(p) for p in names] for names in lists]
            nearest = next((names for names in named if set(names) <= set(points)), None)
            if nearest is not None:
                at[change(joint)] = uv[:, [points.index(p) for p in nearest]].mean(axis=1)
    for joint, entry in data["naive_between"].items():
        for change in (str, mirrored):
            start, stop = change(entry["from"]), change(entry["to"])
            if start in at and stop in at:
                at[change(joint)] = (1 - entry["share"]) * at[start] + entry["share"] * at[stop]
    names = tuple(name for name in SkeletonModel.default().names if name in at)
    uv = np.stack([at[name] for name in names], axis=1)
    return RegressedLandmarks(names, uv, np.ones(uv.shape[:2]), np.full(uv.shape[:2], np.nan))


def _observed(uv: Array, kind: str, rng: Generator) -> tuple[Array, Array]:
    """Simulated detections: points, px, and confidence."""
    confidence = np.ones(uv.shape[:2])
    if kind != "exact":
        bias = BIAS_PX * rng.standard_normal(uv.shape[1:])
        uv = uv + bias + WHITE_PX * rng.standard_normal(uv.shape)
    if kind == "gaps":
        confidence[rng.random(confidence.shape) < HIDDEN] = 0.0
    return uv, confidence


def _distance(points: RegressedLandmarks, truth: Array, names: tuple[str, ...]) -> Array:
    """(T, J) px to the truth, NaN where there is no point."""
    uv = np.full(truth.shape, np.nan)
    for j, name in enumerate(names):
        if name in points.names:
            uv[:, j] = points.uv_px[:, points.names.index(name)]
    return np.asarray(np.linalg.norm(uv - truth, axis=-1))


def _recognised(uv: Array, confidence: Array, layout: str) -> bool:
    try:
        return recognise(uv, confidence).layout.name == layout
    except InvalidInputError:
        return False


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    heads = "layout | 2D | plain px | adapter px | adapter median px | all joints px | given"
    lines = table_head(f"{heads} | expected RMS px | RMS px | recognised")
    for row in rows:
        means = [f"{row[f'{name}_px']:.1f}" for name in ("naive", "adapter", "adapter_median", "all_joints")]
        given, sizes = f"{100 * row['given']:.1f} %", [f"{row[name]:.1f}" for name in ("expected_px", "rms_px")]
        cells = [row["layout"], row["kind"], *means, given, *sizes, f"{100 * row['recognised']:.0f} %"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("detectors", __doc__)
    options = parser.parse_args(arguments)
    clips = list(read_corpus(options.corpus, mocap_people("validation"), output_rate_hz=RATE_HZ))
    rows = measure(clips, LandmarkRegression.default())
    result = {
        "command": "python -m benchmarks detectors --corpus DIR",
        "seed": SEED,
        "clips": [clip.name for clip in clips],
        "rows": rows,
    }
    print(write_results(options.out, result, table(rows)))


if __name__ == "__main__":
    main()
