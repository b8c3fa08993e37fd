"""Flexion of hinges from joint centres: what markers define without any convention of segment axes.

The flexion of a knee or elbow is the angle between the long axes of its two segments, 0 when they are in
line. It is unsigned, and 0 is a straight leg, not the anatomical posture of the person: against another
definition it has an offset of a few degrees, which the error without offset leaves out. Hip centres from
markers of the pelvis are those of Harrington et al., Journal of Biomechanics 40, 595-602, 2007.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.formats.opensim import OpenSimTable

HINGES: Final = {
    "knee_angle_r": ("right_hip", "right_knee", "right_ankle"),
    "knee_angle_l": ("left_hip", "left_knee", "left_ankle"),
    "elbow_flex_r": ("right_shoulder", "right_elbow", "right_wrist"),
    "elbow_flex_l": ("left_shoulder", "left_elbow", "left_wrist"),
}
"""Coordinate of OpenSim -> joint centres before, at and after the hinge."""


def hinge_table(times: Array, centres: Mapping[str, Array]) -> OpenSimTable:
    """Return the flexion, rad, of the hinges whose three centres are known.

    Args:
        times: (T,) s. centres: joint -> (T, 3) in any one unit; NaN where unknown.
    """
    found = {
        name: _flexion(*(centres[joint] for joint in joints))
        for name, joints in HINGES.items()
        if all(joint in centres for joint in joints)
    }
    values = np.stack(list(found.values()), axis=1) if found else np.empty((len(times), 0))
    return OpenSimTable(times, tuple(found), values, in_degrees=False)


def _flexion(before: Array, at: Array, after: Array) -> Array:
    upper, lower = at - before, after - at
    cross = np.linalg.norm(np.cross(upper, lower), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(upper * lower, axis=-1)))


def hip_centres(markers: Mapping[str, Array]) -> dict[str, Array]:
    """Return both hip centres (T, 3) m from the pelvis (Harrington et al. 2007, simple regressions).

    Args:
        markers: 'right_asis', 'left_asis', 'right_psis', 'left_psis' -> (T, 3) m, any axes.
    """
    front = (markers["right_asis"] + markers["left_asis"]) / 2
    back = (markers["right_psis"] + markers["left_psis"]) / 2
    to_right = markers["right_asis"] - markers["left_asis"]
    width = np.linalg.norm(to_right, axis=-1, keepdims=True)
    right = to_right / width
    forward = front - back
    depth = np.linalg.norm(forward, axis=-1, keepdims=True)
    forward = forward - np.sum(forward * right, axis=-1, keepdims=True) * right
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    up = np.cross(right, forward)
    middle = front - (0.24 * depth + 0.0099) * forward - (0.30 * width + 0.0109) * up
    out = (0.33 * width + 0.0073) * right
    return {"right_hip": middle + out, "left_hip": middle - out}
