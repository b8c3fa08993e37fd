"""Steps of every protocol: jobs, reconstruct a recording in several modes, save the motions, draw the errors."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

import rtof_kin
from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.jobs import JobResult, Outcome, Progress, open_runs, run_jobs
from rtof_kin.core.resources import lifter_path
from rtof_kin.protocols.tables import NAME, Table, rows_of
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.document import ESTIMATE, TRUTH, Document, Figure, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

NAMES: Final = {"lift": "baseline (lift)", "sf2": "sf2", "rto": "rto", "rtof": "rtof"}  #: Modes, as figures call them
_SNAPSHOTS: Final = 5
STAGE_COLORS: Final = {"lift": "#8c8c8c", "sf2": "#e69f00", "rto": "#0072b2", "rtof": ESTIMATE}


class CameraProtocol(ABC):
    """Settings of a protocol whose jobs are takes seen by a camera: dataclasses with ``modes`` and ``save``."""

    title: ClassVar[str]
    rate_hz: ClassVar[float]
    skeleton: ClassVar[str]  #: Name of its table
    root: Path
    modes: tuple[str, ...]
    save: Path | None

    @abstractmethod
    def tables(self, outcome: Outcome) -> list[Table]:
        """Return all tables of which something was measured."""

    @abstractmethod
    def jobs(self) -> dict[str, Job]:
        """Return all jobs by key; raises `FileFormatError` without a data set."""

    @abstractmethod
    def measure(self, job: Job) -> JobResult:
        """Run one job."""

    def settings(self) -> dict[str, Any]:
        """Return everything that the results depend on, as plain values."""
        return {"dataset": str(self.root.resolve())} | plain_settings(self, "root", "save")

    def document(self, outcome: Outcome) -> Document:
        """Return the tables, with figures of two takes."""
        measured = sum(facts["camera"] is not None for facts in outcome.done.values())
        failed = f", {len(outcome.failed)} FAILED" if outcome.failed else ""
        tables = self.tables(outcome)
        facts = {"settings": self.settings(), "rows": list(rows_of(outcome)), "failed": outcome.failed}
        return Document(
            NAME,
            self.title,
            f"{self.title}: {measured} recordings measured{failed}.",
            printed=tables,
            figures=figures(outcome, SkeletonModel.named(self.skeleton).table, self.rate_hz),
            facts=facts | {"tables": {table.name: table.as_dict() for table in tables}},
        )

    def run(
        self, folder: Path, *, overwrite: bool = False, workers: int | None = None, progress: Progress | None = None
    ) -> Outcome:
        """Run the jobs that have no result yet, see `rtof_kin.protocols.run`."""
        jobs = self.jobs()
        files = {key: {mode: job.motion_file(mode) for mode in self.modes} for key, job in jobs.items()}
        runs = open_runs(folder, self.settings(), overwrite, self.save, files)
        return run_jobs(measure, jobs, runs, workers, progress)


@dataclass(frozen=True)
class Job:
    """One take of a protocol seen by one camera, or without a camera."""

    protocol: CameraProtocol
    subject: str
    take: str
    camera: int | None

    @property
    def name(self) -> str:
        """Subject, take and camera in words."""
        return f"{self.subject} {self.take}" + (f" camera {self.camera}" if self.camera is not None else "")

    def motion_file(self, mode: str) -> Path | None:
        """Return the path of a saved motion, or None if motions are not saved."""
        save = self.protocol.save
        if save is None or self.camera is None:
            return None
        return save / self.subject / self.take / f"cam{self.camera}" / mode / "motion.h5"


def measure(job: Job) -> JobResult:
    """Run one job, in any process."""
    return job.protocol.measure(job)


def reconstructions(
    recording: Recording,
    modes: Iterable[str],
    lifter: Path | None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool = False,
) -> dict[str, Reconstruction]:
    """Return, for every mode in the order of `CAMERA_MODES`, a reconstruction with it among its stages.

    Modes that need sensors are omitted for a recording without them. Mode *lift* uses the image only, not the lifter
    with sensors of the other modes.
    """
    from lifting.predict import Lifter

    network = Lifter.load(lifter)
    asked = set(modes) - ({"sf2", "rtof"} if recording.imus is None else set())
    runs: dict[str, Reconstruction] = {}
    for mode in ("rtof", "sf2", "rto", "lift"):
        if mode in asked and mode not in runs:
            result = reconstruct(recording, mode=mode, lifter=network, settings=settings, calibrate=calibrate)
            own = [stage for stage in result.stages if stage != "lift" or result.bone_imus is None]
            runs |= {stage: result for stage in own if stage not in runs}
    return {mode: runs[mode] for mode in CAMERA_MODES if mode in asked}


def curves(recording: Recording, results: Mapping[str, Reconstruction], knee: str) -> dict[str, Array]:
    """Return errors over time by mode, see `reconstructions`, and poses at a few instants."""
    truth = recording.truth
    assert truth is not None
    frames = np.linspace(0, len(truth) - 1, _SNAPSHOTS + 2).round().astype(int)[1:-1]
    arrays: dict[str, Array] = {
        "R_camera_world": recording.video.camera.R_camera_world,
        "snapshot_frames": frames.astype(float),
        "snapshot_truth": truth.p_world_joint[frames],
    }
    for mode, result in results.items():
        over_time = result.stage_metrics[mode].over_time
        arrays[f"{mode}_rr_mm"] = over_time["mpjpe_rr_mm"]
        arrays[f"{mode}_knee_deg"] = over_time["joint_flexion_deg"][:, truth.names.index(knee)]
        arrays[f"{mode}_snapshots"] = result.stages[mode].p_world_joint[frames]
    return arrays


def save_motion(result: Reconstruction, mode: str, path: Path | None) -> None:
    """Write the motion of one stage to a file; None writes nothing."""
    if path is None:
        return
    motion = result.motion if mode == result.mode else result.motion.skeleton.motion(result.stages[mode])
    write_motion(path, motion, first_frame=result.recording.first_frame, mode=mode)


def plain_settings(protocol: Any, *without: str) -> dict[str, Any]:
    """Return the fields of a protocol as plain values, with the lifter's weights and the version, but without
    those that results do not depend on.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, Path):
            return str(value.resolve())
        return list(value) if isinstance(value, tuple) else dict(value) if isinstance(value, Mapping) else value

    own = {f.name: plain(getattr(protocol, f.name)) for f in fields(protocol) if f.name not in ("lifter", *without)}
    weights = hashlib.sha256(lifter_path(protocol.lifter).read_bytes()).hexdigest()
    return {"lifter_sha256": weights, "version": rtof_kin.__version__} | own


