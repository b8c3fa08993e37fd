"""Tilt of real cameras, found from the person before them as `rtof-kin run --only recording` assumes a camera.

``python -m benchmarks real_tilts --data DIR``: the clips of two people that `real_clips` has, of four
calibrated cameras each, one camera at a time without sensors. The camera is assumed level, 1.2 m over the
floor, with a focal length 10 % too short. (Two cameras of the third clip lie on their sides, and its person
sits.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.command_line import study_parser
from benchmarks.real_clips import clips
from rtof_kin.calibration.camera_estimate import pitch_and_roll
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.camera import HEIGHT, SIGMA_HEIGHT, SIGMA_PITCH_DEG, SIGMA_ROLL_DEG

_PEOPLE = ("child", "adult")
_UNSURE = CameraUncertainty(
    0.15, float(np.radians(SIGMA_PITCH_DEG)), SIGMA_HEIGHT, 0.08, float(np.radians(SIGMA_ROLL_DEG))
)


def rows(data: Path) -> list[list[str]]:
    """One row for every camera."""
    out = []
    for name, clip in clips(data):
        for camera, view in zip(clip.cameras, clip.views, strict=True) if name in _PEOPLE else ():
            level = Camera.looking_at(
                [0, 0, HEIGHT], [1, 0, HEIGHT], camera.K[0, 0] / 1.1, camera.width_px, camera.height_px
            )
            seen = replace(view.found.keypoints, camera=replace(level, uncertainty=_UNSURE))
            offsets = clip.skeleton.joint_offsets
            recording = Recording(view.name, seen, joint_offsets=offsets, floor_height=0.0)
            found = reconstruct(recording, clip.skeleton, "rto").camera
            assert found is not None
            true, now = (np.degrees(pitch_and_roll(c)) for c in (camera, found.found))
            sigma = np.degrees(found.sigma[1:3])
            cells = [f"{t:.1f} | {n:.1f} ± {s:.1f}" for t, n, s in zip(true, now, sigma, strict=True)]
            height = f"{camera.center_world[2]:.2f} | {found.found.center_world[2]:.2f} ± {found.sigma[3]:.2f}"
            out.append([name, view.name, *cells, height])
            print(" | ".join(out[-1]), flush=True)
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("real_tilts", __doc__, motion=False, page="{}.md")
    parser.add_argument("--data", type=Path, required=True, help="folder of the clips")
    options = parser.parse_args(arguments)
    heads = ["clip", "camera", "looks down deg", "found", "turned deg", "found", "height m", "found"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    lines += [f"| {' | '.join(row)} |" for row in rows(options.data)]
    text = f"# Tilt of real cameras\n\n{(__doc__ or '').partition(chr(10))[2].strip()}\n\n"
    options.out.write_text(text + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
