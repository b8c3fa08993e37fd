"""Whether changes between visits of a known person are covered, and what a file of the person takes off.

Planted people (bones of their own, by 4 %, and a neutral posture) of held-out motion walk twice, with another take,
detector, sensors, mounting and camera, which stands a degree off. Both visits are reconstructed with one file of the
person, wrong by its standard deviations; each with a file of its own, as if its constants were estimated from it; and
with the height alone. The true change of every angle's mean, range and ends is known.

``python -m benchmarks visits --corpus DIR``, ten minutes of one core; goes on where it stopped.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.command_line import study_parser
from benchmarks.harness import SENSOR_SETS, middle, whole_clips, write_results
from rtof_kin.body import kinematics
from rtof_kin.body.metrics import at_times
from rtof_kin.body.pose_prior import JOINTS, NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.clinical.comparison import HEADINGS
from rtof_kin.clinical.comparison_change import SHARED, Made, MixedError, bands_of
from rtof_kin.clinical.comparison_change import Measured as Value
from rtof_kin.clinical.comparison_samples import Samples, usable
from rtof_kin.core import rotations as so3
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.prediction import planted
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.person import Person
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import Estimate, Subject, merged
from rtof_kin.reporting.document import Cell
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, another_person, simulate

WALKS = {
    "CMU016": ("16_15", "16_16", "16_32", "16_47"),
    "CMU008": ("08_01", "08_02", "08_03", "08_09"),
    "CMU002": ("02_01", "02_02"),
    "CMU012": ("12_01-1", "12_01-2"),
}
"""Takes of held-out people; of one take its two halves."""
OTHERS = {
    "SNU": ("snu_balance-1", "snu_balance-2"),
    "SNU:2": ("snu_dance-1", "snu_dance-2"),
    "SNU:3": ("snu_kick-1", "snu_kick-2"),
    "rokoko": ("ad_rokoko_jesse_dance-1", "ad_rokoko_jesse_dance-2"),
    "CMU002:2": ("02_05-1", "02_05-2"),
    "CMU014": ("14_08-1", "14_08-2"),
    "CMU009": ("09_12-1", "09_12-2"),
    "CMU014:2": ("14_14-1", "14_14-2"),
}
"""Halves of other movements, and of held-out rigs."""
SECONDS, LEAST_KNOWN = 4.0, 0.8
MEASURES = ("mean", "range", "high", "low")
FILES = {"F": "one file", "G": "a file each", "N": "no file"}


@dataclass(frozen=True)
class Case:
    """What is recorded."""

    sensors: str = "8"
    mounted: bool = True  #: Else delay, headings and mountings are wrong and found from each recording
    sd_bone_m: float = 0.006
    sd_posture_deg: float = 4.0
    same_view: bool = True  #: To 8 deg around the person, 7 % of the distance and 0.1 m of height
    people: tuple[str, ...] = tuple(WALKS)
    draws: int = 4  #: Planted people of each
    files: str = "FG"


CASES = {
    "8 sensors": Case(files="FGN"),
    "8 sensors, mountings found": Case(mounted=False, files="F"),
    "no sensors": Case("0"),
    "8 sensors, files off by 10 deg and 20 mm": Case(sd_bone_m=0.02, sd_posture_deg=10.0),
    "10 sensors": Case("10", files="F"),
    "8 sensors, other movements": Case(people=tuple(OTHERS), draws=2, files="F"),
    "no sensors, other camera place": Case("0", same_view=False, files="F"),
    "4 sensors": Case("4", files="F"),
    "10 sensors, mountings found": Case("10", mounted=False, files="F"),
}


@dataclass(frozen=True)
class Planted:
    """A person."""

    body: SkeletonModel
    posture: NeutralPosture
    moved: Callable[[PoseSequence], PoseSequence]  #: A movement of the corpus as this person makes it

    @classmethod
    def of(cls, clip: MocapClip, seed: int) -> Planted:
        """Draw a person with the motion of a clip's."""
        rng, names = np.random.default_rng([_seed(clip.subject), seed]), SkeletonModel.default().names
        sizes = (1 + 0.03 * rng.normal()) * (1 + 0.04 * rng.normal(size=len(names)))
        for j, name in enumerate(names):  # both sides are alike
            if name.startswith("Right"):
                sizes[j] = sizes[names.index("Left" + name[5:])] * (1 + 0.01 * rng.normal())
        offsets = clip.joint_offsets * sizes[:, None]
        body, state = SkeletonModel.default().with_offsets(offsets), rng.integers(2**31)

        def moved(poses: PoseSequence) -> PoseSequence:
            root = poses.p_world_joint[:, 0] * [1, 1, sizes[1:].mean()]
            p = kinematics.positions(body.parents, offsets, root, poses.R_world_bone)
            p[..., 2] += poses.p_world_joint[..., 2].min() - p[..., 2].min()
            return another_person(np.random.default_rng(state), replace(poses, p_world_joint=p), body)

        R = np.tile(np.eye(3), (4, len(names), 1, 1))
        still = kinematics.positions(body.parents, offsets, np.zeros((4, 3)), R)
        t_pose = moved(PoseSequence(np.arange(4) / 60, still, R, names))
        return cls(body, NeutralPosture.of(t_pose, body.parents), moved)

    def file(self, rng: Generator, case: Case) -> Subject:
        """Return a file of the person with errors of its standard deviations."""
        bones = zip(self.body.names[1:], self.body.joint_offsets[1:], strict=True)
        turns = zip(JOINTS, np.degrees(so3.log(self.posture.R_parent_bone)), strict=True)
        news: dict[str, Estimate[Any]] = {"height_m": Estimate[Any](value=self.body.height)}
        for field, rows, sd in (
            ("joint_offsets_m", bones, case.sd_bone_m),
            ("posture_deg", turns, case.sd_posture_deg),
        ):
            for joint, value in rows:
                news[f"{field}.{joint}"] = Estimate[Any](value=value + rng.normal(0, sd, 3), sd=sd)
        return merged(Subject.of({"subject": "P"}, Path("P.toml")), news)[0]


