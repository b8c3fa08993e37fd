"""Detection rate and false alarms of the checks of sensors and clocks.

``python -m benchmarks.sensor_checks --corpus DIR`` with DIR the folder of free motion (see README.md
here); ``--real DIR`` adds recordings of real sensors (the trials of examples/sensor_trials.toml), of
which only what physics tells can be checked. Motions of at least 4 s, their middle 10 s at most,
realistic 2D from four cameras and 4, 8 or 10 sensors in turn. Each recording is given as it is, and that
of the first camera with one fault planted at a time. *named*: the first warning names what was planted.
*silent*: no check fails; of nothing planted, no check of the sensors. The checks run at the end of mode
`lift`; in `rtof` sensors that disagree with the solved motion give them away too.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.harness import SENSOR_SETS, write_results
from rtof_kin.calibration.clock_check import NAME as CLOCKS
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.recorded_form import FROZEN, GRAVITY, check_form
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.sensor_checks import SETUP
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

HERE = Path(__file__).parent
TRIALS = HERE.parent / "examples" / "sensor_trials.toml"
SEED, SECONDS, LEAST_SECONDS = 3, 10.0, 4.0
"""Limits were chosen on the middles of motions of all folders with other seeds, and some changed after a
look at rows of this one; `--seed 4 --part beginning` was run once, after all of them."""
Plant = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Fault:
    """Something to plant."""

    plant: Plant
    named: str
    """Part of the cause that names it."""
    of_form: bool = False
    """True if samples suffice to detect it, without an image."""


def _with_imus(recording: Recording, **changed: Any) -> Recording:
    assert recording.imus is not None
    return replace(recording, imus=replace(recording.imus, **changed))


def _flipped(imus: ImuSequence) -> dict[str, Any]:
    return {"f_sensor": -imus.f_sensor}


def _without_gravity(imus: ImuSequence) -> dict[str, Any]:
    return {"f_sensor": imus.f_sensor - 9.81 * imus.R_inertial_sensor[..., 2, :]}


def _as_xyzw(imus: ImuSequence) -> dict[str, Any]:
    R = imus.R_inertial_sensor.copy()
    known = np.isfinite(R).all(axis=(-2, -1))
    R[known] = so3.from_quat_wxyz(np.roll(so3.to_quat_wxyz(R[known]), -1, axis=-1))
    return {"R_inertial_sensor": R}


def _inverted(imus: ImuSequence) -> dict[str, Any]:
    return {"R_inertial_sensor": np.swapaxes(imus.R_inertial_sensor, -1, -2)}


def _frozen(share: float, sensors: slice) -> Callable[[ImuSequence], dict[str, Any]]:
    """The last share of the samples repeats one."""

    def changed(imus: ImuSequence) -> dict[str, Any]:
        R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
        known = np.isfinite(f).all(axis=(1, 2))
        first = max(round((1 - share) * len(f)), int(np.argmax(known)))
        R[first:, sensors], f[first:, sensors] = R[first, sensors], f[first, sensors]
        return {"R_inertial_sensor": R, "f_sensor": f}

    return changed


def _samples(change: Callable[[ImuSequence], dict[str, Any]]) -> Plant:
    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        return _with_imus(recording, **change(recording.imus))

    return plant


def _late(seconds: float) -> Plant:
    """The sensors' stamps are late by so much."""

    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        return _with_imus(recording, times=recording.imus.times + seconds)

    return plant


def _pairs(recording: Recording, left: str, right: str) -> list[tuple[int, int]]:
    """Indices of sensors in the calibration; of sides, all pairs."""
    assert recording.calibration is not None
    joints = recording.calibration.joints
    if left == "Left":
        pairs = [(a, a.replace(left, right)) for a in joints if a.startswith(left)]
    else:
        pairs = [(left, right)]
    return [(joints.index(a), joints.index(b)) for a, b in pairs]


def _samples_swapped(left: str, right: str) -> Plant:
    """Each other's samples under two sensors' names."""

    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        assert recording.calibration is not None
        order = list(range(len(recording.imus.names)))
        for a, b in _pairs(recording, left, right):
            a, b = (recording.imus.names.index(recording.calibration.sensors[s]) for s in (a, b))
            order[a], order[b] = b, a
        R, f = recording.imus.R_inertial_sensor[:, order], recording.imus.f_sensor[:, order]
        return _with_imus(recording, R_inertial_sensor=R, f_sensor=f)

    return plant


