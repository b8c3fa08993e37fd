"""One real camera against two, without sensors, on the clips of ``benchmarks.real_clips``.

``python -m benchmarks two_real_cameras --data DIR``. The reference is the triangulation of the points
that were detected, from all four cameras. Every camera is the first one once; the second is the next of the
four with a direction of view 50 to 130 degrees away, as it is calibrated, or found from the person with its
heading, position and clock unknown (`rtof_kin.calibration.second_camera`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command_line import study_parser
from benchmarks.harness import write_results
from benchmarks.real_clips import COLUMNS, Clip, clips, score
from benchmarks.two_cameras import camera_errors, over_origin
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import RtofError
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.join import find_second_camera
from rtof_kin.vision.image_points import image_points

APART_DEG = (50.0, 130.0)
ONE, TWO, FOUND = "one", "two, calibrated", "two, second found"
FIGURES = ("relative_mm", "centred_mm", "absolute_mm", "own_px", "other_px", "inside")
"""Of `benchmarks.real_clips.COLUMNS`."""


def pairs(clip: Clip) -> Iterator[tuple[int, int]]:
    """First and second camera."""
    ahead = [camera.R_camera_world[2] * [1.0, 1.0, 0.0] for camera in clip.cameras]
    for first in range(len(ahead)):
        for further in range(1, len(ahead)):
            second = (first + further) % len(ahead)
            cosine = float(so3.unit(ahead[first]) @ so3.unit(ahead[second]))
            if APART_DEG[0] <= np.degrees(np.arccos(np.clip(cosine, -1, 1))) <= APART_DEG[1]:
                yield first, second
                break


def measure(name: str, clip: Clip) -> list[dict[str, Any]]:
    """A row for every pair of cameras and way to use them."""
    seen = [replace(v.found.keypoints, camera=c) for v, c in zip(clip.views, clip.cameras, strict=True)]
    points, rows = image_points(clip.skeleton, clip.points), []
    for first, second in pairs(clip):
        one = Recording(clip.views[first].name, seen[first], joint_offsets=clip.skeleton.joint_offsets)
        about = {"clip": name, "camera": clip.views[first].name, "second": clip.views[second].name}
        found: dict[str, Any] = {}
        unknown = replace(
            seen[second], camera=over_origin(seen[second].camera, np.eye(3)), times=seen[second].times + 5.0
        )
        cases = {ONE: one, TWO: replace(one, views=(seen[second],))}
        try:
            other = find_second_camera(one, unknown, sigma_focal=(0.03, 0.03))
            cases[FOUND] = other.apply(one)
            found = camera_errors(other, seen[second], unknown)
        except RtofError as error:  # reported in the rows
            rows.append(about | {"mode": FOUND, "error": str(error)})
        for mode, recording in cases.items():
            result = reconstruct(recording, clip.skeleton, "rto")
            figures = score(clip, first, points, result.motion.poses, result.motion.confidence)
            rows.append(about | {"mode": mode, **figures} | (found if mode == FOUND else {}))
    return rows


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Means over the cameras as Markdown."""
    cells, cameras = [], []
    for clip, mode in dict.fromkeys((row["clip"], row["mode"]) for row in rows):
        own = [r for r in rows if (r["clip"], r["mode"]) == (clip, mode) and "error" not in r]
        values = [[row[figure] for row in own] for figure in FIGURES]
        means = (None if not own or None in v else float(np.mean(v)) for v in values)
        cells.append((clip, mode, len(own), *means))
        cameras += [
            (
                clip,
                row["camera"],
                row["second"],
                *(row[name] for name in ("turn_deg", "sigma_turn_deg", "moved_m", "sigma_moved_m", "clock_ms")),
                row["doubt"] or "-",
            )
            for row in own
            if mode == FOUND
        ]
    first = Table(
        "two_real_cameras",
        "One and two real cameras against the triangulation from four",
        ("clip", "cameras", "pairs", *(COLUMNS[figure] for figure in FIGURES)),
        (0, 0, 0, *(2 if figure == "inside" else 0 for figure in FIGURES)),
        tuple(cells),
    )
    second = Table(
        "second_real_camera",
        "The second camera as found",
        ("clip", "first", "second", "turn deg", "stated", "moved m", "stated", "clock ms", "doubt"),
        (0, 0, 0, 1, 1, 2, 2, 0, 0),
        tuple(cameras),
    )
    return first.markdown() + "\n" + second.markdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("two_real_cameras", __doc__, motion=False)
    parser.add_argument("--data", type=Path, required=True, help="folder of the clips")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for name, clip in clips(options.data):
        rows += measure(name, clip)
        print(name, len(rows), file=sys.stderr, flush=True)
        result = {"command": "python -m benchmarks two_real_cameras --data DIR", "rows": rows}
        write_results(options.out, result, tables(rows))
    print(tables(rows))


if __name__ == "__main__":
    main()
