"""Checks of size and distance of a person by other means than the size in the image: the floor, standing
feet, the accelerations of two segments at a joint, and the perspective of bones with sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.limbs import LIMBS
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.checks import Check
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.contacts import FEET
from rtof_kin.inertial.root_position import refit_root
from rtof_kin.reconstruction.image_checks import Picture
from rtof_kin.reconstruction.limb_images import Limbs

ANKLE_HEIGHT = 0.08
"""[m] of a standing ankle over the floor."""
LEAST_HEIGHT, LEAST_HEIGHT_SENSED, HEIGHT_PER_DISTANCE = 0.16, 0.12, 0.02
"""[m] Tolerance of that height without and with sensors, and per m of distance (one degree of camera tilt)."""
LARGEST_SCALE = 1.14
"""Tolerated factor of bone lengths by the accelerations of two sensors."""
FLATTEST, LEAST_DISTINCT = 0.55, 0.88
"""Perspective of the bones relative to that of the focal length, below which the focal length is too
short; and the fraction of the misfit that must remain with it."""
_PERSPECTIVES = np.linspace(0.0, 3.0, 31)
_AS_GIVEN = 10
_LARGEST_MISFIT = 0.3
_PARTS = 4
"""Parts of a recording that have to agree on it."""
_CUTOFF_HZ, _LEAST_SAMPLES, _LEAST_ACCELERATION, _LEAST_EXPLAINED = 3.0, 90, 1.0, 0.5
_EDGE = 5
LEGS = tuple(bone for limb in LIMBS if limb[-1] in FEET for bone in limb[:2])
_SCALE, _PERSPECTIVE = "length of bones by accelerations", "perspective"


@dataclass(frozen=True)
class Standing:
    """Position of a standing person by the size of the body alone."""

    height: float
    """z in world of the ankle that stands, m."""
    distance: float
    """Of the hips along the camera's axis, m."""
    tolerance: float
    """How far the height may be off, m."""


def standing(poses: PoseSequence, k: KeypointSequence, sensed: bool) -> Standing | None:
    """Estimate where the person stands; None without ankles.

    Args:
        poses: (T, J), of which the shape is used.
    """
    feet = [poses.names.index(foot) for foot in FEET if foot in poses.names]
    if not feet:
        return None
    placed = refit_root(poses, k, sigma_depth=1.0).p_world_joint
    height = np.percentile(placed[:, feet, 2].min(axis=1), 20)
    distance = float(np.median(k.camera.to_camera(placed[:, 0])[:, 2]))
    least = LEAST_HEIGHT_SENSED if sensed else LEAST_HEIGHT
    return Standing(float(height), distance, least + HEIGHT_PER_DISTANCE * distance)


def check_bones(bone_imus: BoneImuSequence | None, skeleton: SkeletonModel) -> Check:
    """Check bone lengths by the accelerations of two sensors at a joint.

    Args:
        skeleton: the subject's.
    """
    bounds = None if bone_imus is None else _length_ratio(bone_imus, skeleton)
    if bounds is None:
        return Check.unknown(_SCALE, "bones", "times", "no two sensors at one joint that turns fast enough")
    found = min(max(1.0, bounds[0]), bounds[1])  # the nearest to 1 that both directions of regression allow
    word = "long" if found < 1 else "short"
    return Check(
        _SCALE,
        "bones",
        max(1 / found, found),
        LARGEST_SCALE,
        "times",
        f"Accelerations are those of bones {found:.2f} times as long; give the subject's height or bones "
        "in m, or look at the sensors' places",
        cause=f"the bones are probably too {word}, or the sensors sit elsewhere on them than declared",
    )


