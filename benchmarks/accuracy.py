"""How accurate the joint-space solver is: by sensors, under faults, and without its ingredients.

``python -m benchmarks.accuracy --corpus DIR`` with the harness' motions, cameras and noise. Tables:

* sensors: 0, 4, 8 and 10 IMUs x kinds of 2D, four cameras a motion; and on which motions the solver is
  worse than its own start, SF2.
* robustness: 8 IMUs, white 5 px, one thing wrong at a time, one camera a motion.
* ablation: 8 IMUs, white and realistic 2D, one ingredient left out at a time, one camera a motion.

Rows are written as they come: an interrupted run goes on where it stopped. ``--subset validation`` takes
motions of the validation subjects instead, to tune on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from rich.progress import Progress

import rtof_kin
from benchmarks import harness
from benchmarks.harness import HERE, KEYPOINTS, SENSOR_SETS
from rtof_kin import rotations as so3
from rtof_kin.errors import RtofError
from rtof_kin.fragment import FragmentSolver, SolverStatus
from rtof_kin.inertial_ik import InertialGuidedIK
from rtof_kin.joint_space.frame_energy import TORSO
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.metrics import evaluate, motionless
from rtof_kin.mocap import MocapClip
from rtof_kin.pipeline import reconstruct
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.recording import Recording
from rtof_kin.resources import model_path
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, PoseSequence

Array = NDArray[np.float64]
Row = dict[str, Any]
NOMINAL = "nominal"
VALIDATION = {
    "131_03": 3, "ad_rokoko_jesse_dance": 3, "131_01": 1, "131_02": 1, "08_04": 1, "08_05": 1,
    "08_11": 1, "pymo_8walk_meredith": 1,
}  # fmt: skip
"""Motions to tune on, and into how many parts each is cut. Only the first two of what the validation
subjects do are neither walking nor running, so each gives three of the twelve."""
FIGURES = {
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjpe_mm": ("abs mm", 1),
    "mpjae": ("MPJAE m/s2", 2),
    "mpjje": ("MPJJE m/s3", 0),
    "flexion_deg": ("flexion deg", 1),
    "pelvis_deg": ("pelvis deg", 1),
    "upper_trunk_deg": ("upper trunk deg", 1),
}
"""Figure -> heading and digits. The last two are mean angles between estimated and true orientation."""
LEFT_LIMBS = ("LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot")
LIMBS = (*LEFT_LIMBS, *(name.replace("Left", "Right") for name in LEFT_LIMBS))


# --- what may be wrong with a recording ----------------------------------------------------------


def with_outliers(
    recording: Recording, rng: Generator, share: float = 0.1, size_px: float = 80.0
) -> Recording:
    """A share of all landmarks, drawn one by one, displaced by so much in any direction."""
    keypoints = recording.keypoints
    hit = rng.random(keypoints.confidence.shape) < share
    angle = rng.uniform(0, 2 * np.pi, hit.shape)
    shift = size_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1) * hit[..., None]
    return replace(recording, keypoints=replace(keypoints, uv_px=keypoints.uv_px + shift))


def middle_second(times: Array) -> tuple[float, float]:
    """The second in the middle of some times, s."""
    middle = float(times[0] + times[-1]) / 2
    return middle - 0.5, middle + 0.5


def second_after_half(times: Array) -> tuple[float, float]:
    """The second after the middle of some times, s."""
    middle = float(times[0] + times[-1]) / 2
    return middle, middle + 1.0


def with_unseen_limbs(recording: Recording, rng: Generator) -> Recording:
    """The left arm and leg unseen for the middle second."""
    keypoints = recording.keypoints
    start, stop = middle_second(keypoints.times)
    during = (keypoints.times >= start) & (keypoints.times < stop)
    hidden = during[:, None] & np.isin(keypoints.names, LEFT_LIMBS)
    return replace(
        recording,
        keypoints=replace(
            keypoints,
            uv_px=np.where(hidden[..., None], np.nan, keypoints.uv_px),
            confidence=np.where(hidden, 0.0, keypoints.confidence),
        ),
    )


def without_sensor(recording: Recording, rng: Generator, name: str = "L_LowArm") -> Recording:
    """One sensor missing altogether."""
    imus = recording.imus
    assert imus is not None
    return replace(recording, imus=imus.select([other for other in imus.names if other != name]))


def with_stopped_sensors(
    recording: Recording, rng: Generator, names: tuple[str, ...] | None = None
) -> Recording:
    """Some sensors, or all, that say nothing after half of the video."""
    imus = recording.imus
    assert imus is not None
    stop, _ = second_after_half(recording.keypoints.times)
    stopped = np.isin(imus.names, imus.names if names is None else names)
    gone = (imus.times >= stop)[:, None] & stopped
    return replace(
        recording,
        imus=replace(
            imus,
            R_inertial_sensor=np.where(gone[..., None, None], np.nan, imus.R_inertial_sensor),
            f_sensor=np.where(gone[..., None], np.nan, imus.f_sensor),
        ),
    )


def with_wrong_bones(
    recording: Recording, rng: Generator, spread: float = 0.0, excess: float = 0.0
) -> Recording:
    """Bones believed too long by a share, give or take a random one of their own."""
    factor = 1 + excess + spread * rng.standard_normal((len(recording.joint_offsets), 1))
    return replace(recording, joint_offsets=recording.joint_offsets * factor)


def with_wrong_focal_length(recording: Recording, rng: Generator, excess: float = 0.02) -> Recording:
    """A focal length believed too long by a share."""
    camera = recording.keypoints.camera
    K = camera.K * np.array([[1 + excess], [1 + excess], [1.0]])
    K[:, 2] = camera.K[:, 2]
    return replace(recording, keypoints=replace(recording.keypoints, camera=replace(camera, K=K)))


def with_tilted_camera(recording: Recording, rng: Generator, angle_deg: float = 1.0) -> Recording:
    """A camera that is believed to look lower or higher, from the place where it is."""
    camera = recording.keypoints.camera
    R = so3.about_axis("x", np.radians(angle_deg)) @ camera.R_camera_world
    tilted = replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world)
    return replace(recording, keypoints=replace(recording.keypoints, camera=tilted))


def with_late_video(recording: Recording, rng: Generator, delay: float = 0.1) -> Recording:
    """A video that shows what was `delay` s before its time stamps, in whole frames.

    Truth and sensors keep their clock; frames that would show what was before the start are left out.
    """
    keypoints = recording.keypoints
    late = round(delay / float(np.median(np.diff(keypoints.times))))
    shown = keypoints[: len(keypoints) - late]
    return replace(recording, keypoints=replace(shown, times=keypoints.times[late:]))


def with_wrong_heading(recording: Recording, rng: Generator, angle_deg: float = 10.0) -> Recording:
    """All sensors' references believed turned about the vertical, all alike."""
    own = recording.calibration
    assert own is not None
    R = so3.about_axis("z", np.radians(angle_deg)) @ own.R_world_inertial
    return replace(recording, calibration=replace(own, R_world_inertial=R))


