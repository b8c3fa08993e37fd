"""Small takes in the formats of Total Capture, of planted motion, for the tests of what reads them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import planted

from benchmarks import total_capture_files as files
from benchmarks.total_capture_motion import body, cameras, from_t_pose
from benchmarks.total_capture_standin import StandInTake, make_take, write_take
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.noise import ImuNoise


@cache
def motion(subject: str = "S5", name: str = "acting3", frames: int = 60, seed: int = 0) -> PoseSequence:
    """A subject who starts in a T-pose and moves all joints smoothly."""
    offsets = body(subject, name)
    poses = planted.moving(SkeletonModel.default().with_offsets(offsets), frames, seed, 0.15).poses
    return from_t_pose(poses, offsets, seed)


@cache
def take(
    subject: str = "S5",
    name: str = "acting3",
    *,
    noisy: bool = False,
    stamp: bool = False,
    frames: int = 60,
    seed: int = 0,
) -> StandInTake:
    """A take of about a second, its sensors perfect unless asked otherwise."""
    return make_take(
        subject,
        name,
        motion(subject, name, frames, seed),
        body(subject, name),
        noise=ImuNoise() if noisy else ImuNoise.perfect(),
        stamp=stamp,
        seed=seed,
    )


def dataset(root: Path, *takes: StandInTake, layout: str = "one", **written: bool) -> dict[str, Path]:
    """Write cameras and takes; the paths of the last one's files by kind, and of 'cameras'."""
    paths: dict[str, Path] = {}
    for one in takes or (take(),):
        paths = write_take(root, one, layout, **written)
    paths["cameras"] = root / "calibration.cal"
    files.write_cameras(paths["cameras"], cameras())
    return paths


def edit(path: Path, old: str, new: str, count: int = 1) -> None:
    """Replace text in a file; it must be there."""
    text = path.read_bytes().decode()
    assert old in text, f"{old!r} is not in {path.name}"
    path.write_bytes(text.replace(old, new, count).encode())


def lines(path: Path) -> list[str]:
    """The lines of a file with their ends."""
    return path.read_bytes().decode().splitlines(keepends=True)


def degrees_apart(R_a: np.ndarray, R_b: np.ndarray) -> float:
    """Largest angle between rotations (..., 3, 3)."""
    cos = (np.einsum("...ij,...ij->...", R_a, R_b) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cos, -1, 1))).max())
