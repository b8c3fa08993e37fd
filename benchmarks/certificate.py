"""Whether left-out sensors certify: ``python -m benchmarks certificate --corpus DIR --exercises CORPUS.npz --faults``.

The benchmark's motions of held-out people and rigs and exercises of two held-out people, one camera each in turn,
realistic 2D, 8 and 10 sensors: the certified error of every left-out sensor's segment, swing and twist, beside its
true error and the stated one; and the bands of the reconstruction with all sensors, as they are and scaled by what the
certificate found. ``--faults`` adds every second motion with errors that are hardly named: a clock 100 ms off, a
sensor turned by 15 degrees, references tilted by 5, a focal length or bones 10 and 5 % wrong. Recordings of less than
4 s have no certificate. Half an hour of two cores with faults.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks import clocks_real, harness
from benchmarks.accuracy.faults import with_changed_camera
from benchmarks.accuracy.video_faults import with_late_video
from benchmarks.clocks_headings import filmed
from benchmarks.command_line import in_parallel, study_parser, table_head
from benchmarks.confidence.cases import turn_error
from benchmarks.verdicts.scores import area, rank_correlation
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.certificate import MOST_SECONDS
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.certificate import MUCH_WORSE, WORSE
from rtof_kin.simulation.mocap import MocapClip

Row = dict[str, Any]
SENSORS = ("8", "10")
SETTINGS = ReconstructionSettings(certificate=True)
EVERY = 6
"""Step between the frames whose bands are looked at."""


def _calibrated(recording: Recording, **changes: Array) -> Recording:
    assert recording.calibration is not None
    return replace(recording, calibration=replace(recording.calibration, **changes))


def _turned(recording: Recording, rng: Generator) -> Recording:
    """One sensor, drawn, believed turned by 15 degrees about a drawn axis."""
    assert recording.calibration is not None
    R = recording.calibration.R_sensor_bone.copy()
    one = rng.integers(len(R))
    R[one] = R[one] @ so3.exp(np.radians(15.0) * so3.unit(rng.normal(size=3)))
    return _calibrated(recording, R_sensor_bone=R)


def _tilted(recording: Recording, rng: Generator) -> Recording:
    """All references believed tilted by 5 degrees about one horizontal axis."""
    assert recording.calibration is not None
    tilt = so3.exp(np.radians(5.0) * so3.unit(np.append(rng.normal(size=2), 0.0)))
    return _calibrated(recording, R_world_inertial=tilt @ recording.calibration.R_world_inertial)


def _zoomed(recording: Recording, rng: Generator) -> Recording:
    """A focal length believed 10 % too long or too short."""
    camera = recording.video.camera
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= rng.choice((0.9, 1.1))
    return with_changed_camera(recording, K=K)


def _resized(recording: Recording, rng: Generator) -> Recording:
    """Bones believed 5 % too long or too short."""
    return replace(recording, joint_offsets=recording.joint_offsets * rng.choice((0.95, 1.05)))


FAULTS: Mapping[str, Callable[[Recording, Generator], Recording]] = {
    "none": lambda recording, _: recording,
    "clock 100 ms": lambda recording, rng: with_late_video(recording, rng, 0.1),
    "a sensor turned 15 deg": _turned,
    "references tilted 5 deg": _tilted,
    "focal length 10 %": _zoomed,
    "bones 5 %": _resized,
}


@cache
def _lifter() -> Any:
    from lifting.predict import Lifter

    return Lifter.load(None)


def measured(job: tuple[MocapClip, int, str, str]) -> Row | None:
    """One recording: its certificate and bands beside the truth; None where it is not certified."""
    clip, camera, sensors, fault = job
    recording = harness.recorded(clip, camera, "realistic", harness.SENSOR_SETS[sensors], 0)
    truth = recording.truth
    assert truth is not None
    recording = FAULTS[fault](recording, np.random.default_rng(camera))
    try:
        with without_warnings(RESULT_WARNINGS):
            result = reconstruct(recording, mode="rtof", lifter=_lifter(), settings=SETTINGS)
    except RtofError as error:
        print(f"{clip.name}, {fault}: {error}", file=sys.stderr)
        return None
    certificate, motion = result.certificate, result.motion
    assert certificate is not None
    true, index = at_times(truth, motion.times).R_world_bone, motion.poses.names.index
    segments = [
        {"certified": one.certified, "expected": one.expected, "true": _rms(one.against(true[:, index(one.joint)]))}
        for one in certificate.left_out
    ]
    named = any(check.failed for check in result.checks)
    about = {"sensors": sensors, "fault": fault, "segments": segments, "ratio": certificate.ratio, "named": named}
    return about | {"turns": _turns(motion, truth), "positions": _positions(motion, truth)}


def _rms(values: Array) -> Array:
    """Root mean square over the known frames of (T, n)."""
    return np.sqrt(np.nanmean(values**2, axis=0))


def _turns(motion: Motion, truth: PoseSequence) -> tuple[Array, Array]:
    """Errors and standard deviations (n, 3), rad, of all pairs of segments, every `EVERY` frames."""
    known, few = motion.confidence, slice(None, None, EVERY)
    assert known is not None
    names, true, errors, sigmas = motion.poses.names, at_times(truth, motion.times), [], []
    for k, (parent, child) in enumerate(known.pairs):
        R, R_true = motion.poses.R_world_bone[few], true.R_world_bone[few]
        errors.append(turn_error(R, R_true, names, parent, child))
        sigmas.append(np.sqrt(np.diagonal(known.turn_covariance[few, k], axis1=1, axis2=2)))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    both = np.isfinite(error + sigma).all(axis=1)
    return error[both], sigma[both]


def _positions(motion: Motion, truth: PoseSequence) -> tuple[float, float]:
    """Shares of the errors of positions inside their 95 % bands, relative to the root and in world."""
    known, p = motion.confidence, motion.poses.p_world_joint
    assert known is not None
    off = p - at_times(truth, motion.times).p_world_joint
    inside = []
    for error, covariance in ((off - off[:, :1], known.relative_covariance), (off, known.position_covariance)):
        sigma = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))[:, 1:]
        both = np.isfinite(error[:, 1:] + sigma)
        inside.append(float(np.mean(np.abs(error[:, 1:][both]) <= BAND_95 * sigma[both])))
    return inside[0], inside[1]


def table(rows: Sequence[Row]) -> str:
    """What certified errors tell of true ones, beside what was stated."""
    lines = table_head(
        "sensors | of the segment without its sensor | recordings, segments | certified, true, stated RMS deg "
        "| rank correlation (stated) | above 5 deg: area under the curve (stated), share | above 10 deg"
    )
    for sensors in SENSORS:
        own = [one for row in rows if row["sensors"] == sensors for one in row["segments"]]
        count = sum(bool(row["segments"]) for row in rows if row["sensors"] == sensors)
        both = {name: np.degrees([one[name] for one in own]) for name in ("certified", "true", "expected")}
        for what, pick in PARTS.items():
            certified, true, stated = (pick(both[name]) for name in ("certified", "true", "expected"))
            sizes = ", ".join(f"{np.sqrt(np.mean(v**2)):.1f}" for v in (certified, true, stated))
            cells = [f"{rank_correlation(certified, true):.2f} ({rank_correlation(stated, true):.2f})"]
            for limit in (5.0, 10.0):
                bad = true > limit
                cells.append(f"{area(certified, bad):.2f} ({area(stated, bad):.2f}), {100 * bad.mean():.0f} %")
            lines.append(f"| {sensors} | {what} | {count}, {len(own)} | {sizes} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


PARTS: Mapping[str, Callable[[Array], Array]] = {
    "swing": lambda parts: parts[:, 0],
    "twist": lambda parts: parts[:, 1],
    "swing and twist, each": lambda parts: parts.ravel(),
    "both together": lambda parts: np.linalg.norm(parts, axis=1),
}


def fault_table(rows: Sequence[Row]) -> str:
    """Bands of the reconstruction with all sensors, as they are and as the certificate would have them."""
    lines = table_head(
        "fault | sensors | recordings | ratio: median, 5 and 95 % | warn, fail | named by a check "
        "| turns inside 95 % bands | scaled by the certificate | half width deg, scaled | positions: relative, world"
    )
    for fault in dict.fromkeys(row["fault"] for row in rows):
        for sensors in SENSORS:
            own = [row for row in rows if (row["fault"], row["sensors"]) == (fault, sensors) and row["segments"]]
            if not own:
                continue
            ratio = np.array([row["ratio"] for row in own])
            low, middle, high = np.quantile(ratio, (0.05, 0.5, 0.95))
            graded = [f"{100 * np.mean(ratio > limit):.0f} %" for limit in (WORSE, MUCH_WORSE)]
            named = 100 * np.mean([row["named"] for row in own])
            plain = [_covered(row, 1.0) for row in own]
            scaled = [_covered(row, max(1.0, row["ratio"])) for row in own]
            (inside, half), (inside_scaled, half_scaled) = np.mean(plain, axis=0), np.mean(scaled, axis=0)
            cells = [
                *(fault, sensors, str(len(own)), f"{middle:.2f}, {low:.2f}, {high:.2f}", ", ".join(graded)),
                f"{named:.0f} %",
                f"{100 * inside:.0f} % (least {100 * min(i for i, _ in plain):.0f})",
                *(f"{100 * inside_scaled:.0f} %", f"{half:.1f}, {half_scaled:.1f}"),
                ", ".join(f"{100 * share:.0f} %" for share in np.mean([row["positions"] for row in own], axis=0)),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _covered(row: Row, scale: float) -> tuple[float, float]:
    """Share of errors inside the 95 % bands times a scale, and their mean half width, deg."""
    error, sigma = row["turns"]
    half = BAND_95 * scale * sigma
    return float(np.mean(np.abs(error) <= half)), float(np.degrees(np.mean(half)))


def print_real(folder: Path) -> None:
    """Print certificates of real sensors: alone, and beside a camera that is simulated from their own motion."""
    columns = "trial", "sensors, seconds", "camera", "a segment without its sensor: deg RMS, 90 % below"
    print(f"| {' | '.join((*columns, 'stated', 'worst, best'))} |")
    print("|---" * 6 + "|")
    for number, own in enumerate(clocks_real.sessions(folder)):
        usual = [s for s, joint in own.joints.items() if joint in {j for j, _ in own.skeleton.sensors.values()}]
        streams = [stream for stream in own.log.streams if stream.name in usual]
        imus = ImuSequence.joined([stream.imu() for stream in streams])
        count = min(round(MOST_SECONDS * 60), len(own.poses) - 1)
        video = filmed(own, (len(own.poses) - count) // 2, count, 60.0, number)
        alone = Recording(own.name, imus=imus, calibration=own.calibration.select(tuple(imus.names)))
        seen = replace(alone, keypoints=video.keypoints, imus=replace(imus, times=imus.times - video.start))
        for camera, recording, mode in (("none", alone, "imu"), ("simulated", seen, "rtof")):
            try:
                with without_warnings(RESULT_WARNINGS):
                    found = reconstruct(recording, own.skeleton, mode, settings=SETTINGS).certificate
            except RtofError as error:
                print(f"| {own.name} | {len(usual)} | {camera} | {error} | | |", flush=True)
                continue
            assert found is not None
            size = {one.joint: np.degrees(np.linalg.norm(one.certified)) for one in found.left_out}
            order = sorted(size, key=lambda joint: -size[joint])
            ends = ", ".join(f"{joint} {size[joint]:.0f}" for joint in (order[0], order[-1]))
            error, below, stated = np.degrees([found.error, found.below_90, found.expected])
            seconds = f"{found.stop - found.start:.0f}"
            told = f"{stated:.1f}" if np.isfinite(stated) else "-"
            cells = (own.name, f"{len(size)}, {seconds}", camera, f"{error:.1f}, {below:.0f}", told, ends)
            print(f"| {' | '.join(cells)} |", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("certificate", __doc__, motion=False)
    parser.add_argument("--corpus", type=Path, help="folder of free motion")
    parser.add_argument("--exercises", type=Path, help="corpus of models/build_corpus.py with UI-PRMD's people")
    parser.add_argument("--faults", action="store_true", help="also every second motion with each fault")
    parser.add_argument("--real", type=Path, help="folder of real sensors: the table of their certificates alone")
    options = parser.parse_args(arguments)
    if options.real:
        print_real(options.real)
        return
    if options.corpus is None:
        parser.error("give --corpus, or --real")
    clips = harness.test_clips(options.corpus)
    if options.exercises:
        clips += harness.exercise_clips(options.exercises)[::2]
    jobs = [
        (clip, i % 4, sensors, fault)
        for fault in (FAULTS if options.faults else ("none",))
        for i, clip in enumerate(clips[:: 1 if fault == "none" else 2])
        for sensors in SENSORS
    ]
    rows = [row for row in in_parallel(measured, jobs) if row is not None]
    right = [row for row in rows if row["fault"] == "none"]
    about = (__doc__ or "").partition("\n\n")[2]
    text = "\n".join(["# Certificates of held-out people and rigs\n", about, table(right), fault_table(rows)])
    print(harness.write_results(options.out, [], text))


if __name__ == "__main__":
    main()