def with_wrong_mounting(recording: Recording, rng: Generator, sigma_deg: float = 6.0) -> Recording:
    """Each sensor believed mounted as it is not, by a random angle about each axis."""
    own = recording.calibration
    assert own is not None
    turn = so3.exp(np.radians(sigma_deg) * rng.standard_normal((len(own.sensors), 3)))
    return replace(recording, calibration=replace(own, R_sensor_bone=own.R_sensor_bone @ turn))


@dataclass(frozen=True)
class Fault:
    """Something wrong, and where in time it is looked at."""

    apply: Callable[[Recording, Generator], Recording]
    """Another recording with the same truth; equal draws give equal faults."""
    window: Callable[[Array], tuple[float, float]] | None = None
    """Times of the video -> the window before, in and after which errors are told; None for none."""
    joints: tuple[str, ...] = ()
    """Whose error is told there besides that of all joints."""


FAULTS = {
    NOMINAL: Fault(lambda recording, rng: recording),
    "10 % outliers of 80 px": Fault(with_outliers),
    "left arm and leg unseen for 1 s": Fault(with_unseen_limbs, middle_second, LEFT_LIMBS),
    "left forearm's sensor missing": Fault(without_sensor),
    "left forearm's sensor stops halfway": Fault(
        partial(with_stopped_sensors, names=("L_LowArm",)), second_after_half,
        ("LeftForeArm", "LeftHand"),
    ),
    "all sensors stop halfway": Fault(with_stopped_sensors, second_after_half, LIMBS),
    "bones wrong by 3 % at random": Fault(partial(with_wrong_bones, spread=0.03)),
    "all bones 3 % too long": Fault(partial(with_wrong_bones, excess=0.03)),
    "focal length + 2 %": Fault(with_wrong_focal_length),
    "camera tilted by 1 deg": Fault(with_tilted_camera),
    "video late by 33 ms": Fault(partial(with_late_video, delay=1 / 30)),
    "video late by 100 ms": Fault(with_late_video),
    "headings off by 10 deg": Fault(with_wrong_heading),
    "mounting off by 6 deg per axis": Fault(with_wrong_mounting),
}  # fmt: skip

# --- what is compared ----------------------------------------------------------------------------

