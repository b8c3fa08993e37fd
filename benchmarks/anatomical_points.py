"""What the pelvis and the trunk gain from a detector that sees anatomical points, with 0, 8 and 10 sensors.

``python -m benchmarks anatomical_points --corpus DIR``: the benchmark's motions of held-out people and rigs, one camera
each. The detector errs as MediaPipe does (``models/detector_errors.toml``), an anatomical point as the measured points
next to it; a person's points stand beside the places of the table by the spread, the same in all recordings of the
person, and a point on the skin is hidden where its side faces away. The reconstruction knows the table's places alone.
*Fixed in the body*: without MediaPipe's displacement of points by the direction of view, which nobody measured for
another detector. *Half the errors*: half of that displacement and of the errors in the image.
"""

from __future__ import annotations

import sys
import zlib
from dataclasses import replace
from typing import Any, Final

import numpy as np

from benchmarks import harness, scoring
from benchmarks.command_line import in_parallel, study_parser
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings

SENSORS = ("0", "8", "10")
_ANATOMICAL = DetectorErrors(layout="anatomical52")
CASES: Final = {
    "mediapipe33": DetectorErrors(),
    "coco17": DetectorErrors(layout="coco17"),
    "anatomical52": _ANATOMICAL,
    "anatomical52, fixed in the body": replace(_ANATOMICAL, view=0.0),
    "anatomical52, half the errors": replace(_ANATOMICAL, view=0.5, constant=0.5, coloured=0.5),
}
BEFORE: Final = "coco17"
"""What a change is counted from: the points that a detector without anatomical ones shares with it."""
COLUMNS = {name: harness.COLUMNS[name] for name in ("hips_deg", "trunk_deg", "flexion_deg", "mpjpe_rr_mm")}
GOAL_DEG: Final = 7.0


def rows(job: tuple[int, MocapClip]) -> list[dict[str, Any]]:
    """Figures of one motion."""
    number, clip = job
    own, camera, found = zlib.crc32(clip.name.encode()), number % 4, list[dict[str, Any]]()
    for sensors in SENSORS:
        worn = harness.SENSOR_SETS.get(sensors, ())
        for case, errors in CASES.items():
            settings = SimulationSettings(replace(errors, who=zlib.crc32(clip.subject.encode())), sensors=worn)
            recording = harness.filmed(clip, own, camera, settings)
            mode = "rtof" if worn else "rto"
            with without_warnings(RESULT_WARNINGS):
                result = reconstruct(recording, mode=mode)
            about = {"motion": clip.name, "rig": clip.rig, "sensors": sensors, "detector": case}
            print(*about.values(), file=sys.stderr)
            found.append(about | {"frames": len(recording.video)} | scoring.figures(result, mode))
    return found


def table(found: list[dict[str, Any]]) -> str:
    """Rows pooled by sensors and detector, as Markdown."""
    heads = [*(heading for heading, _ in COLUMNS.values()), "hips better", "trunk better", "both <= 7 deg"]
    lines = [f"| sensors | detector | {' | '.join(heads)} |", "|---" * (len(heads) + 2) + "|"]
    for sensors in SENSORS:
        for case in CASES:
            own, before = ([r for r in found if (r["sensors"], r["detector"]) == (sensors, c)] for c in (case, BEFORE))
            figures = harness.pooled(own, COLUMNS)
            cells = [f"{figures[name]:.{digits}f}" for name, (_, digits) in COLUMNS.items()]
            for name in ("hips_deg", "trunk_deg"):
                better = np.mean([new[name] < old[name] for new, old in zip(own, before, strict=True)])
                cells.append("" if case == BEFORE else f"{better:.0%}")
            cells.append(f"{np.mean([max(row['hips_deg'], row['trunk_deg']) <= GOAL_DEG for row in own]):.0%}")
            lines.append(f"| {sensors} | {case} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("anatomical_points", __doc__, page="{}.md")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    jobs = list(enumerate(harness.test_clips(options.corpus)))
    found = [row for own in in_parallel(rows, jobs, options.workers) for row in own]
    about = (__doc__ or "").partition("\n\n")[2]
    text = f"# Anatomical points\n\n{about}\n{table(found)}"
    options.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
