"""Which sensor is on which segment: share right and calibration of the stated probabilities.

``python -m benchmarks assignment --corpus DIR`` with DIR the folder of free motion (see README.md here).
Recordings of 10 to 60 s join motions of the test split's people, and the same on the rig that nothing learned
from (`rerigged`); realistic 2D of one camera, lifted without sensors. 4, 8, 10 and 13 sensors with arbitrary
mountings and headings have 13 segments to choose from, or those that have one are told. Exchanges are planted
in the map of ten sensors. ``--subset validation`` is what weights and thresholds were chosen on. ``--real
DIR`` adds real recordings, sensors alone.
"""

from __future__ import annotations

import tomllib
import zlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser, table_head
from benchmarks.harness import SENSOR_SETS, mocap_people, write_results
from benchmarks.rerigged import rerigged
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.assignment import assign_sensors, check_assignment
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

HERE = Path(__file__).parent
TRIALS = HERE.parent / "examples" / "sensor_trials.toml"
SECONDS = {10.0: 2, 20.0: 1, 40.0: 1, 60.0: 1}
"""Recordings of a person by length, where there is motion for them."""
RERIGGED = 20.0
"""[s] Length of those that are also on the other rig."""
EVERY = tuple(SkeletonModel.default().sensors)
SETS = {**SENSOR_SETS, "13": EVERY}
FAULTS: dict[str, dict[str, str]] = {
    "nothing": {},
    "forearms exchanged": {"LeftForeArm": "RightForeArm", "RightForeArm": "LeftForeArm"},
    "all sides exchanged": {
        a + joint: b + joint
        for a, b in (("Left", "Right"), ("Right", "Left"))
        for joint in ("Arm", "ForeArm", "UpLeg", "Leg")
    },
    "shank declared as foot": {"RightLeg": "RightFoot"},
}
"""Declared segments by true ones."""
REAL_FAULTS: dict[str, dict[str, str]] = {
    "nothing": {},
    "left thigh and shank exchanged": {"LeftUpLeg": "LeftLeg", "LeftLeg": "LeftUpLeg"},
    "all sides exchanged": FAULTS["all sides exchanged"] | {"LeftFoot": "RightFoot", "RightFoot": "LeftFoot"},
}
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.01)


def sessions(corpus: Path, subjects: list[str]) -> Iterator[MocapClip]:
    """Recordings of each person, one of 20 s on the other rig too."""
    people: dict[str, list[MocapClip]] = {}
    for clip in read_corpus(corpus, subjects, output_rate_hz=120.0, min_seconds=2.0):
        if "GLITCH" not in clip.quality and len(clip.poses) >= 2.0 * clip.poses.rate_hz:
            people.setdefault(clip.subject, []).append(resample_clip(low_passed(clip, 10.0), 60.0))
    for subject, clips in people.items():
        for seconds, again in ((seconds, i) for seconds, count in SECONDS.items() for i in range(count)):
            total = sum(len(clip.poses) for clip in clips) / 60
            if total < (again + 1) * min(seconds, 10.0) or total < 0.8 * seconds:
                continue
            name = f"{subject}, {seconds:g} s, {again + 1}"
            order = np.random.default_rng(zlib.crc32(name.encode())).permutation(len(clips))
            session = joined([clips[i] for i in order], seconds, name)
            walks = "walk" if all("walk" in clips[i].category.lower() for i in order) else ""
            yield replace(session, category=walks)
            if seconds == RERIGGED and subject.startswith("CMU"):
                yield replace(rerigged(session), name=f"{name}, rerigged", category=walks)


def recorded(clip: MocapClip, seed: int) -> tuple[Recording, PoseSequence]:
    """What the first camera and all sensors record, and the lifted poses."""
    own = seed * 1_000_003 + zlib.crc32(clip.name.encode())
    settings = replace(SimulationSettings.realistic(), sensors=EVERY)
    camera = standard_cameras(clip.poses, own)[own % 4]
    recording = simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=own, name=clip.name)
    keypoints = evenly_spaced(recording.video)
    return recording, lift(keypoints, recording.skeleton).poses


def as_log(recording: Recording, sensors: tuple[str, ...]) -> SensorLog:
    """Unnamed sensors."""
    assert recording.imus is not None
    log = SensorLog.of_imus(recording.imus.select(sensors), recording.name)
    return log.renamed({name: str(s) for s, name in enumerate(sensors)})


