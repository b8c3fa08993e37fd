"""Checks of a recording's camera, body and keypoints against the reconstructed motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import Limbs
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import refit_root
from rtof_kin.inertial.root_path import FEET
from rtof_kin.reconstruction.camera_evidence import ANKLE_HEIGHT, WALK_IN_DEPTH, Scene, check_walk, standing_feet
from rtof_kin.reconstruction.checks.image import ImageExcerpt, sensed
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.lift import LifterLike, shipped_lifter
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.recording.body_checks import check_camera
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.uncertainty import LegMisfit

LEAST_HEIGHT, LEAST_HEIGHT_SENSED, HEIGHT_PER_DISTANCE = 0.16, 0.12, 0.02
"""[m] Tolerance of that height without and with sensors, and per m of distance (one degree of camera tilt)."""
LARGEST_SCALE = 1.14  # Tolerated factor of bone lengths by the accelerations of two sensors
FLATTEST, LEAST_DISTINCT = 0.55, 0.88
"""Perspective of the bones relative to that of the focal length, below which the focal length is too
short; and the fraction of the misfit that must remain with it."""
_PERSPECTIVES = np.linspace(0.0, 3.0, 31)
_AS_GIVEN = 10
_LARGEST_MISFIT = 0.3
_PARTS = 4  # Parts of a recording that have to agree on it
_CUTOFF_HZ, _LEAST_SAMPLES, _LEAST_ACCELERATION, _LEAST_EXPLAINED = 3.0, 90, 1.0, 0.5
_EDGE = 5
_SCALE, _PERSPECTIVE = "length of bones by accelerations", "perspective"


@dataclass(frozen=True)
class Standing:
    """Position of a standing person by the size of the body alone."""

    height: float  # z in world of the ankle that stands, m
    distance: float  # Of the hips along the camera's axis, m
    tolerance: float  # How far the height may be off, m


def standing(poses: PoseSequence, k: KeypointSequence, sensed: bool) -> Standing | None:
    """Estimate where the person stands, for poses of J joints in T frames; None without ankles."""
    feet = [poses.names.index(foot) for foot in FEET if foot in poses.names]
    if not feet:
        return None
    placed = refit_root(poses, k, sigma_depth=1.0).p_world_joint
    height = np.percentile(placed[:, feet, 2].min(axis=1), 20)
    distance = float(np.median(k.camera.to_camera(placed[:, 0])[:, 2]))
    least = LEAST_HEIGHT_SENSED if sensed else LEAST_HEIGHT
    return Standing(float(height), distance, least + HEIGHT_PER_DISTANCE * distance)


def check_bones(bone_imus: BoneImuSequence | None, skeleton: SkeletonModel) -> Check:
    """Check bone lengths by the accelerations of two sensors at a joint."""
    bounds = None if bone_imus is None else _length_ratio(bone_imus, skeleton)
    if bounds is None:
        return Check.unknown(_SCALE, "bones", "times", "no two sensors at one joint that turns fast enough")
    found = min(max(1.0, bounds[0]), bounds[1])  # the nearest to 1 that both directions of regression allow
    word = "long" if found < 1 else "short"
    advice = (
        f"Accelerations are those of bones {found:.2f} times as long; give the subject's height or bones "
        "in m, or look at the sensors' places"
    )
    cause = f"the bones are probably too {word}, or the sensors sit elsewhere on them than declared"
    return Check(_SCALE, "bones", max(1 / found, found), LARGEST_SCALE, "times", advice, cause=cause)


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


def check_perspective(image: ImageExcerpt, skeleton: SkeletonModel) -> Check:
    """Check the focal length by the perspective of bones away from the image centre."""
    what = "the picture"
    if image.bone_imus is None:
        return Check.unknown(_PERSPECTIVE, what, "times", "needs sensors")
    limbs = Limbs.of(image.keypoints, image.bone_imus, skeleton)
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
    advice = f"It is {share:.2f} times what the focal length makes; give that in px, of images of this size"
    cause = image.small or "the focal length is probably too short"
    return Check(_PERSPECTIVE, what, 1 / share, 1 / FLATTEST, "times", advice, cause=cause)


FURTHEST = 100.0  # [m] of a camera from the world's origin; beyond it the unit is wrong
WIDEST_DEG = 100.0  # Horizontal field of view of a lens without distortion
BODY, BODY_FACTOR = 1.62, 1.35  # [m] Usual height of a body, and the factor either way: 1.2 to 2.19 m
HEIGHT_DIFFERENCE = 10.0  # % difference of a declared height from that of the bones
DISTANCE, DISTANCE_FACTOR = 4.5, 9.0  # [m] Usual distance of a person from the camera, and the factor either way
MOST_OUTSIDE = 50.0  # % of the detected points that may lie outside the image
LONGEST_FROZEN = 0.5  # [s] for which a detector may repeat its points exactly
_FEWEST, _FRAMES = 6, 64
_OF_ASSUMED = 2.5  # Standard deviations of an assumption by which it may be off
_LARGE = 0.6  # [m] between ankle and floor from which the floor is more likely wrong than a scale
UNVERIFIED = "camera unverified: pelvis angles may be off by 20 deg"
_DISTANCE, _FEET = "distance from the camera", "height of the standing ankle"
ROOM_CHECKS = (_DISTANCE, _FEET, WALK_IN_DEPTH, "principal point off the centre")
"""Beginnings of the names of checks about the position in the room, which angles hardly depend on."""


def check_camera_evidence(
    recording: Recording, prepared: Prepared, poses: PoseSequence, lifter: LifterLike | None = None
) -> tuple[tuple[Check, ...], PositionErrors]:
    """Check the declared camera, image and body.

    Args:
        prepared: the prepared streams and the poses of each stage before the solver. lifter: default: the shipped one.

    Returns:
        Every check that the recording allows; failed ones name a likely cause, the likeliest first. And what
        they leave open of positions in world.
    """
    skeleton, video = prepared.skeleton, prepared.recording.video
    certain = np.isfinite(prepared.lifted.poses.sigma_rad).any()  # the lifter predicts its uncertainty
    image = ImageExcerpt.of(recording, skeleton, (lifter or shipped_lifter()) if certain else None)
    some = slice(None, None, max(1, len(video) // _FRAMES))
    stands = standing(prepared.start[some], video[some], prepared.bone_imus is not None)
    contacts = standing_feet(video, poses, skeleton)
    scene = Scene(skeleton, recording.floor_height, contacts, prepared.bone_imus)
    position = PositionErrors.declared(recording).seen(scene, video, poses, image)
    return _ordered(recording, image, skeleton, stands, (check_walk(scene, video.camera, poses),)), position


def check_camera_alone(
    recording: Recording, skeleton: SkeletonModel, lifter: LifterLike | None = None
) -> tuple[Check, ...]:
    """Check the same before a reconstruction, by default with the shipped lifter."""
    image = ImageExcerpt.of(recording, skeleton, lifter or shipped_lifter())
    stands = None
    if image.lifted is not None:
        stands = standing(image.lifted.poses, image.keypoints, False)
    return _ordered(recording, image, skeleton, stands)


def _ordered(
    recording: Recording,
    image: ImageExcerpt,
    skeleton: SkeletonModel,
    stands: Standing | None,
    of_motion: tuple[Check, ...] = (),
) -> tuple[Check, ...]:
    """Order the checks by cause: of several that one mistake fails, the one that names it leads."""
    keypoints, camera = recording.video, recording.video.camera
    first = (_check_unit(camera), *image.checks, _check_frozen(keypoints))
    lens, declared = _check_view(camera), (*_declared(keypoints), *_check_body(recording, skeleton))
    wrong = next((check.cause for check in first[:-1] if check.failed), "")
    if wrong:
        unknown = (Check.unknown(name, "the person", "m", wrong) for name in (_DISTANCE, _FEET))
        return (*first, lens, *declared, *unknown)
    imus = recording.imus
    bones = check_bones(None if imus is None else sensed(recording, imus.times), skeleton)
    perspective = check_perspective(image, skeleton)
    known = (bones, lens, perspective, *of_motion)
    cause = next((check.cause for check in known if check.failed), image.small)
    return (*first, *known, _check_feet(recording, stands, cause), _check_distance(stands), *declared)


# --- the camera ----------------------------------------------------------------------------------


def _check_unit(camera: Camera) -> Check:
    far = float(np.linalg.norm(camera.t_camera_world))
    unit = "millimetres" if far > 10 * FURTHEST else "centimetres"
    advice = "Give t_camera_world in m, of a world whose origin is near"
    cause = f"the camera's translation is probably in {unit}, not metres"
    return Check("distance from the world's origin", "camera", far, FURTHEST, "m", advice, cause=cause)


def _check_view(camera: Camera) -> Check:
    view = float(np.degrees(2 * np.arctan(camera.width_px / 2 / camera.K[0, 0])))
    limit = WIDEST_DEG if not np.any(camera.distortion) else 130.0
    advice = "So wide a lens distorts; give the focal length in px, of images of this size"
    cause = "the focal length is probably too short"
    return Check("view of the lens", "camera", view, limit, "deg", advice, cause=cause)


def _declared(keypoints: KeypointSequence) -> Iterator[Check]:
    camera = keypoints.camera
    causes = (
        "the focal length is of another unit or picture",
        "pixels are not square",
        "the principal point is of another picture",
    )
    for check, cause in zip(check_camera("of the recording", camera), causes, strict=True):
        yield replace(check, cause=cause)
    name = "points outside of the picture"
    if camera.stabilised:
        yield Check.unknown(name, "keypoints", "%", "the camera turned, and its picture has no borders")
    else:
        uv = keypoints.uv_px[keypoints.seen]
        outside = ((uv < 0) | (uv > [camera.width_px, camera.height_px])).any(axis=-1)
        share = 100 * float(outside.mean()) if len(uv) else np.nan
        advice = "Give the camera of the picture that was detected in"
        cause = "the keypoints are of a larger picture than the camera's"
        yield Check(name, "keypoints", share, MOST_OUTSIDE, "%", advice, cause=cause)
    assumed = camera.assumed if camera.uncertainty is None else ()  # its unknowns are estimated
    advice = f"Not measured: {', '.join(assumed) or 'nothing'}; calibrate, then take it out of assumed"
    yield Check("assumed, not measured", "camera", float(len(assumed)), 0.0, "quantities", advice, cause=UNVERIFIED)


# --- the body and the floor ----------------------------------------------------------------------


def _check_body(recording: Recording, skeleton: SkeletonModel) -> Iterator[Check]:
    tall = skeleton.height
    advice = f"They make a body {tall:.2f} m tall, usual is {BODY} m"
    cause = f"the bones are probably too {'long' if tall > BODY else 'short'}"
    yield Check("height of the bones", "body", max(tall / BODY, BODY / tall), BODY_FACTOR, "times", advice, cause=cause)
    declared = recording.height
    if declared is not None:
        yield Check(
            "height against that of the bones",
            "body",
            100 * abs(tall / declared - 1),
            HEIGHT_DIFFERENCE,
            "%",
            f"{declared:.2f} m are declared, the bones make {tall:.2f} m; give only one of the two",
            cause="height and bones are of different people",
        )


def _check_distance(stands: Standing | None) -> Check:
    if stands is None or not stands.distance > 0:
        return Check.unknown(_DISTANCE, "the person", "m", "no person could be lifted")
    distance = stands.distance
    return Check(
        _DISTANCE,
        "the person",
        max(distance / DISTANCE, DISTANCE / distance),
        DISTANCE_FACTOR,
        "times",
        f"It is {distance:.3g} m, usual are {DISTANCE} m",
        cause="the focal length or the size of the bones is in another unit",
    )


def _check_feet(recording: Recording, stands: Standing | None, cause: str) -> Check:
    """Check that the person stands on the floor, at z = 0 where none is declared."""
    if stands is None:
        return Check.unknown(_FEET, "the person", "m", "no person could be lifted")
    floor = recording.floor_height
    off = stands.height - (floor or 0.0) - ANKLE_HEIGHT
    limit, assumed = stands.tolerance, recording.video.camera.uncertainty
    if assumed is not None:
        level = assumed.focal * recording.video.camera.R_camera_world[2, 2]
        own = np.hypot(assumed.height, stands.distance * np.hypot(assumed.tilt, level))
        limit = float(np.hypot(limit, _OF_ASSUMED * own))
    advice = f"It is at z = {stands.height:.2f} m, {stands.distance:.1f} m away, by the body's size"
    if floor is None:
        advice += "; no floor is declared: give its z, floor_height_m, where it is not 0"
    return Check(
        f"{_FEET} over {'z = 0' if floor is None else 'the floor'}",
        "the person",
        abs(off),
        limit,
        "m off",
        advice,
        cause=cause or _cause_of_height(off, stands.distance, recording),
    )


def _cause_of_height(off: float, distance: float, recording: Recording) -> str:
    """The likeliest cause first: what is assumed, a floor or camera far off, a scale."""
    undeclared, camera = recording.floor_height is None, recording.video.camera
    if camera.uncertainty is not None or camera.assumed:
        deg = np.degrees(abs(off) / distance)
        return (
            f"the lens is {abs(off):.1f} m {'lower' if off > 0 else 'higher'} than assumed, or looks "
            f"{deg:.0f} degrees {'less' if off > 0 else 'more'} down: measure its height"
        )
    floor = "the floor is not at z = 0" if undeclared else "the floor is probably wrong"
    floor += ", or the camera's height or tilt is"
    scale = f"the focal length or the bones are too {'short' if off > 0 else 'long'}"
    return f"{floor}, or {scale}" if abs(off) > _LARGE or undeclared else f"{scale}, or {floor}"


def _check_frozen(keypoints: KeypointSequence) -> Check:
    uv = keypoints.uv_px
    enough = keypoints.seen.sum(axis=1) >= _FEWEST
    same = ((uv[1:] == uv[:-1]) | np.isnan(uv[1:] + uv[:-1])).all(axis=(1, 2))
    same &= (keypoints.seen[1:] == keypoints.seen[:-1]).all(axis=1) & enough[1:]
    times = keypoints.times
    start, stop = max(signals.runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
    return Check(
        "time for which points repeat exactly",
        "keypoints",
        float(times[stop] - times[start]),
        LONGEST_FROZEN,
        "s",
        f"At {times[start]:.2f} s; look at the detector, or take those frames out",
        cause="the keypoints are frozen: the detector repeats one frame",
    )


_LEGS_MM: Final = 130.0
"""[mm] Largest misfit of the legs without an alarm; 98 right recordings of people whom nothing was fitted on
reach 87, a squat with hidden hips 120."""
_TOGETHER = 0.6  # Misfit of the shanks relative to that of the thighs, from which wrong sensors explain both


def check_legs(misfit: LegMisfit, times: Array, sensed: bool) -> Check:
    """Check that the keypoints of knees and feet fit the hips, the bones and the sensors as a whole."""
    worst = int(misfit.thighs.argmax())
    name, value = "distance of the legs' keypoints from the body's place", 1000 * float(misfit.thighs[worst])
    if not value:
        return Check.unknown(name, "keypoints", "mm", "hips or knees are not seen")
    if sensed and value > _LEGS_MM and 1000 * misfit.shanks[worst] > _TOGETHER * value:
        return Check.unknown(name, "keypoints", "mm", "the sensors may be wrong instead")
    px, t = value * misfit.px_per_m / 1000, times[worst]
    bones = ", the bones and the sensors" if sensed else " and the bones"
    advice = "Look at the legs on the video at that time; detect again, or leave the points of knees and feet out"
    cause = f"the keypoints of the legs are off by {px:.0f} px or more at {t:.1f} s: they do not fit the hips{bones}"
    return Check(name, "keypoints", value, _LEGS_MM, "mm", advice, cause=cause)
