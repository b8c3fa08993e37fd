"""What `find_offset` makes of clocks that are right, off or drifting, and of sensors of another take.

``python -m benchmarks clock_offsets --corpus DIR`` with DIR the folder of free motion (README.md here).
8 s of the benchmark's motions from two cameras, detections of `DetectorErrors`, 1 to 3 frames late.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.command_line import study_parser
from benchmarks.harness import SENSOR_SETS, middle, recorded, test_clips, write_results
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.reconstruction.self_calibration import find_offset
from rtof_kin.recording.recording import Recording

PLANTED = {
    "right": (0.0, 0.0),
    "50 ms late": (0.05, 0.0),
    "50 ms early": (-0.05, 0.0),
    "120 ms late": (0.12, 0.0),
    "120 ms early": (-0.12, 0.0),
    "200 ms late": (0.2, 0.0),
    "400 ms late": (0.4, 0.0),
    "1 % fast": (0.0, 0.01),
    "another take": (0.0, 0.0),
}
"""[s] by which the sensors are late in the middle, and their drift."""


def planted(recording: Recording, late: float, drift: float) -> Recording:
    """The recording with sensors on a wrong clock."""
    assert recording.imus is not None
    times = recording.imus.times
    return replace(recording, imus=replace(recording.imus, times=times + late + drift * (times - times.mean())))


def rows(recordings: list[Recording]) -> list[dict[str, float | str | bool]]:
    """A row for every recording and fault."""
    out: list[dict[str, float | str | bool]] = []
    for name, (late, drift) in PLANTED.items():
        for i, recording in enumerate(recordings):
            other = recordings[(i + 11) % len(recordings)]
            if name == "another take":
                if other.name.split("_")[:2] == recording.name.split("_")[:2]:
                    continue
                recording = replace(recording, imus=other.imus, calibration=other.calibration)
            own = planted(recording, late, drift)
            found = find_offset([Job.of(own, None, None, None, None)])
            at = 0.0 if found.applied is None or found.delay is None else float(found.delay.value[0])
            out.append(
                {
                    "planted": name,
                    "motion": recording.name,
                    "moved_ms": 1e3 * at,
                    "late_ms": 1e3 * late,
                    "corrected": found.applied is not None,
                    "named": bool(found.warnings) or found.foreign,
                    "left out": found.foreign,
                }
            )
    return out


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("clock_offsets", __doc__)
    options = parser.parse_args(arguments)
    clips = [middle(clip, 8.0) for clip in test_clips(options.corpus)]
    found = rows([recorded(c, camera, "realistic", SENSOR_SETS["8"], 0) for c in clips for camera in (0, 2)])
    lines = ["| sensors | recordings | corrected | named | left out | moved, median ms |", "|---" * 6 + "|"]
    for name in PLANTED:
        own = [row for row in found if row["planted"] == name]
        counts = [sum(bool(row[key]) for row in own) for key in ("corrected", "named", "left out")]
        moved = np.median([float(row["moved_ms"]) for row in own])
        lines.append(f"| {name} | {len(own)} | {' | '.join(map(str, counts))} | {moved:.0f} |")
    print(write_results(options.out, found, "\n".join(lines)))


if __name__ == "__main__":
    main()
