"""Real motion capture as motion of the package's skeleton: single files, and a corpus of them.

A file's skeleton is recognised by its joint names (`simulation.mocap_families`) and carried over joint by
joint (`simulation.mocap_mapping`).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.text import read_text
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh
from rtof_kin.simulation.mocap_families import (
    NAMES,
    PARENTS,
    lead_in,
    recognise_family,
    recognise_unit,
    without_character,
)
from rtof_kin.simulation.mocap_mapping import MocapClip, map_motion, resample_clip

__all__ = [
    "CORRECTIONS",
    "NAMES",
    "PARENTS",
    "MocapClip",
    "find_asf",
    "read_corpus",
    "read_mocap",
    "resample_clip",
    "without_spikes",
]

Array = NDArray[np.float64]


def read_mocap(
    path: str | Path,
    *,
    rate_hz: float | None = None,
    unit_m: float | None = None,
    output_rate_hz: float | None = 60.0,
    asf: str | Path | None = None,
    names: Mapping[str, str] | None = None,
) -> MocapClip:
    """Read a motion capture file of a known skeleton as motion of the package's.

    Frames that a converter put before the motion are left out.

    Args:
        path: a .bvh or .amc file.
        rate_hz: frames per second, where the file is not to be believed; .amc does not say (120).
        unit_m: metres per unit of the file; by default the one that gives a human leg.
        output_rate_hz: frames per second of the result; None keeps those of the file. See
            `resample_clip`.
        asf: skeleton of an .amc file; by default the one that `find_asf` finds.
        names: what joints of the file are called in a known family, for files of another vendor whose
            skeleton is otherwise like that family's. Where no family is recognised, a beginning that all
            names share ("mixamorig:") is left out too.

    Returns:
        The clip, its heights and headings as in the file, in world axes z up.

    Raises:
        FileFormatError: the file is not there or broken, its skeleton unknown or not of human size.
        UnknownNameError: a joint in `names` is not in the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".bvh":
        motion = read_bvh(path, rate_hz)
    elif path.suffix.lower() == ".amc":
        motion = read_asf_amc(find_asf(path) if asf is None else asf, path)
    else:
        raise FileFormatError(path, "motion capture is read from .bvh and .amc files")
    motion = without_character(motion.renamed(names or {}))
    family = recognise_family(path, motion)
    rate = _whole(motion.rate_hz) if rate_hz is None else rate_hz
    unit_m = recognise_unit(path, motion, family) if unit_m is None else unit_m
    clip = map_motion(motion[lead_in(motion, family) :], family, unit_m, rate, path.stem)
    return clip if output_rate_hz is None else resample_clip(clip, output_rate_hz)


def find_asf(path_amc: str | Path) -> Path:
    """The skeleton beside an .amc file: of its name, without digits at the end, or up to a '_'.

    ``16_21.amc`` belongs to ``16.asf``, ``gs_charleston2.amc`` to ``gs_charleston.asf``.

    Raises:
        FileFormatError: there is none.
    """
    path_amc = Path(path_amc)
    stem = path_amc.stem
    tried = (stem, stem.rstrip("0123456789"), stem.rsplit("_", 1)[0], stem.split("_")[0])
    for name in filter(None, tried):
        candidate = path_amc.with_name(f"{name}.asf")
        if candidate.is_file():
            return candidate
    raise FileFormatError(path_amc, "no .asf skeleton beside it; name one with asf=...")


def _whole(rate_hz: float) -> float:
    """The whole rate that a rounded frame time stands for (0.0083333 s is 120 Hz)."""
    return float(round(rate_hz)) if abs(rate_hz - round(rate_hz)) < 2e-4 * rate_hz else rate_hz


# --- the corpus: a folder of such files with index.csv -------------------------------------------

SPIKE_SPEED = 15.0
"""A joint faster than this, m/s, is a fault of the original."""
SPIKE_JUMP = 10.0
"""So is one whose velocity differs by more, m/s, from the median of the 7 steps around."""
SPIKE_TURN = 60.0
"""So is a segment that turns faster, rad/s; hands, which nothing hangs on, are not looked at."""
ANKLE_TURN = np.radians(110.0)
"""A foot turned further from its place on the shank is a fault too: CMU's solver flips some."""
ANKLE_HEIGHT = 0.07
"""The lower ankle's height over the floor in the lowest twentieth of a recording, m."""
CORRECTIONS = {
    "cmu_amc/gs_backflip.amc": {"fps": "60"},
    "cmu_amc/gs_lambada.amc": {"subject": "CMU055"},
    "cmu_amc/gs_pirouette.amc": {"subject": "CMU005"},
    "other_bvh/ad_cmu1_jumping_jacks.bvh": {"subject": "CMU014"},
}
"""What ``index.csv`` has wrong. The backflip falls with 9.81 m/s^2 at 60 Hz, not at 120; the
skeletons of the others are, to the digit, those of these subjects (the jumping jacks are 14_14)."""