_HUGE = 1e4
_ABLATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    NOMINAL: ("8", {}),
    "orientation of the sensors": ("8", {"sigma_swing": _HUGE, "sigma_twist": _HUGE}),
    "acceleration": ("8", {"sigma_acceleration": _HUGE}),
    "swing and twist apart: both 6 deg": ("8", {"sigma_twist": np.radians(6.0)}),
    "swing and twist apart: both 12.6 deg, their root mean square": (
        "8", {"sigma_swing": np.radians(12.6), "sigma_twist": np.radians(12.6)}
    ),
    "robust 2D": ("8", {"robust_reprojection": 1e3}),
    "refitting the root": ("8", {"refit_root": False}),
    "robust orientation": ("8", {"robust_orientation": 1e3}),
    "robust acceleration": ("8", {"robust_acceleration": 1e3}),
    "pose prior": ("8", {"prior_inflation": 1e3}),
    "jerk": ("8", {"jerk": _HUGE}),
    "torso anchor": ("8", {"sigma_torso": None}),
    "limits": ("8", {"limits": False}),
    "hinges": ("8", {"hinges": False}),
    "smoothed start": ("8", {"smooth_start_hz": _HUGE}),
    "annealing: sigma given, 5 px": ("8", {"sigma_reprojection": 5.0}),
    "annealing: sigma given, 10 px": ("8", {"sigma_reprojection": 10.0}),
    "correlation in time": ("8", {"largest_correlation_factor": 1.0}),
    f"{NOMINAL}, 4 sensors": ("4", {}),
    "limb anchor, 4 sensors": ("4", {"sigma_bone": None}),
    f"{NOMINAL}, no sensors": ("0", {}),
    "limb anchor, no sensors": ("0", {"sigma_bone": None}),
    "root anchor, no sensors": ("0", {"sigma_root": None}),
}  # fmt: skip
"""Ingredient -> sensors, and the settings that leave it out. Eight sensors sit on all limbs and leave
nothing to the limb anchor, any sensor nothing to the root anchor."""


@dataclass(frozen=True)
class Case:
    """One way to record and to solve."""

    name: str
    keypoints: str
    sensors: str
    fault: str = NOMINAL
    settings: JointSpaceSettings = field(default_factory=JointSpaceSettings)


def cases(table: str) -> list[Case]:
    """All cases of a table; those that share a recording stand together."""
    if table == "sensors":
        return [
            Case(f"{count} sensors", kind, count)
            for kind in KEYPOINTS for count in sorted({*SENSOR_SETS, "0"}, key=int)
        ]  # fmt: skip
    if table == "robustness":
        return [Case(name, "white", "8", name) for name in FAULTS]
    return [
        Case(name, kind, sensors, settings=JointSpaceSettings(**changes))
        for kind in ("white", "realistic") for name, (sensors, changes) in _ABLATIONS.items()
    ]  # fmt: skip


# --- one motion and camera -----------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One motion seen by one camera, for one table."""

    table: str
    clip: MocapClip
    camera: int
    seed: int
    lifter: str | None

    @property
    def key(self) -> str:
        """What the job is called where its rows are kept."""
        return f"{self.clip.name} {self.camera}"


@dataclass(frozen=True)
class Prepared:
    """Everything up to the fragment solver's start."""

    recording: Recording
    lifted: PoseSequence
    sf2: PoseSequence
    """Without sensors: the lifted poses with the skeleton's bone lengths."""
    bone_imus: BoneImuSequence | None
    truth: PoseSequence
    """At the times of the video."""


class Scene:
    """One motion and camera; nothing is simulated, lifted or fused twice."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._recordings: dict[str, Recording] = {}
        self._lifted: dict[str, PoseSequence] = {}
        self._prepared: dict[tuple[str, str, str], Prepared] = {}

    def prepared(self, case: Case) -> Prepared:
        """What the solver of a case starts from."""
        key = case.keypoints, case.sensors, case.fault
        if key not in self._prepared:
            self._prepared[key] = self._prepare(case)
        return self._prepared[key]

    def _prepare(self, case: Case) -> Prepared:
        recording = self._recorded(case)
        bone_imus = recording.bone_imus()
        lifted = self._lift(case.keypoints, recording)
        sf2 = InertialGuidedIK(recording.skeleton).refine(lifted, bone_imus)
        truth = recording.truth
        assert truth is not None
        first = int(np.searchsorted(truth.times, lifted.times[0] - 1e-9))
        truth = truth[first : first + len(lifted)]
        return Prepared(recording, lifted, sf2, bone_imus, truth)

    def _recorded(self, case: Case) -> Recording:
        """The recording of a case: of all sensors' recording those it has, with its fault."""
        job = self._job
        recording = self._whole(case.keypoints)
        names = SENSOR_SETS.get(case.sensors, ())
        assert recording.imus is not None
        imus = recording.imus.select(names) if names else None
        rng = np.random.default_rng(
            [job.seed, job.camera, zlib.crc32(f"{job.clip.name} {case.fault}".encode())]
        )
        return FAULTS[case.fault].apply(replace(recording, imus=imus), rng)

    def _whole(self, kind: str) -> Recording:
        if kind not in self._recordings:
            job, names = self._job, tuple(dict.fromkeys(n for s in SENSOR_SETS.values() for n in s))
            self._recordings[kind] = harness.recorded(job.clip, job.camera, kind, names, job.seed)
        return self._recordings[kind]

    def _lift(self, kind: str, recording: Recording) -> PoseSequence:
        """Lifted poses; those of the kind of 2D itself where a fault changes nothing the lifter sees."""
        whole = self._whole(kind)
        same = recording.keypoints is whole.keypoints and np.array_equal(
            recording.joint_offsets, whole.joint_offsets
        )
        if same and kind in self._lifted:
            return self._lifted[kind]
        lifter = _lifter(self._job.lifter)
        lifted = reconstruct(recording, mode="lift", lifter=lifter).stages["lift"]
        if same:
            self._lifted[kind] = lifted
        return lifted


