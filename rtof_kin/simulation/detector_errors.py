"""Detections of a known motion with the errors of a real detector (``models/detector_errors.toml``).

A point stands at its place in the body, which differs from person to person and moves with the pose and the view. Its
error in the image has a part that is constant over the recording and a coloured one, both correlated over the points;
the coloured part grows where the body hides the point. Limbs jump, left and right are exchanged, the person is lost,
all detections are late by some frames, and the camera stands a little differently from what its calibration says.

The table is of MediaPipe. The points of other layouts err as those of the table next to them (`_as_of`); a point with a
place of its own stands there, by its spread elsewhere in each person, and its own segment can hide it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import pairwise
from typing import Any, Final, Self

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.image_points import MIRROR_HARMONICS, detector_points, harmonics, link_turns
from rtof_kin.vision.layouts import MIRROR, Layout, detector_table, mirrored

# The table of a detector's errors (``models/detector_errors.toml``), for all points of both sides.

VIEWS = ("front", "back", "left", "right")  #: Where a camera stands that sees a covariance of coloured errors
_NUMBERS = ("amplitude", "visibility", "exchanges", "jumps", "lost", "camera")
_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("knee", "ankle", "foot")
_MIRROR_IMAGE = np.array([-1, 1])


@dataclass(frozen=True)
class Places:
    """Where the K points stand, of a person whose thigh and shank together have the length `leg`."""

    leg: float  #: m
    anchor: tuple[str, ...]  #: K joints
    frame: tuple[str, ...]  #: K joints, of whose links the mean is fixed in
    second_frame: tuple[str, ...]  #: K joints, of whose links `pose` is fixed in
    mean: Array  #: (K, 3) from the anchor, m
    pose: Array  #: (K, 3) m
    view: Array  #: (K, 8, 3) displacement in the pelvis frame, m, by `harmonics` of the direction to the camera
    view_spread: float  #: Log-normal, of all `view` together
    person: Index  #: (K,) row of `person_sd` of each point: points of one row are displaced together
    person_sd: Array  #: (G, 3) of each kind of points, and of further points, between persons, m
    outward: Array  #: (K, 3) direction away from the axis of `frame` of points on the skin, else zero


@dataclass(frozen=True)
class Covariance:
    """Covariance ``factor factor^T + diag(rest^2)`` of errors in the image at the points' depth."""

    factor: Array  #: (..., K, 2, r) m
    rest: Array  #: (..., K, 2) m


@dataclass(frozen=True)
class DetectorErrorTable:
    """Errors of a detector of K points; lengths in m, times in s, angles in rad."""

    layout: Layout  #: Names of the points
    group: tuple[str, ...]  #: Kinds of points, e.g. face, shoulder; G of them.
    kind: Index  #: (K,) index of each point's kind
    left: Mask  #: (K,) points of the left side
    mirror: Index  #: (K,) the same point of the other side
    limb: Index  #: (K,) 0 for head and hips, then right arm, left arm, right leg, left leg
    places: Places  #: Of the points in the body
    shares: Array  #: (K, C) of the variance of coloured errors by time constant
    amplitude: Mapping[str, Array]  #: (K,) by kind of point: gain, hidden, far, speed, mood_sd
    visibility: Mapping[str, Array]  #: (K,) by kind of point: base, hidden, far, log_error, outside, residual_sd
    constant: Covariance  #: For a whole recording
    coloured: Covariance  #: Of coloured errors; the first axis is that of `VIEWS`
    time_constants: Array  #: (C,) of coloured errors, s
    smoothing: float  #: Standard deviation of the normal window over coloured errors, s
    numbers: Mapping[str, Any]
    """The sections amplitude, visibility, exchanges, jumps, lost and camera as they stand in the file."""

    def points_of(self, groups: Sequence[str]) -> Index:
        """Return the points of some kinds."""
        return np.flatnonzero(np.isin(self.kind, [self.group.index(name) for name in groups]))


def detector_error_table(layout: str | None = None) -> DetectorErrorTable:
    """Return the shipped table, or what it is taken to be for another layout; `UnknownNameError`: no such layout."""
    if layout is not None and layout != _table().layout.name:
        return _as_of(detector_table().layout(layout))
    return _table()


