"""False alarms and power of ``rtof-kin compare``: ``python -m benchmarks comparison --corpus DIR``.

The benchmark's motions of held-out people and rigs, `SECONDS` from the middle of each, recorded twice with
other errors, cameras and mountings (8 sensors and none, realistic 2D): the two results must not differ, nor
may the first from the truth. Then with the flexion of the right knee of four walks scaled in the second
recording. Five minutes on one core.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.command_line import study_parser
from benchmarks.harness import middle, recorded, test_clips, write_results
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.clinical.comparison import By, Compared, Comparison, compare, compared
from rtof_kin.clinical.comparison_change import Change, Verdict
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import LIMB_SENSORS

SECONDS = 5.0
WALKS = ("02_05", "14_08", "16_15", "16_16")
SCALES = (0.5, 0.75, 1.25, 1.5)
"""Of the right knee's flexion."""
KNEE = "right_knee_flexion"
BYS: tuple[By, ...] = ("time", "cycle", "range")


@dataclass(frozen=True)
class Outcome:
    """One comparison of one motion."""

    motion: str
    case: str
    by: str
    changes: tuple[tuple[str, Change], ...]

    @property
    def changed(self) -> list[str]:
        """Angles that are called changed."""
        return [name for name, change in self.changes if change.verdict is Verdict.CHANGED]


def take(clip: MocapClip, camera: int, seed: int, mode: str = "rtof") -> tuple[Compared, Recording]:
    """A recording of a motion, reconstructed."""
    recording = recorded(clip, camera, "realistic", LIMB_SENSORS if mode == "rtof" else (), seed)
    result = reconstruct(recording, mode=mode)  # type: ignore[arg-type]
    return compared(f"{clip.name}, seed {seed}", result.motion, clip.name), recording


def truth_of(recording: Recording) -> Compared:
    """The truth of a recording, as another system's result."""
    assert recording.truth is not None
    skeleton = SkeletonModel.named(recording.skeleton_table)
    return Compared("truth", clinical_angles(all_observed(recording.truth), skeleton))


def scaled(clip: MocapClip, factor: float) -> MocapClip:
    """The motion with another range of the right knee's flexion."""
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    q = np.array(skeleton.motion(clip.poses).q)
    q[:, 7 + skeleton.dof_names.index("RightLeg_y")] *= factor
    p, R = skeleton.forward_kinematics(q)
    return replace(clip, poses=replace(clip.poses, p_world_joint=p, R_world_bone=R))


def outcome(a: Compared, b: Compared, by: By, about: tuple[str, str], names: Sequence[str] = ()) -> list[Outcome]:
    """The comparison, or none where the motions do not have the axis."""
    try:
        found: Comparison = compare(a, b, by, names=names)
    except InvalidInputError:
        return []
    changes = tuple((one.name, change) for one in found.angles for change in one.changes)
    return [Outcome(about[0], about[1], by, changes)]


def unchanged(clip: MocapClip) -> Iterator[Outcome]:
    """Comparisons of one motion with itself: two recordings, and each against the truth."""
    for mode in ("rtof", "rto"):
        (a, recording), (b, _) = take(clip, 0, 0, mode), take(clip, 1, 1, mode)
        for by in BYS:
            yield from outcome(a, b, by, (clip.name, f"two recordings, {mode}"))
        yield from outcome(a, truth_of(recording), "time", (clip.name, f"against the truth, {mode}"))


def planted(clip: MocapClip) -> Iterator[Outcome]:
    """Comparisons of one motion with itself, the knee changed in the second recording."""
    a, _ = take(clip, 0, 0)
    for factor in SCALES:
        b, _ = take(scaled(clip, factor), 1, 1)
        for by in ("time", "cycle"):
            for names, what in (((), "all angles"), ((KNEE,), "the knee alone")):
                yield from outcome(a, b, by, (clip.name, f"{factor:g}, {what}"), names)


# --- tables --------------------------------------------------------------------------------------


def false_alarms(found: Sequence[Outcome]) -> Table:
    """How often something is called changed that is not, and how wide the stated errors are."""
    rows = []
    for case, by in dict.fromkeys((one.case, one.by) for one in found):
        own = [one for one in found if (one.case, one.by) == (case, by)]
        alarms = sum(bool(one.changed) for one in own)
        for measure in ("mean", "range"):
            tests = [c for one in own for _, c in one.changes if c.measure == measure and np.isfinite(c.p)]
            if tests:
                z = np.array([c.difference / c.sigma for c in tests])
                inside = np.mean([c.interval[0] <= 0 <= c.interval[1] for c in tests])
                sizes = np.degrees([np.median([getattr(c, k) for c in tests]) for k in ("sigma", "detectable")])
                rms = float(np.sqrt(np.mean(z**2)))
                figures = (f"{alarms} of {len(own)}", len(tests), 100 * inside, rms, *sizes)
                rows.append((case, by, measure, *figures))
    return Table(
        "false_alarms",
        "The same motion",
        (
            "case",
            "by",
            "measure",
            "comparisons with a change",
            "tests",
            "0 in 95 % interval %",
            "difference / sd, RMS",
            "median sd deg",
            "median detectable deg",
        ),
        (0, 0, 0, 0, 0, 1, 2, 1, 1),
        tuple(rows),
        ("A comparison has all its angles and both measures; at most 5 % should have a change.",),
    )


def power(found: Sequence[Outcome]) -> Table:
    """How often the planted change of the knee is found, and what else is called changed."""
    rows = []
    for case, by in dict.fromkeys((one.case, one.by) for one in found):
        own = [one for one in found if (one.case, one.by) == (case, by)]
        knee = [[c for name, c in one.changes if name == KNEE] for one in own]
        sizes = {
            m: np.degrees([c.difference for changes in knee for c in changes if c.measure == m])
            for m in ("mean", "range")
        }
        hit = sum(KNEE in one.changed for one in own)
        legs = ("right_hip", "right_ankle", "right_knee")
        others = {name for one in own for name in one.changed if not name.startswith(legs)}
        scale, names = case.split(", ")
        rows.append(
            (
                scale,
                names,
                by,
                *(float(np.mean(sizes[m])) for m in ("mean", "range")),
                f"{hit} of {len(own)}",
                ", ".join(sorted(others)),
            )
        )
    return Table(
        "power",
        "Right knee flexion scaled",
        ("scale", "tested", "by", "mean B - A deg", "range B - A deg", "found", "changed on other limbs"),
        (0, 0, 0, 1, 1, 0, 0),
        tuple(rows),
    )


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("comparison", __doc__)
    parser.add_argument("--most", type=int, help="number of motions")
    options = parser.parse_args(arguments)
    clips = [middle(clip, SECONDS) for clip in test_clips(options.corpus)][: options.most]
    walks = [clip for clip in clips if clip.name in WALKS]
    same = [one for clip in track(clips, "two recordings") for one in unchanged(clip)]
    changed = [one for clip in track(walks, "planted") for one in planted(clip)]
    tables = [false_alarms(same), power(changed)]
    text = "# Comparison of two motions\n\n" + "\n".join(table.markdown() for table in tables)
    rows: list[dict[str, Any]] = [
        {"motion": one.motion, "case": one.case, "by": one.by, "changed": one.changed} for one in same + changed
    ]
    print(write_results(options.out, rows, text))


if __name__ == "__main__":
    main()
