"""Whether the file of another person is named, what it does where it is not, and how often the right one is named.

``python -m benchmarks subject --corpus CORPUS.npz [--people N]`` with CORPUS.npz of models/build_corpus.py. Motion of
held-out people of CMU on the package's skeleton, each with a height of 1.50 to 1.95 m, proportions (4 %) and a neutral
posture of their own; files with the errors of their standard deviations (bones 1.5 %, posture 4 degrees, height 5 mm):
their own, one of another person, and one of another person of the same height (1 cm). 6 s, realistic 2D, calibrated
camera and floor; recordings that give nothing, or the height. Half an hour of one core for 30 people.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.command_line import study_parser
from benchmarks.harness import SENSOR_SETS, built_clip, write_results
from benchmarks.rerigged import rerigged, t_pose
from lifting.training.corpus import read_corpus
from rtof_kin.body import kinematics
from rtof_kin.body.metrics import at_times
from rtof_kin.body.pose_prior import JOINTS
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.person import Person
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import Subject
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

PROPORTION, BONE_SD, POSTURE_SD, HEIGHT_SD = 0.04, 0.015, 4.0, 0.005  # [1], [1], [deg], [m]
SECONDS, FEWEST = 6.0, 200
FAST: Final = ReconstructionSettings(checks=False, confidence=False)
USUAL: Final = SkeletonModel.default()


@dataclass(frozen=True)
class Planted:
    """A person."""

    seed: int
    body: SkeletonModel

    @classmethod
    def of(cls, seed: int, height: float | None = None) -> Planted:
        """Draw a person, of a height if it is given."""
        rng = np.random.default_rng([seed, 7])
        height = float(rng.uniform(1.50, 1.95)) if height is None else height
        sizes = {joint: 1 + PROPORTION * rng.normal() for joint in USUAL.names if not joint.startswith("Right")}
        lengths = {j: sizes[j.replace("Right", "Left")] * length for j, length in USUAL.bone_lengths.items()}
        return cls(seed, USUAL.with_bone_lengths(lengths).with_height(height))

    def file(self) -> Subject:
        """Return the person's file."""
        rng = np.random.default_rng([self.seed, 9])
        height = {"value": self.body.height + rng.normal(0, HEIGHT_SD), "sd": HEIGHT_SD}
        still = np.tile(np.eye(3), (1, len(USUAL.names), 1, 1))
        poses = PoseSequence(np.zeros(1), np.zeros((1, len(USUAL.names), 3)), still, USUAL.names)
        bones, posture = {}, {}
        for joint, length in self.body.bone_lengths.items():
            offset = self.body.joint_offsets[USUAL.index(joint)[0]] * (1 + rng.normal(0, BONE_SD))
            bones[joint] = {"value": offset.tolist(), "sd": BONE_SD * length}
        for joint, R in t_pose(MocapClip("", poses, self.body.joint_offsets, f"P{self.seed}", "")).items():
            if joint in JOINTS:
                turn = np.degrees(so3.log(R)) + rng.normal(0, POSTURE_SD, 3)
                posture[joint] = {"value": turn.tolist(), "sd": POSTURE_SD}
        data = {"subject": f"P{self.seed}", "height_m": height, "joint_offsets_m": bones, "posture_deg": posture}
        return Subject.of(data, Path(f"P{self.seed}.toml"))

    def filmed(self, clip: MocapClip, sensors: str) -> Recording:
        """Return a recording of the person moving as in a clip, with truth."""
        clip, rng = low_passed(clip, 8.0), np.random.default_rng([self.seed, 3])
        count = min(len(clip.poses), round(SECONDS * clip.poses.rate_hz))
        first = int(rng.integers(0, len(clip.poses) - count + 1))
        poses = clip.poses[first : first + count]
        poses = replace(poses, times=poses.times - poses.times[0])
        poses = rerigged(replace(clip, subject=f"P{self.seed}", poses=poses)).poses
        scale = self.body.height / USUAL.with_offsets(clip.joint_offsets).height
        p_root, R = scale * poses.p_world_joint[:, 0], poses.R_world_bone
        p = kinematics.positions(USUAL.parents, self.body.joint_offsets, p_root, R)
        p[..., 2] += 0.06 - p[..., 2].min()
        poses = replace(poses, p_world_joint=p)
        camera = standard_cameras(poses, self.seed)[self.seed % 4]
        settings = replace(SimulationSettings.realistic(), sensors=SENSOR_SETS.get(sensors, ()))
        recording = simulate(poses, self.body.joint_offsets, camera=camera, settings=settings, seed=self.seed)
        return replace(recording, floor_height=0.0, joint_offsets=np.empty((0, 3)))


