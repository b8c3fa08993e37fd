"""How well clocks and headings of sensors are found from a video, and what is said where they are not.

``python -m benchmarks clocks_headings --corpus DIR`` with DIR the folder of free motion (README.md here).
The test people of split.toml, three of them also on another rig (rerigged.py). Each has a session of about
12 minutes: all own motions one after the other, with pauses and turns between, among motions of people
that train, on his skeleton. Sensors of 100, 60 or 120 Hz measure all of it, each with a heading and mounting
of its own; the video shows a part of the own motions, 30 or 60 Hz, with realistic 2D and a known camera.
Planted: an offset of up to 10 minutes and a drift of up to 100 ppm. A detector's delay would count as offset:
it is zero here. Limits in the package were chosen on validation and training people.

*turn or raise*: the pelvis turns by 45 degrees or an upper arm rises by 60 in the video. *sure*: no doubt is
stated. *wrong*: sure, and further off than 50 ms or 10 degrees. *refined*: with the delay that the
self-calibration of headings and mountings finds. *other log*: the sensors of another person. *treadmill*: a
stride repeated for five minutes, exactly or with strides whose duration varies by 4 %; 10 s of it are filmed.
Headings are found of the first video of a session. ``--excerpts`` instead compares, on videos of ten minutes, the
alignment by all of it with that by the five minutes in which the person moves most, as `run` sets sensors up.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from rich.progress import track

from benchmarks.command_line import study_parser
from benchmarks.harness import SENSOR_SETS, split, write_results
from benchmarks.rerigged import rerigged
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.alignment import align_sensors
from rtof_kin.calibration.clocks import find_clock
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import wrapped
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.setup.init import liveliest
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

RATE_HZ = 60.0
"""Of the motion."""
SESSION, VIDEO, PAUSE, BLEND = 720.0, 20.0, 2.0, 1.0
"""[s] A session, a video, the mean pause between motions, and the time from one to the next."""
LONG_VIDEO, STRIDES = 300.0, 300.0
"""[s] The video for drift, and the walk on a treadmill."""
REACH, DRIFT = 600.0, 100e-6
"""[s] and [s/s] Largest offset and drift planted."""
SECONDS = (20.0, 10.0, 5.0)
MOST_ALIGNED = 1
RERIGGED = ("CMU009", "CMU014", "CMU016")
RATES_HZ = ((100.0, 30.0), (60.0, 60.0), (120.0, 30.0), (100.0, 60.0))
"""Sensors and video."""


@dataclass(frozen=True)
class Session:
    """A person's long motion and what sensors measure of it."""

    name: str
    poses: PoseSequence
    skeleton: SkeletonModel
    own: tuple[int, int]
    """First and last frame of the person's own motions."""
    log: SensorLog
    calibration: ImuCalibration

    @property
    def joints(self) -> dict[str, str]:
        """Sensor -> segment."""
        return dict(zip(self.calibration.sensors, self.calibration.joints, strict=True))


@dataclass(frozen=True)
class Video:
    """A part of a session as a camera shows it, from time 0."""

    start: float
    """[s] In the session."""
    truth: PoseSequence
    keypoints: KeypointSequence
    poses: PoseSequence
    """Lifted."""

    def first(self, seconds: float) -> Video:
        """Its first part."""
        part = slice(0, int(np.searchsorted(self.truth.times, seconds)))
        return Video(self.start, self.truth[part], self.keypoints[part], self.poses[part])

    @property
    def turns(self) -> bool:
        """Whether the person turns or raises an arm."""
        facing = np.unwrap(so3.heading(self.truth.R_world_bone[:, 0]))
        if np.ptp(facing) > np.radians(45.0):
            return True
        j = [self.truth.names.index(name) for name in ("LeftArm", "RightArm")]
        k = [self.truth.names.index(name) for name in ("LeftForeArm", "RightForeArm")]
        up = so3.unit(self.truth.p_world_joint[:, k] - self.truth.p_world_joint[:, j])[..., 2]
        return bool(np.ptp(np.arcsin(np.clip(up, -1, 1)), axis=0).max() > np.radians(60.0))