@cache
def _lifter(path: str | None) -> Any:
    from lifting.predict import Lifter

    return Lifter.load(path)


def run(job: Job) -> list[Row]:
    """Every case of a table for one motion and camera: rows of all its stages."""
    scene, rows, told = Scene(job), [], set()
    for case in cases(job.table):
        about = {
            "motion": job.clip.name,
            "source": job.clip.name.partition("/")[0],
            "category": job.clip.category,
            "camera": job.camera,
            "keypoints": case.keypoints,
            "sensors": case.sensors,
            "case": case.name,
        }
        try:
            prepared = scene.prepared(case)
            for mode, poses in _stages_before(prepared).items():
                key = (mode, case.keypoints, case.fault, case.sensors if mode == "sf2" else None)
                if key not in told:
                    told.add(key)
                    rows.append(about | {"mode": mode} | scored(poses, prepared, case.fault))
            poses, facts = solve(prepared, case.settings)
            mode = "rto" if prepared.bone_imus is None else "rtof"
            rows.append(about | {"mode": mode} | scored(poses, prepared, case.fault) | facts)
        except RtofError as error:  # told in the table, instead of losing the other cases
            rows.append(about | {"mode": "failed", "error": str(error)})
    return rows


def _stages_before(prepared: Prepared) -> dict[str, PoseSequence]:
    truth = prepared.truth
    still = np.broadcast_to(
        so3.nearest_rotation(truth.R_world_bone.mean(axis=0)), truth.R_world_bone.shape
    )
    return {
        "zero motion": replace(motionless(truth), R_world_bone=still),
        "lift": prepared.lifted,
        "sf2": prepared.sf2,
    }


def solve(prepared: Prepared, settings: JointSpaceSettings) -> tuple[PoseSequence, Row]:
    """The joint-space solver's poses, and how it ended."""
    skeleton = prepared.recording.skeleton
    solution = FragmentSolver(skeleton, 50, settings).solve(
        prepared.sf2, prepared.recording.keypoints, prepared.bone_imus
    )
    ended = [report.status is SolverStatus.CONVERGED for report in solution.fragments]
    facts = {
        "converged": float(np.mean(ended)),
        "sigma_reprojection": float(np.median([r.sigma_reprojection for r in solution.fragments])),
    }
    return skeleton.motion(solution.poses).poses, facts


def scored(estimate: PoseSequence, prepared: Prepared, fault: str) -> Row:
    """Figures of an estimate; its root-relative error by seconds, and around what is wrong."""
    truth, skeleton = prepared.truth, prepared.recording.skeleton
    metrics = evaluate(estimate, truth, skeleton)
    torso = [skeleton.names.index(name) for name in TORSO]
    angle = so3.angle_between(estimate.R_world_bone[:, torso], truth.R_world_bone[:, torso])
    pelvis_deg, upper_trunk_deg = np.degrees(angle).mean(axis=0)
    error_mm = relative_errors_mm(estimate, truth)
    row: Row = {name: metrics[name] for name in FIGURES if name in metrics}
    row |= {
        "pelvis_deg": float(pelvis_deg),
        "upper_trunk_deg": float(upper_trunk_deg),
        "coverage": metrics["coverage"],
        "frames": len(estimate),
        "seconds_rr_mm": by_seconds(error_mm.mean(axis=1), estimate.rate_hz),
    }
    windows = FAULTS if fault == NOMINAL else {fault: FAULTS[fault]}
    row["phases"] = {
        name: around(error_mm, estimate.times, one, skeleton)
        for name, one in windows.items() if one.window is not None
    }  # fmt: skip
    return row