@cache
def _table() -> DetectorErrorTable:
    data = load_toml(model_path("detector_errors.toml"))
    layout = detector_table().layout(data["layout"])
    group = tuple(data["group"])
    points = [data["point"][_stem(name)] for name in layout.names]
    kind = np.array([group.index(point["group"]) for point in points])
    left = np.array(["left" in name.split("_") for name in layout.names])
    sides = list(zip(map(_stem, layout.names), left.tolist(), strict=True))
    mirror = np.array(
        [sides.index((stem, not side)) if (stem, not side) in sides else k for k, (stem, side) in enumerate(sides)]
    )
    limb = [_limb(group[g], bool(side)) for g, side in zip(kind, left, strict=True)]
    coloured, rows = data["coloured"], [data["group"][group[g]] for g in kind]
    seen = [_covariance(coloured[view], len(points)) for view in VIEWS[:3]]  # the right mirrors the left
    seen.append(Covariance(seen[-1].factor[mirror] * _MIRROR_IMAGE[:, None], seen[-1].rest[mirror]))

    def columns(section: str) -> dict[str, Array]:
        return {name: np.array([float(row[section][name]) for row in rows]) for name in rows[0][section]}

    return DetectorErrorTable(
        layout=layout,
        group=group,
        kind=kind,
        left=left,
        mirror=mirror,
        limb=np.array(limb),
        places=_places(data, points, left, group, kind),
        shares=np.array([row["shares"] for row in rows], dtype=float),
        amplitude=columns("amplitude"),
        visibility=columns("visibility"),
        constant=_covariance(data["constant"], len(points)),
        coloured=Covariance(np.stack([c.factor for c in seen]), np.stack([c.rest for c in seen])),
        time_constants=np.array(coloured["time_constants"], dtype=float),
        smoothing=float(coloured["smoothing"]),
        numbers={name: data[name] for name in _NUMBERS},
    )


def _stem(name: str) -> str:
    return "_".join(word for word in name.split("_") if word not in ("left", "right"))


def _limb(group: str, left: bool) -> int:
    return left + (1 if group in _ARM else 3) if group in (*_ARM, *_LEG) else 0


def _places(
    data: Mapping[str, Any], points: Sequence[Mapping[str, Any]], left: Mask, group: Sequence[str], kind: Index
) -> Places:
    sign = np.where(left[:, None], MIRROR, 1)
    view = np.array([point["view_mm"] for point in points]) / 1e3
    mirrored = view * MIRROR_HARMONICS[:, None] * MIRROR

    def joints(field: str) -> tuple[str, ...]:
        names = zip((point[field] for point in points), left, strict=True)
        return tuple(name.replace("Right", "Left") if side else name for name, side in names)

    return Places(
        leg=float(data["leg_mm"]) / 1e3,
        anchor=joints("anchor"),
        frame=joints("frame"),
        second_frame=joints("second_frame"),
        mean=np.array([point["mean_mm"] for point in points]) / 1e3 * sign,
        pose=np.array([point["pose_mm"] for point in points]) / 1e3 * sign,
        view=np.where(left[:, None, None], mirrored, view),
        view_spread=float(data["view"]["spread"]),
        person=kind,
        outward=np.zeros((len(points), 3)),
        person_sd=np.array([data["group"][name]["person_sd_mm"] for name in group]) / 1e3,
    )


def _covariance(section: Mapping[str, Any], K: int) -> Covariance:
    factor = np.array(section["factor_mm"], dtype=float).reshape(K, 2, -1) / 1e3
    return Covariance(factor, np.array(section["rest_mm"], dtype=float).reshape(K, 2) / 1e3)


_NEAR, _ON_SKIN = 0.02, 0.03  #: [m] Least distance of a neighbour, and of a point on the skin from its segment's axis