def _seed(text: str) -> int:
    return zlib.crc32(text.encode())


def camera_of(poses: PoseSequence, who: str, seed: int, case: Case) -> tuple[Camera, Camera]:
    """Return the camera of a visit, and as it is declared."""
    rng, own = np.random.default_rng([_seed(who), 5]), np.random.default_rng(seed)
    p = poses.p_world_joint
    centre, way = (p.min(axis=(0, 1)) + p.max(axis=(0, 1))) / 2, p[-1, 0, :2] - p[0, 0, :2]
    facing = so3.heading(poses.R_world_bone[:1, 0])[0]
    azimuth = np.arctan2(way[1], way[0]) if np.linalg.norm(way) > 0.5 else facing
    if case.same_view:
        azimuth += rng.uniform(0, 2 * np.pi) + np.radians(own.uniform(-8, 8))
    else:
        azimuth += own.uniform(0, 2 * np.pi)
    distance, height = rng.uniform(3.5, 5.5) * own.uniform(0.93, 1.07), rng.uniform(0.9, 1.8) + own.uniform(-0.1, 0.1)
    while True:
        position = [*(centre[:2] + distance * np.array([np.cos(azimuth), np.sin(azimuth)])), height]
        camera = Camera.looking_at(position, centre, 1250.0)
        uv = camera.project(p)
        if ((uv > 0) & (uv < [1920, 1080])).all(-1).mean() > 0.95 or distance > 12:
            break
        distance += 0.25
    R = so3.exp(np.radians(own.normal(0, 1.0, 3))) @ camera.R_camera_world
    return camera, replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world)