def relative_errors_mm(estimate: PoseSequence, truth: PoseSequence) -> Array:
    """(T, J) distance of every joint from its true place, relative to the root."""
    p, p_true = estimate.p_world_joint, truth.p_world_joint
    return np.asarray(1000 * np.linalg.norm((p - p[:, :1]) - (p_true - p_true[:, :1]), axis=-1))


def by_seconds(error: Array, rate_hz: float) -> list[list[float]]:
    """[frames, mean error] of stretches of about a second, as even as can be."""
    stretches = np.array_split(error, max(1, round(len(error) / rate_hz)))
    return [[len(stretch), float(stretch.mean())] for stretch in stretches]


def around(error: Array, times: Array, fault: Fault, skeleton: SkeletonModel) -> list[list[float]]:
    """Before, in and after a fault's window: [frames, mean error of its joints, of all joints]."""
    assert fault.window is not None
    start, stop = fault.window(times)
    own = skeleton.index(*fault.joints)
    phases = (times < start), (times >= start) & (times < stop), (times >= stop)
    return [
        [int(phase.sum()), float(error[phase][:, own].mean()), float(error[phase].mean())]
        if phase.any() else [0, 0.0, 0.0]
        for phase in phases
    ]  # fmt: skip


# --- arithmetic over rows ------------------------------------------------------------------------


def chosen(rows: Iterable[Row], **wanted: str) -> list[Row]:
    """The rows in which the fields named have these values."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def paired(rows: Sequence[Row], base: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Rows and base rows of the same motion and camera, where there are both."""
    other = {(row["motion"], row["camera"]): row for row in base}
    keys = [(row["motion"], row["camera"]) for row in rows]
    return [(row, other[key]) for row, key in zip(rows, keys, strict=True) if key in other]


def cost(rows: Sequence[Row], base: Sequence[Row], figure: str) -> tuple[float, list[float]]:
    """Mean difference of a figure, and its 95 % bootstrap interval over source motions."""
    pairs = paired(rows, base)
    values = [row[figure] - other[figure] for row, other in pairs]
    frames = [row["frames"] for row, _ in pairs]
    interval = harness.bootstrap([row["source"] for row, _ in pairs], values, frames)
    return float(np.average(values, weights=frames)), interval


def against_sf2(rows: Sequence[Row]) -> list[Row]:
    """Per motion, kind of 2D and sensors: the solver's root-relative error less that of SF2.

    The interval is the 95 % bootstrap over the motion's second-long stretches of all cameras.
    """
    found = []
    for key in dict.fromkeys((row["keypoints"], row["sensors"], row["motion"]) for row in rows):
        same = chosen(rows, **dict(zip(("keypoints", "sensors", "motion"), key, strict=True)))
        solved = [row for row in same if row["mode"] in ("rto", "rtof")]
        seconds = [
            (frames, after, before)
            for row, other in paired(solved, chosen(same, mode="sf2"))
            for (frames, after), (_, before) in zip(
                row["seconds_rr_mm"], other["seconds_rr_mm"], strict=True
            )
        ]  # fmt: skip
        if not seconds:
            continue
        frames, after, before = np.array(seconds).T
        found.append(
            {
                "keypoints": key[0], "sensors": key[1], "motion": key[2],
                "sf2": float(np.average(before, weights=frames)),
                "solved": float(np.average(after, weights=frames)),
                "difference": float(np.average(after - before, weights=frames)),
                "interval": harness.bootstrap(range(len(frames)), after - before, frames),
                "stretches": len(frames),
            }
        )  # fmt: skip
    return found


# --- tables --------------------------------------------------------------------------------------


def _figures(rows: Sequence[Row]) -> list[Cell]:
    """Cells of `FIGURES` and of the interval; empty ones where there are no rows."""
    if not rows:
        return [*(None for _ in FIGURES), "-"]
    pool = harness.pooled(rows, FIGURES, "source")
    low, high = pool["rr_interval"]
    return [*(pool[name] for name in FIGURES), f"{low:.1f}-{high:.1f}"]


_HEADINGS = (*(heading for heading, _ in FIGURES.values()), "rr 95 %")
_DIGITS = (*(digits for _, digits in FIGURES.values()), 0)
_POOLED = "Means over frames pooled over motions and cameras; intervals are 95 % bootstraps over motions."


