"""Steps of every protocol: reconstruct a recording in several modes, score, save the motions."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import rtof_kin
from rtof_kin.body.motion_file import write_motion
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.jobs import Outcome
from rtof_kin.core.resources import lifter_path
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

_SNAPSHOTS = 5


def reconstructions(
    recording: Recording,
    modes: Iterable[str],
    lifter: Path | None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool = False,
) -> dict[str, Reconstruction]:
    """Return, for every mode in the order of `CAMERA_MODES`, a reconstruction with it among its stages.

    Modes that need sensors are omitted for a recording without them. Mode *lift* uses the image only, not the
    lifter with sensors of the other modes.

    Args:
        lifter: checkpoint, by default the shipped one.
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
    """Return the data of `rtof_kin.protocols.pictures`: errors over time, and poses at a few instants.

    Args:
        results: by mode, see `reconstructions`.
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
    """Write the motion of one stage to a file.

    Args:
        path: of the file; None writes nothing.
    """
    if path is None:
        return
    motion = result.motion if mode == result.mode else result.motion.skeleton.motion(result.stages[mode])
    write_motion(path, motion, first_frame=result.recording.first_frame, mode=mode)


def provenance(lifter: str | Path | None) -> dict[str, Any]:
    """Return what results depend on besides settings: the lifter's weights and the version.

    Args:
        lifter: checkpoint, by default the shipped one.
    """
    return {
        "lifter_sha256": hashlib.sha256(lifter_path(lifter).read_bytes()).hexdigest(),
        "version": rtof_kin.__version__,
    }


def rows_of(outcome: Outcome) -> Iterator[dict[str, Any]]:
    """Yield one flat row for every take, camera and method that was measured."""
    for facts in outcome.done.values():
        about = {name: facts[name] for name in ("subject", "take", "camera")}
        for method, figures in facts["methods"].items():
            yield about | {"method": method} | figures