@lru_cache(maxsize=8)
def _as_of(layout: Layout) -> DetectorErrorTable:
    """Return the table for another layout's K points: the same point of the table, or a mean of its neighbours by the
    fourth power of their distance in the T-pose, the face for points of the head alone.
    """
    table, known, skeleton = _table(), detector_table(), SkeletonModel.default()
    own, names = table.layout.points, layout.points
    upright = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    still = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.zeros(3), upright)
    at = {point.name: still[skeleton.names.index(point.joint)] + point.offset for point in known.points}
    head = [point.name for point in known.points if point.joint in ("Neck", "Head")]
    face = table.kind == table.group.index(_RIGID)
    weights = np.zeros((len(names), len(own)))
    for row, name in enumerate(names):
        if name in own:
            weights[row, own.index(name)] = 1
            continue
        apart = np.linalg.norm(np.array([at[one] for one in own]) - at[name], axis=1)
        near = np.maximum(apart, _NEAR) ** -4.0 * (face == (name in head))
        weights[row] = near / near.sum()
    nearest = weights.argmax(axis=1)
    left = np.array([name.startswith("Left") for name in names])
    other = map(mirrored, names)

    def mixed(of: Covariance) -> Covariance:
        """Variances are the neighbours' mean, the correlated part that of the neighbours' mean error."""
        factor = np.einsum("kp,...pir->...kir", weights, of.factor)
        total = np.einsum("kp,...pi->...ki", weights, (of.factor**2).sum(axis=-1) + of.rest**2)
        return Covariance(factor, np.sqrt(np.maximum(total - (factor**2).sum(axis=-1), 0)))

    return replace(
        table,
        layout=layout,
        kind=table.kind[nearest],
        left=left,
        mirror=np.array([names.index(name) if name in names else k for k, name in enumerate(other)]),
        limb=np.array([_limb(table.group[table.kind[n]], bool(side)) for n, side in zip(nearest, left, strict=True)]),
        places=_places_of(table.places, layout, weights, nearest),
        shares=weights @ table.shares,
        amplitude={name: weights @ values for name, values in table.amplitude.items()},
        visibility={name: weights @ values for name, values in table.visibility.items()},
        constant=mixed(table.constant),
        coloured=mixed(table.coloured),
    )


def _places_of(places: Places, layout: Layout, weights: Array, nearest: Index) -> Places:
    """Return the places of a layout's points: where they were measured, or else where its table has them."""
    placed, found, joints = detector_table().places, detector_points(layout.name), SkeletonModel.default().table.joints
    ends, inner = {joint.name: joint.end for joint in joints}, {joint.parent for joint in joints}
    anchor, frame, second = ([of[n] for n in nearest] for of in (places.anchor, places.frame, places.second_frame))
    mean, pose, person = places.mean[nearest], places.pose[nearest], places.person[nearest]
    outward, spreads, rows = np.zeros_like(mean), list(places.person_sd), dict[str, int]()
    for k, name in enumerate(layout.points):
        if weights[k].max() == 1:
            continue
        point = found[name]
        anchor[k], frame[k], second[k] = point.anchor, point.frame, point.second
        mean[k], pose[k] = places.leg * point.place, places.leg * point.second_place
        if name not in placed:
            continue
        side = mirrored(name) if name.startswith("Left") else name
        if side not in rows:
            rows[side] = len(spreads)
            spreads.append(np.array(placed[name].spread))
        person[k] = rows[side]
        along = np.abs(ends[point.frame]).argmax()
        across = np.where(np.arange(3) == along, 0.0, placed[name].offset)
        if point.frame in inner and np.linalg.norm(across) > _ON_SKIN:
            outward[k] = so3.unit(across)
    return replace(
        places,
        anchor=tuple(anchor),
        frame=tuple(frame),
        second_frame=tuple(second),
        mean=mean,
        pose=pose,
        view=np.einsum("kp,phj->khj", weights, places.view),
        person=person,
        person_sd=np.array(spreads),
        outward=outward,
    )


def ornstein_uhlenbeck(rng: Generator, frames: int, size: Sequence[int], memory: float) -> Array:
    """Return a stationary process (T, *size) of unit variance with an exponential autocorrelation of a correlation time
    in frames; 0 gives white noise.
    """
    noise = rng.standard_normal((frames, *size))
    if memory <= 0:
        return noise
    share = np.exp(-1 / memory)
    noise[1:] *= np.sqrt(1 - share**2)
    return np.asarray(lfilter([1.0], [1.0, -share], noise, axis=0))


def smoothed(values: Array, width: float) -> Array:
    """Return values (T, ...) under a moving normal window; values: (T, ...)."""
    return np.asarray(gaussian_filter1d(values, width, axis=0, mode="nearest"))


def episodes(rng: Generator, per_minute: Array, rate_hz: float, numbers: Mapping[str, Any]) -> list[slice]:
    """Return runs of frames that start at random, at expected rates (T,) per minute, of log-normal durations with the
    median, s, and the spread in a table's section, of at least one frame.
    """
    starts = np.flatnonzero(rng.random(len(per_minute)) < per_minute / 60 / rate_hz)
    durations = numbers["duration"] * np.exp(numbers["duration_spread"] * rng.standard_normal(len(starts)))
    lengths = np.maximum(np.round(durations * rate_hz).astype(int), 1)
    return [slice(start, start + length) for start, length in zip(starts, lengths, strict=True)]


