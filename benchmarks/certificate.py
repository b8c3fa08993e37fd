"""Whether left-out sensors certify a recording: ``python -m benchmarks certificate --corpus DIR --exercises CORPUS.npz``.

The benchmark's motions of held-out people and rigs and exercises of two held-out people, one camera each in turn,
realistic 2D, 8 and 10 sensors: the certified error of every left-out sensor's segment, swing and twist, beside its true
error and the stated one; and the bands of the reconstruction with all sensors, as they are and scaled by what the
certificate found. ``--faults`` adds recordings with errors that are hardly named: a clock 100 ms off, a sensor turned by
15 degrees, references tilted by 5, a focal length or bones 10 and 5 % wrong.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from rich.progress import track

from benchmarks import harness
from benchmarks.accuracy.faults import with_changed_camera
from benchmarks.accuracy.video_faults import with_late_video
from benchmarks.verdicts.scores import area, rank_correlation
from rtof_kin.body.metrics import at_times
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

Row = dict[str, Any]
SENSORS = ("8", "10")
EVERY = 6
"""Step between the frames whose bands are looked at."""


def _calibrated(recording: Recording, **changes: Array) -> Recording:
    assert recording.calibration is not None
    return replace(recording, calibration=replace(recording.calibration, **changes))


def _turned(recording: Recording, rng: Generator) -> Recording:
    """One sensor, drawn, believed turned by 15 degrees about a drawn axis."""
    assert recording.calibration is not None
    R = recording.calibration.R_sensor_bone.copy()
    one = rng.integers(len(R))
    R[one] = R[one] @ so3.exp(np.radians(15.0) * so3.unit(rng.normal(size=3)))
    return _calibrated(recording, R_sensor_bone=R)


def _tilted(recording: Recording, rng: Generator) -> Recording:
    """All references believed tilted by 5 degrees about one horizontal axis."""
    assert recording.calibration is not None
    tilt = so3.exp(np.radians(5.0) * so3.unit(np.append(rng.normal(size=2), 0.0)))
    return _calibrated(recording, R_world_inertial=tilt @ recording.calibration.R_world_inertial)


def _zoomed(recording: Recording, rng: Generator) -> Recording:
    """A focal length believed 10 % too long or too short."""
    camera = recording.video.camera
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= rng.choice((0.9, 1.1))
    return with_changed_camera(recording, K=K)


def _resized(recording: Recording, rng: Generator) -> Recording:
    """Bones believed 5 % too long or too short."""
    return replace(recording, joint_offsets=recording.joint_offsets * rng.choice((0.95, 1.05)))


FAULTS: Mapping[str, Callable[[Recording, Generator], Recording]] = {
    "none": lambda recording, _: recording,
    "clock 100 ms": lambda recording, rng: with_late_video(recording, rng, 0.1),
    "a sensor turned 15 deg": _turned,
    "references tilted 5 deg": _tilted,
    "focal length 10 %": _zoomed,
    "bones 5 %": _resized,
}


@cache
def _lifter() -> Any:
    import torch

    from lifting.predict import Lifter

    torch.set_num_threads(1)
    return Lifter.load(None)


def measured(job: tuple[MocapClip, int, str, str]) -> Row | None:
    """One recording: its certificate and bands beside the truth; None where it is not certified."""
    clip, camera, sensors, fault = job
    recording = harness.recorded(clip, camera, "realistic", harness.SENSOR_SETS[sensors], 0)
    truth = recording.truth
    assert truth is not None
    recording = FAULTS[fault](recording, np.random.default_rng(camera))
    try:
        with without_warnings(RESULT_WARNINGS):
            result = reconstruct(
                recording, mode="rtof", lifter=_lifter(), settings=ReconstructionSettings(certificate=True)
            )
    except RtofError as error:
        print(f"{clip.name}, {fault}: {error}", file=sys.stderr)
        return None
    certificate, motion = result.certificate, result.motion
    assert certificate is not None
    true, index = at_times(truth, motion.times).R_world_bone, motion.poses.names.index
    segments = []
    for one in certificate.left_out:
        R = true[:, index(one.joint)]
        kept = one.against(R), replace(one, predicted=motion.poses.R_world_bone[:, index(one.joint)]).against(R)
        error, with_it = (np.sqrt(np.nanmean(e**2, axis=0)) for e in kept)
        segments.append(
            {"joint": one.joint, "certified": one.certified, "expected": one.expected, "measured": one.measured}
            | {"movement": np.sqrt(np.nanmean(one.movement**2, axis=0)), "true": error, "kept": with_it}
            | {"sensor_sd": one.sensor_sd}
        )
    about = {"motion": clip.name, "subject": clip.subject, "rig": clip.rig, "camera": camera}
    about |= {"sensors": sensors, "fault": fault, "seconds": len(motion.times) / motion.poses.rate_hz}
    return about | {"segments": segments, "ratio": certificate.ratio, "bands": _bands(result.motion, truth)}


def _bands(motion: Any, truth: Any) -> list[tuple[str, str, Array, Array]]:
    """Parent, child, errors and standard deviations (n, 3), rad, of every pair of segments."""
    known, few = motion.confidence, slice(None, None, EVERY)
    if known is None:
        return []
    names, true = motion.poses.names, at_times(truth, motion.times)
    found = []
    for k, (parent, child) in enumerate(known.pairs):
        turns = []
        for R in (motion.poses.R_world_bone[few], true.R_world_bone[few]):
            own = R[:, names.index(child)]
            turns.append(own if parent == "world" else np.swapaxes(R[:, names.index(parent)], -1, -2) @ own)
        error = so3.known_log(np.swapaxes(turns[1], -1, -2) @ turns[0])
        sigma = np.sqrt(np.diagonal(known.turn_covariance[few, k], axis1=1, axis2=2))
        found.append((parent, child, error, sigma))
    return found