def sensors_tables(rows: Sequence[Row]) -> list[Table]:
    """Errors by kind of 2D, sensors and stage; where the solver is worse than SF2."""
    lines: list[tuple[Cell, ...]] = []
    for kind in dict.fromkeys(row["keypoints"] for row in rows):
        same = chosen(rows, keypoints=kind)
        for mode in ("zero motion", "lift"):
            lines.append((kind, "-", mode, *_figures(chosen(same, mode=mode))))
        for count in dict.fromkeys(row["sensors"] for row in same):
            for mode in ("sf2", "rto" if count == "0" else "rtof"):
                lines.append(
                    (kind, count, mode, *_figures(chosen(same, mode=mode, sensors=count)))
                )
    main = Table(
        "sensors", "Sensors", ("2D", "sensors", "stage", *_HEADINGS), (0, 0, 0, *_DIGITS),
        tuple(lines), (_POOLED, "sf2 of no sensors: the lifted pose with the right bone lengths."),
    )  # fmt: skip
    return [main, *_check_tables(against_sf2(rows))]


def _check_tables(differences: Sequence[Row]) -> list[Table]:
    lines: list[tuple[Cell, ...]] = []
    for kind, count in dict.fromkeys((d["keypoints"], d["sensors"]) for d in differences):
        same = chosen(differences, keypoints=kind, sensors=count)
        worse = [d for d in same if d["difference"] > 0]
        beyond = [d for d in worse if d["interval"][0] > 0]
        lines.append((kind, count, str(len(same)), str(len(worse)), str(len(beyond))))
    exceptions: list[tuple[Cell, ...]] = [
        (
            d["keypoints"], d["sensors"], d["motion"], d["sf2"], d["solved"], d["difference"],
            "{:.1f} to {:.1f}".format(*d["interval"]), str(d["stretches"]),
            "yes" if d["interval"][0] > 0 else "no",
        )
        for d in differences if d["difference"] > 0
    ]  # fmt: skip
    note = (
        "Beyond: the whole 95 % interval of the difference in rr lies above 0. It is a bootstrap over "
        "the motion's second-long stretches of all cameras; those of one camera share its bias, so it "
        "is narrower than it should be and finds too many rather than too few."
    )
    return [
        Table(
            "check", "Motions on which the solver is worse than SF2",
            ("2D", "sensors", "motions", "worse", "worse beyond the interval"), (0,) * 5,
            tuple(lines), (note,),
        ),
        Table(
            "exceptions", "Every motion on which it is worse",
            ("2D", "sensors", "motion", "sf2 rr mm", "solver rr mm", "difference", "95 %",
             "stretches", "beyond"),
            (0, 0, 0, 1, 1, 1, 0, 0, 0), tuple(exceptions),
            () if exceptions else ("There is none.",),
        ),
    ]  # fmt: skip


def _costs(rows: Sequence[Row], base: Sequence[Row], figures: Sequence[str]) -> list[Cell]:
    """Differences to the base, with the interval after the first."""
    if not paired(rows, base):
        return [None, "-", *[None] * (len(figures) - 1)]
    (first, (low, high)), *others = (cost(rows, base, figure) for figure in figures)
    return [first, f"{low:.1f} to {high:.1f}", *(value for value, _ in others)]


def _converged(rows: Sequence[Row]) -> Cell:
    """Share of fragments, %."""
    return 100 * float(np.mean([row["converged"] for row in rows])) if rows else None


def robustness_tables(rows: Sequence[Row]) -> list[Table]:
    """Errors under each fault, and around those that come and go."""
    nominal = chosen(rows, case=NOMINAL)
    base = chosen(nominal, mode="rtof")
    lines: list[tuple[Cell, ...]] = [
        (f"{NOMINAL}: {mode}", *_figures(chosen(nominal, mode=mode)), None, "-", None, None, None)
        for mode in ("zero motion", "lift", "sf2")
    ]
    for name in dict.fromkeys(row["case"] for row in rows):
        solved = chosen(rows, case=name, mode="rtof")
        start = _figures(chosen(rows, case=name, mode="sf2"))[0]
        costs = _costs(solved, base, ("mpjpe_rr_mm", "mpjpe_mm"))
        lines.append((name, *_figures(solved), *costs, start, _converged(solved)))
    columns = ("rtof with", *_HEADINGS, "+ rr", "95 %", "+ abs", "sf2 rr mm", "converged %")
    digits = (0, *_DIGITS, 1, 0, 1, 1, 0)
    main = Table("robustness", "Robustness", columns, digits, tuple(lines), (_POOLED,))
    return [main, _phases_table(rows, base)]