def read_corpus(
    root: str | Path,
    subjects: Collection[str] | None = None,
    *,
    output_rate_hz: float = 60.0,
    min_seconds: float = 0.5,
) -> Iterator[MocapClip]:
    """Clips of a folder whose ``index.csv`` states subject, category and true rate of each file.

    The index' rate stands above the file's (CMU's salsa was taken at 60 Hz, whatever its header
    says), `CORRECTIONS` above the index. Heights are shifted file by file so that the floor, found
    by `ANKLE_HEIGHT`, lies at z = 0; in the files it is off by up to 0.2 m. Glitches (spikes of one
    or two frames in the originals, and legs that jump to another solution for a while) are cut out,
    see `without_spikes`, and the clip goes on as another one; pieces shorter than `min_seconds`
    between two of them are left out.

    Args:
        root: the folder.
        subjects: those wanted, as the index names them after correction; None for all.
        output_rate_hz: frames per second of the clips.
        min_seconds: length of the shortest piece of a cut clip that is kept.

    Yields:
        Clips with `subject`, `category` and `quality` of their file; pieces of a file that was cut
        are named ``name[first:stop]``, in frames of the file after its artificial start.

    Raises:
        UnknownNameError: a subject is not in the index.
        FileFormatError: there is no index, it lacks a column, has a rate that is none or names a file
            outside the folder, or a file is broken.
    """
    root = Path(root)
    rows = _index_rows(root / "index.csv")
    known = sorted({row["subject"] for row in rows})
    missing = [] if subjects is None else sorted(set(subjects) - set(known))
    if missing:
        raise UnknownNameError("subject", missing, known)
    for row in rows:
        if subjects is not None and row["subject"] not in subjects:
            continue
        whole = read_mocap(root / row["file"], rate_hz=_rate(root, row), output_rate_hz=None)
        whole = _on_floor(
            replace(whole, subject=row["subject"], category=row["tc_like"], quality=row["quality"])
        )
        pieces = without_spikes(whole)
        for piece in pieces:
            if len(pieces) == 1 or len(piece.poses) >= min_seconds * piece.poses.rate_hz:
                yield resample_clip(piece, output_rate_hz)


def _index_rows(path: Path) -> list[dict[str, str]]:
    """Rows of motions (not of skeletons), corrected and checked for the columns that are used."""
    columns = ("file", "subject", "tc_like", "fps", "quality")
    reader = csv.DictReader(io.StringIO(read_text(path, "a CSV file"), newline=""), restval="")
    try:
        lacking = set(columns) - set(reader.fieldnames or ())
        if lacking:
            raise FileFormatError(path, f"no column {', '.join(sorted(lacking))}", 1)
        rows = [{column: row[column] for column in columns} for row in reader]
    except csv.Error as error:
        raise FileFormatError(path, f"not a readable CSV file: {error}") from error
    for row in rows:
        if path_inside(path.parent, row["file"]) is None:
            raise FileFormatError(path, f"{row['file'][:100]!r} is no file inside this folder")
    motions = [row for row in rows if row["tc_like"] != "skeleton"]
    return [{**row, **CORRECTIONS.get(row["file"], {})} for row in motions]


def _rate(root: Path, row: dict[str, str]) -> float:
    """The index' frames per second."""
    try:
        rate_hz = float(row["fps"])
    except ValueError:
        rate_hz = np.nan
    if not 1e-3 < rate_hz < 1e6:
        problem = f"{row['file']}: fps is {row['fps'][:40]!r}, not a number of frames per second"
        raise FileFormatError(root / "index.csv", problem)
    return rate_hz


def _on_floor(clip: MocapClip) -> MocapClip:
    """The clip shifted in height, the floor under its feet at z = 0."""
    p = clip.poses.p_world_joint.copy()
    feet = [m for m, name in enumerate(NAMES) if name.endswith("Foot")]
    p[..., 2] -= np.percentile(p[:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
    return replace(clip, poses=replace(clip.poses, p_world_joint=p))


def without_spikes(clip: MocapClip) -> list[MocapClip]:
    """The clip itself, or the pieces between its spikes, each starting at time 0.

    Where a step from one frame to the next exceeds `SPIKE_SPEED`, `SPIKE_JUMP` or `SPIKE_TURN`,
    both frames and a neighbour on either side are cut out; so are frames beyond `ANKLE_TURN`.
    """
    poses = clip.poses
    good = ~_flipped(poses.R_world_bone)
    fault = np.flatnonzero(_spikes(poses))
    for shift in (-1, 0, 1, 2):
        good[np.clip(fault + shift, 0, len(poses) - 1)] = False
    if good.all():
        return [clip]
    return [
        replace(
            clip,
            name=f"{clip.name}[{start}:{stop}]",
            poses=replace(poses[start:stop], times=poses.times[: stop - start]),
        )
        for start, stop in signals.runs(good)
    ]


def _spikes(poses: PoseSequence) -> NDArray[np.bool_]:
    """(T - 1,) whether the step to the next frame is a fault."""
    v = np.diff(poses.p_world_joint, axis=0) * poses.rate_hz
    around = np.pad(v, ((3, 3), (0, 0), (0, 0)), mode="edge")
    jump = v - np.median(sliding_window_view(around, 7, axis=0), axis=-1)
    carrying = [m for m, name in enumerate(NAMES) if not name.endswith("Hand")]
    R = poses.R_world_bone[:, carrying]
    turn = so3.angle_between(R[1:], R[:-1]) * poses.rate_hz
    fault = np.any(np.linalg.norm(v, axis=-1) > SPIKE_SPEED, axis=1)
    fault |= np.any(np.linalg.norm(jump, axis=-1) > SPIKE_JUMP, axis=1)
    return np.asarray(fault | np.any(turn > SPIKE_TURN, axis=1))


def _flipped(R_world_bone: Array) -> NDArray[np.bool_]:
    """(T,) whether a foot is turned beyond what an ankle can."""
    feet = [m for m, name in enumerate(NAMES) if name.endswith("Foot")]
    shanks = [PARENTS[m] for m in feet]
    angle = so3.angle_between(R_world_bone[:, feet], R_world_bone[:, shanks])
    return np.asarray(np.any(angle > ANKLE_TURN, axis=1))