def errors(recording: Recording, truth: PoseSequence) -> tuple[float, float]:
    """Mean errors of joints relative to the root, and in world, mm."""
    poses = reconstruct(recording, settings=FAST).motion.poses
    off = 1e3 * (poses.p_world_joint - at_times(truth, poses.times).p_world_joint)
    relative, world = (np.linalg.norm(each, axis=-1) for each in (off - off[:, :1], off))
    return float(np.nanmean(relative)), float(np.nanmean(world))


def rows_of(seed: int, clip: MocapClip) -> Iterator[dict[str, Any]]:
    """Yield what each file does to recordings of a person."""
    rng = np.random.default_rng([seed, 5])
    me, other = Planted.of(seed), Planted.of(1000 + seed)
    alike = Planted.of(2000 + seed, me.body.height + float(rng.normal(0, 0.01)))
    for sensors in ("0", "8"):
        filmed = me.filmed(clip, sensors)
        truth = filmed.truth
        assert truth is not None
        used = dict[str, tuple[float, float]]()  # hardly depends on what the recording gives
        for gives, height in (("nothing", None), ("height", me.body.height)):
            recording = replace(filmed, truth=None, joint_offsets=np.empty((0, 3)), height=height)
            none = errors(recording, truth)
            for name, whose in (("right", me), ("another", other), ("same height", alike)):
                file = whose.file()
                who = Person.of(file, recording).seen(recording, recording.usual_mode, None, FAST)
                used[name] = used.get(name) or errors(Person(file).informed(recording).whole(), truth)
                result = none if who.doubt else used[name]
                if who.remarks:  # no bones and no posture
                    result = none if gives == "height" else errors(who.informed(recording).whole(), truth)
                row: dict[str, Any] = {"seed": seed, "sensors": sensors, "gives": gives, "file": name}
                row |= {"named": bool(who.doubt), "doubted": bool(who.remarks), "said": who.doubt}
                yield row | {"none": none, "used": used[name], "result": result}


def table(rows: list[dict[str, Any]]) -> str:
    """Return Markdown."""
    head = "sensors | recording gives | file | named | bones not used | rr none | with all of it | result"
    lines = [f"| {head} | abs none | result | rr harm: mean, 90 %, most |", "|" + "---|" * 11]
    for key in dict.fromkeys((row["sensors"], row["gives"], row["file"]) for row in rows):
        own = [row for row in rows if (row["sensors"], row["gives"], row["file"]) == key]
        none, used, result = (np.array([row[name] for row in own]) for name in ("none", "used", "result"))
        harm = (result - none)[:, 0]
        counts = [f"{sum(row[name] for row in own)} of {len(own)}" for name in ("named", "doubted")]
        means = *(each[:, 0].mean() for each in (none, used, result)), none[:, 1].mean(), result[:, 1].mean()
        most = ", ".join(f"{value:+.1f}" for value in (harm.mean(), np.quantile(harm, 0.9), harm.max()))
        lines.append(f"| {' | '.join([*key, *counts, *(f'{value:.0f}' for value in means), most])} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = study_parser("subject", __doc__)
    parser.add_argument("--people", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="number of the first person")
    options = parser.parse_args()
    rows, corpus = list[dict[str, Any]](), read_corpus(options.corpus)
    test = [i for i in range(len(corpus.split)) if corpus.split[i] == "test" and corpus.subjects[i].startswith("CMU")]
    test = [i for i in test if corpus.start[i + 1] - corpus.start[i] >= FEWEST]
    people = sorted({corpus.subjects[i] for i in test})
    for seed in range(options.first, options.first + options.people):
        mine = [i for i in test if corpus.subjects[i] == people[seed % len(people)]]
        rows += rows_of(seed, built_clip(corpus, int(np.random.default_rng([seed, 11]).choice(mine))))
        count = seed - options.first + 1
        head = f"# The file of another person\n\nMade by `python -m benchmarks subject`, {count} people."
        write_results(options.out, rows, f"{head}\n\n{table(rows)}")


if __name__ == "__main__":
    main()