_TRUNK = ("Hips", "Neck", 0.11, 0.12)
"""Joints at the ends of a capsule; its radius and the depth behind its axis that hides points, m."""
_LEG_RADIUS, _LEG_MARGIN = 0.06, 0.08
_SPHERES = 6  #: Spheres that make a capsule


def self_occluded(p_camera_joint: Array, p_camera_point: Array, limb: Index, skeleton: SkeletonModel) -> Mask:
    """Return which points (T, K) stand behind the trunk, or behind the other leg if their `limb` (K,) is 3, the right
    leg, or 4, the left. Joints (T, J, 3) and points are in camera axes, m.
    """

    def joint(name: str) -> Array:
        return p_camera_joint[:, skeleton.index(name)[0]]

    hips, neck, radius, margin = _TRUNK
    hidden = _behind(p_camera_point, joint(hips), joint(neck), radius, margin)
    for own, other in ((3, "Left"), (4, "Right")):
        points = np.flatnonzero(limb == own)
        leg = [joint(f"{other}{name}") for name in ("UpLeg", "Leg", "Foot")]
        for start, stop in pairwise(leg):
            hidden[:, points] |= _behind(p_camera_point[:, points], start, stop, _LEG_RADIUS, _LEG_MARGIN)
    return hidden


def _behind(points: Array, start: Array, stop: Array, radius: float, margin: float) -> Mask:
    """Return which points (T, K) a capsule from `start` to `stop` (T, 3) hides."""
    share = np.linspace(0, 1, _SPHERES)[:, None]
    centre = start[:, None] + share * (stop - start)[:, None]
    along = so3.unit(points) @ np.swapaxes(centre, -1, -2)  # of the foot of the perpendicular from the centre
    off = np.sum(centre**2, axis=-1)[:, None] - along**2
    near = (off < radius**2) & (along < np.linalg.norm(points, axis=-1, keepdims=True) - margin)
    return np.asarray(near.any(axis=-1))


DELAY_RATE_HZ: Final = 60.0  #: Frame rate that `DetectorErrors.delay_frames` are counted at, Hz
_LIMBS: Final = 5
_RIGID: Final = "face"  # kind of points that differ between persons by one displacement, not mirrored
_AWAY: Final = 0.3  #: Cosine by which a point on the skin faces away from the camera so that its segment hides it
_FAR, _FAR_RANGE = 0.2, 1.5  #: Unit of the depth behind the hips, m, and its largest value in that unit
_FASTEST: Final = 3.0  # [m/s] speed beyond which errors grow no more
_LOG_ERROR, _LEAST_ERROR = 0.03, 0.005  # [m] unit of the errors that visibility depends on, and the least


@dataclass(frozen=True)
class DetectorErrors:
    """Which errors a simulated detector has: factors on those of the table, 0 for none."""

    person: float = 1.0  # [-] on the spread of places between persons
    view: float = 1.0  # [-] on the displacement that turns with the view
    constant: float = 1.0  # [-] on the errors that last for the recording
    coloured: float = 1.0  # [-] on the coloured errors
    jumps: float = 1.0  # [-] on how often a limb is found elsewhere
    exchanges: float = 1.0  # [-] on how often left and right are exchanged
    losses: float = 1.0  # [-] on how often the person is lost inside the image
    camera: float = 1.0  # [-] on the error of the camera's calibration
    delay_frames: tuple[float, ...] = (1, 1, 1, 2, 2, 3)  # [frames at 60 Hz] of which one is drawn
    who: int | None = None  # Seed of the person's places; by default every recording is of another person
    layout: str | None = None  # Points of the detector; None for those of the table

    @classmethod
    def none(cls) -> Self:
        """Return a detector that finds the points at the mean of their places, seen by an exact camera."""
        return cls(
            person=0, view=0, constant=0, coloured=0, jumps=0, exchanges=0, losses=0, camera=0, delay_frames=(0,)
        )

    def draw_delay(self, rng: Generator) -> float:
        """Return by how much the detections of a recording are late, s."""
        return float(rng.choice(self.delay_frames)) / DELAY_RATE_HZ


