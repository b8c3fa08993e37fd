"""The paper's protocol on Total Capture.

A job is one take seen by one camera: all modes, and the studies of fragment length and k_V. One more job per
take scores what needs no camera (no motion, and the truth low-passed at 6 Hz) and checks the take's files.
`rtof_kin.protocols.total_capture_tables` makes the tables.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np

from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.choices import CAMERA_MODES, SPACES, Space
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.jobs import JobResult, Outcome, Progress, open_runs, run_jobs
from rtof_kin.core.resources import lifter_path
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.detections import read_detections
from rtof_kin.datasets.total_capture import SUBJECTS, TEST, TRAIN, Take, TotalCapture
from rtof_kin.datasets.total_capture_checks import check_camera, check_keypoints, check_take
from rtof_kin.protocols.jobs import Job
from rtof_kin.protocols.measures import curves, provenance, reconstructions, save_motion
from rtof_kin.protocols.published import FRAGMENT_LENGTH, VISUAL_WEIGHT
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.files import RECOGNISE
from rtof_kin.simulation.simulate import LIMB_SENSORS
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.vision.layouts import detector_table

TEST_TAKES = ("walking2", "acting3", "freestyle3")
CAMERAS = (1, 3, 4, 5, 6, 7, 8)
"""All cameras but the miscalibrated camera 2."""
SENSOR_SETS = {
    "8": LIMB_SENSORS,
    "10": (*LIMB_SENSORS, "Pelvis", "Sternum"),
    "13": (*LIMB_SENSORS, "Pelvis", "Sternum", "Head", "L_Foot", "R_Foot"),
}
"""Sets of sensors: the paper's eight on the limbs, with the trunk, all."""
SIXTEEN = (
    "Hips",
    "RightUpLeg",
    "RightLeg",
    "RightFoot",
    "LeftUpLeg",
    "LeftLeg",
    "LeftFoot",
    "Spine",
    "Neck",
    "Head",
    "LeftArm",
    "LeftForeArm",
    "LeftHand",
    "RightArm",
    "RightForeArm",
    "RightHand",
)
"""Joints of the multi-view papers (GeoFuse and those after it)."""
SIXTEEN_CAMERAS, SIXTEEN_STEP = (1, 3, 5, 7), 16
"""Cameras of the multi-view papers, and their step between scored frames."""
_LOW_PASS_HZ: Final = 6.0
STILL, LOW_PASSED = "no motion", f"truth low-passed at {_LOW_PASS_HZ:g} Hz"
"""Names of the calibration rows."""
_KNEE: Final = "RightLeg"


