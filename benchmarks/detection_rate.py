"""What `detect --every N` costs: errors of motions whose video was looked at in every Nth frame only.

``python -m benchmarks detection_rate --corpus DIR`` thins the 2D of the harness' motions (60 Hz, one camera,
realistic errors of a detector), reconstructs them, and interpolates the poses at all frames: at those every
rate is compared with the truth. ``--unseen``: the skipped frames also stay in the recording, without points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.command_line import in_parallel, study_parser
from benchmarks.harness import SENSOR_SETS, recorded, test_clips, write_results
from rtof_kin.body.metrics import at_times, evaluate
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

STRIDES: Final = (1, 2, 3, 4)
MODES: Final = {"8": "rtof", "0": "rto"}
FIGURES: Final = {
    "angle_deg": ("joint angle deg", 2),
    "flexion_deg": ("flexion deg", 2),
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjpe_mm": ("abs mm", 1),
}


@dataclass(frozen=True)
class Job:
    """One motion with one set of sensors."""

    clip: MocapClip
    sensors: str
    seed: int
    strides: Sequence[int]
    unseen: bool


def thinned(recording: Recording, every: int, unseen: bool) -> Recording:
    """Return a recording of whose frames every so many have points. unseen: whether the others stay, without points."""
    keypoints = recording.video
    if not unseen:
        return replace(recording, keypoints=keypoints[::every])
    skipped = np.arange(len(keypoints)) % every > 0
    uv, confidence = np.array(keypoints.uv_px), np.array(keypoints.confidence)
    uv[skipped], confidence[skipped] = np.nan, 0.0
    return replace(recording, keypoints=replace(keypoints, uv_px=uv, confidence=confidence))


def run(job: Job) -> list[dict[str, Any]]:
    """Simulate, thin, reconstruct and score; a row for each rate and way."""
    recording = recorded(job.clip, 0, "realistic", SENSOR_SETS.get(job.sensors, ()), job.seed)
    truth, rows = recording.truth, []
    assert truth is not None
    times = recording.video.times
    inside = times[(times >= truth.times[0]) & (times <= times[-8])]
    for every in job.strides:
        for unseen in (False, True)[: 1 + (job.unseen and every > 1)]:
            found = reconstruct(thinned(recording, every, unseen), mode=MODES[job.sensors])
            known = found.motion.poses
            at = inside[(inside >= known.times[0]) & (inside <= known.times[-1])]
            scores = evaluate(at_times(replace(known, valid=np.ones_like(known.valid)), at), truth, recording.skeleton)
            about = {"motion": job.clip.name, "sensors": job.sensors, "every": every, "unseen": unseen}
            rows.append(about | {name: scores[name] for name in FIGURES} | {"frames": len(at)})
    return rows


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Means over the frames of all motions, and the change of angles by motion."""
    columns = ("sensors", "every", "Hz", "skipped frames", *(heading for heading, _ in FIGURES.values()))
    lines = []
    for key in dict.fromkeys((row["sensors"], row["every"], row["unseen"]) for row in rows):
        own = [row for row in rows if (row["sensors"], row["every"], row["unseen"]) == key]
        frames = [row["frames"] for row in own]
        means = (float(np.average([row[name] for row in own], weights=frames)) for name in FIGURES)
        lines.append((key[0], key[1], 60 / key[1], "unseen" if key[2] else "left out", *means))
    note = f"{len({row['motion'] for row in rows})} motions, means over frames."
    digits = (0, 0, 1, 0, *(d for _, d in FIGURES.values()))
    return Table("detection_rate", "Every Nth frame", columns, digits, tuple(lines), (note,))


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("detection_rate", __doc__)
    parser.add_argument("--motions", type=int, help="as many only, spread over the list")
    parser.add_argument("--every", type=int, nargs="+", default=STRIDES)
    parser.add_argument("--unseen", action="store_true", help="also with the skipped frames, without points")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    clips = test_clips(options.corpus)
    some = clips[:: max(1, len(clips) // (options.motions or len(clips)))][: options.motions]
    jobs = [Job(clip, sensors, 0, options.every, options.unseen) for clip in some for sensors in MODES]
    rows = [row for own in in_parallel(run, jobs, options.workers) for row in own]
    found = table(rows)
    write_results(options.out, {"table": found.as_dict(), "rows": rows}, found.markdown().removesuffix("\n"))
    print(found.markdown())


if __name__ == "__main__":
    main()