@dataclass(frozen=True)
class _Scene:
    """What the camera would see without errors in the image, in camera axes."""

    lens: Camera  #: The camera, with its axes as world
    p_joint: Array  #: (T, K, 3) joints that the points are anchored at, m
    p_point: Array  #: (T, K, 3) places of the points, m
    azimuth: Array  #: (T,) of the camera in the pelvis frame, rad; 0 in front, positive to the left
    hidden: Mask  #: (T, K) points that the body hides
    far: Array  #: (T, K) depth behind the hips in units of `_FAR`, limited
    speed: Array  #: (T, K) m/s, limited
    rate_hz: float  #: Frames per second

    @property
    def px_per_m(self) -> Array:
        """(T, K) scale of the image at the points' depth."""
        focal = np.trace(self.lens.K[:2, :2]) / 2
        return np.asarray(focal / self.p_point[..., 2])


def simulate_detections(
    rng: Generator, poses: PoseSequence, skeleton: SkeletonModel, camera: Camera, errors: DetectorErrors
) -> Detections:
    """Simulate what a detector finds of one person.

    Each part of the errors has a random stream of its own: switching one off leaves the others as they are.
    `UnknownNameError`: the skeleton lacks a joint that the points are anchored at.

    Args:
        rng: source of randomness, of this person, detector, camera mounting and recording.
        poses: motion at the instants that the frames show; an even rate is assumed.

    Returns:
        One person in the errors' layout, with visibility as confidence; points outside of the image included.
    """
    table = detector_error_table(errors.layout)
    standing, person, lasting, colour, moods, jumps, swaps, seeing, losing = rng.spawn(9)
    person = person if errors.who is None else np.random.default_rng(errors.who)
    true_camera = _true_camera(standing, camera, poses.p_world_joint[:, 0].mean(axis=0), table, errors.camera)
    scene = _scene(person, poses, skeleton, true_camera, table, errors)
    T = len(poses)
    error = errors.coloured * _coloured(colour, scene, table) * _amplitude(moods, scene, table)[..., None]
    factor, rest = table.constant.factor, table.constant.rest
    shared = lasting.standard_normal(factor.shape[-1])
    error += errors.constant * (factor @ shared + rest * lasting.standard_normal(rest.shape))
    error += _jumps(jumps, scene, table, errors.jumps)
    p_found = scene.p_point + np.concatenate([error, np.zeros((T, len(table.layout), 1))], axis=-1)
    uv = _exchanged(swaps, scene.lens.project(p_found), scene, table, errors.exchanges)
    uv_joint = scene.lens.project(scene.p_joint)
    inside = np.all((uv_joint > 0) & (uv_joint < [camera.width_px, camera.height_px]), axis=-1)
    visibility = _visibility(seeing, uv, scene, inside, table)
    lost = _lost(losing, inside, scene.rate_hz, table, errors.losses)
    uv[lost], visibility[lost] = np.nan, 0.0
    return Detections(uv[:, None], visibility[:, None], names=table.layout.names)


# --- what is to be seen --------------------------------------------------------------------------


def _true_camera(
    rng: Generator, camera: Camera, p_world_centre: Array, table: DetectorErrorTable, factor: float
) -> Camera:
    """Return the camera as it really stands: turned about the middle of the scene and moved a little."""
    size = table.numbers["camera"]
    turn = np.radians(size["rotation_sd_deg"]) * rng.standard_normal(3)
    moved = np.array(size["translation_sd_mm"]) / 1e3 * rng.standard_normal(3)
    focal = np.exp(factor * size["focal_sd"] * rng.standard_normal())
    R_true_camera = so3.exp(factor * turn)
    p_camera_centre = camera.to_camera(p_world_centre)
    t = R_true_camera @ (camera.t_camera_world - p_camera_centre) + p_camera_centre + factor * moved
    K = camera.K @ np.diag([focal, focal, 1.0])
    return replace(camera, K=K, R_camera_world=R_true_camera @ camera.R_camera_world, t_camera_world=t)