@dataclass(frozen=True)
class TotalCaptureProtocol:
    """Settings of the measurements."""

    root: Path
    """Folder of the dataset."""
    subjects: tuple[str, ...] = SUBJECTS
    """Subjects that are measured."""
    takes: tuple[str, ...] = TEST_TAKES
    """Takes of each subject; default: the paper's three test takes."""
    cameras: tuple[int, ...] = CAMERAS
    """Numbers of the cameras; camera 2 is miscalibrated."""
    keypoints: Path | None = None
    """Folder with a detector's 2D; default: ground-truth 2D."""
    layout: str | None = None
    """Layout of the detector's points, such as body25, coco17 or mediapipe33, or auto to have it recognised; default:
    landmarks of the skeleton."""
    noise_px: float = 0.0
    """Standard deviation of white noise added to ground-truth 2D, px per axis."""
    sensors: tuple[str, ...] = LIMB_SENSORS
    """IMUs that are used."""
    space: Space = SPACES[0]
    """Variables of the fragment solver; the studies use those of the paper."""
    modes: tuple[str, ...] = CAMERA_MODES
    """Stages to measure."""
    lifter: Path | None = None
    """A file, or the name of a shipped one; the shipped default where not given."""
    calibrate: bool = False
    """Whether every take is self-calibrated first; the paper does not."""
    posture: bool = True
    """Whether the subject's neutral posture is taken from the take's first T-pose, as bone lengths are."""
    studies: bool = True
    """Whether fragment length and k_V are varied too."""
    seed: int = 0
    """Seed of the noise."""
    save: Path | None = None
    """Folder for the motions of every take, camera and mode, if wanted."""

    def __post_init__(self) -> None:
        for name in ("subjects", "takes", "cameras", "modes"):
            if not getattr(self, name):
                raise InvalidInputError(f"{name}: none are named, so there is nothing to measure")
        indices_of("subject", self.subjects, SUBJECTS)
        indices_of("take", self.takes, sorted({take for _, take in (*TRAIN, *TEST)}))
        indices_of("mode", self.modes, CAMERA_MODES)
        indices_of("space", [self.space], SPACES)
        indices_of("sensor", self.sensors, list(SkeletonModel.default().sensors))
        indices_of("camera", [str(c) for c in self.cameras], [str(c) for c in range(1, 9)])
        if not self.sensors and {"sf2", "rtof"} & set(self.modes):
            raise InvalidInputError("modes sf2 and rtof need sensors; name some, or only lift and rto")
        if self.keypoints is not None and self.noise_px:
            raise InvalidInputError("noise is added to ground-truth 2D only, not to a detector's")
        if not 0 <= self.noise_px < np.inf:
            raise InvalidInputError(f"noise_px: {self.noise_px:g} is not a standard deviation")
        if self.seed < 0:
            raise InvalidInputError(f"seed: {self.seed} is negative")
        if self.keypoints is not None and not self.keypoints.is_dir():
            raise FileFormatError(self.keypoints, "there is no such folder of detections")
        lifter_path(self.lifter)
        if self.layout is not None:
            indices_of("layout", [self.layout], (RECOGNISE, *detector_table().layouts))
            if self.keypoints is None:
                raise InvalidInputError("layout is that of a detector's points; name their folder as keypoints")

    def settings(self) -> dict[str, Any]:
        """Return everything that the results depend on, as plain values."""
        return provenance(self.lifter) | {
            "dataset": str(self.root.resolve()),
            "subjects": list(self.subjects),
            "takes": list(self.takes),
            "cameras": list(self.cameras),
            "keypoints": str(self.keypoints.resolve()) if self.keypoints else "ground truth",
            "layout": self.layout,
            "noise_px": self.noise_px,
            "sensors": list(self.sensors),
            "space": self.space,
            "modes": list(self.modes),
            "calibrate": self.calibrate,
            "posture": self.posture,
            "studies": self.studies,
            "seed": self.seed,
        }

    def jobs(self) -> dict[str, Job]:
        """Return all jobs by key, take by take."""
        return {
            f"{subject}_{take}" + (f"_cam{camera}" if camera else ""): Job(self, subject, take, camera)
            for subject, take in self.pairs()
            for camera in (None, *self.cameras)
        }

    def pairs(self) -> list[tuple[str, str]]:
        """Return subject and name of every take."""
        return [(subject, take) for subject in self.subjects for take in self.takes]


