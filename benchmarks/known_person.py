"""People known from one recording of a minute: held-out people with their file against recordings without it.

``python -m benchmarks known_person --exercises CORPUS.npz`` with CORPUS.npz of models/build_corpus.py. Each person is
also another, who moves alike in a neutral posture of its own (`another_person`). The first recording has ten sensors
and is calibrated from itself; what it says is merged into a file. Others, with other motion, cameras, clothes
(constant errors of the detector) and sensors, are reconstructed with and without the file. Bones are given: the file
adds the posture, the height of the ankles and, without sensors, where the detector sees this person's points, which
is the same in all recordings. Who walks out of the picture is left out. Ten minutes of two cores.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from benchmarks.command_line import in_parallel, study_parser
from lifting.training.corpus import read_corpus
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.core.errors import ViewError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.reconstruction.person import Person
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import Subject, merged
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, another_person, low_passed, simulate, standard_cameras

PEOPLE = ("CMU002", "CMU008", "CMU009", "CMU014", "CMU016", "CMU131", "UIPRMD07", "UIPRMD08")
POSTURES = 2  # of each, the own one among them
FIRST_S, LATER_S, LATER = 60.0, 8.0, 2  # [s] length of the first recording and of later ones, and how many
BLEND_S = 0.4  # [s] in which one motion becomes the next
SENSORS = ("10", "8", "0")
COLUMNS = {
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjpe_mm": ("abs mm", 1),
    "hips_deg": ("hips deg", 1),
    "trunk_deg": ("upper trunk deg", 1),
    "flexion_deg": ("flexion deg", 1),
    "inside_relative": ("inside 95 % bands", 2),
}


def people(path: Path) -> Iterator[tuple[str, MocapClip, list[MocapClip]]]:
    """Yield people with a long motion and later ones of other clips."""
    corpus = read_corpus(path)
    for name in PEOPLE:
        own = [i for i, subject in enumerate(corpus.subjects) if subject == name]
        clips = [harness.built_clip(corpus, i) for i in np.random.default_rng(1).permutation(own)]
        clips = [low_passed(clip, 10.0) for clip in clips if clip.poses.times[-1] > 2 * BLEND_S]
        first, later = _joined(clips[::2], FIRST_S), [_joined(clips[i::4], LATER_S) for i in (1, 3)]
        for posture in range(POSTURES):
            who = f"{name}-{posture}"
            yield who, *(_posed(first, who, posture), [_posed(clip, who, posture) for clip in later[:LATER]])


def _joined(clips: list[MocapClip], seconds: float) -> MocapClip:
    """Clips one after the other, turned and moved to where the last one ends, blended."""
    rate, out = clips[0].poses.rate_hz, clips[0]
    blend = round(BLEND_S * rate)
    R, p = clips[0].poses.R_world_bone, clips[0].poses.p_world_joint[:, 0]
    for clip in clips[1:]:
        if len(R) >= seconds * rate:
            break
        more_R, more_p = clip.poses.R_world_bone, clip.poses.p_world_joint[:, 0]
        forward = R[-blend, 0, :, 0], more_R[0, 0, :, 0]
        angle = float(np.subtract(*(np.arctan2(f[1], f[0]) for f in forward)))
        turn = so3.about_axis("z", angle)
        more_R, more_p = turn @ more_R, (more_p - more_p[0]) @ turn.T + more_p[0]
        more_p = more_p + (p[-blend] - more_p[0]) * [1, 1, 0]
        share = np.linspace(0, 1, blend)
        apart = so3.log(np.swapaxes(R[-blend:], -1, -2) @ more_R[:blend])
        R = np.concatenate([R[:-blend], R[-blend:] @ so3.exp(share[:, None, None] * apart), more_R[blend:]])
        mixed = p[-blend:] + share[:, None] * (more_p[:blend] - p[-blend:])
        p = np.concatenate([p[:-blend], mixed, more_p[blend:]])
    count = min(len(R), round(seconds * rate))
    parents, names = SkeletonModel.default().parents, clips[0].poses.names
    joints = kinematics.positions(parents, out.joint_offsets, p[:count], R[:count])
    return replace(out, poses=PoseSequence(np.arange(count) / rate, joints, R[:count], names))


def _posed(clip: MocapClip, who: str, posture: int) -> MocapClip:
    if posture == 0:
        return clip
    body = SkeletonModel.default().with_offsets(clip.joint_offsets)
    return replace(clip, poses=another_person(np.random.default_rng(_seed(who)), clip.poses, body))


def _seed(name: str) -> int:
    return zlib.crc32(name.encode())


def recorded(clip: MocapClip, who: str, number: int, sensors: str) -> Recording:
    """A recording of a person with known bones."""
    seed = _seed(f"{who} {number}")
    return simulate(
        clip.poses,
        clip.joint_offsets,
        camera=standard_cameras(clip.poses, seed)[number % 4],
        settings=SimulationSettings(
            keypoints=DetectorErrors(who=_seed(who)), sensors=harness.SENSOR_SETS.get(sensors, ())
        ),
        seed=seed,
        name=f"{who} {number}",
    )


def measured(job: tuple[str, MocapClip, list[MocapClip]]) -> list[dict[str, Any]]:
    """Rows of one person: later recordings without and with the file."""
    who, first, later = job
    subject = Subject.of({"subject": who}, Path(f"{who}.toml"))
    rows = list[dict[str, Any]]()
    with without_warnings(RESULT_WARNINGS), suppress(ViewError):  # who walks out of the picture is left out
        recording, person = recorded(first, who, 0, "10"), Person()
        result = reconstruct(recording, mode="rtof", calibrate=True)
        list(person.learning([result], recording, recording.skeleton, "recording 1"))
        subject, said = merged(subject, person.news)
        print(who, *said, sep="\n  ", file=sys.stderr, flush=True)
        for number, clip in enumerate(later, start=1):
            for sensors in SENSORS:
                recording = recorded(clip, who, number, sensors)
                mode = "rto" if sensors == "0" else "rtof"
                for name, known in (("none", None), ("file", subject)):
                    informed = Person.of(known, recording).informed(recording).whole()
                    found = reconstruct(informed, mode=mode, calibrate=mode == "rtof")
                    about = {"who": who, "number": number, "sensors": sensors, "file": name}
                    rows.append(about | {"frames": len(recording.video)} | scoring.figures(found, mode))
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """Rows pooled by sensors and file, with how often the file is not worse."""
    found = list[tuple[Cell, ...]]()
    for sensors in SENSORS:
        own = [row for row in rows if row["sensors"] == sensors]
        rr = {name: np.array([row["mpjpe_rr_mm"] for row in own if row["file"] == name]) for name in ("none", "file")}
        change = rr["file"] - rr["none"]
        for name, share in (("none", 1.0), ("file", float(np.mean(change < 0.1)))):
            mine = [row | {"motion": row["who"]} for row in own if row["file"] == name]
            figures = harness.pooled(mine, COLUMNS)
            worst = 0.0 if name == "none" else float(change.max())
            found.append((sensors, name, *(figures[column] for column in COLUMNS), share, worst))
    headings, digits = zip(*COLUMNS.values(), strict=True)
    columns = ("sensors", "file", *headings, "not worse", "worst mm")
    return Table("known_person", "Later recordings", columns, (0, 0, *digits, 2, 1), tuple(found))


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("known_person", __doc__, motion=False, page="{}.md")
    parser.add_argument("--exercises", type=Path, required=True, help="corpus of models/build_corpus.py")
    options = parser.parse_args(arguments)
    rows = [row for own in in_parallel(measured, people(options.exercises)) for row in own]
    text = f"# People known from one recording\n\n{table(rows).markdown()}"
    options.out.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
