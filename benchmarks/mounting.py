"""How often faults of a sensor setup are found and named, and how often good setups are accused.

``python -m benchmarks mounting --corpus DIR`` with DIR the folder of free motion (see README.md here).
Motion of the validation subjects of split.toml (``--subset train``: of all that train), in pieces of 4 to
12 s. Sensors are simulated with soft tissue and accelerometer noise; each is misaligned by about 10
degrees. One fault is planted at a time, as if it was made before a calibration in an N-pose; which
sensor, axis and angle are drawn. *found*: something is reported, which is a false alarm where nothing was
planted. *named*: what is reported first is what was planted, and correcting it gives the good calibration
back.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from rich.progress import track

from benchmarks.command_line import study_parser
from benchmarks.harness import SENSOR_SETS, mocap_people, split, write_results
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.inertial.pose_calibration import pose_rotations, usual_lever
from rtof_kin.inertial.setup_diagnosis import LEAST_RATIO, Fault, FaultKind, diagnose_setup
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import low_passed

SEED, POSE = 1, "N"
SECONDS, LEAST_SECONDS, MOST_PIECES = 12.0, 4.0, 2
MISALIGNMENT_DEG = 10 / np.sqrt(8 / np.pi)
"""Per axis: the mean length of three normal components is sqrt(8 / pi) of one's standard deviation."""
SETS = {**SENSOR_SETS, "13": tuple(SkeletonModel.default().sensors)}
NEIGHBOURS = (("Leg", "UpLeg"), ("Foot", "Leg"), ("ForeArm", "Arm"))