def _phases_table(rows: Sequence[Row], base: Sequence[Row]) -> Table:
    lines: list[tuple[Cell, ...]] = []
    for name in (name for name, fault in FAULTS.items() if fault.window is not None):
        faulty = chosen(rows, case=name, mode="rtof")
        for column, joints in ((1, "affected"), (2, "all")):
            for label, some in (("faulty", faulty), (NOMINAL, base)):
                lines.append((name, label, joints, *_phases(some, name, column)))
    notes = (
        "Root-relative, mm. During: the second in which the limbs are unseen, or the first one without "
        "the sensors; short motions have nothing after that.",
        *(f"{n}, affected: {', '.join(f.joints)}." for n, f in FAULTS.items() if f.joints),
    )
    columns = ("rtof with", "recording", "joints", "before", "during", "after")
    digits = (0, 0, 0, 1, 1, 1)
    return Table("phases", "Before, during and after", columns, digits, tuple(lines), notes)


def _phases(rows: Sequence[Row], fault: str, column: int) -> Iterator[float]:
    for phase in range(3):
        parts = np.array([row["phases"][fault][phase] for row in rows]).reshape(-1, 3)
        frames = parts[:, 0].sum()
        yield float(parts[:, 0] @ parts[:, column] / frames) if frames else float("nan")


def ablation_tables(rows: Sequence[Row]) -> list[Table]:
    """What leaving each ingredient out costs."""
    figures = ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg", "mpjje")
    lines: list[tuple[Cell, ...]] = []
    for kind in dict.fromkeys(row["keypoints"] for row in rows):
        same = chosen(rows, keypoints=kind)
        for mode in ("zero motion", "lift", "sf2"):
            stage = chosen(same, mode=mode, case=NOMINAL)
            lines.append((kind, mode, *_figures(stage), None, "-", *[None] * 4))
        base: list[Row] = []
        for name in dict.fromkeys(row["case"] for row in same):
            solved = [r for r in chosen(same, case=name) if r["mode"] in ("rto", "rtof")]
            if name.startswith(NOMINAL):
                base = solved
            label = name if name.startswith(NOMINAL) else f"without {name}"
            costs = _costs(solved, base, figures)
            lines.append((kind, label, *_figures(solved), *costs, _converged(solved)))
    columns = ("2D", "rtof", *_HEADINGS, "+ rr", "95 %", "+ abs", "+ flexion", "+ MPJJE", "converged %")
    digits = (0, 0, *_DIGITS, 1, 0, 1, 1, 0, 0)
    notes = (
        _POOLED,
        "What is left out costs the difference to the nominal row above it.",
        "The start (SF2) has the sensors' orientation in every row with sensors.",
    )
    return [Table("ablation", "Ablation", columns, digits, tuple(lines), notes)]


TABLES: dict[str, Callable[[Sequence[Row]], list[Table]]] = {
    "sensors": sensors_tables,
    "robustness": robustness_tables,
    "ablation": ablation_tables,
}


def _failures(rows: Sequence[Row]) -> list[str]:
    return [
        f"FAILED: {r['motion']}, camera {r['camera']}, {r['keypoints']}, {r['case']}: {r['error']}"
        for r in chosen(rows, mode="failed")
    ]


# --- rows on disk --------------------------------------------------------------------------------


class RowFile:
    """Rows of finished jobs, one job a line, of one version of everything that makes them."""

    def __init__(self, path: Path, version: str, restart: bool = False) -> None:
        """Go on with a file, or begin it.

        Raises:
            RtofError: it was begun by another version, and is not to be thrown away.
        """
        self.path, self.rows = path, dict[str, list[Row]]()
        if path.is_file() and not restart:
            self._read(version)
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [{"version": version}, *({"job": k, "rows": v} for k, v in self.rows.items())]
        path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def _read(self, version: str) -> None:
        whole = [s for s in self.path.read_text(encoding="utf-8").splitlines(True) if s[-1] == "\n"]
        lines = [json.loads(line) for line in whole]  # an interrupted last line is no line
        if lines and lines[0].get("version") != version:
            raise RtofError(
                f"{self.path}: begun with other code, models or options; --restart throws it away"
            )
        self.rows = {line["job"]: line["rows"] for line in lines[1:]}

    def add(self, job: str, rows: list[Row]) -> None:
        """Keep the rows of a finished job."""
        self.rows[job] = rows
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"job": job, "rows": rows}) + "\n")


