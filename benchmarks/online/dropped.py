"""A camera that is off for a while, and a video that is late.

Whole motions of at least a quarter of a minute. The camera is off from `LOSS` on for 1, 3 and 10 s; the
newest pose (lag 0) is scored by the time since the loss, beside the same estimator with its camera and
beside mode imu of the sensors' samples from the loss on, which begins at the truth. It has recovered when its
poses stay within `RECOVERED` of those with a camera. Videos that arrive 50, 100 and 200 ms after what they
show are scored at lag 0 on the sensors' clock, the delay told to the estimator or not.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import harness
from benchmarks.online.estimators import estimator, settings
from benchmarks.online.recordings import KEYPOINTS, truth_of
from benchmarks.online.running import tracks
from rtof_kin.body.metrics import at_times, comparable, evaluate
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.replay import Faults
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

MOTIONS = ("14_14", "02_10", "14_08", "02_07", "02_06", "09_12", "02_05")
"""Of test people, 15 s at least."""
LONGEST = 22.0
"""[s] of a motion."""
LOSS = 3.0
"""[s] into the recording."""
OFF = (1.0, 3.0, 10.0)
"""[s] without the camera."""
LATE = (0.05, 0.1, 0.2)
"""[s] by which the video is late."""
SINCE = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
"""[s] ends of the intervals since the loss."""
RECOVERED, STEADY = 0.02, 0.25
"""[m] mean distance of joints from the estimate with a camera, over so many seconds."""
CAMERA, OFFLINE, IMU = "online with its camera", "online", "mode imu from the loss on"


@dataclass(frozen=True)
class Job:
    """One motion, camera and set of sensors."""

    clip: MocapClip
    camera: int
    sensors: str
    seed: int

    @property
    def about(self) -> dict[str, Any]:
        """What its rows have in common."""
        return {"motion": self.clip.name, "camera": self.camera, "sensors": self.sensors}

    def recorded(self) -> Recording:
        """Simulate as the harness does."""
        own = harness.SENSOR_SETS[self.sensors]
        return harness.recorded(self.clip, self.camera, KEYPOINTS, own, self.seed)


def jobs(options: Namespace) -> list[Job]:
    """Motions x cameras x sensors."""
    names = MOTIONS[: int(options.motions)] if options.motions else MOTIONS
    clips = harness.whole_clips(options.corpus, harness.split()["test"], list(names))
    most = round((options.seconds or LONGEST) * clips[0].poses.rate_hz)
    clips = [replace(clip, poses=clip.poses[:most]) for clip in clips]
    return [
        Job(clip, (i + camera) % 4, sensors, options.seed)
        for i, clip in enumerate(clips)
        for sensors in options.sensors
        for camera in range(options.cameras)
    ]


def measured(job: Job) -> list[dict[str, Any]]:
    """Rows of one recording: of each interval since the loss, recovery, and late video."""
    recording = job.recorded()
    loss = float(recording.video.times[0]) + LOSS
    usual = _newest(recording)
    rows: list[dict[str, Any]] = []
    for off in OFF:
        if loss + off > recording.video.times[-1]:
            continue
        without = _newest(recording, Faults(dead=((VIDEO, loss, loss + off),)))
        about = job.about | {"off": off}
        rows.append(about | {"kind": "recovery", "seconds": recovery(usual, without, loss + off)})
        if off == max(OFF):
            inertial = _from_sensors(recording, loss, loss + off)
            for name, poses in {CAMERA: usual, OFFLINE: without, IMU: inertial}.items():
                rows += [
                    about | {"kind": "since", "estimate": name} | one for one in since_loss(poses, recording, loss)
                ]
    return rows + _late(job, recording, usual)


def _newest(recording: Recording, faults: Faults | None = None, **changed: Any) -> PoseSequence:
    """Poses at lag 0."""
    found = tracks(recording, estimator, settings(**changed), (0.0,), faults or Faults())
    return found[0.0].poses


def _from_sensors(recording: Recording, start: float, stop: float) -> PoseSequence:
    """Mode imu of an interval, which begins at the truth."""
    imus = recording.imus
    assert imus is not None
    first, last = np.searchsorted(imus.times, [start, stop])
    cut = replace(
        imus,
        times=imus.times[first:last],
        R_inertial_sensor=imus.R_inertial_sensor[first:last],
        f_sensor=imus.f_sensor[first:last],
    )
    poses = reconstruct(replace(recording, keypoints=None, imus=cut), mode="imu").motion.poses
    return comparable(poses, truth_of(recording), "imu")


def errors(poses: PoseSequence, recording: Recording) -> tuple[Array, Array, Array]:
    """Mean errors (T,) relative to the root and absolute, mm, and error of the root (T, 3), m."""
    over_time = evaluate(poses, truth_of(recording), recording.skeleton).over_time
    true = at_times(truth_of(recording), poses.times)
    root = poses.p_world_joint[:, 0] - true.p_world_joint[:, 0]
    return over_time["mpjpe_rr_mm"], over_time["mpjpe_mm"], np.asarray(root)


def since_loss(poses: PoseSequence, recording: Recording, loss: float) -> list[dict[str, Any]]:
    """Errors in every interval since the loss.

    drift_mm: how far the root went off since the loss.
    """
    relative, absolute, root = errors(poses, recording)
    after = poses.times - loss
    begun = int(np.searchsorted(after, -1e-6))
    drift = 1e3 * np.linalg.norm(root - root[begun], axis=-1)
    rows = []
    for low, high in pairwise(SINCE):
        own = (after >= low) & (after < high)
        if own.sum():
            named = {"rr_mm": relative, "abs_mm": absolute, "drift_mm": drift}
            figures = {name: float(np.nanmean(values[own])) for name, values in named.items()}
            rows.append({"from": low, "to": high, "frames": int(own.sum())} | figures)
    return rows


def recovery(usual: PoseSequence, without: PoseSequence, back: float) -> float:
    """How long after the camera is back the poses stay near those with a camera, s; NaN if never."""
    p = signals.interpolate(usual.times, usual.p_world_joint, without.times)
    apart = np.linalg.norm(without.p_world_joint - p, axis=-1).mean(axis=1)
    frames = max(round(STEADY * without.rate_hz), 1)
    steady = np.convolve(np.nan_to_num(apart), np.full(frames, 1 / frames), mode="valid")
    times = without.times[: len(steady)]
    far = np.flatnonzero((steady > RECOVERED) & (times >= back))
    if len(far) == 0:
        return 0.0
    return float(times[far[-1] + 1] - back) if far[-1] + 1 < len(times) else float("nan")


def _late(job: Job, recording: Recording, usual: PoseSequence) -> list[dict[str, Any]]:
    found = {(0.0, "-"): usual}
    for late in LATE:
        for told in ("yes", "no"):
            own = settings(video_delay_s=late if told == "yes" else 0.0)
            faults = Faults(video_delay_s=late)
            found[late, told] = tracks(recording, estimator, own, (0.0,), faults)[0.0].poses
    rows = []
    for (late, told), poses in found.items():
        metrics = evaluate(poses, truth_of(recording), recording.skeleton)
        own_figures = {name: metrics[f"mpjpe_{name}"] for name in ("rr_mm", "mm")}
        rows.append(
            job.about
            | {
                "kind": "late",
                "late": late,
                "told": told,
                "frames": len(poses),
                "rr_mm": own_figures["rr_mm"],
                "abs_mm": own_figures["mm"],
                "mpjae": metrics["mpjae"],
            }
        )
    return rows


def rows_of(options: Namespace) -> list[dict[str, Any]]:
    """Rows of all recordings, in parallel."""
    work = jobs(options)
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.workers) as pool:
        done = as_completed([pool.submit(measured, job) for job in work])
        for future in track(done, "recordings", total=len(work)):
            rows += future.result()
    return sorted(rows, key=lambda r: (r["kind"], int(r["sensors"]), r["motion"], r["camera"]))


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """Errors since the loss, recovery, and late video."""
    return [_since(rows), _recovery(rows), _late_table(rows)]


def _kind(rows: Sequence[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    return [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]


def _mean(rows: Sequence[dict[str, Any]], figure: str) -> float:
    return float(np.average([r[figure] for r in rows], weights=[r["frames"] for r in rows]))


def _since(rows: Sequence[dict[str, Any]]) -> Table:
    lines = []
    every = _kind(rows, kind="since")
    for sensors in dict.fromkeys(row["sensors"] for row in every):
        for low, high in pairwise(SINCE):
            own = [row for row in every if (row["sensors"], row["from"]) == (sensors, low)]
            if own:
                cells = [
                    _mean(_kind(own, estimate=name), figure)
                    for figure in ("rr_mm", "abs_mm", "drift_mm")
                    for name in (CAMERA, OFFLINE, IMU)
                ]
                lines.append((sensors, f"{low:g} to {high:g}", *cells))
    columns: tuple[str, ...] = ("IMUs", "s since the loss")
    columns += tuple(
        f"{figure} mm: {name}" for figure in ("rr", "abs", "root drift") for name in ("camera", "online", "imu")
    )
    notes = (
        "camera: the estimator with its camera; online: without since the loss; imu: mode imu of all samples "
        "from the loss on, the first frame at the truth. Root drift: error since the loss. Lag 0.",
    )
    return Table("since", f"Camera off for {max(OFF):g} s", columns, (0, 0, *[1] * 9), tuple(lines), notes)


def _recovery(rows: Sequence[dict[str, Any]]) -> Table:
    lines = []
    every = _kind(rows, kind="recovery")
    for sensors in dict.fromkeys(row["sensors"] for row in every):
        for off in OFF:
            took = np.array([row["seconds"] for row in _kind(every, sensors=sensors, off=off)])
            if len(took):
                known = took[np.isfinite(took)]
                spread = np.percentile(known, [50, 90, 100]).tolist() if len(known) else [None] * 3
                lines.append((sensors, off, float(len(took)), *spread, float(np.isnan(took).sum())))
    columns = ("IMUs", "off s", "recordings", "median s", "90 % s", "longest s", "not to the end")
    notes = (
        f"Until poses stay within {1e3 * RECOVERED:g} mm of those with a camera (mean of joints over {STEADY:g} s).",
    )
    return Table("recovery", "After the camera is back", columns, (0, 0, 0, 2, 2, 2, 0), tuple(lines), notes)


def _late_table(rows: Sequence[dict[str, Any]]) -> Table:
    lines = []
    every = _kind(rows, kind="late")
    for sensors in dict.fromkeys(row["sensors"] for row in every):
        for late, told in dict.fromkeys((row["late"], row["told"]) for row in every):
            own = _kind(every, sensors=sensors, late=late, told=told)
            figures = [_mean(own, figure) for figure in ("rr_mm", "abs_mm", "mpjae")]
            lines.append((sensors, 1e3 * late, told, *figures))
    columns = ("IMUs", "video late ms", "told", "rr mm", "abs mm", "MPJAE m/s2")
    notes = (
        "Of the newest pose on the sensors' clock; the detector's own delay, 17 to 50 ms, comes on top "
        "and is never told.",
    )
    return Table("late", "Late video", columns, (0, 0, 0, 1, 1, 2), tuple(lines), notes)
