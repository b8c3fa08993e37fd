"""Evidence of an uncalibrated camera: quantities of a recording that are known with the true camera.

========  ===================================================================================  ==========
floor     height of standing ankles over the floor, its slope in depth and across              m, rad, rad
tilt      body by the image alone against the sensors' bones, or against upright               rad, rad
walk      logarithm of the path of the body over standing feet, by the image, per that of its  1
          legs, by the sensors
========  ===================================================================================  ==========

Heights follow from the size of the person in the image. Standard deviations are those with the true camera
on recordings of other people (``python -m benchmarks uncalibrated_camera --fit``).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import LIMBS
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_estimate import Evidence
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import turned
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import refit_root
from rtof_kin.inertial.root_path import FEET, Contacts, detect_contacts
from rtof_kin.reconstruction.lift import LifterLike, lift

ANKLE_HEIGHT = 0.08  # [m] of a standing ankle over the floor
LEGS = tuple(bone for limb in LIMBS if limb[-1] in FEET for bone in limb[:2])
_STILL = 0.3  # [m/s] at the body's distance, of a standing ankle in the image
_SHORTEST = 0.15  # [s] of a contact
_CUTOFF_HZ = 5.0  # [Hz] Low-pass of the ankle in the image


class Usual(NamedTuple):
    """Mean and standard deviation of a quantity with the true camera."""

    mean: float
    sigma: float


HEIGHT: Final = Usual(0.02, 0.03)  # [m] of standing ankles over `ANKLE_HEIGHT`, by the size of the person in the image
SIZE: Final = 0.015  # [1] Standard deviation of the size of the skeleton in the image; it moves a foot along its ray
UNEVEN: Final = 0.035  # [m] Standard deviation of the mean height of feet in one place, relative to another
SLOPE: Final = 0.01  # [rad] Standard deviation of a slope over any distance
LEAN: Final = Usual(0.0, np.radians(2.6)), Usual(0.0, np.radians(2.3))
"""[rad] of the body in the mean, forwards and to the right as seen from the camera."""
TURN: Final = Usual(0.0, np.radians(2.4)), Usual(0.0, np.radians(1.8))
"""[rad] of bones with sensors by the image alone, about the camera's x and z axes."""
LASTING, SECONDS = 0.4, 20.0
"""[1] Share of the squares of `LEAN` and `TURN` that does not depend on a recording's length, and [s] that of
the recordings that they were measured on: postures average out."""
WALK: Final = Usual(np.log(1.05), 0.03)  # [1] for a long walk
WALK_LEG: Final = 0.08  # [m] Standard deviation of the root of the sum of squares of all contacts' paths
LEAST_WALK: Final = 2.0
"""[m^2] Sum of squares of the legs' paths below which nothing follows from them: some five steps."""


WALK_IN_DEPTH: Final = "walk in depth"
_OF_WALK = 3.0  # Standard deviations by which a walk may contradict the focal length


@dataclass(frozen=True)
class Scene:
    """What the evidence of one recording has in common for all cameras."""

    skeleton: SkeletonModel
    floor_height: float | None
    contacts: Contacts  # `standing_feet`
    bone_imus: BoneImuSequence | None  # At the keypoints' times
    floor_and_tilt: bool = True  # Whether to use them; walking is used always


def standing_feet(keypoints: KeypointSequence, poses: PoseSequence, skeleton: SkeletonModel) -> Contacts:
    """Return the feet that hardly move in the image and move little in the poses."""
    found = detect_contacts(poses, None, skeleton, from_poses=True)
    xy = keypoints.camera.normalise(keypoints.select(found.joints).uv_px)
    depth = keypoints.camera.to_camera(poses.p_world_joint[:, 0])[:, 2]
    standing, rate_hz = found.standing.copy(), poses.rate_hz
    for i in range(len(found.joints)):
        smooth = signals.low_pass_known(keypoints.times, xy[:, i], _CUTOFF_HZ)
        speed = np.linalg.norm(np.gradient(smooth, axis=0), axis=-1) * rate_hz * depth
        standing[:, i] &= speed < _STILL  # false for NaN
        for start, stop in signals.runs(standing[:, i]):
            if stop - start < _SHORTEST * rate_hz:
                standing[start:stop, i] = False
    return replace(found, standing=standing)