# --- figures -------------------------------------------------------------------------------------


def figures(outcome: Outcome, table: SkeletonTable, rate_hz: float) -> list[Figure]:
    """Return the figures of a protocol; none if no job has curves."""
    if not (keys := _characters(outcome)):
        return []
    curves_of, skeletons = "Joint error and error of the right knee over time", "Skeletons over the truth"
    return [
        Figure("figures/error_curves", curves_of, lambda: error_curves(outcome, keys, rate_hz)),
        Figure("figures/skeletons", skeletons, lambda: _skeletons(outcome, keys[-1], table.parents, rate_hz)),
    ]


def _characters(outcome: Outcome) -> list[str]:
    """Return jobs of the takes with the least and the most motion, by the acceleration error of no motion."""
    first: dict[tuple[str, str], str] = {}
    lively: dict[tuple[str, str], float] = {}
    for key, facts in outcome.done.items():
        take = (facts["subject"], facts["take"])
        if facts["camera"] is not None:
            if set(NAMES) & set(facts["methods"]):
                first.setdefault(take, key)
        elif "no motion" in facts["methods"]:
            lively[take] = facts["methods"]["no motion"]["mpjae"]
    takes = sorted(first, key=lambda take: lively.get(take, 0.0))
    return [first[take] for take in dict.fromkeys([takes[0], takes[-1]])] if takes else []