def recorded(clip: MocapClip, person: Planted, who: str, seed: int, case: Case) -> Recording:
    """Simulate a visit, which knows the height alone."""
    poses, sensors = person.moved(clip.poses), SENSOR_SETS.get(case.sensors, ())
    camera, declared = camera_of(poses, who, seed, case)
    settings = replace(SimulationSettings.realistic(), sensors=sensors)
    found = simulate(poses, person.body.joint_offsets, camera=camera, settings=settings, seed=seed, name=clip.name)
    keypoints = replace(found.video, camera=declared)
    return replace(found, keypoints=keypoints, joint_offsets=np.empty((0, 3)), height=person.body.height)


def errors(found: ClinicalAngles, truth: ClinicalAngles) -> Iterator[tuple[str, str, float, float]]:
    """Yield angle, measure, error and stated standard deviation, deg, over the frames in which an angle is usable."""
    for row in found.rows:
        (values, sigma), exact = (usable(one.select([row.name])) for one in (found, truth))
        assert sigma is not None
        t = exact[0] - 2 * np.pi * np.round((exact[0] - values) / (2 * np.pi))
        known = np.isfinite(values + t)
        if row.name in HEADINGS or row.about_vertical or known.mean() < LEAST_KNOWN:
            continue
        own, true = Samples(values[None, known], sigma[None, known]), Samples(t[None, known], None)
        for measure in MEASURES:
            a, b = (getattr(one, measure)() for one in (own, true))
            yield row.name, measure, float(np.degrees(a.mean - b.mean)), float(np.degrees(a.band_sigma))


def visit(recording: Recording, subject: Subject | None, person: Planted, seed: int, case: Case) -> list[Any]:
    """Reconstruct a visit; its rows of `errors`."""
    truth, mode = recording.truth, "rtof" if SENSOR_SETS.get(case.sensors) else "rto"
    assert truth is not None
    given = recording if case.mounted else replace(planted(replace(recording, truth=None), seed), truth=None)
    informed = Person.of(subject, given).informed(given).whole()
    with without_warnings():
        result = reconstruct(informed, mode=mode, calibrate=not case.mounted)  # type: ignore[arg-type]
    exact = clinical_angles(all_observed(at_times(truth, result.motion.times)), person.body)
    return [*errors(clinical_angles(result.motion), exact)]


def measure(case: Case, clips: dict[str, MocapClip]) -> Iterator[dict[str, Any]]:
    """Yield a row for each person, visit and file."""
    for draw in range(case.draws):
        for subject in case.people:
            takes, who = (WALKS | OTHERS)[subject], f"{subject}-{draw}"
            person, rng = Planted.of(clips[takes[0]], draw), np.random.default_rng([_seed(who), 9])
            same = person.file(rng, case)
            for number, i in enumerate(rng.permutation(len(takes))[:2]):
                seed = _seed(f"{who}{number}") % 2**31
                recording = recorded(clips[takes[i]], person, who, seed, case)
                files = {"F": same, "G": person.file(np.random.default_rng(seed), case), "N": None}
                for file in case.files:
                    try:
                        rows = visit(recording, files[file], person, seed, case)
                    except RtofError as error:
                        rows = []
                        print(f"{who} {takes[i]}: {error}", file=sys.stderr)
                    yield {"person": who, "visit": number, "file": file, "rows": rows}


# --- tables --------------------------------------------------------------------------------------


def pairs(
    rows: Sequence[dict[str, Any]], file: str, measures: Sequence[str], angles: Collection[str]
) -> list[tuple[str, float, Value, Value]]:
    """Return person, error of the change, deg, and both values with their bands of all that both visits have."""
    by: dict[str, dict[int, dict[Any, Any]]] = {}
    for row in rows:
        if row["file"] == file:
            found = {
                (angle, measure): (error, sd)
                for angle, measure, error, sd in row["rows"]
                if measure in measures and angle in angles
            }
            by.setdefault(row["person"], {})[row["visit"]] = found
    out = []
    for who, visits in by.items():
        for key in sorted(visits.get(0, {}).keys() & visits.get(1, {}).keys()):
            (e, s), (f, t) = visits[0][key], visits[1][key]
            out.append((who, f - e, Value(np.array([e]), s), Value(np.array([f]), t)))
    return out