# --- sessions ------------------------------------------------------------------------------------


def sessions(corpus: Path) -> Iterator[Session]:
    """The sessions of all test people."""
    clips = [resample_clip(low_passed(c, 10.0), RATE_HZ) for c in read_corpus(corpus, output_rate_hz=120.0)]
    rows = split()
    others = [clip for clip in clips if clip.subject not in rows["test"]]
    people = [(who, [c for c in clips if c.subject == who]) for who in rows["test"]]
    people += [(f"{who} re-rigged", [rerigged(c) for c in own]) for who, own in people if who in RERIGGED]
    for i, (name, own) in enumerate(people):
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        sensors = tuple(SENSOR_SETS)[i % 3]
        yield session(rng, name, own, others, SENSOR_SETS[sensors], RATES_HZ[i % len(RATES_HZ)][0])


def session(
    rng: Generator,
    name: str,
    own: Sequence[MocapClip],
    others: Sequence[MocapClip],
    sensors: tuple[str, ...],
    rate_hz: float,
) -> Session:
    """All motions of a person amid those of others on his skeleton, with sensors."""
    skeleton = SkeletonModel.default().with_offsets(own[0].joint_offsets)
    mine = [own[i].poses for i in rng.permutation(len(own))]
    left, seconds = [], sum(len(poses) / RATE_HZ + PAUSE + BLEND for poses in mine)
    for i in rng.permutation(len(others)):
        if seconds < SESSION:
            left.append(others[i].poses)
            seconds += len(left[-1]) / RATE_HZ + PAUSE + BLEND
    at = int(rng.integers(len(left)))
    poses, firsts = joined(rng, [*left[:at], *mine, *left[at:]], skeleton)
    block = firsts[at], firsts[at + len(mine) - 1] + len(mine[-1])
    log, calibration = measured(rng, poses, skeleton, sensors, rate_hz)
    return Session(name, poses, skeleton, block, log, calibration)


def joined(rng: Generator, motions: Sequence[PoseSequence], skeleton: SkeletonModel) -> tuple[PoseSequence, list[int]]:
    """Motions one after the other, each facing anywhere, with pauses between; and where each begins."""
    R_parts, p_parts, firsts, count = list[Array](), list[Array](), list[int](), 0
    for poses in motions:
        turn = so3.about_axis("z", rng.uniform(-np.pi, np.pi))
        R, p = turn @ poses.R_world_bone, poses.p_world_joint[:, 0] @ turn.T
        p -= p[0] * [1, 1, 0]
        if R_parts:
            end = p_parts[-1][-1]
            R_between, share = _between(rng, R_parts[-1][-1], R[0], skeleton)
            p += end * [1, 1, 0]
            R_parts.append(R_between)
            p_parts.append(end + share[:, None] * (p[0] - end))
            count += len(share)
        firsts.append(count)
        R_parts.append(R)
        p_parts.append(p)
        count += len(R)
    return alive(rng, np.concatenate(R_parts), np.concatenate(p_parts), skeleton), firsts


def _between(rng: Generator, R_a: Array, R_b: Array, skeleton: SkeletonModel) -> tuple[Array, Array]:
    """A pause and the way to another pose (T, J, 3, 3), and the share of the way (T,)."""
    held = rng.exponential(PAUSE)
    s = np.clip((np.arange(round((held + BLEND) * RATE_HZ)) / RATE_HZ - held) / BLEND, 0, 1)
    share = s**3 * (10 - 15 * s + 6 * s**2)  # minimum jerk
    a, b = (kinematics.local_rotations(skeleton.parents, R) for R in (R_a, R_b))
    step = so3.log(np.swapaxes(a, -1, -2) @ b)
    local = a @ so3.exp(share[:, None, None] * step)
    return kinematics.world_rotations(skeleton.parents, local), share


