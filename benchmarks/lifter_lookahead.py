"""Lifts of the newest frames: errors and stated errors by the number k of later frames that are there.

``python -m benchmarks lifter_lookahead --corpus DIR`` gives the harness's motions (people and rigs of no
training, see split.toml; realistic 2D, cameras taking turns) with 0, 8 and 10 sensors to `StreamingLifter`,
frame by frame. Beside it: the last frame repeated, as `Lifter.predict` does, and poses without the mirrored
scene. It writes results/lifter_lookahead.json and .md. Four minutes of one core.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.command_line import rounded, study_parser
from benchmarks.harness import SENSOR_SETS, bootstrap, recorded, split, test_clips, write_results
from lifting.predict import Lifter
from lifting.streaming import StreamedPose, StreamingLifter
from rtof_kin.body.metrics import at_times
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.reconstruction.prepare import cleaned, evenly_spaced
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

Row = dict[str, Any]
Estimate = tuple[Array, Array, Array, Array]
"""Positions (n, J, 3), their sigma (n, J, 2), orientations (n, J, 3, 3), their sigma (n, J)."""
LOOKAHEADS = (0, 1, 2, 4, 6, 9, 13)
SENSORS = ("0", "8", "10")
EVERY = 6
"""Step between the frames that are lifted; neighbours are correlated."""
FIGURES = ("rr_mm", "abs_mm", "hips_deg", "trunk_deg")
SIGMAS = ("joints across", "joints along", "root across", "root along", "turns")


def worn(recording: Recording) -> Iterator[tuple[str, BoneImuSequence | None]]:
    """Each set of sensors of one recording."""
    assert recording.imus is not None
    for count in SENSORS:
        imus = recording.imus.select(SENSOR_SETS[count]) if count in SENSOR_SETS else None
        yield count, None if imus is None else replace(recording, imus=imus).bone_imus()


def lifts(
    lifter: Lifter, recording: Recording, imus: BoneImuSequence | None, frames: Sequence[int]
) -> Iterator[tuple[str, int, Estimate]]:
    """The lifts of some frames by what is done about later frames and their number k."""
    for name, flip, ks in (("moved on", True, LOOKAHEADS), ("moved on, not mirrored", False, (0, 4, 13))):
        poses = streamed(lifter, recording, imus, frames, flip, ks)
        for k in ks:
            yield name, k, stacked([poses[k, frame] for frame in frames])
    keypoints = recording.video
    for k in (0, 4):
        own = [
            lifter.predict(
                keypoints[max(frame - 30, 0) : frame + k + 1],
                recording.joint_offsets,
                bone_imus=imus,
                floor_height=recording.floor_height,
            )
            for frame in frames
        ]
        at = -1 - k
        yield (
            "repeated",
            k,
            stacked(
                [
                    StreamedPose(
                        each.times[at],
                        each.p_world_joint[at],
                        each.sigma_m[at],
                        each.R_world_bone[at],
                        each.sigma_rad[at],
                    )
                    if each.seen[at]
                    else None
                    for each in own
                ]
            ),
        )


def streamed(
    lifter: Lifter,
    recording: Recording,
    imus: BoneImuSequence | None,
    frames: Sequence[int],
    flip: bool,
    lookaheads: Sequence[int],
) -> dict[tuple[int, int], StreamedPose | None]:
    """The poses of some frames with each number of later frames."""
    keypoints, wanted = recording.video, set(frames)
    stream = StreamingLifter(
        lifter, keypoints.camera, recording.joint_offsets, recording.floor_height, names=keypoints.names, flip=flip
    )
    poses = {}
    for t, time in enumerate(keypoints.times):
        R = {} if imus is None else dict(zip(imus.joints, imus.R_world_bone[t], strict=True))
        stream.put(time, keypoints.uv_px[t], keypoints.confidence[t], R)
        due = [(k, t - k) for k in lookaheads if t - k in wanted]
        found = stream.lift([keypoints.times[frame] for _, frame in due])
        poses |= dict(zip(due, found, strict=True))
    return poses


def stacked(poses: Sequence[StreamedPose | None]) -> Estimate:
    """Poses as arrays; NaN where there is none."""
    known = next(pose for pose in poses if pose is not None)
    names = ("p_world_joint", "sigma_m", "R_world_bone", "sigma_rad")
    p, sigma_m, R, sigma_rad = (
        np.stack(
            [np.full(getattr(known, name).shape, np.nan) if pose is None else getattr(pose, name) for pose in poses]
        )
        for name in names
    )
    return p, sigma_m, R, sigma_rad


def scored(estimate: Estimate, p_true: Array, R_true: Array, names: tuple[str, ...], centre: Array) -> Row:
    """Mean errors; and the mean squares, actual and stated, and the share within two sigmas of each."""
    p, sigma_m, R, sigma_rad = estimate
    error = p - p_true
    relative = error[:, 1:] - error[:, :1]
    row: Row = {"frames": int(np.isfinite(p).all(axis=(1, 2)).sum())}
    row["rr_mm"] = float(np.nanmean(np.linalg.norm(error - error[:, :1], axis=-1)) * 1e3)
    row["abs_mm"] = float(np.nanmean(np.linalg.norm(error, axis=-1)) * 1e3)
    angles = np.degrees(so3.angle_between(R, R_true))
    row["hips_deg"], row["trunk_deg"] = (float(np.nanmean(angles[:, names.index(n)])) for n in ("Hips", "Spine3"))
    ray = so3.unit(p_true[:, 0] - centre)
    beside = so3.unit(np.cross(ray, [0.0, 0.0, 1.0]))
    axes = np.stack([beside, np.cross(ray, beside), ray], axis=1)
    joints = np.einsum("tac,tjc->tja", axes, relative)
    root = np.einsum("tac,tc->ta", axes, error[:, 0])
    lifted = np.isfinite(R).all(axis=(1, 2, 3))
    turns = so3.log(np.swapaxes(R[lifted], -1, -2) @ R_true[lifted])
    pairs = (
        (joints[..., :2], sigma_m[:, 1:, :1]),
        (joints[..., 2:], sigma_m[:, 1:, 1:]),
        (root[:, :2], sigma_m[:, 0, :1]),
        (root[:, 2:], sigma_m[:, 0, 1:]),
        (turns, sigma_rad[lifted, :, None]),
    )
    for name, (e, s) in zip(SIGMAS, pairs, strict=True):
        s = np.broadcast_to(s, e.shape)
        known = np.isfinite(e + s)
        row[f"actual {name}"] = float(np.mean(e[known] ** 2))
        row[f"stated {name}"] = float(np.mean(s[known] ** 2))
        row[f"within {name}"] = float(np.mean(np.abs(e[known]) < 2 * s[known]))
    return row


def rows_of(clip: MocapClip, camera: int, lifter: Lifter) -> Iterator[Row]:
    """Every row of one motion and camera."""
    whole = recorded(clip, camera, "realistic", SENSOR_SETS["10"], 0)
    whole, _ = cleaned(whole, ReconstructionSettings())
    recording = replace(whole, keypoints=evenly_spaced(whole.video))
    truth = recording.truth
    assert truth is not None
    frames = range(27, len(recording.video) - max(LOOKAHEADS), EVERY)
    true = at_times(truth, recording.video.times[list(frames)])
    about: Row = {
        "motion": clip.name,
        "camera": camera,
        "held out": "rigs" if clip.rig in split()["benchmark"]["rigs"] else "people",
    }
    centre = recording.video.camera.center_world
    for count, imus in worn(recording):
        for later, k, estimate in lifts(lifter, recording, imus, frames):
            own = about | {"sensors": count, "later frames": later, "k": k}
            yield own | scored(estimate, true.p_world_joint, true.R_world_bone, truth.names, centre)


def pooled(rows: list[Row]) -> Row:
    """Means over frames, and by kind of sigma the ratio of actual to stated and the share within two."""
    weights = np.array([row["frames"] for row in rows], float)

    def mean(name: str) -> float:
        return float(np.average([row[name] for row in rows], weights=weights))

    out: Row = {name: mean(name) for name in FIGURES}
    out["interval"] = bootstrap([r["motion"] for r in rows], [r["rr_mm"] for r in rows], weights)
    for name in SIGMAS:
        out[f"ratio {name}"] = float(np.sqrt(mean(f"actual {name}") / mean(f"stated {name}")))
        out[f"within {name}"] = mean(f"within {name}")
    return out


def table(rows: list[Row], by: tuple[str, ...]) -> str:
    """Rows pooled by what they have in common in some fields."""
    heads = [*by, "rr mm", "95 %", "abs mm", "hips deg", "upper trunk deg"]
    heads += [f"{name}: actual / stated, within 2" for name in SIGMAS]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for key in dict.fromkeys(tuple(row[field] for field in by) for row in rows):
        own = pooled([row for row in rows if tuple(row[field] for field in by) == key])
        low, high = own["interval"]
        cells = [str(value) for value in key] + [f"{own['rr_mm']:.1f}", f"{low:.1f}-{high:.1f}"]
        cells += [f"{own['abs_mm']:.1f}", f"{own['hips_deg']:.1f}", f"{own['trunk_deg']:.1f}"]
        cells += [f"{own[f'ratio {name}']:.2f}, {100 * own[f'within {name}']:.0f} %" for name in SIGMAS]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def text_of(rows: list[Row]) -> str:
    """All tables."""
    parts = ["# Lifts of the newest frames", __doc__.replace("``", "`").partition("\n\n")[2].strip()]
    for count in SENSORS:
        own = [row for row in rows if row["sensors"] == count]
        parts += [f"## {count} sensors", table(own, ("later frames", "k"))]
    ends = [row for row in rows if row["later frames"] == "moved on" and row["k"] in (0, 4, 13)]
    parts += ["## Held-out people and rigs", table(ends, ("sensors", "held out", "k"))]
    return "\n\n".join(part.rstrip() for part in parts)


def main(arguments: list[str] | None = None) -> None:
    """Measure, write and print."""
    parser = study_parser("lifter_lookahead", __doc__)
    parser.add_argument("--lifter", default="live", help="a file, or a shipped one by name")
    parser.add_argument("--motions", help="only these, separated by commas")
    options = parser.parse_args(arguments)
    lifter, clips = Lifter.load(options.lifter), test_clips(options.corpus)
    rows: list[Row] = []
    for i, clip in enumerate(clips):
        if not options.motions or clip.name in options.motions.split(","):
            rows += rows_of(clip, i % 4, lifter)
            print(clip.name, file=sys.stderr)
    print(write_results(options.out, rounded(rows, 5), text_of(rows)))


if __name__ == "__main__":
    main()