def _segments_swapped(left: str, right: str) -> Plant:
    """Two sensors, each with its own calibration, declared on each other's segments."""

    def plant(recording: Recording) -> Recording:
        assert recording.calibration is not None
        order = list(range(len(recording.calibration.joints)))
        for a, b in _pairs(recording, left, right):
            order[a], order[b] = b, a
        joints = tuple(recording.calibration.joints[s] for s in order)
        levers = recording.calibration.p_bone_sensor[order]
        return replace(
            recording, calibration=replace(recording.calibration, joints=joints, p_bone_sensor=levers)
        )

    return plant


_FOREARMS, _SIDES = ("LeftForeArm", "RightForeArm"), ("Left", "Right")
_ARM_THIGH, _ARM = ("LeftArm", "RightUpLeg"), ("LeftArm", "LeftForeArm")
FAULTS: dict[str, Fault] = {
    "accelerations negated": Fault(_samples(_flipped), "sign flipped", True),
    "gravity removed": Fault(_samples(_without_gravity), "gravity was removed", True),
    "quaternions x, y, z, w": Fault(_samples(_as_xyzw), "order x, y, z, w", True),
    "quaternions conjugated": Fault(_samples(_inverted), "orientations are inverted", True),
    "one sensor frozen": Fault(_samples(_frozen(0.6, slice(1))), "is frozen", True),
    "all sensors frozen": Fault(_samples(_frozen(1.0, slice(None))), "all sensors are frozen", True),
    "sensors 0.5 s late": Fault(_late(0.5), "the clocks are off"),
    "sensors 1 s early": Fault(_late(-1.0), "the clocks are off"),
    "sensors 2 s late": Fault(_late(2.0), "the clocks are off"),
    "samples of the forearms swapped": Fault(
        _samples_swapped(*_FOREARMS), "samples of LeftForeArm and RightForeArm are swapped"
    ),
    "samples of left and right swapped": Fault(
        _samples_swapped(*_SIDES), "samples of all left and right sensors"
    ),
    "samples of an arm and a thigh swapped": Fault(
        _samples_swapped(*_ARM_THIGH), "samples of LeftArm and RightUpLeg are swapped"
    ),
    "forearms swapped": Fault(
        _segments_swapped(*_FOREARMS), "sensors of LeftForeArm and RightForeArm are swapped"
    ),
    "left and right swapped": Fault(_segments_swapped(*_SIDES), "all left and right sensors"),
    "an arm and a thigh swapped": Fault(
        _segments_swapped(*_ARM_THIGH), "sensors of LeftArm and RightUpLeg are swapped"
    ),
    "upper arm and forearm swapped": Fault(
        _segments_swapped(*_ARM), "sensors of LeftArm and LeftForeArm are swapped"
    ),
}
NOTHING = "nothing"
OF_SENSORS = {FROZEN, GRAVITY, CLOCKS, SETUP}
"""Checks that may accuse a good recording here; those of cameras have a benchmark of their own."""


def recordings(corpus: Path, most: int, seed: int, part: str) -> Iterator[tuple[str, list[Recording]]]:
    """The folder of each motion, and what each camera records of it, with one number of sensors after the
    other."""
    sets = list(SENSOR_SETS.items())
    for k, (folder, clip) in enumerate(_chosen(corpus, most, part)):
        own = seed * 1_000_003 + zlib.crc32(clip.name.encode())
        views = []
        for i, camera in enumerate(standard_cameras(clip.poses, own)):
            number, sensors = sets[(k + i) % len(sets)]
            settings = replace(SimulationSettings.realistic(), sensors=sensors)
            views.append(simulate(
                clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=own + i,
                name=f"{clip.name}, camera {i}, {number} sensors",
            ))  # fmt: skip
        yield folder, views