HEADINGS_OF = (
    *("recorded", "angles", "known by", "measure", "people", "error deg", "error of the change deg", "correlation"),
    *("detectable, independent deg", "shared deg", "inside, independent %", "inside, shared %", "95 %"),
)


def line(own: Sequence[tuple[str, float, Value, Value]]) -> tuple[Cell, ...]:
    """Return the figures of a table's row, from the number of people on; own: of `pairs`."""
    z = MixedError(1.0).half_width(0.05)
    d, e = np.array([one[1] for one in own]), np.array([[a.mean, b.mean] for _, _, a, b in own])
    half = [z * np.sqrt([bands_of(a, b, shared) for _, _, a, b in own]) for shared in (0.0, SHARED)]
    inside = [np.abs(d) <= width for width in half]
    people = sorted({one[0] for one in own})
    per = np.array([np.mean([ok for one, ok in zip(own, inside[1], strict=True) if one[0] == who]) for who in people])
    drawn = np.random.default_rng(0).integers(len(people), size=(2000, len(people)))
    low, high = 100 * np.percentile(per[drawn].mean(axis=1), [2.5, 97.5])
    rms = [float(np.sqrt(np.mean(x**2))) for x in (e, d)]
    return (
        len(people),
        *rms,
        float(np.mean(e[:, 0] * e[:, 1]) / np.mean(e**2)),
        *(float(np.median(width)) for width in half),
        *(100 * float(np.mean(own)) for own in inside),
        f"{low:.1f}-{high:.1f}",
    )


def table(found: dict[str, list[dict[str, Any]]]) -> Table:
    """Coverage of the stated intervals of the change, as of independent recordings and with what is shared."""
    kinds = {"mean": ("mean",), "range": ("range",), "ends": ("high", "low")}
    lines: list[tuple[Cell, ...]] = []
    body = SkeletonModel.default()
    every = angle_table(body.table).rows
    for name, rows in found.items():
        case = CASES[name]
        joints = tuple(body.sensors[sensor][0] for sensor in SENSOR_SETS.get(case.sensors, ()))
        own = {row.name for row in every if Made((), joints, not case.mounted).shares(row)}
        for which, angles in (("share", own), ("mounting", {row.name for row in every} - own)):
            for file, (kind, measures) in product(case.files, kinds.items()):
                if values := pairs(rows, file, measures, angles):
                    lines.append((name, which, FILES[file], kind, *line(values)))
    note = (
        f"Angles: those that share errors (`Made.shares`), {100 * SHARED:.0f} % of the variance, and those that "
        "mountings make up, for which the package shares nothing. The last column is a bootstrap over people."
    )
    return Table(
        "visits",
        "Changes between two visits",
        HEADINGS_OF,
        (0, 0, 0, 0, 0, 1, 1, 2, 1, 1, 1, 1, 0),
        tuple(lines),
        (note,),
    )


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("visits", __doc__)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), help="only these")
    options = parser.parse_args(arguments)
    found: dict[str, list[dict[str, Any]]] = json.loads(options.out.read_text()) if options.out.exists() else {}
    todo = [name for name in options.cases if name not in found]
    takes = {take.partition("-")[0] for name in todo for who in CASES[name].people for take in (WALKS | OTHERS)[who]}
    people = sorted({who.partition(":")[0] for name in todo for who in CASES[name].people})
    clips = dict[str, MocapClip]()
    for clip in whole_clips(options.corpus, people, sorted(takes)) if todo else ():
        clips[clip.name], half = middle(clip, SECONDS), len(clip.poses) // 2
        for i in (0, 1):
            part = clip.poses[i * half : (i + 1) * half]
            poses = replace(part, times=part.times - part.times[0])
            clips[f"{clip.name}-{i + 1}"] = middle(replace(clip, poses=poses), SECONDS)
    for name in todo:
        found[name] = [*measure(CASES[name], clips)]
        write_results(options.out, found, f"# Changes between visits\n\n{table(found).markdown()}")
    print(table(found).markdown())


if __name__ == "__main__":
    main()