def judge(clip: MocapClip, seed: int) -> Iterator[dict[str, Any]]:
    """A row for each sensor, number of sensors, with and without an image, and segments told or not."""
    recording, poses = recorded(clip, seed)
    skeleton = recording.skeleton
    about = {
        "recording": clip.name,
        "rig": clip.rig,
        "walk": bool(clip.category),
        "seconds": round(len(clip.poses) / 60),
    }
    for number, some in SETS.items():
        order = np.random.default_rng(zlib.crc32(f"{clip.name}{number}".encode())).permutation(len(some))
        sensors = tuple(some[i] for i in order)
        truth = [skeleton.sensors[sensor][0] for sensor in sensors]
        log = as_log(recording, sensors)
        ways = [(True, False), (False, False)]
        for image, told in ways + ([(True, True), (False, True)] if number == "8" else []):
            candidates = sorted(truth) if told else None
            found = assign_sensors(log, skeleton, poses if image else None, candidates=candidates)
            for name, joint in zip(log.names, truth, strict=True):
                yield {
                    **about,
                    "sensors": int(number),
                    "image": image,
                    "told": told,
                    "truth": joint,
                    "found": found.joints[name],
                    "probability": found.probabilities[name],
                    "doubt": bool(found.doubt),
                }
        if number == "10":
            for image in (True, False):
                yield from planted(about | {"image": image}, log, truth, skeleton, poses if image else None)


def planted(
    about: dict[str, Any], log: SensorLog, truth: list[str], skeleton: SkeletonModel, poses: PoseSequence | None
) -> Iterator[dict[str, Any]]:
    """A row for each planted error of the map: whether sensors are named, and whether rightly."""
    for fault, other in (REAL_FAULTS if about.get("real") else FAULTS).items():
        joints = dict(zip(log.names, (other.get(joint, joint) for joint in truth), strict=True))
        found = check_assignment(log, joints, skeleton, poses)
        right = found.joints == dict(zip(log.names, truth, strict=True))
        yield {**about, "fault": fault, "named": bool(found.wrong), "right": right, "doubt": bool(found.doubt)}


def real_trials(folder: Path) -> Iterator[dict[str, Any]]:
    """The same of real sensors on the skeleton's usual segments, without an image."""
    skeleton = SkeletonModel.default()
    usual = {joint for joint, _ in skeleton.sensors.values()}
    for name, facts in tomllib.loads(TRIALS.read_text(encoding="utf-8")).items():
        log = _read(folder / name, facts)
        if log is None:
            continue
        truth = {sensor: joint for sensor, joint in facts["joints"].items() if joint in usual}
        log = log.select(list(truth))
        about = {"recording": name, "image": False, "real": True}
        yield from planted(about, log, list(truth.values()), skeleton, None)
        for told in (False, True):
            candidates = sorted(truth.values()) if told else None
            found = assign_sensors(log, skeleton, candidates=candidates)
            for sensor, joint in truth.items():
                yield {
                    **about,
                    "sensors": len(truth),
                    "told": told,
                    "truth": joint,
                    "found": found.joints[sensor],
                    "probability": found.probabilities[sensor],
                    "doubt": bool(found.doubt),
                }


def _read(folder: Path, facts: dict[str, Any]) -> SensorLog | None:
    """The log with the trial's sensors, wherever in the folder it is."""
    for path in [folder, *sorted(folder.rglob("*"))]:
        if path.is_dir() or path.suffix == ".mat":
            try:
                log = read_sensor_log(path, **facts.get("declared", {}))
            except RtofError:
                continue
            if set(facts["joints"]) <= set(log.names):
                return log
    return None


def tables(rows: list[dict[str, Any]]) -> str:
    """Markdown of the results."""
    faults = [r for r in rows if "fault" in r and not r.get("real")]
    real = [r for r in rows if "told" in r and r.get("real")]
    real_faults = [r for r in rows if "fault" in r and r.get("real")]
    simulated = [r for r in rows if "told" in r and not r.get("real")]
    untold = [r for r in simulated if not r["told"]]
    walking = [r for r in untold if r["walk"]]
    out = ["# Which sensor is where", "", "Of 13 segments:", "", *_shares(untold)]
    out += ["", "Where the segments that have a sensor are told:", ""]
    out += _shares([r for r in simulated if r["told"]])
    out += ["", "## Walking alone, of 13 segments", "", *_shares(walking)] if walking else []
    out += ["", "## By rig, 8 to 13 sensors", "", *_by_rig([r for r in untold if r["sensors"] >= 8])]
    out += ["", "## Stated probability of a sensor's segment, and share right", "", *_reliability(untold)]
    out += ["", "## Planted errors of the map, 10 sensors", "", *_faults(faults)]
    if real:
        out += ["", "## Real sensors, without an image", "", *_real(real), "", *_faults(real_faults)]
    return "\n".join(out) + "\n"


def _right(r: dict[str, Any]) -> bool:
    return bool(r["truth"] == r["found"])


def _right_but_side(r: dict[str, Any]) -> bool:
    return bool(r["truth"].replace("Left", "Right") == r["found"].replace("Left", "Right"))


def _percent(values: list[bool]) -> str:
    return f"{100 * np.mean(values):.1f}" if values else "-"