def run(
    protocol: TotalCaptureProtocol,
    folder: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Run the jobs that have no result yet.

    Args:
        folder: for the results; a run of the same settings is resumed.
        overwrite: whether results of other settings may be replaced. workers, progress: see `run_jobs`.

    Raises:
        FileFormatError: there is no such dataset. OutputExistsError: see `open_runs`.
    """
    TotalCapture(protocol.root)  # fails early without a dataset
    jobs = protocol.jobs()
    files = {key: {mode: job.motion_file(mode) for mode in protocol.modes} for key, job in jobs.items()}
    runs = open_runs(folder, protocol.settings(), overwrite, protocol.save, files)
    return run_jobs(measure, jobs, runs, workers, progress)


def measure(job: Job) -> JobResult:
    """Run one job.

    Args:
        job: one take seen by one camera, or without a camera.
    """
    take = _take(job.protocol.root, job.subject, job.take)
    return _reference(take) if job.camera is None else _seen_by(take, job, job.camera)


@lru_cache(maxsize=1)
def _take(root: Path, subject: str, name: str) -> Take:
    """Read a take; jobs are ordered by take, so one is cached."""
    return TotalCapture(root).take(subject, name)


def _reference(take: Take) -> JobResult:
    """Score the calibration rows and check the files of a take."""
    truth, skeleton = take.truth, take.skeleton
    smooth = signals.low_pass(_without_glitches(truth), truth.rate_hz, _LOW_PASS_HZ)
    low_passed = _scores(replace(truth, p_world_joint=smooth), truth, skeleton)
    rows = {
        STILL: _scores(motionless(truth), truth, skeleton),
        LOW_PASSED: low_passed | {"angle_deg": None},  # its orientations are the truth's own
    }
    failed = [check.message for check in check_take(take) if not check.passed]
    return JobResult(
        {
            "subject": take.subject,
            "take": take.name,
            "camera": None,
            "methods": rows,
            "failed_checks": failed,
            "notes": [*take.notes, *take.missing],
        }
    )


def _without_glitches(truth: PoseSequence) -> Array:
    """Return positions (T, J, 3) m, interpolated where invalid, as a filter would spread glitches."""
    p = np.array(truth.p_world_joint)
    for j, valid in enumerate(truth.valid.T):
        for i in range(3 if valid.any() else 0):
            p[:, j, i] = np.interp(truth.times, truth.times[valid], p[valid, j, i])
    return p


def _seen_by(take: Take, job: Job, number: int) -> JobResult:
    protocol, notes = job.protocol, []
    absent = [s for s in protocol.sensors if take.imus is None or s not in take.imus.names]
    if absent and {"sf2", "rtof"} & set(protocol.modes):
        notes.append(f"sf2 and rtof are left out, without the sensors {', '.join(absent)}")
    recording = take.recording(
        number,
        keypoints=_detected(take, job, number),
        noise_px=protocol.noise_px,
        seed=protocol.seed,
        sensors=() if absent else protocol.sensors,
        posture=protocol.posture,
    )
    truth, skeleton = recording.truth, recording.skeleton
    assert truth is not None
    settings = ReconstructionSettings(fragment=None if protocol.space == "joint" else CartesianSettings())
    results = reconstructions(recording, protocol.modes, protocol.lifter, settings, protocol.calibrate)
    notes += sorted({warning for result in results.values() for warning in result.warnings})
    methods: dict[str, Any] = {}
    for mode, result in results.items():
        methods[mode] = _scores(result.stages[mode], truth, skeleton)
        save_motion(result, mode, job.motion_file(mode))
    if protocol.studies and "rtof" in results:
        methods |= _studies(results["rtof"], truth)
    checks = check_camera(number)
    if protocol.keypoints is not None:
        checks += check_keypoints(take, number, recording.video)
    failed = [check.message for check in checks if not check.passed]
    return JobResult(
        {
            "subject": take.subject,
            "take": take.name,
            "camera": number,
            "methods": methods,
            "failed_checks": failed,
            "notes": notes,
        },
        curves(recording, results, _KNEE),
    )


def _detected(take: Take, job: Job, number: int) -> KeypointSequence | None:
    folder = job.protocol.keypoints
    if folder is None:
        return None
    camera, layout = take.cameras[number], job.protocol.layout
    return read_detections(folder, job.subject, job.take, number, camera, layout=layout)


def _studies(result: Reconstruction, truth: PoseSequence) -> dict[str, dict[str, Any]]:
    """Solve the energy of the paper from SF2's poses with other fragment lengths and weights k_V."""
    printed = CartesianSettings.paper()
    variants = {length_name(N): (N, printed) for N in FRAGMENT_LENGTH}
    for k_V in VISUAL_WEIGHT:
        if k_V != printed.k_V:
            variants[weight_name(k_V)] = (50, replace(printed, k_V=k_V, k_I=round(1 - k_V, 6)))
    rows = {}
    skeleton = result.motion.skeleton
    for name, (N, settings) in variants.items():
        solver = FragmentSolver(skeleton, N, settings)
        began = perf_counter()
        solution = solver.solve(result.stages["sf2"], result.keypoints, result.bone_imus)
        rows[name] = _scores(solution.poses, truth, skeleton) | {"seconds": perf_counter() - began}
    return rows


def length_name(N: int) -> str:
    """Return the name of the method with the energy of the paper and fragments of N frames."""
    return f"as printed, N = {N}"


def weight_name(k_V: float) -> str:
    """Return the name of the method with the energy of the paper and another visual weight."""
    return length_name(50) if k_V == CartesianSettings.paper().k_V else f"as printed, k_V = {k_V:g}"


def _scores(estimate: PoseSequence, truth: PoseSequence, skeleton: SkeletonModel) -> dict[str, Any]:
    """Return every figure, the number of scored frames, and the error of the multi-view papers."""
    metrics = evaluate(estimate, truth, skeleton)
    error = metrics.over_time["joint_mm"]
    sixteen = error[::SIXTEEN_STEP, skeleton.index(*SIXTEEN)]
    scored = np.isfinite(sixteen).all(axis=1)
    return dict(metrics) | {
        "frames": int(np.isfinite(error).all(axis=1).sum()),
        "sixteen_mm": float(sixteen[scored].mean()) if scored.any() else None,
        "sixteen_frames": int(scored.sum()),
    }