def _length_ratio(imus: BoneImuSequence, skeleton: SkeletonModel) -> tuple[float, float] | None:
    """Bounds of the ratio of measured to declared bone lengths between sensors: regression of the measured
    accelerations on those of the declared bones, which errors of the orientations make too small, and the
    other way round, which errors of the accelerations make too large (Frisch 1934).
    """
    if len(imus.times) < _LEAST_SAMPLES:
        return None
    rate_hz = (len(imus.times) - 1) / float(np.ptp(imus.times))
    if rate_hz < 3 * _CUTOFF_HZ:
        return None
    measured, declared = [], []
    for s, joint in enumerate(imus.joints):
        for child in kinematics.children_of(skeleton.parents, skeleton.names.index(joint)):
            if skeleton.names[child] not in imus.joints:
                continue
            c = imus.joints.index(skeleton.names[child])
            R, R_child = imus.R_world_bone[:, s], imus.R_world_bone[:, c]
            levers = R_child @ imus.p_bone_sensor[c] - R @ imus.p_bone_sensor[s]
            bone = R @ skeleton.joint_offsets[child]
            a = (imus.a_world[:, c] - imus.a_world[:, s])[1:-1]
            parts = np.stack([a - signals.derivative(levers, rate_hz, 2), signals.derivative(bone, rate_hz, 2)])
            known = parts[:, np.isfinite(parts).all(axis=(0, 2))]
            if known.shape[1] >= _LEAST_SAMPLES:
                slow = np.stack([signals.low_pass(part, rate_hz, _CUTOFF_HZ) for part in known])
                slow = slow[:, _EDGE:-_EDGE]
                slow -= slow.mean(axis=1, keepdims=True)
                measured.append(slow[0].ravel())
                declared.append(slow[1].ravel())
    if not measured:
        return None
    y, x = np.concatenate(measured), np.concatenate(declared)
    xx, xy, yy = x @ x, x @ y, y @ y
    moving = xx / len(x) > (_LEAST_ACCELERATION / 3) ** 2
    explained = moving and xy > 0 and xy**2 > _LEAST_EXPLAINED * xx * yy
    return (float(xy / xx), float(yy / xy)) if explained else None


def check_perspective(picture: Picture, skeleton: SkeletonModel) -> Check:
    """Check the focal length by the perspective of bones away from the image centre.

    Args:
        skeleton: the subject's.
    """
    what = "the picture"
    if picture.bone_imus is None:
        return Check.unknown(_PERSPECTIVE, what, "times", "needs sensors")
    limbs = Limbs.of(picture.keypoints, picture.bone_imus, skeleton)
    seen2 = np.sum(limbs.seen**2, axis=(1, 2))
    drawn = limbs.drawn(limbs.bones, _PERSPECTIVES)[:, seen2 > 0]
    seen, seen2 = limbs.seen[seen2 > 0], seen2[seen2 > 0]
    scale = np.maximum((seen * drawn).sum(axis=(2, 3)), 0) / (drawn**2).sum(axis=(2, 3))
    off = np.linalg.norm(seen - scale[..., None, None] * drawn, axis=-1) / np.sqrt(seen2)[:, None]
    by_frame = np.mean(np.minimum(off, _LARGEST_MISFIT) ** 2, axis=2)
    misfits = by_frame.mean(axis=1)
    best = int(np.argmin(misfits))
    clear = misfits[best] < LEAST_DISTINCT * misfits[_AS_GIVEN] and by_frame.shape[1] >= _PARTS
    parts = np.array_split(by_frame, _PARTS, axis=1) if clear else []
    apart = [int(part.mean(axis=1).argmin()) for part in parts]
    shorter = all(0 < one < _AS_GIVEN for one in apart)
    longer = all(_AS_GIVEN < one < len(misfits) - 1 for one in apart)
    if not clear or not (shorter or longer):
        why = "its estimates differ, or the person stays near the picture's middle"
        return Check.unknown(_PERSPECTIVE, what, "times", why)
    share = max(float(_PERSPECTIVES[best]), 0.05)
    return Check(
        _PERSPECTIVE,
        what,
        1 / share,
        1 / FLATTEST,
        "times",
        f"It is {share:.2f} times what the focal length makes; give that in px, of images of this size",
        cause=picture.small or "the focal length is probably too short",
    )
