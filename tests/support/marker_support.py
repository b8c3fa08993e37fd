"""Trials of planted markers: a known body, known places, a rich movement, noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.markers.energy import MarkerModel
from rtof_kin.markers.marker_sets import MarkerPlaces, places_of

PLUG_IN_GAIT = [
    *(end + "HD" for end in ("LF", "RF", "LB", "RB")),
    *("C7", "T10", "CLAV", "STRN", "RBAK"),
    *(side + name for side in "LR" for name in ("SHO", "UPA", "ELB", "FRM", "WRA", "WRB", "FIN")),
    *("LASI", "RASI", "LPSI", "RPSI"),
    *(side + name for side in "LR" for name in ("THI", "KNE", "TIB", "ANK", "HEE", "TOE")),
]
_RANGES_DEG = {"Arm": (50, 40, 50), "UpLeg": (15, 40, 10), "Foot": (3, 15, 3), "Hand": (15, 0, 10), "Neck": (5, 10, 15)}
_HINGES_DEG = {"LeftLeg": (1, 55), "RightLeg": (1, 55), "LeftForeArm": (2, -60), "RightForeArm": (2, 60)}


@dataclass(frozen=True)
class Planted:
    """The truth of a trial."""

    skeleton: SkeletonModel
    places: MarkerPlaces
    p: Array  #: (T, J, 3) m
    R: Array  #: (T, J, 3, 3)
    markers: MarkerSequence


def planted(
    seed: int = 0, *, frames: int = 240, scale: float = 1.0, noise: float = 0.005, apart: float = 0.5
) -> Planted:
    """Return markers on a person who bends and turns every joint.

    Args:
        scale: size of the body. noise: m. apart: deviations of bones and places, in standard deviations of their prior.
    """
    rng = np.random.default_rng(seed)
    skeleton, places = SkeletonModel.default(), places_of(PLUG_IN_GAIT)
    lengths = {
        name: scale * length * (1 + 0.06 * apart * rng.standard_normal())
        for name, length in skeleton.bone_lengths.items()
        if name.endswith(("Leg", "Foot", "ForeArm", "Hand")) and not name.endswith("UpLeg")
    }
    skeleton = skeleton.with_offsets(skeleton.joint_offsets * scale).with_bone_lengths(lengths)
    moved = apart * places.sigma_place * rng.standard_normal(places.p_bone_marker.shape)
    places = replace(places, p_bone_marker=scale * (places.p_bone_marker + moved))
    times = np.arange(frames) / 60.0
    model = MarkerModel(skeleton, places.segments, np.array(places.p_bone_marker), np.array(places.sigma_skin), 1.0)
    turns = np.zeros((frames, len(skeleton.names), 3))
    for j, name in enumerate(skeleton.names):
        for axis in range(3):
            size = _RANGES_DEG.get(name.removeprefix("Left").removeprefix("Right"), (3, 5, 4))[axis]
            if name in _HINGES_DEG or name.endswith("Shoulder"):
                size = 0
            phase, rate = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.8)
            turns[:, j, axis] = np.radians(size) * np.sin(2 * np.pi * rate * times + phase)
        if name in _HINGES_DEG:
            axis, size = _HINGES_DEG[name]
            turns[:, j, axis] = np.radians(size) * (1 - np.cos(2 * np.pi * rng.uniform(0.4, 0.8) * times))
    x = np.zeros((frames, 3 + 4 * len(skeleton.names)))
    x[:, 3::4] = 1.0
    root = np.stack([0.3 * np.sin(times), 0.2 * np.cos(times), 0.95 + 0.02 * np.sin(3 * times)], axis=1)
    x = model.space.retract(x, np.concatenate([root, turns.reshape(frames, -1)], axis=1))
    p, R = model.poses(x)
    points = model.points(p, R) + noise * rng.standard_normal((frames, len(places.names), 3))
    return Planted(skeleton, places, p, R, MarkerSequence(times, places.names, points))
