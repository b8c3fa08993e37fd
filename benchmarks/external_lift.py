"""Planted 3D poses of another model as a second lift: right ones, and ones with known faults, with 0 and 8 sensors.

``python -m benchmarks external_lift --corpus DIR``: every third of the benchmark's motions, one camera each, realistic
2D. The other model gives the points of MHR (SAM 3D Body) about the hips on the camera's axes, with errors of 35 mm that
last half a second; *faults* adds a lean of 8 degrees, the scale 0.9, 80 ms of delay and 60 mm that last five seconds;
*somebody else* is the motion of the next recording.

``--without-video`` plants a file of 26 points (Halpe, as Pose2Sim's) beside 8, 6 and 4 sensors alone, mode ``imu``, in
all of the motions: y up and leaning by 8 degrees, mm, 80 ms late, errors of 35 mm that last a second and 20 mm that are
constant in each point, sides exchanged in stretches of a third of a second, a fifth of the frames, and a gap of 1 s.
In the room, motions are turned about the vertical, and moved, to the truth (the file alone in any way): without a
camera neither heading nor place means anything. Of the file alone the points of the limbs count.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from benchmarks.command_line import in_parallel, study_parser, table_head
from rtof_kin.body.metrics import at_times
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.data.confidence import BAND_95, Confidence
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.noise import coloured_noise
from rtof_kin.vision.lift_points import LiftPoints, convention

CASES = ("none", "right", "faults", "somebody else")
SENSORS = ("0", "8")
COLUMNS = {name: harness.COLUMNS[name] for name in ("mpjpe_rr_mm", "mpjpe_mm", "hips_deg", "trunk_deg", "flexion_deg")}
ERROR, SLOW, LEAN, SCALE, DELAY = 0.035, 0.06, 8.0, 0.9, 0.08  # [m], [m], [deg], [1], [s]


def points(recording: Recording, seed: int, faults: bool) -> LiftPoints:
    """What the other model says of a recording with truth."""
    truth, rng, form = recording.truth, np.random.default_rng(seed), convention("mhr70")
    assert truth is not None
    segments, places = [truth.names.index(name) for name in form.segments], form.places
    p = truth.p_world_joint[:, segments] + np.einsum("tkij,kj->tki", truth.R_world_bone[:, segments], places)
    p = p - truth.p_world_joint[:, :1]
    for memory, size in ((0.5, ERROR), (5.0, SLOW if faults else 0.0)):
        p = p + size / np.sqrt(3) * coloured_noise(rng, truth.times, memory, places.shape)
    turn = recording.video.camera.R_camera_world
    turn = turn @ so3.about_axis("y", np.radians(LEAN)) if faults else turn
    times, scale = (truth.times + DELAY, SCALE) if faults else (truth.times, 1.0)
    return LiftPoints("points", MarkerSequence(times, form.layout.names, scale * p @ turn.T))


def rows(job: tuple[int, MocapClip, MocapClip]) -> list[dict[str, Any]]:
    """Figures of one motion."""
    number, clip, other = job
    found = list[dict[str, Any]]()
    for sensors in SENSORS:
        worn = harness.SENSOR_SETS.get(sensors, ())
        recording = harness.recorded(clip, number % 4, "realistic", worn, 0)
        foreign = harness.recorded(other, number % 4, "realistic", (), 0)
        mode = "rtof" if worn else "rto"
        for case in CASES:
            given = (
                None
                if case == "none"
                else points(foreign if case == "somebody else" else recording, number, case == "faults")
            )
            with without_warnings(RESULT_WARNINGS):
                result = reconstruct(replace(recording, lifts=() if given is None else (given,)), mode=mode)
            named = any(lift.warning in result.warnings for lift in result.lifts)
            about = {"motion": clip.name, "sensors": sensors, "lift": case, "named": named}
            found.append(about | {"frames": len(recording.video)} | scoring.figures(result, mode))
    return found


WORN = harness.SENSOR_SETS | {"6": (*harness.SENSOR_SETS["4"], "Pelvis", "Sternum")}
ALONE = {"room_mm": 0, "path_mm": 0, "relative_mm": 1, "flexion_deg": 1, "inside_room": 2, "inside_relative": 2}
CONSTANT, MEMORY, STRETCH, GAP = 0.02, 1.0, 20, 1.0  # [m], [s], [frames], [s]


def placed_file(recording: Recording, seed: int) -> tuple[LiftPoints, dict[str, float]]:
    """A file of points in the room, and the figures of it alone."""
    truth, rng, form = recording.truth, np.random.default_rng(seed), convention("halpe26")
    assert truth is not None
    names, segments = form.layout.names, [truth.names.index(name) for name in form.segments]
    true = truth.p_world_joint[:, segments] + np.einsum("tkij,kj->tki", truth.R_world_bone[:, segments], form.places)
    p = true + ERROR / np.sqrt(3) * coloured_noise(rng, truth.times, MEMORY, form.places.shape)
    p = p + CONSTANT / np.sqrt(3) * rng.standard_normal(form.places.shape)
    other = [names.index(n.replace("left", "?").replace("right", "left").replace("?", "right")) for n in names]
    stretches = np.arange(len(p)) // STRETCH
    wrong = np.isin(stretches, rng.permutation(stretches[-1] + 1)[: round((stretches[-1] + 1) / 5)])
    p[wrong] = p[wrong][:, other]
    half = round(GAP * truth.rate_hz / 2)
    p[len(p) // 2 - half : len(p) // 2 + half] = np.nan
    limbs = [
        [names.index(f"{side}_{n}") for n in limb]
        for side in ("left", "right")
        for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
    ]
    seen, at = np.isfinite(p[:, 0, 0]), np.concatenate(limbs)
    hips = [names.index(f"{side}_hip") for side in ("left", "right")]
    own, real = ({"p": x[seen][:, at], "root": x[seen][:, hips].mean(axis=1)} for x in (p, true))
    figures = compared(own["p"], real["p"], own["root"], real["root"], upright=False)
    bent = [angles(x[seen], limbs) for x in (p, true)]
    figures["flexion_deg"] = float(np.degrees(np.abs(bent[0] - bent[1]).mean()))
    turn = (
        so3.about_axis("x", -np.pi / 2)
        @ so3.about_axis("y", np.radians(LEAN))
        @ so3.about_axis("z", rng.uniform(-3, 3))
    )
    return LiftPoints(
        "trial.trc", MarkerSequence(truth.times + DELAY, names, 1000 * (p + np.array([1.0, -2.0, 0.3])) @ turn.T)
    ), figures


def angles(p: Array, limbs: list[list[int]]) -> Array:
    """Angles (T, 4), rad, by which knees and elbows are bent."""
    upper, lower = (np.stack([so3.unit(p[:, limb[i + 1]] - p[:, limb[i]]) for limb in limbs], 1) for i in (0, 1))
    return np.asarray(np.arccos(np.clip(np.sum(upper * lower, axis=-1), -1, 1)))


def compared(p: Array, true: Array, root: Array, true_root: Array, upright: bool) -> dict[str, float]:
    """Mean errors, mm, of joints (T, J, 3) and roots (T, 3), turned and moved to the true ones; and relative ones."""
    x, y = (each - each.mean(axis=(0, 1)) for each in (p, true))
    moment = np.einsum("tji,tjk->ik", y, x)
    turn = so3.nearest_rotation(moment)
    if upright:
        turn = so3.about_axis("z", np.arctan2(moment[1, 0] - moment[0, 1], moment[0, 0] + moment[1, 1]))
    off, of_root = x @ turn.T - y, (root - p.mean(axis=(0, 1))) @ turn.T - (true_root - true.mean(axis=(0, 1)))
    relative = (p - root[:, None]) @ (np.eye(3) if upright else turn).T - (true - true_root[:, None])
    sizes = (float(1000 * np.linalg.norm(each, axis=-1).mean()) for each in (off, of_root, relative))
    return dict(zip(("room_mm", "path_mm", "relative_mm"), sizes, strict=True))


def rows_without_video(job: tuple[int, MocapClip, MocapClip]) -> list[dict[str, Any]]:
    """Figures of one motion with sensors alone, with a file beside them, and of the file alone."""
    number, clip, other = job
    found = list[dict[str, Any]]()
    for sensors in ("8", "6", "4"):
        recording, foreign = (
            replace(harness.recorded(one, 0, "realistic", WORN[sensors], 0), keypoints=None) for one in (clip, other)
        )
        truth = recording.truth
        assert truth is not None
        given, alone = placed_file(recording, number)
        about = {"motion": clip.name, "sensors": sensors, "frames": len(truth.times)}
        found.append(about | {"case": "file alone", "named": False} | alone)
        for case, lifts in (("none", ()), ("right", (given,)), ("somebody else", (placed_file(foreign, number)[0],))):
            with without_warnings(RESULT_WARNINGS):
                result = reconstruct(replace(recording, lifts=lifts), mode="imu")
            true = at_times(truth, result.motion.times).p_world_joint
            known = np.flatnonzero(np.isfinite(true).all(axis=(1, 2)))
            p, true, stated = result.motion.poses.p_world_joint[known], true[known], result.motion.confidence
            own = compared(p, true, p[:, 0], true[:, 0], upright=True)
            own["flexion_deg"] = result.stage_metrics["imu"]["flexion_deg"]
            if stated is not None:
                own |= inside(p, true, stated[known])
            named = any(lift.warning in result.warnings for lift in result.lifts)
            found.append(about | {"case": case, "named": named} | own)
    return found


def inside(p: Array, true: Array, stated: Confidence) -> dict[str, float]:
    """Shares of errors of joints inside their 95 % bands, axis by axis."""
    x, y = (each - each.mean(axis=(0, 1)) for each in (p, true))
    moment = np.einsum("tji,tjk->ik", y, x)
    turn = so3.about_axis("z", np.arctan2(moment[1, 0] - moment[0, 1], moment[0, 0] + moment[1, 1]))
    errors = x @ turn.T - y, ((p - p[:, :1]) - (true - true[:, :1]))[:, 1:]
    covariances = stated.position_covariance, stated.relative_covariance[:, 1:]
    shares = []
    for error, covariance in zip(errors, covariances, strict=True):
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        shares.append(float(np.mean((np.abs(error) <= BAND_95 * sigma)[np.isfinite(sigma)])))
    return {"inside_room": shares[0], "inside_relative": shares[1]}


def table_without_video(found: list[dict[str, Any]]) -> str:
    """Rows pooled by sensors and case, as Markdown."""
    heads = "sensors | points | room mm | root path mm | relative mm | flexion deg | in bands: room | relative"
    heads += " | better than sensors alone | at worst | better than the file alone | left out"
    lines = table_head(heads)
    for sensors in ("8", "6", "4"):
        cases = ("none", "file alone", "right", "somebody else")
        of = {case: [row for row in found if (row["sensors"], row["case"]) == (sensors, case)] for case in cases}
        for case, own in of.items():
            figures = harness.pooled([row | {"mpjpe_rr_mm": row["relative_mm"]} for row in own], ALONE)
            cells = ["" if np.isnan(figures[name]) else f"{figures[name]:.{digits}f}" for name, digits in ALONE.items()]
            change = {}
            for base in cases[:2]:
                pairs = zip(own, of[base], strict=True)
                change[base] = np.array([[row[name] / old[name] - 1 for name in [*ALONE][:3]] for row, old in pairs])
            for base in cases[:2]:
                cells.append(", ".join(f"{share:.0%}" for share in np.mean(change[base] < 0, axis=0)))
            cells.insert(-1, ", ".join(f"{worst:+.0%}" for worst in change["none"].max(axis=0)))
            lines.append(
                f"| {sensors} | {case} | {' | '.join(cells)} | {sum(row['named'] for row in own)} of {len(own)} |"
            )
    return "\n".join(lines) + "\n\nBetter and at worst: in the room, of the root's path, and relative to the root.\n"


def table(found: list[dict[str, Any]]) -> str:
    """Rows pooled by sensors and lift, as Markdown."""
    figures_of = " | ".join(heading for heading, _ in COLUMNS.values())
    lines = table_head(f"sensors | other lift | {figures_of} | not worse | worst mm | left out")
    for sensors in SENSORS:
        without = [row["mpjpe_rr_mm"] for row in found if (row["sensors"], row["lift"]) == (sensors, "none")]
        for case in CASES:
            own = [row for row in found if (row["sensors"], row["lift"]) == (sensors, case)]
            change = np.array([row["mpjpe_rr_mm"] for row in own]) - without
            figures = harness.pooled(own, COLUMNS)
            cells = [f"{figures[name]:.{digits}f}" for name, (_, digits) in COLUMNS.items()]
            named = sum(row["named"] for row in own)
            cells += [f"{np.mean(change < 0.1):.0%}", f"{change.max():+.1f}", f"{named} of {len(own)}"]
            lines.append(f"| {sensors} | {case} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("external_lift", __doc__, page="")
    parser.add_argument("--without-video", action="store_true", help="a file beside sensors alone")
    parser.add_argument("--out", type=Path, help="page; default: in results/")
    options = parser.parse_args(arguments)
    name = "external_lift_sensors.md" if options.without_video else "external_lift.md"
    out = options.out or harness.HERE / "results" / name
    clips = harness.test_clips(options.corpus)[:: 1 if options.without_video else 3]
    jobs = [(i, clip, clips[(i + 1) % len(clips)]) for i, clip in enumerate(clips)]
    function = rows_without_video if options.without_video else rows
    found = [row for own in in_parallel(function, jobs) for row in own]
    about = (__doc__ or "").partition("\n\n")[2]
    title = "beside sensors, without a video" if options.without_video else "as a second lift"
    pooled = table_without_video(found) if options.without_video else table(found)
    out.write_text(f"# The 3D poses of another model {title}\n\n{about}\n{pooled}", encoding="utf-8")
    print(pooled)


if __name__ == "__main__":
    main()
