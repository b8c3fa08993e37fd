"""What every protocol does with a recording: reconstruct it in several modes, score, keep the motions."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.resources import lifter_path
from rtof_kin.formats.motion_npz import write_motion_npz
from rtof_kin.protocols.jobs import Outcome
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
_SNAPSHOTS = 5


def reconstructions(
    recording: Recording,
    modes: Iterable[str],
    lifter: Path | None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool = False,
) -> dict[str, Reconstruction]:
    """For every mode, in the order of `CAMERA_MODES`, a reconstruction that has it among its stages.

    Modes that need sensors are left out where the recording has none. *lift* is that of the image alone,
    not the lifter of those modes, which is told the sensors.

    Args:
        lifter: checkpoint; the shipped one where not given. settings: of the stages after it.
        calibrate: whether recordings are calibrated from themselves, where the mode has sensors; the
            papers take every calibration as it is given.
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
    """What `rtof_kin.protocols.pictures` draws: errors over time, and poses at a few instants.

    Args:
        results: by mode, see `reconstructions`. knee: the joint whose flexion is drawn.
    """
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
    """Write one stage's motion to a file; nothing without a path."""
    if path is None:
        return
    motion = result.motion if mode == result.mode else result.motion.skeleton.motion(result.stages[mode])
    write_motion_npz(path, motion, first_frame=result.recording.first_frame, mode=mode)


def provenance(lifter: str | Path | None) -> dict[str, Any]:
    """What results depend on besides a protocol's settings: the lifter's weights, the version."""
    return {
        "lifter_sha256": hashlib.sha256(lifter_path(lifter).read_bytes()).hexdigest(),
        "version": _version(),
    }


def _version() -> str:
    try:
        return version("rtof_kin")
    except PackageNotFoundError:  # a clone that was not installed
        return "0+unknown"


def rows_of(outcome: Outcome) -> Iterator[dict[str, Any]]:
    """One flat row for every take, camera and method that was measured."""
    for facts in outcome.done.values():
        about = {name: facts[name] for name in ("subject", "take", "camera")}
        for method, figures in facts["methods"].items():
            yield about | {"method": method} | figures