def evidence(scene: Scene, keypoints: KeypointSequence, by_image: PoseSequence, poses: PoseSequence) -> Evidence:
    """Return the evidence of a recording reconstructed with a camera; `by_image`: lifted without sensors."""
    camera = keypoints.camera
    parts = (
        _floor(scene, camera, refit_root(poses, keypoints, sigma_depth=1.0)),
        _tilt(scene, camera, by_image),
        walk(scene, camera, poses),
    )
    value = np.concatenate([part.value for part in parts])
    if not scene.floor_and_tilt:
        value[: -len(parts[-1].value)] = np.nan
    return Evidence(value, np.concatenate([part.sigma for part in parts]))


def _level_axes(camera: Camera) -> Array:
    """(2, 3) horizontal unit vectors forwards and to the right."""
    forward = so3.unit(camera.R_camera_world[2] * [1, 1, 0])
    return np.stack([forward, np.cross(forward, [0.0, 0.0, 1.0])])


def _floor(scene: Scene, camera: Camera, poses: PoseSequence) -> Evidence:
    """Height of standing ankles and its slopes: of the mean, in depth and across."""
    p = poses.p_world_joint[:, scene.skeleton.index(*scene.contacts.joints)][scene.contacts.standing]
    plane = None if scene.floor_height is None else floor_plane(camera, p, scene.floor_height)
    return Evidence(np.full(3, np.nan), np.ones(3)) if plane is None else plane.evidence


class FloorPlane(NamedTuple):
    """Plane through the ankles of standing feet."""

    evidence: Evidence  # (3,) height of the mean over that of a standing ankle, slopes in depth and across
    p: Array  # (n, 3) ankles
    fit: Array  # (3, n) from their heights


def floor_plane(camera: Camera, p: Array, floor_height: float) -> FloorPlane | None:
    """Return the plane through standing ankles (n, 3) in world, m, near the floor's height z; None for too few."""
    if len(p) < 10:
        return None
    height = p[:, 2] - floor_height - ANKLE_HEIGHT
    p = p[np.abs(height - np.median(height)) < 0.3]
    places = (p - camera.center_world) @ _level_axes(camera).T
    away = places - np.median(places, axis=0)
    A = np.column_stack([np.ones(len(away)), away])
    ridge = np.diag([0.0, *(len(away) * 0.05**2,) * 2])
    fit = np.linalg.solve(A.T @ A + ridge, A.T)
    value = fit @ (p[:, 2] - floor_height - ANKLE_HEIGHT) - [HEIGHT.mean, 0.0, 0.0]
    over = abs(float(camera.center_world[2]) - floor_height)
    slopes = np.hypot(UNEVEN / np.maximum(away.std(axis=0), 0.05), SLOPE)
    return FloorPlane(Evidence(value, np.array([np.hypot(HEIGHT.sigma, SIZE * over), *slopes])), p, fit)


def _tilt(scene: Scene, camera: Camera, poses: PoseSequence) -> Evidence:
    """Rotation of the body by the image alone against the sensors; without them, its mean lean."""
    skeleton, p = scene.skeleton, poses.p_world_joint
    if scene.bone_imus is None:
        below = skeleton.index(*(scene.contacts.joints or skeleton.names[:1]))
        above = p[:, skeleton.names.index("Neck")] - p[:, below].mean(axis=1)
        up = so3.unit(np.median(so3.unit(above), axis=0))
        value, usual = _level_axes(camera) @ up, LEAN
    else:
        value, usual = turn_of_image(scene.bone_imus, skeleton, camera, poses)[[0, 2]], TURN
    sigma = np.array([u.sigma for u in usual]) * lasting(float(poses.times[-1] - poses.times[0]))
    return Evidence(value - [u.mean for u in usual], sigma)