def error_curves(outcome: Outcome, keys: Sequence[str], rate_hz: float) -> Plot:
    """Plot joint error (left) and the error of the right knee's flexion (right) over time, one row a job."""
    figure, axes = subplots(len(keys), 2, (13, 3.4 * len(keys)))
    columns = {"rr_mm": "joint error, root-relative [mm]", "knee_deg": "right knee flexion error [deg]"}
    for row, key in zip(axes, keys, strict=True):
        arrays = outcome.arrays(key)
        for ax, (suffix, label) in zip(row, columns.items(), strict=True):
            best = [mode for mode in ("rtof", "rto", "sf2") if f"{mode}_{suffix}" in arrays][:1]
            for mode in (["lift"] if f"lift_{suffix}" in arrays else []) + best:
                curve = arrays[f"{mode}_{suffix}"]
                text, times = f"{NAMES[mode]}: mean {np.nanmean(curve):.1f}", np.arange(len(curve)) / rate_hz
                ax.plot(times, curve, color=STAGE_COLORS[mode], lw=0.9, label=text)
            ax.set_title(_where(outcome, key), fontsize=10)
            ax.set(xlabel="time [s]", ylabel=label)
            ax.set_ylim(bottom=0)
            ax.grid(alpha=0.3)
            ax.legend(loc="upper right", fontsize=8)
    return figure


def _where(outcome: Outcome, key: str) -> str:
    facts = outcome.done[key]
    return f"{facts['subject']} {facts['take']}, camera {facts['camera']}"


def _skeletons(outcome: Outcome, key: str, parents: Sequence[int], rate_hz: float) -> Plot:
    """Plot each mode's skeleton over the truth (green) at a few instants, seen from the camera's right."""
    arrays = outcome.arrays(key)
    view, label = views(arrays["R_camera_world"])[1]
    modes = [mode for mode in NAMES if f"{mode}_snapshots" in arrays]
    frames, truth = arrays["snapshot_frames"], arrays["snapshot_truth"]
    figure, axes = subplots(len(modes), len(frames), (2.6 * len(frames), 2.9 * len(modes)))
    for row, mode in zip(axes, modes, strict=True):
        for ax, frame, *both in zip(row, frames, truth, arrays[f"{mode}_snapshots"], strict=True):
            for points, color in zip(both, (TRUTH, STAGE_COLORS[mode]), strict=True):
                plot_skeleton(ax, (points - points[0]) @ view.T, parents, color)
            up = f"{NAMES[mode]}\nup [m]" if ax is row[0] else ""
            ax.set(aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.2, 1.0), xlabel=f"{label} [m]", ylabel=up)
            ax.set_title(f"{frame / rate_hz:.1f} s", fontsize=9)
    figure.suptitle(f"{_where(outcome, key)}: estimate over the truth (green), roots together")
    return figure


def views(R_camera_world: Array) -> list[tuple[Array, str]]:
    """Return the projections (2, 3) of a camera's view (3, 3) and of the view from its right, with axis labels."""
    R = R_camera_world
    looks_down = np.hypot(*R[2, :2]) < 0.1  # then the top of the image is ahead
    forward = -R[1] if looks_down else R[2].copy()
    forward[2] = 0.0
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    return [(np.stack([right, up]), "right"), (np.stack([forward, up]), "away from camera")]


def plot_skeleton(ax: Any, points: Array, parents: Sequence[int], color: str, label: str | None = None) -> None:
    """Draw the bones between joints (J, 2)."""
    for child, parent in enumerate(parents):
        if parent >= 0:
            x, y = points[[parent, child]].T
            ax.plot(x, y, color=color, lw=2, alpha=0.85, label=label if child == 1 else None)