def _by_recording(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    groups: dict[Any, list[dict[str, Any]]] = {}
    for r in rows:
        groups.setdefault((r["recording"], r["sensors"], r["image"], r.get("told")), []).append(r)
    return list(groups.values())


def _shares(rows: list[dict[str, Any]]) -> list[str]:
    out = table_head(
        "image | sensors | recordings | sensors right % | right but for the side % | recordings all right % | "
        "recordings said sure % | of these all right % | sensors stated 95 % sure % | of these right %"
    )
    for image in (True, False):
        for number in sorted({r["sensors"] for r in rows}):
            own = [r for r in rows if r["image"] == image and r["sensors"] == number]
            groups = _by_recording(own)
            sure = [g for g in groups if not g[0]["doubt"]]
            certain = [r for r in own if r["probability"] >= 0.95]
            cells = [
                "yes" if image else "no",
                str(number),
                str(len(groups)),
                _percent([_right(r) for r in own]),
                _percent([_right_but_side(r) for r in own]),
                _percent([all(map(_right, g)) for g in groups]),
                f"{100 * len(sure) / max(len(groups), 1):.0f}",
                _percent([all(map(_right, g)) for g in sure]),
                f"{100 * len(certain) / max(len(own), 1):.0f}",
                _percent([_right(r) for r in certain]),
            ]
            out.append("| " + " | ".join(cells) + " |")
    return out


def _by_rig(rows: list[dict[str, Any]]) -> list[str]:
    out = table_head("rig | image | recordings | sensors right %")
    for rig in sorted({r["rig"] for r in rows}):
        for image in (True, False):
            own = [r for r in rows if r["rig"] == rig and r["image"] == image]
            count = len({r["recording"] for r in own})
            out.append(f"| {rig} | {'yes' if image else 'no'} | {count} | {_percent([_right(r) for r in own])} |")
    return out


def _reliability(rows: list[dict[str, Any]]) -> list[str]:
    out = table_head(
        "stated | with image: sensors | mean stated % | right % | without: sensors | mean stated % | right %"
    )
    for low, high in pairwise(BINS):
        cells = [f"{100 * low:.0f} to {min(100 * high, 100):.0f} %"]
        for image in (True, False):
            own = [r for r in rows if r["image"] == image and low <= r["probability"] < high]
            mean = f"{100 * np.mean([r['probability'] for r in own]):.1f}" if own else "-"
            cells += [str(len(own)), mean, _percent([_right(r) for r in own])]
        out.append("| " + " | ".join(cells) + " |")
    return out


def _faults(rows: list[dict[str, Any]]) -> list[str]:
    out = table_head("planted | image | recordings | sensors named % | corrected rightly % | doubt alone %")
    for fault in dict.fromkeys(r["fault"] for r in rows):
        for image in sorted({r["image"] for r in rows}, reverse=True):
            own = [r for r in rows if r["fault"] == fault and r["image"] == image]
            alone = [r["doubt"] and not r["named"] for r in own]
            cells = [
                fault,
                "yes" if image else "no",
                str(len(own)),
                _percent([r["named"] for r in own]),
                _percent([r["right"] for r in own]),
                _percent(alone),
            ]
            out.append("| " + " | ".join(cells) + " |")
    return out


def _real(rows: list[dict[str, Any]]) -> list[str]:
    out = table_head("recording | segments told | sensors | right | right but for the side | wrong | doubt")
    for group in _by_recording(rows):
        first, wrong = group[0], [r for r in group if not _right(r)]
        named = [f"{r['truth']} as {r['found']} ({100 * r['probability']:.0f} %)" for r in wrong]
        cells = [
            first["recording"],
            "yes" if first["told"] else "no",
            str(len(group)),
            str(len(group) - len(wrong)),
            str(sum(map(_right_but_side, group))),
            ", ".join(named) or "-",
            "yes" if first["doubt"] else "no",
        ]
        out.append("| " + " | ".join(cells) + " |")
    return out


def main() -> None:
    """Run and write."""
    parser = study_parser("assignment", __doc__)
    parser.add_argument("--real", type=Path, help="folder of real sensor recordings")
    parser.add_argument("--subset", choices=("test", "validation"), default="test")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = [] if options.real is None else list(real_trials(options.real))
    clips = sorted(sessions(options.corpus, mocap_people(options.subset)), key=lambda clip: len(clip.poses))
    for clip in clips:
        rows += judge(clip, options.seed)
        mine = [r for r in rows if r["recording"] == clip.name and r.get("told") is False]
        shares = [_percent([_right(r) for r in mine if r["image"] == image]) for image in (True, False)]
        print(f"{clip.name}: {shares[0]} % right with the image, {shares[1]} % without", flush=True)
        write_results(options.out, {"rows": rows}, tables(rows))  # a part is a result too
    print(tables(rows))


if __name__ == "__main__":
    main()
