"""Rows: every case of a table for one motion and camera, at all its stages."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.accuracy.cases import Case, cases
from benchmarks.accuracy.faults import FAULTS, NOMINAL, Fault
from benchmarks.accuracy.windows import bounds
from benchmarks.harness import SENSOR_SETS
from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import RtofError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver, SolverStatus
from rtof_kin.solve.initial_guess import InertialGuidedIK
from rtof_kin.solve.joint_space.terms import TORSO
from rtof_kin.solve.settings import JointSpaceSettings

Row = dict[str, Any]
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
        """Name of the job in the file of rows."""
        return f"{self.clip.name} {self.camera}"


@dataclass(frozen=True)
class Prepared:
    """Everything up to the fragment solver's start."""

    recording: Recording
    keypoints: KeypointSequence
    """Keypoints as they are used, evenly spaced."""
    lifted: PoseSequence
    sf2: PoseSequence
    """Without sensors: the lifted poses with the skeleton's bone lengths."""
    bone_imus: BoneImuSequence | None
    truth: PoseSequence
    """At the times of the video."""
    solution: FragmentSolution | None = None
    """The pipeline's own, with its settings, in the table of faults."""
    found: tuple[StreamFault, ...] = ()
    """Faults found by the pipeline."""


class Scene:
    """One motion and camera; nothing is simulated, lifted or fused twice."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._recordings: dict[str, Recording] = {}
        self._prepared: dict[tuple[str, str, str, bool, bool], Prepared] = {}

    def prepared(self, case: Case) -> Prepared:
        """Prepare the input of the solver of a case."""
        key = case.keypoints, case.sensors, case.fault, case.lift_with_sensors, case.as_given
        if key not in self._prepared:
            self._prepared[key] = self._prepare(case)
        return self._prepared[key]

    def _prepare(self, case: Case) -> Prepared:
        recording = self._recorded(case)
        lifter = harness.lifter(self._job.lifter)
        # Sensors that disagree are found by solving.
        inertial = "rtof" if self._job.table == "robustness" else "sf2"
        mode = "lift" if recording.imus is None else inertial
        settings = ReconstructionSettings(lift_with_sensors=case.lift_with_sensors)
        result = reconstruct(recording, mode=mode, lifter=lifter, settings=settings, calibrate=not case.as_given)
        lifted = result.stages["lift"]
        ik = InertialGuidedIK(recording.skeleton)
        sf2 = result.stages.get("sf2") or ik.refine(lifted, None, lifted.R_world_bone)
        truth = recording.truth
        assert truth is not None
        assert result.keypoints is not None
        return Prepared(
            recording,
            result.keypoints,
            lifted,
            sf2,
            result.bone_imus,
            at(truth, lifted.times),
            result.solution,
            result.faults,
        )

    def _recorded(self, case: Case) -> Recording:
        """The recording of a case: of all sensors' recording those it has, with its fault."""
        job = self._job
        recording = self._whole(case.keypoints)
        names = SENSOR_SETS.get(case.sensors, ())
        assert recording.imus is not None
        imus = recording.imus.select(names) if names else None
        rng = np.random.default_rng([job.seed, job.camera, zlib.crc32(f"{job.clip.name} {case.fault}".encode())])
        return FAULTS[case.fault].apply(replace(recording, imus=imus), rng)

    def _whole(self, kind: str) -> Recording:
        if kind not in self._recordings:
            job, names = self._job, tuple(dict.fromkeys(n for s in SENSOR_SETS.values() for n in s))
            self._recordings[kind] = harness.recorded(job.clip, job.camera, kind, names, job.seed)
        return self._recordings[kind]


def run(job: Job) -> list[Row]:
    """Every case of a table for one motion and camera: rows of all its stages."""
    scene, rows, reported = Scene(job), [], set()
    for case in cases(job.table):
        about = {
            "motion": job.clip.name,
            "source": job.clip.name.partition("-")[0],
            "category": job.clip.category,
            "camera": job.camera,
            "keypoints": case.keypoints,
            "sensors": case.sensors,
            "case": case.name,
        }
        try:
            prepared = scene.prepared(case)
            for mode, poses in ({} if case.as_given else stages(prepared)).items():
                sensors = None if mode == "zero motion" else case.sensors
                key = (mode, case.keypoints, case.fault, sensors, case.lift_with_sensors)
                if key not in reported:
                    reported.add(key)
                    rows.append(about | {"mode": mode} | scored(poses, prepared, case.fault))
            poses, facts = solved(prepared, case.settings)
            mode = "rto" if prepared.bone_imus is None else "rtof"
            if case.as_given and job.table == "sensors":
                mode = "rtof, as given"
            rows.append(about | {"mode": mode} | scored(poses, prepared, case.fault) | facts)
        except RtofError as error:  # reported in the table, instead of losing the other cases
            rows.append(about | {"mode": "failed", "error": str(error)})
    return rows


def at(truth: PoseSequence, times: Array) -> PoseSequence:
    """The truth at other times, which a delay may put some milliseconds beyond its ends."""
    inside = np.clip(times, truth.times[0], truth.times[-1])
    return PoseSequence(
        times,
        signals.interpolate(truth.times, truth.p_world_joint, inside),
        signals.interpolate_rotations(truth.times, truth.R_world_bone, inside),
        truth.names,
    )


def stages(prepared: Prepared) -> dict[str, PoseSequence]:
    """Results of the earlier stages and of zero motion."""
    return {"zero motion": motionless(prepared.truth), "lift": prepared.lifted, "sf2": prepared.sf2}


def solved(prepared: Prepared, settings: JointSpaceSettings) -> tuple[PoseSequence, Row]:
    """The joint-space solver's poses, and how it ended."""
    skeleton, solution = prepared.recording.skeleton, prepared.solution
    if solution is None:
        solution = FragmentSolver(skeleton, 50, settings).solve(prepared.sf2, prepared.keypoints, prepared.bone_imus)
    reports = solution.fragments
    facts = {
        "converged": float(np.mean([r.status is SolverStatus.CONVERGED for r in reports])),
        "sigma_reprojection": float(np.median([r.sigma_reprojection for r in reports])),
        "found": [str(fault) for fault in prepared.found],
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
        name: around(error_mm, estimate.times, one, skeleton) for name, one in windows.items() if one.window is not None
    }
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
    start, stop = bounds(times, fault.window)
    own = skeleton.index(*fault.joints)
    phases = (times < start), (times >= start) & (times < stop), (times >= stop)
    return [
        [int(phase.sum()), float(error[phase][:, own].mean()), float(error[phase].mean())]
        if phase.any()
        else [0, 0.0, 0.0]
        for phase in phases
    ]