def version_of(*options: object) -> str:
    """Digest of the code, the models and some options that rows depend on."""
    package = Path(rtof_kin.__file__).parent
    sources = [*package.rglob("*.py"), *(HERE.parent / "lifting").rglob("*.py")]
    sources += [HERE / name for name in ("accuracy.py", "harness.py", "split.toml")]
    sources += [model_path(name) for name in ("lifter.pt", "pose_prior.npz", "skeleton.toml")]
    digest = hashlib.sha256(repr(options).encode())
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _rounded(value: Any) -> Any:
    """Six significant digits are plenty in a file."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    return [_rounded(one) for one in value] if isinstance(value, list) else value


# --- command line --------------------------------------------------------------------------------


def clips(corpus: Path, subset: str) -> list[MocapClip]:
    """The motions of a subset: at most as many seconds each as the benchmark's."""
    if subset == "test":
        return harness.test_clips(corpus)
    rows = harness.split()
    found = []
    for clip in harness.whole_clips(corpus, rows["validation"], list(VALIDATION)):
        parts = VALIDATION[clip.name]
        for i, index in enumerate(np.array_split(np.arange(len(clip.poses)), parts)):
            name = clip.name if parts == 1 else f"{clip.name}/{i + 1}"
            part = replace(clip, name=name, poses=clip.poses[index[0] : index[-1] + 1])
            found.append(harness.middle(part, rows["benchmark"]["seconds"]))
    return found


def jobs(table: str, motions: Sequence[MocapClip], options: argparse.Namespace) -> list[Job]:
    """Of the first table all cameras of every motion, of the others one, in turn."""
    chosen_motions = options.motions.split(",") if options.motions else None
    return [
        Job(table, clip, camera, options.seed, options.lifter)
        for i, clip in enumerate(motions)
        if chosen_motions is None or clip.name in chosen_motions
        for camera in (range(options.cameras) if table == "sensors" else [i % 4])
    ]


def measure(table: str, work: Sequence[Job], kept: RowFile, workers: int) -> list[Row]:
    """Rows of all jobs in their order; those done earlier are taken from the file."""
    left = [job for job in work if job.key not in kept.rows]
    with Progress() as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add_task(table, total=len(work), completed=len(work) - len(left))
        futures = {pool.submit(run, job): job for job in left}
        try:
            for future in as_completed(futures):
                kept.add(futures[future].key, _rounded(future.result()))
                progress.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [row for job in work for row in kept.rows[job.key]]


def write(out: Path, tables: Sequence[Table], facts: Row, rows: Sequence[Row]) -> str:
    """Write the JSON, a line a row, and the Markdown beside it; the Markdown."""
    text = "\n".join([*(table.markdown() for table in tables), *_failures(rows)])
    content = facts | {"tables": _rounded({t.name: t.as_dict() for t in tables})}
    body = json.dumps(content, indent=1)[:-2]
    lines = ",\n".join("  " + json.dumps(row) for row in rows)
    out.with_suffix(".json").write_text(f'{body},\n "rows": [\n{lines}\n ]\n}}\n', encoding="utf-8")
    out.with_suffix(".md").write_text(text.rstrip() + "\n", encoding="utf-8")
    return text


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    options = _parser().parse_args(arguments)
    motions = clips(options.corpus, options.subset)
    wanted = set(options.motions.split(",")) if options.motions else set()
    if unknown := wanted - {clip.name for clip in motions}:
        names = ", ".join(clip.name for clip in motions)
        sys.exit(f"error: no motion {', '.join(sorted(unknown))}; there are {names}")
    for table in options.tables.split(","):
        if table not in TABLES:
            sys.exit(f"error: no table {table}; there are {', '.join(TABLES)}")
        name = f"accuracy_{table}" + (f"_{options.subset}" if options.subset != "test" else "")
        out = options.out / (name + ("_some" if options.motions or options.cameras != 4 else ""))
        work = jobs(table, motions, options)
        version = version_of(table, [job.key for job in work], options.seed, options.lifter)
        try:
            kept = RowFile(out.with_suffix(".jsonl"), version, options.restart)
        except RtofError as error:
            sys.exit(f"error: {error}")
        rows = measure(table, work, kept, options.workers)
        facts = {
            "command": _command(sys.argv[1:] if arguments is None else arguments, options),
            "version": version, "seed": options.seed, "subset": options.subset,
        }  # fmt: skip
        print(write(out, TABLES[table](rows), facts, rows))
        kept.path.unlink()
    return 0


def _command(arguments: Sequence[str], options: argparse.Namespace) -> str:
    """The command without the places of one machine."""
    places = {str(options.corpus): "DIR", str(options.out): "FOLDER", options.lifter: "FILE"}
    parts = [option.partition("=") for option in arguments]
    words = [places.get(a, a) + equals + places.get(b, b) for a, equals, b in parts]
    return " ".join(["python -m benchmarks.accuracy", *words])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accuracy", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--tables", default=",".join(TABLES), help="separated by commas")
    parser.add_argument("--subset", default="test", choices=("test", "validation"))
    parser.add_argument("--motions", help="only these, separated by commas")
    parser.add_argument(
        "--cameras", type=int, default=4, choices=range(1, 5), help="a motion, in the table of sensors"
    )
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the results")
    return parser


if __name__ == "__main__":
    sys.exit(main())