def _chosen(corpus: Path, most: int, part: str) -> list[tuple[str, MocapClip]]:
    """Motions long enough, their middles or beginnings, evenly of every folder."""
    folders = {p.stem: p.parent.name for p in corpus.glob("*/*") if p.suffix in (".bvh", ".amc")}
    found: dict[str, list[MocapClip]] = {}
    for clip in read_corpus(corpus, output_rate_hz=120.0, min_seconds=LEAST_SECONDS):
        rate = clip.poses.rate_hz
        if "GLITCH" in clip.quality or len(clip.poses) < LEAST_SECONDS * rate:
            continue
        count = min(len(clip.poses), round(SECONDS * rate))
        first = (len(clip.poses) - count) // 2 if part == "middle" else 0
        poses = clip.poses[first : first + count]
        cut = replace(clip, poses=replace(poses, times=poses.times - poses.times[0]))
        found.setdefault(folders[clip.name.partition("[")[0]], []).append(cut)
    return [
        (folder, resample_clip(low_passed(clip, 10.0), 60.0))
        for folder, clips in found.items() for clip in clips[:: max(1, len(clips) // most)][:most]
    ]  # fmt: skip


def judge(folder: str, recording: Recording, faults: bool) -> list[dict[str, Any]]:
    """A row for nothing planted, and for every fault that the recording's sensors can have."""
    rows = []
    for name, plant, named in _cases(recording):
        if name != NOTHING and not faults:
            break
        try:
            result = reconstruct(plant(recording), mode="lift", calibrate=False)
            own = {check.name for check in result.checks} if name != NOTHING else OF_SENSORS
            causes = [check.cause for check in result.checks if check.failed and check.name in own]
        except RtofError as error:
            causes = [str(error)]
        rows.append(_row(folder, recording.name, name, causes, named))
    return rows


def _cases(recording: Recording) -> Iterator[tuple[str, Plant, str]]:
    yield NOTHING, lambda recording: recording, ""
    assert recording.calibration is not None
    for name, fault in FAULTS.items():
        try:
            fault.plant(recording)
        except ValueError as error:
            if not isinstance(error, RtofError):  # the segments carry no sensors
                continue
        yield name, fault.plant, fault.named


def judge_real(folder: Path) -> list[dict[str, Any]]:
    """The same of real sensors, of what samples alone show."""
    rows = []
    nothing = Fault(lambda recording: recording, "", True)
    for trial, imus in _real(folder):
        reference = np.tile(np.eye(3), (len(imus.names), 1, 1))
        for name, fault in {NOTHING: nothing, **FAULTS}.items():
            if not fault.of_form:
                continue
            try:
                planted = fault.plant(Recording(trial, imus=imus)).imus
                assert planted is not None
                causes = [check.cause for check in check_form(planted, reference) if check.failed]
            except RtofError as error:
                causes = [str(error)]
            rows.append(_row("real", trial, name, causes, fault.named))
    return rows


def _real(folder: Path) -> Iterator[tuple[str, ImuSequence]]:
    """The trials that are there, but those whose orientations have to be estimated first."""
    for trial, facts in tomllib.loads(TRIALS.read_text(encoding="utf-8")).items():
        places = [folder / trial, *(p for p in sorted((folder / trial).rglob("*")) if p.is_dir())]
        for place in places:
            try:
                log = read_sensor_log(place, **facts.get("declared", {}))
                log = log.select([name for name in facts["joints"] if name in log.names])
                imus = ImuSequence.joined(log.imus())
            except RtofError:  # no sensors there, or raw ones without orientation
                continue
            if not facts.get("vqf"):
                yield trial, imus
            break


def _row(folder: str, recording: str, fault: str, causes: list[str], named: str) -> dict[str, Any]:
    return {
        "folder": folder, "recording": recording, "fault": fault, "causes": causes,
        "named": bool(causes) and bool(named) and named in causes[0], "silent": not causes,
    }  # fmt: skip


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Shares by fault and folder, as Markdown; of nothing planted, how often something is accused."""
    folders = list(dict.fromkeys(row["folder"] for row in rows))
    lines = [
        "| planted | " + " | ".join(f"{f} named" for f in folders) + " | all simulated | silent |",
        "|---" * (len(folders) + 3) + "|",
    ]
    for fault in (NOTHING, *FAULTS):
        own = [row for row in rows if row["fault"] == fault]
        key = "silent" if fault == NOTHING else "named"
        groups = [[r for r in own if r["folder"] == f] for f in folders]
        groups.append([r for r in own if r["folder"] != "real"])
        cells = [f"{sum(r[key] for r in g)} of {len(g)}" for g in groups]
        cells.append(f"{sum(r['silent'] for r in own)} of {len(own)}")
        title = f"{fault} (silent)" if fault == NOTHING else fault
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sensor_checks", description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--real", type=Path, help="folder of recordings of real sensors")
    parser.add_argument("--most", type=int, default=20, help="so many motions of each folder")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--part", choices=("middle", "beginning"), default="middle", help="of motions")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "sensor_checks.json")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    motions = recordings(options.corpus, options.most, options.seed, options.part)
    for folder, views in track(list(motions), "motions"):
        for i, recording in enumerate(views):
            seconds = len(recording.video) / recording.truth.rate_hz if recording.truth else 0.0
            rows += [row | {"seconds": seconds} for row in judge(folder, recording, faults=i == 0)]
    rows += [] if options.real is None else judge_real(options.real)
    real = " --real DIR" if options.real else ""
    result = {
        "command": f"python -m benchmarks.sensor_checks --corpus DIR{real} --most {options.most} --seed "
        f"{options.seed} --part {options.part}",
        "rows": rows,
    }  # fmt: skip
    write_results(options.out, result, table(rows))
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