def lasting(seconds: float) -> float:
    """Return the factor on `LEAN` and `TURN` in a recording of another length."""
    return float(np.sqrt(LASTING + (1 - LASTING) * max(1.0, SECONDS / max(seconds, 0.1))))


def turn_of_image(imus: BoneImuSequence, skeleton: SkeletonModel, camera: Camera, poses: PoseSequence) -> Array:
    """Return the rotation vector (3,), camera axes, from the sensors' bones to those of the image alone, or NaN."""
    p, products = poses.p_world_joint, np.zeros((3, 3))
    for s, joint in enumerate(skeleton.index(*imus.joints)):
        children = kinematics.children_of(skeleton.parents, joint)
        if len(children) != 1:  # a segment without a direction, or at the end of a limb
            continue
        sensed = imus.R_world_bone[:, s] @ so3.unit(skeleton.joint_offsets[children[0]])
        seen = so3.unit(p[:, children[0]] - p[:, joint])
        known = np.isfinite(sensed + seen).all(axis=-1)
        products += seen[known].T @ sensed[known]
    if not products.any():
        return np.full(3, np.nan)
    return np.asarray(camera.R_camera_world @ so3.log(so3.nearest_rotation(products)))


def walk(scene: Scene, camera: Camera, poses: PoseSequence) -> Evidence:
    """Return the logarithm of the path of the body over standing feet, along the view, per that of its legs."""
    body, legs = walked(scene, camera, poses)
    total = float(legs @ legs)
    if total < LEAST_WALK or not body @ legs > 0.2 * total:
        return Evidence(np.full(1, np.nan), np.ones(1))
    value = np.log(body @ legs / total) - WALK.mean
    sigma = np.hypot(WALK.sigma, WALK_LEG / np.sqrt(total))
    return Evidence(np.array([value]), np.array([sigma]))


def check_walk(scene: Scene, camera: Camera, poses: PoseSequence) -> Check:
    """Check the focal length by walking to or from the camera."""
    if camera.uncertainty is not None:
        return Check.unknown(WALK_IN_DEPTH, "the feet", "times", "the focal length is estimated by it")
    found = walk(scene, camera, poses)
    (value,), (sigma,) = found.value, found.sigma
    if np.isnan(value):
        why = "needs some five steps to or from the camera, with sensors on thighs and shanks"
        return Check.unknown(WALK_IN_DEPTH, "the feet", "times", why)
    return Check(
        WALK_IN_DEPTH,
        "the feet",
        float(np.exp(abs(value))),
        float(np.exp(_OF_WALK * sigma)),
        "times",
        f"Along the view the body moves {np.exp(value):.2f} times as far over standing feet as its legs do",
        cause=f"the focal length is probably too {'long' if value > 0 else 'short'}",
    )


def walked(scene: Scene, camera: Camera, poses: PoseSequence) -> tuple[Array, Array]:
    """Return the paths (n,) of the body along the view in each contact, by the image and by sensed legs, m."""
    if scene.bone_imus is None or not {*LEGS} <= {*scene.bone_imus.joints}:
        return np.zeros(0), np.zeros(0)
    ahead, root = _level_axes(camera)[0], poses.p_world_joint[:, 0]
    body, legs = [], []
    for i, foot in enumerate(scene.skeleton.index(*scene.contacts.joints)):
        for start, stop in signals.runs(scene.contacts.standing[:, i]):
            since = np.arange(stop - start) - (stop - start - 1) / 2
            slope = since / (since @ since) * (stop - start)  # a regression line's rise
            path = np.stack([root, root - poses.p_world_joint[:, foot]])[:, start:stop] @ ahead
            moved = path @ slope
            body.append(moved[0])
            legs.append(moved[1])
    return np.array(body), np.array(legs)


_log = logging.getLogger(__name__)