def pieces(corpus: Path, subset: str) -> Iterator[MocapClip]:
    """Motion of the subjects of a subset, low-passed, at 60 Hz, in pieces of `SECONDS`."""
    held_out = {*split()["test"], *split()["validation"]}
    for clip in read_corpus(corpus, mocap_people("validation") if subset == "validation" else None):
        if subset == "train" and clip.subject in held_out:
            continue
        count, length = len(clip.poses), round(SECONDS * clip.poses.rate_hz)
        if count < LEAST_SECONDS * clip.poses.rate_hz:
            continue
        smooth = resample_clip(low_passed(clip, 10.0), 60.0)
        for first in list(range(0, max(count - length // 2, 1), length))[:MOST_PIECES]:
            poses = smooth.poses[first : first + length]
            if len(poses) >= LEAST_SECONDS * 60:
                poses = replace(poses, times=poses.times - poses.times[0])
                yield replace(smooth, poses=poses, name=f"{clip.name}[{first}]")


@dataclass(frozen=True)
class Planted:
    """A calibration with a fault, and what it is."""

    calibration: ImuCalibration
    kind: FaultKind | None


def _declared_on(good: ImuCalibration, wrong: dict[str, str], skeleton: SkeletonModel) -> ImuCalibration:
    """As if the sensors on some segments had been declared on others before the calibration pose."""
    R_pose = pose_rotations(POSE, skeleton)
    joints = [wrong.get(joint, joint) for joint in good.joints]
    was, now = skeleton.index(*good.joints), skeleton.index(*joints)
    R = good.R_sensor_bone @ np.swapaxes(R_pose[was], -1, -2) @ R_pose[now]
    levers = dict(zip(good.joints, good.p_bone_sensor, strict=True))
    new = [levers[j] if j in levers else usual_lever(j, skeleton) for j in joints]
    return replace(good, joints=tuple(joints), R_sensor_bone=R, p_bone_sensor=np.array(new))


def _nothing(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted:
    return Planted(good, None)


def _facing(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted:
    turn = so3.about_axis("z", np.radians(rng.choice([90, -90, 180])))
    R_pose = pose_rotations(POSE, skeleton)[skeleton.index(*good.joints)]
    R = good.R_sensor_bone @ np.swapaxes(R_pose, -1, -2) @ turn @ R_pose
    return Planted(replace(good, R_sensor_bone=R), FaultKind.FACING)


def _turned(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted:
    s = int(rng.integers(len(good.sensors)))
    R = good.R_sensor_bone.copy()
    R[s] = R[s] @ so3.about_axis(rng.choice(list("xyz")), np.radians(rng.choice([90, -90, 180])))
    return Planted(replace(good, R_sensor_bone=R), FaultKind.MOUNTING)


def _swapped(
    good: ImuCalibration, skeleton: SkeletonModel, kind: FaultKind, pairs: Sequence[tuple[str, str]]
) -> Planted:
    both = {**dict(pairs), **{b: a for a, b in pairs}}
    return Planted(_declared_on(good, both, skeleton), kind)


def _sides(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted:
    pairs = _pairs(good)
    return _swapped(good, skeleton, FaultKind.SIDES, [pairs[int(rng.integers(len(pairs)))]])


def _all_sides(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted:
    return _swapped(good, skeleton, FaultKind.SIDES, _pairs(good))


def _neighbours(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted | None:
    pairs = [(side + a, side + b) for side in ("Left", "Right") for a, b in NEIGHBOURS]
    pairs = [(a, b) for a, b in pairs if a in good.joints and b in good.joints]
    if not pairs:
        return None
    return _swapped(good, skeleton, FaultKind.NEIGHBOURS, [pairs[int(rng.integers(len(pairs)))]])


def _elsewhere(rng: Generator, good: ImuCalibration, skeleton: SkeletonModel) -> Planted | None:
    wrong = [
        (side + a, side + b)
        for side in ("Left", "Right")
        for x, y in NEIGHBOURS
        for a, b in ((x, y), (y, x))
        if side + a in good.joints and side + b not in good.joints
    ]
    if not wrong:
        return None
    true, declared = wrong[int(rng.integers(len(wrong)))]
    return Planted(_declared_on(good, {true: declared}, skeleton), FaultKind.SEGMENT)


def _pairs(good: ImuCalibration) -> list[tuple[str, str]]:
    left = [joint for joint in good.joints if joint.startswith("Left")]
    return [(joint, joint.replace("Left", "Right")) for joint in left]


PLANTS: dict[str, Callable[[Generator, ImuCalibration, SkeletonModel], Planted | None]] = {
    "nothing": _nothing,
    "facing 90, 180": _facing,
    "mounting 90, 180": _turned,
    "a left and a right swapped": _sides,
    "all left and right swapped": _all_sides,
    "neighbours swapped": _neighbours,
    "on the wrong segment": _elsewhere,
}


def judge(clip: MocapClip) -> list[dict[str, Any]]:
    """A row for every set of sensors and kind of fault: what was reported of one piece of motion."""
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    noise = replace(ImuNoise(), misalignment_deg=MISALIGNMENT_DEG)
    rows = []
    for sensors, names in SETS.items():
        rng = np.random.default_rng([SEED, zlib.crc32(f"{clip.name} {sensors}".encode())])
        imus, good = simulate_imus(rng, clip.poses, skeleton, names, clip.poses.times, noise)
        for plant, make in PLANTS.items():
            planted = make(rng, good, skeleton)
            if planted is None:
                continue
            found = diagnose_setup(planted.calibration.apply(imus), skeleton, pose=POSE, most=1)
            rows.append(
                {
                    "motion": clip.name,
                    "subject": clip.subject,
                    "sensors": sensors,
                    "plant": plant,
                    "seconds": len(clip.poses) / 60,
                    "found": bool(found),
                    "ratio": found[0].log_likelihood_ratio if found else None,
                    "what": found[0].what if found else "",
                    "named": bool(found) and _is_right(found[0], planted, good),
                }
            )
    return rows


def _is_right(fault: Fault, planted: Planted, good: ImuCalibration) -> bool:
    """True if correcting it restores the good calibration."""
    if fault.kind is not planted.kind:
        return False
    corrected = fault.corrected(planted.calibration)
    off = so3.angle_between(corrected.R_sensor_bone, good.R_sensor_bone)
    return bool(corrected.joints == good.joints and np.all(off < np.radians(1.0)))


def summarised(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for every set of sensors and kind of fault: shares of the pieces."""
    out = []
    for plant in PLANTS:
        for sensors in SETS:
            own = [r for r in rows if r["plant"] == plant and r["sensors"] == sensors]
            if own:
                ratios = [r["ratio"] for r in own if r["found"]]
                out.append(
                    {
                        "plant": plant,
                        "sensors": sensors,
                        "pieces": len(own),
                        "found": float(np.mean([r["found"] for r in own])),
                        "named": float(np.mean([r["named"] for r in own])),
                        "ratio": round(float(np.median(ratios)), 1) if ratios else None,
                    }
                )
    return out


def table(summary: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = ["| planted | sensors | pieces | found | named | median ratio, nats |", "|---" * 6 + "|"]
    for row in summary:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.0f}"
        found, named = (f"{100 * row[key]:.0f} %" for key in ("found", "named"))
        named = "" if row["plant"] == "nothing" else named
        lines.append(f"| {row['plant']} | {row['sensors']} | {row['pieces']} | {found} | {named} | {ratio} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("mounting", __doc__)
    parser.add_argument("--subset", choices=("validation", "train"), default="validation")
    parser.add_argument("--most", type=int, default=100, help="so many pieces, evenly drawn")
    options = parser.parse_args(arguments)
    clips = list(pieces(options.corpus, options.subset))
    clips = clips[:: max(len(clips) // options.most, 1)][: options.most]
    rows = [row for clip in track(clips, "pieces") for row in judge(clip)]
    summary = summarised(rows)
    chosen = f"--subset {options.subset} --most {options.most}"
    result = {
        "command": f"python -m benchmarks mounting --corpus DIR {chosen}",
        "seed": SEED,
        "least_ratio": LEAST_RATIO,
        "summary": summary,
        "rows": rows,
    }
    print(write_results(options.out, result, table(summary)))


if __name__ == "__main__":
    main()
