"""Library of movements: poses of a given body doing what a protocol asks for, before anyone is recorded.

Each movement is stored (``models/movements/NAME.npz``, made by ``models/build_movements.py``) without bone
lengths: rotations of the segments in their parents' frames, the path of the middle of the hips and those of
both balls of the feet in units of the leg's length. `movement` puts it on a body: the balls of the feet and
the feet's orientations are kept, and the legs follow by inverse kinematics, so a planted foot stays planted.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import shared_frames
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.text import read_text
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence

STORED_RATE_HZ: Final = 30.0
ROTATION_UNIT: Final = 1e-4  #: [rad] of the stored rotation vectors, which are integers
SIDES: Final = ("Left", "Right")
MOST_EXTENDED: Final = 0.9992
"""Largest distance from hip to ankle, share of thigh and shank: the knee keeps five degrees."""
MOST_REPETITIONS: Final = 100
_default = lru_cache(maxsize=1)(SkeletonModel.default)


@dataclass(frozen=True)
class MovementInfo:
    """A movement of the library."""

    name: str  #: As `movement` takes it
    description: str  #: One sentence: what it is, what of it is recorded motion and what is constructed
    instructions: str  #: What the operator tells the person
    angles: tuple[str, ...]  #: Clinical angles that it is for, without their sides
    sources: tuple[str, ...]  #: Motions of the CMU database that it was made from
    repetition: str  #: What one repetition is
    repetitions: int  #: Number of repetitions by default
    acknowledgement: str  #: Of the data that it was made from


def _table() -> Mapping[str, MovementInfo]:
    table = tomllib.loads(read_text(model_path("movements/movements.toml"), "a TOML file"))
    lists = ("angles", "sources")
    infos = [
        MovementInfo(**{**row, **{k: tuple(row[k]) for k in lists}}, acknowledgement=table["acknowledgement"])
        for row in table["movement"]
    ]
    return MappingProxyType({info.name: info for info in infos})


MOVEMENTS: Final[Mapping[str, MovementInfo]] = _table()  #: The movements by name


@dataclass(frozen=True)
class Stored:
    """A movement without bone lengths, on the default skeleton's frames."""

    R_parent_bone: Array  #: (T, J, 3, 3), of the root in world
    hips: Array  #: (T, 3) middle of the hips, above the height of a standing ankle, in leg lengths
    balls: Array  #: (T, 2, 3) balls of the left and right foot, above their height in standing, in leg lengths
    cycle: tuple[int, int] = (0, 0)
    """Frames [start, stop) of the repetition; the pose at stop is that at start, at rest."""


def movement(name: str, skeleton: SkeletonModel, repetitions: int | None = None, rate_hz: float = 60.0) -> PoseSequence:
    """Return a movement of a body: the person starts at the origin, faces x and stands on the floor z = 0.
    `UnknownNameError`: another movement, or a skeleton of other joints; `InvalidInputError`: no possible number of
    repetitions or rate.

    Args:
        name: one of `MOVEMENTS`. skeleton: body, with the 21 joints.
        repetitions: number, at least 1; by default that of the movement. rate_hz: of the poses, Hz.
    """
    if name not in MOVEMENTS:
        raise UnknownNameError("movement", [name], list(MOVEMENTS))
    count = MOVEMENTS[name].repetitions if repetitions is None else repetitions
    if not 1 <= count <= MOST_REPETITIONS:
        raise InvalidInputError(f"movement {name}: {count} repetitions; give 1 to {MOST_REPETITIONS}")
    if not 10 <= rate_hz <= 1000:
        raise InvalidInputError(f"movement {name}: {rate_hz:g} Hz is not a rate between 10 and 1000 Hz")
    stored = _stored(name)
    start, stop = stored.cycle
    frames = np.concatenate([np.arange(start), *[np.arange(start, stop)] * count, np.arange(stop, len(stored.hips))])
    known = np.arange(len(frames)) / STORED_RATE_HZ
    times = np.arange(int(known[-1] * rate_hz + 1e-9) + 1) / rate_hz
    quaternions = so3.to_quat_wxyz(stored.R_parent_bone[frames])
    smooth = Stored(
        so3.from_quat_wxyz(CubicSpline(known, quaternions)(times)),
        CubicSpline(known, stored.hips[frames])(times),
        CubicSpline(known, stored.balls[frames])(times),
    )
    return planted(smooth, skeleton, times, _sway(times))