def alive(rng: Generator, R: Array, p_root: Array, skeleton: SkeletonModel) -> PoseSequence:
    """A motion with a slow sway of 0.4 degrees in all joints and without jerks where pieces meet."""
    local = kinematics.local_rotations(skeleton.parents, R)
    sway = np.cumsum(rng.standard_normal((*local.shape[:2], 3)), axis=0)
    sway = signals.low_pass(sway - signals.low_pass(sway, RATE_HZ, 0.1), RATE_HZ, 0.8)
    turned = local @ so3.exp(np.radians(0.4) * sway / sway.std(axis=0))
    R = kinematics.world_rotations(skeleton.parents, turned)
    R = so3.nearest_rotation(signals.low_pass(R, RATE_HZ, 8.0))
    p_root = signals.low_pass(p_root, RATE_HZ, 8.0)
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p_root, R)
    return PoseSequence(np.arange(len(R)) / RATE_HZ, p, R, skeleton.names)


def measured(
    rng: Generator, poses: PoseSequence, skeleton: SkeletonModel, sensors: tuple[str, ...], rate_hz: float
) -> tuple[SensorLog, ImuCalibration]:
    """What sensors measure on the session's clock, and their calibration."""
    times = np.arange(0, poses.times[-1] - 1 / rate_hz, 1 / rate_hz)
    imus, calibration = simulate_imus(rng, poses, skeleton, sensors, times, ImuNoise())
    streams = tuple(
        SensorStream(name, times, imus.f_sensor[:, s], imus.R_inertial_sensor[:, s])
        for s, name in enumerate(imus.names)
    )
    return SensorLog(Path("simulated"), "simulated", streams, Declaration()), calibration