_PIECE: Final = 2.0  # [s] of a mean
_SIGMA_MEAN: Final = np.radians(3.0)  # of a mean over that, by realistic 2D of motion capture
_SIGMA_WALK: Final = np.radians(0.1)  # [rad/s^0.5] of the random walk


def without_heading_drift(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel, lifter: LifterLike | None
) -> KeypointSequence:
    """Return stabilised keypoints without the drift that `Camera.heading_drift` allows for; None: shipped lifter."""
    camera = keypoints.camera
    angle, sigma = heading_drift(lift(keypoints, skeleton, lifter).poses, bone_imus, camera.heading_drift)
    text = "the heading of the camera drifted by %.1f +- %.1f deg against the sensors; it is removed"
    _log.info(text, *np.degrees([angle[-1] - angle[0], np.hypot(*sigma[[0, -1]])]))
    return heading_turned(keypoints, angle)


def heading_turned(keypoints: KeypointSequence, angle: Array) -> KeypointSequence:
    """Return keypoints turned about the vertical by angles (T,), rad."""
    R = keypoints.camera.R_camera_world
    return turned(keypoints, R @ so3.about_axis("z", angle) @ R.T, keypoints.camera.undistorted())


def heading_drift(poses: PoseSequence, bone_imus: BoneImuSequence, sigma_rate: float) -> tuple[Array, Array]:
    """Estimate the drift of a camera's heading.

    A phone knows its camera's tilt from gravity, but its heading drifts (that of the background's keyframes hardly
    does). Segments in the image and by their sensors differ by this drift, by errors of the lifter that depend on the
    pose, and by the drift of the sensors' headings, which is the same to a reconstruction. The drift is a line and a
    random walk, estimated by Gaussian process regression (Rasmussen and Williams 2006, ch. 2) from means over two
    seconds. Removing it corrects positions in world; those relative to the root hardly change.
    `InvalidInputError`: other times, or no segment is seen by both.

    Args:
        poses: lifted from the image alone, in the world of the camera that stands still.
        sigma_rate: standard deviation of a steady drift, rad/s.

    Returns:
        Angles (T,) about the vertical by which what the camera sees has to be turned, relative to their mean, and their
        standard deviations (T,), rad.
    """
    if not np.array_equal(poses.times, bone_imus.times):
        raise InvalidInputError("heading drift: poses and sensors have other times; resample the sensors")
    joints = [poses.names.index(joint) for joint in bone_imus.joints]
    R = bone_imus.R_world_bone @ np.swapaxes(poses.R_world_bone[:, joints], -1, -2)
    weight = np.nan_to_num(1 / poses.sigma_rad[:, joints] ** 2, nan=1.0)
    known = np.asarray(np.isfinite(R).all(axis=(-2, -1)))
    if not known.any():
        raise InvalidInputError("heading drift: no segment is seen by the image and by a sensor")
    M = (np.where(known[..., None, None], R, 0.0) * weight[..., None, None]).sum(axis=1)
    piece = ((poses.times - poses.times[0]) // _PIECE).astype(int)
    use = [k for k in np.unique(piece) if known[piece == k].any()]
    at = np.array([poses.times[piece == k].mean() for k in use])
    heading = np.unwrap([float(so3.heading(M[piece == k].sum(axis=0))) for k in use])
    # The drift (n,) less its mean, which the camera's pose has, and its standard deviation (n,).
    line = sigma_rate**2 * np.multiply.outer(at - at.mean(), at - at.mean())
    prior = line + _SIGMA_WALK**2 * np.minimum.outer(at - at[0], at - at[0])
    centre = np.eye(len(at)) - 1 / len(at)
    prior = centre @ prior @ centre
    gain = np.linalg.solve(prior + _SIGMA_MEAN**2 * np.eye(len(at)), prior).T
    variance = np.diag(prior - gain @ prior)
    angle, sigma = gain @ (centre @ heading), np.sqrt(np.maximum(variance, 0.0))
    return np.interp(poses.times, at, angle), np.interp(poses.times, at, sigma)