def planted(
    stored: Stored, skeleton: SkeletonModel, times: Array, sway: tuple[Array, Array] | None = None
) -> PoseSequence:
    """Return the poses of a body whose feet are where a stored movement has them.

    Where its legs do not reach both feet, the body is lowered throughout by what is missing. `UnknownNameError`,
    `InvalidInputError`: a skeleton of other joints.

    Args:
        skeleton: body, with the 21 joints. times: (T,) s.
        sway: rotation vectors (T, J, 3) added to the segments', rad, and (T, 3) to the hips, in leg lengths.
    """
    default = _default()
    skeleton.check_joints(default.names, "the skeleton of a planned movement")
    hips, R_local, parents = stored.hips, stored.R_parent_bone, skeleton.parents
    feet, shanks, thighs = (skeleton.index(*(f"{s}{n}" for s in SIDES)) for n in ("Foot", "Leg", "UpLeg"))
    R_feet = kinematics.world_rotations(parents, R_local)[:, feet]
    if sway is not None:
        R_local, hips = R_local @ so3.exp(sway[0]), hips + sway[1]
    shared, ours = (shared_frames(s.names, s.joint_offsets) for s in (default, skeleton))
    R = kinematics.world_rotations(parents, R_local) @ shared @ np.swapaxes(ours, -1, -2)
    R[:, feet] = R_feet
    offsets = skeleton.joint_offsets
    lengths = np.linalg.norm(offsets, axis=1)
    leg = float(lengths[shanks + feet].sum()) / 2
    heel, ball = (np.mean([skeleton.landmarks[f"{s}{n}"][1] for s in SIDES], axis=0)[2] for n in ("Heel", "ToeBase"))
    centre = leg * hips - [0, 0, heel]
    p_root = centre - R[:, 0] @ offsets[thighs].mean(axis=0)
    p_hip = p_root[:, None] + np.einsum("tij,sj->tsi", R[:, 0], offsets[thighs])
    ball_in_foot = np.array([skeleton.landmarks[f"{side}ToeBase"][1] for side in SIDES])
    p_ankle = leg * stored.balls + [0, 0, ball - heel] - np.einsum("tsij,sj->tsi", R_feet, ball_in_foot)
    way, legs = p_hip - p_ankle, lengths[shanks] + lengths[feet]
    most = np.sqrt(np.maximum((MOST_EXTENDED * legs) ** 2 - np.sum(way[..., :2] ** 2, axis=-1), 0.0))
    lowered = max(float((way[..., 2] - most).max()), 0.0)  # for the legs to reach the ankles
    p_root[:, 2] -= lowered
    p_hip[..., 2] -= lowered
    p_knee = _knees(p_hip, p_ankle, R[:, thighs][..., 0], lengths[shanks], lengths[feet])
    for parent, child, bone in ((thighs, shanks, p_knee - p_hip), (shanks, feet, p_ankle - p_knee)):
        rest = np.einsum("tsij,sj->tsi", R[:, parent], offsets[child])
        R[:, parent] = so3.minimal_rotation(rest, bone) @ R[:, parent]
    return PoseSequence(times, kinematics.positions(parents, offsets, p_root, R), R, skeleton.names)


def _knees(p_hip: Array, p_ankle: Array, forward: Array, thigh: Array, shank: Array) -> Array:
    """Return knees (T, 2, 3), m, that bend towards `forward` (T, 2, 3); lengths (2,) m."""
    way = p_ankle - p_hip
    distance = np.linalg.norm(way, axis=-1)
    along = way / distance[..., None]
    across = so3.unit(forward - np.sum(forward * along, axis=-1, keepdims=True) * along)
    cosine = (thigh**2 + distance**2 - shank**2) / (2 * thigh * distance)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    return np.asarray(p_hip + thigh[:, None] * (cosine[..., None] * along + sine[..., None] * across))


@lru_cache(maxsize=16)
def _stored(name: str) -> Stored:
    """Read a stored movement."""
    with np.load(model_path(f"movements/{name}.npz")) as file:
        steps = np.cumsum(file["rotations"], axis=0, dtype=np.int16)
        start, stop = file["cycle"].tolist()
        paths = file["hips"].astype(float), file["balls"].astype(float)
    return Stored(so3.exp(ROTATION_UNIT * steps.astype(float)), *paths, (start, stop))


def _sway(times: Array) -> tuple[Array, Array]:
    """Return the sway of a standing person at times (T,) s: see `planted`; it is a Fourier series."""
    with np.load(model_path("movements/sway.npz")) as file:
        period, rotations, hips = float(file["period"]), file["rotations"], file["hips"]
    phase = 2 * np.pi * np.outer(times, np.arange(1, len(hips[0]) + 1)) / period
    waves = np.stack([np.cos(phase), np.sin(phase)])
    return np.einsum("ctk,ckja->tja", waves, rotations), np.einsum("ctk,cka->ta", waves, hips)