def _scene(
    rng: Generator,
    poses: PoseSequence,
    skeleton: SkeletonModel,
    camera: Camera,
    table: DetectorErrorTable,
    errors: DetectorErrors,
) -> _Scene:
    p_camera_joint = camera.to_camera(poses.p_world_joint)
    R_camera_bone = camera.R_camera_world @ poses.R_world_bone
    hips = skeleton.index("Hips")[0]
    R_camera_pelvis, p_hips = R_camera_bone[:, hips], p_camera_joint[:, hips]
    anchor = p_camera_joint[:, skeleton.index(*table.places.anchor)]
    R_camera_place = R_camera_bone
    if table is not _table():  # places are in the link frames of the shipped skeleton
        R_camera_place = R_camera_bone @ link_turns(skeleton)
    offset = _offsets(rng, R_camera_place, R_camera_pelvis, anchor, skeleton, table, errors)
    hidden = self_occluded(p_camera_joint, anchor, table.limb, skeleton)
    outward = np.einsum("tkij,kj->tki", R_camera_place[:, skeleton.index(*table.places.frame)], table.places.outward)
    hidden |= np.einsum("tki,tki->tk", outward, so3.unit(-anchor)) < -_AWAY
    legs = [skeleton.index(f"{side}UpLeg", f"{side}Leg", f"{side}Foot") for side in ("Left", "Right")]
    bones = np.diff(poses.p_world_joint[0, legs], axis=1)
    leg = float(np.linalg.norm(bones, axis=-1).sum(axis=1).mean())  # thigh and shank together
    forward, leftward = np.moveaxis(np.einsum("tji,tj->ti", R_camera_pelvis, -p_hips), -1, 0)[:2]
    speed = np.linalg.norm(np.gradient(anchor, axis=0), axis=-1) * poses.rate_hz
    return _Scene(
        lens=replace(camera, R_camera_world=np.eye(3), t_camera_world=np.zeros(3)),
        p_joint=anchor,
        p_point=anchor + leg / table.places.leg * offset,
        azimuth=np.arctan2(leftward, forward),
        hidden=hidden,
        far=np.clip((anchor[..., 2] - p_hips[:, None, 2]) / _FAR, -_FAR_RANGE, _FAR_RANGE),
        speed=np.minimum(speed, _FASTEST),
        rate_hz=poses.rate_hz,
    )


def _offsets(
    rng: Generator,
    R_camera_bone: Array,
    R_camera_pelvis: Array,
    anchor: Array,
    skeleton: SkeletonModel,
    table: DetectorErrorTable,
    errors: DetectorErrors,
) -> Array:
    """Return the places (T, K, 3) from the anchors in camera axes, m, for a leg as in the table."""
    places = table.places
    own = errors.person * (places.person_sd * rng.standard_normal(places.person_sd.shape))[places.person]
    own[table.left & (table.kind != table.group.index(_RIGID)), 1] *= -1
    toward = so3.unit(-anchor) @ R_camera_pelvis
    view = errors.view * np.exp(places.view_spread * rng.standard_normal()) * places.view
    turned = np.einsum("tkh,khj->tkj", harmonics(toward), view)

    def fixed(frames: tuple[str, ...], offset: Array) -> Array:
        return np.asarray(np.einsum("tkij,kj->tki", R_camera_bone[:, skeleton.index(*frames)], offset))

    in_frames = fixed(places.frame, places.mean + own) + fixed(places.second_frame, places.pose)
    return np.asarray(in_frames + turned @ np.swapaxes(R_camera_pelvis, -1, -2))


# --- errors in the image, m at the depth of the points -------------------------------------------


def _coloured(rng: Generator, scene: _Scene, table: DetectorErrorTable) -> Array:
    """Return (T, K, 2) the sum over views and time constants of Ornstein-Uhlenbeck processes."""
    T, (factor, rest) = len(scene.azimuth), (table.coloured.factor, table.coloured.rest)
    V, K, _, r = factor.shape
    along, across = np.cos(scene.azimuth), np.sin(scene.azimuth)
    weight = np.maximum(np.stack([along, -along, across, -across], axis=-1), 0)
    out = np.zeros((T, K, 2))
    for memory, share in zip(table.time_constants * scene.rate_hz, table.shares.T, strict=True):
        shared = ornstein_uhlenbeck(rng, T, (V, r), memory) * weight[..., None]
        own = ornstein_uhlenbeck(rng, T, (V, K, 2), memory) * weight[..., None, None]
        together = np.einsum("tvr,vkir->tki", shared, factor, optimize=True)
        out += np.sqrt(share)[:, None] * (together + np.einsum("tvki,vki->tki", own, rest))
    return smoothed(out, table.smoothing * scene.rate_hz)