def treadmill(rng: Generator, corpus: Path, spread: float) -> Session:
    """A stride of a test person, repeated; each takes a little longer or shorter."""
    walk = next(clip for clip in read_corpus(corpus, ["CMU016"]) if clip.name == "16_15")
    skeleton = SkeletonModel.default().with_offsets(walk.joint_offsets)
    R, p = walk.poses.R_world_bone, walk.poses.p_world_joint[:, 0]
    first, lengths = 30, np.arange(50, 90)
    apart = [np.mean(so3.angle_between(R[first], R[first + n])) for n in lengths]
    stride = slice(first, first + int(lengths[int(np.argmin(apart))]))
    own, up = R[stride], p[stride] * [0, 0, 1]
    parts = []
    while sum(map(len, parts)) < STRIDES * RATE_HZ:
        count = round(len(own) * (1 + spread * rng.standard_normal()))
        parts.append(np.clip(np.round(np.linspace(0, len(own), count, endpoint=False)), 0, len(own) - 1))
    index = np.concatenate(parts).astype(int)
    poses = alive(rng, own[index], up[index], skeleton)
    log, calibration = measured(rng, poses, skeleton, SENSOR_SETS["8"], 100.0)
    name = f"treadmill, strides vary by {100 * spread:g} %"
    return Session(name, poses, skeleton, (len(poses) // 2 - 300, len(poses) // 2 + 300), log, calibration)


# --- what is given and what is found -------------------------------------------------------------


def videos(own: Session, rate_hz: float, seconds: float = VIDEO) -> Iterator[Video]:
    """The videos of a person's own motions, from changing cameras."""
    a, b = own.own
    count = round(min(seconds, (b - a) / RATE_HZ) * RATE_HZ)
    for i, first in enumerate(range(a, b - count + 1, count)):
        yield filmed(own, first, count, rate_hz, i)


def filmed(own: Session, first: int, count: int, rate_hz: float, seed: int) -> Video:
    """Some frames of a session as a camera shows them."""
    shown = own.poses[first : first + count : round(RATE_HZ / rate_hz)]
    shown = replace(shown, times=shown.times - shown.times[0])
    recording = simulate(
        shown,
        own.skeleton.joint_offsets,
        camera=standard_cameras(shown, seed)[seed % 4],
        seed=seed,
        settings=SimulationSettings(keypoints=DetectorErrors(delay_frames=(0,)), sensors=()),
    )
    lifted = lift(recording.video, own.skeleton)
    return Video(first / RATE_HZ, shown, recording.video, lifted.poses)


def planted(rng: Generator, log: SensorLog, start: float) -> tuple[SensorLog, float, float]:
    """Sensors on a clock of their own: t_video = t_sensor + offset + drift t_sensor."""
    offset, drift = rng.uniform(-REACH, REACH), rng.uniform(-DRIFT, DRIFT)
    streams = tuple(replace(s, times=(s.times - start - offset) / (1 + drift)) for s in log.streams)
    return replace(log, streams=streams), float(offset), float(drift)


def clock_row(rng: Generator, own: Session, video: Video, known: bool, log: SensorLog | None = None) -> Any:
    """What is found of a planted clock; sensors of another person if `log` is given."""
    moved, offset, drift = planted(rng, own.log if log is None else log, video.start)
    about = {
        "session": own.name,
        "start": video.start,
        "seconds": round(float(video.truth.times[-1])),
        "sensors": len(own.log.streams),
        "known": known,
        "turns": video.turns,
        "other log": log is not None,
    }
    joints = own.joints if known else None
    try:
        found = find_clock(video.poses, video.keypoints, moved, own.skeleton, joints, reach=REACH + 1)
    except RtofError as error:
        return about | {"doubt": str(error)}, None
    truth = offset + drift * found.middle
    row = about | {
        "offset": offset,
        "drift_ppm": 1e6 * drift,
        "error_ms": 1e3 * (found.offset - truth),
        "sigma_ms": 1e3 * found.sigma,
        "margin": found.margin,
        "doubt": found.doubt,
        "drift_error_ppm": 1e6 * (found.drift - drift),
        "drift_sigma_ppm": 1e6 * found.sigma_drift,
    }
    return row, found.apply(moved)


def heading_rows(own: Session, video: Video, log: SensorLog, clock: dict[str, Any]) -> list[dict[str, Any]]:
    """What is found of headings and mountings, with the clock that was found."""
    found = align_sensors(video.poses, video.keypoints, log, own.joints, own.skeleton, calibrate_recording)
    delay = 0.0 if found.delay is None else float(found.delay.value[0])
    clock["refined_ms"] = clock["error_ms"] + 1e3 * delay
    truth, rows = own.calibration, []
    for s, sensor in enumerate(found.sensors):
        off = float(wrapped(sensor.heading - so3.heading(truth.R_world_inertial[s])))
        mounting = so3.angle_between(found.calibration.R_sensor_bone[s], truth.R_sensor_bone[s])
        rows.append(
            {
                "session": own.name,
                "start": video.start,
                "turns": video.turns,
                "joint": sensor.joint,
                "error_deg": float(np.degrees(off)),
                "sigma_deg": float(np.degrees(sensor.sigma_heading)),
                "mounting_error_deg": float(np.degrees(mounting)),
                "doubt": sensor.doubt,
            }
        )
    return rows


# --- results -------------------------------------------------------------------------------------


def measure(corpus: Path, align: bool, out: Path) -> dict[str, list[dict[str, Any]]]:
    """All rows, of which those so far are written after every session."""
    people = list(sessions(corpus))
    clocks, headings = list[dict[str, Any]](), list[dict[str, Any]]()
    for i, own in enumerate(track(people, "sessions")):
        rng = np.random.default_rng([1, i])
        other = people[(i + 1) % len(people)]
        wrong = other.log.select([s for s in own.joints if s in other.log.names])
        for count, video in enumerate(videos(own, RATES_HZ[i % len(RATES_HZ)][1])):
            row, log = clock_row(rng, own, video, known=True)
            clocks.append(row)
            clocks.append(clock_row(rng, own, video, known=False)[0])
            for seconds in SECONDS[1:]:
                if seconds < video.truth.times[-1] - 0.5:
                    clocks.append(clock_row(rng, own, video.first(seconds), known=True)[0])
            part = replace(own, calibration=own.calibration.select(wrong.names))
            clocks.append(clock_row(rng, part, video, known=True, log=wrong)[0])
            if align and log is not None and count < MOST_ALIGNED:
                headings += heading_rows(own, video, log, row)
        for seconds in (LONG_VIDEO,) if i % 3 == 0 else ():
            long = filmed(own, round(60 * RATE_HZ), round(seconds * RATE_HZ), 30.0, i)
            clocks.append(clock_row(rng, own, long, known=True)[0])
        write_results(out, {"clocks": clocks, "headings": headings}, "")
    for k, spread in enumerate((0.0, 0.04)):
        rng = np.random.default_rng([2, k])
        walk = treadmill(rng, corpus, spread)
        for video in videos(walk, 30.0, 10.0):
            clocks.append(clock_row(rng, walk, video, known=True)[0])
    return {"clocks": clocks, "headings": headings}


def clock_groups(rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Rows of the clocks in groups, by their heading."""
    usual = [r for r in rows if not r["other log"] and "treadmill" not in r["session"]]
    short = [r for r in usual if r["seconds"] <= VIDEO]
    moving = [r for r in short if r["turns"]]
    yield "turn or raise, 20 s", [r for r in moving if r["known"] and r["seconds"] > 10]
    yield "turn or raise, 20 s, places unknown", [r for r in moving if not r["known"]]
    yield "turn or raise, 10 s", [r for r in moving if r["known"] and 5 < r["seconds"] <= 10]
    yield "turn or raise, 5 s", [r for r in moving if r["known"] and r["seconds"] <= 5]
    yield "neither, any length", [r for r in short if not r["turns"] and r["known"]]
    yield "5 minutes", [r for r in usual if r["seconds"] > VIDEO]
    yield "other log", [r for r in rows if r["other log"]]
    for name in dict.fromkeys(r["session"] for r in rows if "treadmill" in r["session"]):
        yield name, [r for r in rows if r["session"] == name]


def text_of(result: dict[str, list[dict[str, Any]]]) -> str:
    """Tables."""
    lines = ["| clocks | videos | sure | of these within 10 ms | RMS ms | stated ms | wrong |", "|---" * 7 + "|"]
    for name, rows in clock_groups(result["clocks"]):
        sure = [r for r in rows if not r["doubt"]]
        off = np.array([r["error_ms"] for r in sure])
        near, stated = off[np.abs(off) < 50], [r["sigma_ms"] for r in sure]
        wrong = len(sure) if name == "other log" else len(off) - len(near)
        figures = (
            f"{np.mean(np.abs(off) <= 10):.0%} | {np.sqrt(np.mean(near**2)):.1f} | {np.mean(stated):.1f}"
            if len(near) and name != "other log"
            else "- | - | -"
        )
        lines.append(f"| {name} | {len(rows)} | {len(sure)} | {figures} | {wrong} |")
    long = [r for r in result["clocks"] if r["seconds"] > VIDEO and "drift_error_ppm" in r]
    off, stated = (np.array([r[k] for r in long]) for k in ("drift_error_ppm", "drift_sigma_ppm"))
    lines += [
        "",
        f"Drift in 5 minutes: RMS error {np.sqrt(np.mean(off**2)):.0f} ppm, stated {np.mean(stated):.0f} ppm.",
    ]
    both = [r for r in result["clocks"] if "refined_ms" in r and not r["doubt"]]
    if both:
        before, after = (np.array([r[k] for r in both]) for k in ("error_ms", "refined_ms"))
        lines += [
            "",
            f"Of {len(both)} videos: within 10 ms {np.mean(np.abs(before) <= 10):.0%}, "
            f"RMS {np.sqrt(np.mean(before**2)):.1f} ms; refined {np.mean(np.abs(after) <= 10):.0%}, "
            f"{np.sqrt(np.mean(after**2)):.1f} ms.",
        ]
    if result["headings"]:
        lines += ["", *_heading_lines(result["headings"])]
    return "\n".join(lines)


def _heading_lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield (
        "| headings | sensors | sure | of these within 3 deg | within 5 deg | within 2 sd | median deg | "
        "wrong | median of all | mounting deg |"
    )
    yield "|---" * 10 + "|"
    groups = {
        "turn or raise": [r for r in rows if r["turns"]],
        "neither": [r for r in rows if not r["turns"]],
        "limbs, turn or raise": [r for r in rows if r["turns"] and r["joint"].startswith(("Left", "Right"))],
        "trunk, turn or raise": [r for r in rows if r["turns"] and not r["joint"].startswith(("Left", "Right"))],
    }
    for name, group in groups.items():
        sure = [r for r in group if not r["doubt"]]
        if not sure:
            continue
        off, sigma = (np.array([r[k] for r in sure]) for k in ("error_deg", "sigma_deg"))
        off, everyone = np.abs(off), np.abs([r["error_deg"] for r in group])
        mounting = np.median([r["mounting_error_deg"] for r in sure])
        yield (
            f"| {name} | {len(group)} | {len(sure)} | {np.mean(off <= 3):.0%} | {np.mean(off <= 5):.0%} | "
            f"{np.mean(off <= 2 * sigma):.0%} | {np.median(off):.1f} | {np.sum(off > 10)} | "
            f"{np.median(everyone):.1f} | {mounting:.1f} |"
        )


def excerpts(corpus: Path) -> Iterator[str]:
    """Table of alignments by ten minutes and by the liveliest five of them."""
    yield "| session | sensors | by | mounting deg | heading deg | most | processor s |"
    yield "|---" * 7 + "|"
    measured = dict[str, list[tuple[float, ...]]]()
    for i, own in enumerate(track(list(sessions(corpus)), "sessions")):
        count = min(round(2 * LONG_VIDEO * RATE_HZ), len(own.poses) - 120)
        first = int(np.random.default_rng(i).integers(0, len(own.poses) - count - 60))
        video = filmed(own, first, count, RATE_HZ, i)
        streams = tuple(replace(s, times=s.times - video.start) for s in own.log.streams)
        seen = liveliest(video.keypoints)
        begin = int(np.searchsorted(video.poses.times, seen.times[0]))
        excerpt = replace(video, keypoints=seen, poses=video.poses[begin : begin + len(seen)])
        for by, shown in (("all", video), ("excerpt", excerpt)):
            began = time.process_time()
            sensors = heading_rows(own, shown, replace(own.log, streams=streams), {"error_ms": 0.0})
            seconds, heading = time.process_time() - began, np.abs([sensor["error_deg"] for sensor in sensors])
            mounting = np.mean([sensor["mounting_error_deg"] for sensor in sensors])
            row = (float(mounting), float(heading.mean()), float(heading.max()), seconds)
            measured.setdefault(by, []).append(row)
            yield f"| {own.name} | {len(sensors)} | {by} | " + " | ".join(f"{v:.1f}" for v in row) + " |"
    for by, rows in measured.items():
        yield f"| mean | | {by} | " + " | ".join(f"{v:.1f}" for v in np.mean(rows, axis=0)) + " |"


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("clocks_headings", __doc__)
    parser.add_argument("--clocks-only", action="store_true", help="without headings, in two minutes")
    parser.add_argument("--excerpts", action="store_true", help="the alignment by a part of a long video alone")
    options = parser.parse_args(arguments)
    if options.excerpts:
        lines = [
            "Mounting and heading of sensors by ten minutes of video, and by the five in which the person moves most",
            "(`python -m benchmarks clocks_headings --excerpts --corpus DIR`); errors are means over the sensors.",
            "",
        ]
        for line in excerpts(options.corpus):
            lines.append(line)
            (options.out.parent / "alignment_excerpt.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return
    result = measure(options.corpus, not options.clocks_only, options.out)
    print(write_results(options.out, result, text_of(result)))


if __name__ == "__main__":
    main()
