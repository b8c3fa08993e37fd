"""Motions of a person on two humanoid robots: slip of the feet, limits, distance from the targets and latency.

``python -m benchmarks robots [MOTION ...]``: the true motion of the demo, 24 s of squats, lunges and steps on the spot,
or outputs of reconstruct; with contacts and limits, without contacts, and without both, the usual inverse kinematics.
The robots are PAL's Talos and Fourier's GR1, of example-robot-data and fourier-robot-descriptions. The time of a frame
is the least of three runs, as other programs may interrupt one. A minute.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.metadata import files
from pathlib import Path

import numpy as np

from benchmarks.command_line import study_parser, table_head
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.packages import optional
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.robots.retarget import RobotMotion

KINDS = {"": "contacts and limits", "contacts": "limits alone", "contacts, limits": "neither"}
HEADS = (
    "motion | robot | kept | slip in a stance, mean (most) mm | frames beyond limits: angles, velocities | soles below "
    "the floor mm | hands and feet off mm | links off deg | a frame, 50 % (99 %) ms"
)


def robots() -> dict[str, Path]:
    """The robots' files, of their packages."""
    talos = next(
        Path(str(one.locate())) for one in files("example-robot-data") or () if one.name == "talos_full_v2.urdf"
    )
    return {
        "Talos": talos,
        "GR1": optional("fourier_robot_descriptions.fourier", "dev").BASE_PACKAGE_PATH / "gr1t2.urdf",
    }


def demo() -> Motion:
    """The true motion of the demo."""
    recording = Recording.load(model_path("demo"))
    assert recording.truth is not None
    return recording.skeleton.motion(recording.truth)


def rows(motions: dict[str, Motion]) -> Iterator[str]:
    """One line for every motion, robot and kind."""
    for name, motion in motions.items():
        for robot, urdf in robots().items():
            for without, kept in KINDS.items():
                runs = [RobotMotion.of(MotionSource.of(motion), urdf, without=without).robot.track for _ in range(3)]
                one = runs[0].figures()
                p50, p99 = 1000 * np.percentile(
                    np.min([[row[-1] for row in run.rows] for run in runs], axis=0), [50, 99]
                )
                yield (
                    f"| {name} | {robot} | {kept} | {one['slip_mm']:.1f} ({one['most_mm']:.1f}) | "
                    f"{one['outside']:.0%}, {one['fast']:.0%} | {one['below_mm']:.0f} | {one['ends_mm']:.0f} | "
                    f"{one['turns_deg']:.1f} | {p50:.1f} ({p99:.1f}) |"
                )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("robots", __doc__, motion=False, page="{}.md")
    parser.add_argument("motions", nargs="*", type=Path, metavar="MOTION", help="outputs of reconstruct")
    options = parser.parse_args(arguments)
    motions = {"demo": demo()} | {path.name: Motion.load(path) for path in options.motions}
    lines = [*table_head(HEADS)]
    for line in rows(motions):
        print(line, flush=True)
        lines.append(line)
    head, _, about = (__doc__ or "").partition("\n")
    options.out.write_text(f"# {head}\n\n{about.strip()}\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