def _amplitude(rng: Generator, scene: _Scene, table: DetectorErrorTable) -> Array:
    """Return the factor (T, K) on coloured errors."""
    numbers, kind, rate = table.numbers["amplitude"], table.amplitude, scene.rate_hz
    exponent = kind["hidden"] * scene.hidden + kind["far"] * scene.far + kind["speed"] * scene.speed
    mood = ornstein_uhlenbeck(rng, len(exponent), (_LIMBS,), numbers["mood_memory"] * rate)
    mood = smoothed(mood, numbers["mood_smoothing"] * rate)[:, table.limb] * kind["mood_sd"]
    return np.asarray(kind["gain"] * np.exp(np.clip(exponent, *numbers["log_range"]) + mood - kind["mood_sd"] ** 2))


def _jumps(rng: Generator, scene: _Scene, table: DetectorErrorTable, factor: float) -> Array:
    """Return displacements (T, K, 2) of whole limbs for some frames."""
    numbers = table.numbers["jumps"]
    out = np.zeros((*scene.hidden.shape, 2))
    small = np.isin(np.arange(len(table.kind)), table.points_of(numbers["small"]["groups"]))
    share = np.where(small, numbers["small"]["factor"], 1.0)[:, None]
    for limb in numbers["limbs"]:
        points = table.points_of(limb["groups"])
        for side in filter(len, (points[table.left[points]], points[~table.left[points]])):
            often = np.where(scene.hidden[:, side].mean(axis=1) > 0.5, numbers["when_hidden"], 1.0)
            for frames in episodes(rng, factor * limb["per_minute"] * often, scene.rate_hz, numbers):
                size = numbers["size_mm"] / 1e3 * np.exp(numbers["size_spread"] * rng.standard_normal())
                out[frames, side] += size * rng.standard_normal(2) * share[side]
    return out


def _exchanged(rng: Generator, uv: Array, scene: _Scene, table: DetectorErrorTable, factor: float) -> Array:
    """Return points (T, K, 2) with left and right exchanged for some frames, mostly in profile."""
    numbers = table.numbers["exchanges"]
    apart = np.linalg.norm(uv - uv[:, table.mirror], axis=-1) / scene.px_per_m * 1e3
    out = uv.copy()
    for row in numbers["rates"]:
        if not len(points := table.points_of(row["groups"])):
            continue
        beyond = np.maximum(apart[:, points].mean(axis=1) - numbers["near_mm"], 0)
        likely = np.sin(scene.azimuth) ** 2 * (numbers["always"] + np.exp(-beyond / numbers["near_mm"]))
        for frames in episodes(rng, factor * row["per_minute"] * likely, scene.rate_hz, numbers):
            out[frames, points] = out[frames][:, table.mirror[points]]
    return out


# --- what the detector says ----------------------------------------------------------------------


def _visibility(rng: Generator, uv: Array, scene: _Scene, inside: Mask, table: DetectorErrorTable) -> Array:
    """Return what the detector reports of each point (T, K)."""
    kind = table.visibility
    memory = table.numbers["visibility"]["memory"] * scene.rate_hz
    T, K = inside.shape
    error = np.linalg.norm(uv - scene.lens.project(scene.p_point), axis=-1) / scene.px_per_m
    shared = ornstein_uhlenbeck(rng, T, (_LIMBS,), memory)[:, table.limb]
    residual = (shared + ornstein_uhlenbeck(rng, T, (K,), memory)) / np.sqrt(2)
    logit = kind["base"] + kind["hidden"] * scene.hidden + kind["far"] * scene.far
    logit += kind["log_error"] * np.log(np.maximum(error, _LEAST_ERROR) / _LOG_ERROR)
    logit += kind["outside"] * ~inside + kind["residual_sd"] * residual
    return np.asarray(1 / (1 + np.exp(-logit)))


def _lost(rng: Generator, inside: Mask, rate_hz: float, table: DetectorErrorTable, factor: float) -> Mask:
    """Return the frames (T,) without the person: too little of it in the image, or lost by itself."""
    numbers, T = table.numbers["lost"], len(inside)
    wandering = ornstein_uhlenbeck(rng, T, (), numbers["share_memory"] * rate_hz)
    out = inside.mean(axis=1) < numbers["share_inside"] + numbers["share_sd"] * wandering
    for frames in episodes(rng, np.full(T, factor * numbers["per_minute"]), rate_hz, numbers):
        out[frames] = True
    return np.asarray(out)
