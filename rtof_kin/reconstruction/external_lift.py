"""The 3D points of another model as a further lift: brought to the package's own, and weighed against it.

A model's points come on axes of its own, at a scale of its own, on a clock near the video's, and around the hips or
anywhere. So rotation, scale and delay are found, once for a recording: the delay by the own lift (similarity of Umeyama
1991, PAMI 13, robust), the scale by the lengths of the skeleton's bones, and the rotation by the image, in which the
turned points must be seen where they are, at any place of the body in each frame. What counts is in which directions
the bones point: lengths are the skeleton's, the place in the room is that of the own lift.

Its errors are estimated, not believed. Across the camera's ray the image tells how far each lift is off, and so the
ratio of their standard deviations. Along the ray, with that of the own lift, s, the difference d of the two, and errors
that are correlated by rho, as both see one image,

::

    E d^2 = e^2 - 2 rho s e + s^2

gives that of the other lift, e, for each joint; it is not less than what is usual of the model, than the sensor of the
segment says, or than a share of s, as d is small too where both err alike. With the correlation that d, s and e show,
the weight of the other lift in the best mean of both is (1 + (s^2 - e^2) / d^2) / 2, within bounds. All lifts are
combined as those of several cameras are (`lift.fused`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
import scipy

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import CLAVICLES, SPINE
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.world_axes import METRES, UP
from rtof_kin.markers.marker_sets import places_of
from rtof_kin.reconstruction.lift import JOINT, Lifted
from rtof_kin.vision.layouts import mirrored
from rtof_kin.vision.lift_points import LiftPoints, convention, recognised, usual_errors

_DELAYS: Final = np.arange(-12, 13) * 0.04  #: [s] by which the clock may differ from the video's
_SAMPLE: Final = 400  #: Frames by which rotation and delay are found
_SAME: Final = 0.01  #: Relative misfit within which a delay counts as none
_CORRELATION: Final = 0.3  #: [1] of the errors of two lifts of one image
LEAST: Final = np.array([0.01, 0.02])  #: [m] least standard deviation across and along the ray of a joint
_MOST_RATIO: Final = 3.0  #: Largest ratio of the two lifts' errors across the ray
_FOREIGN: Final = 2.5  #: Differences from the own lift, relative to its standard deviations, from which it is left out
FEWEST: Final = 8  #: Fewest joints that its points show
LONGEST_GAP: Final = 0.2  #: [s] between samples that are interpolated
_UNKNOWN: Final = 1e3  #: [m], [rad] of what it does not show
_UNIT: Final = 0.25  #: Largest logarithm of the scale relative to a unit's
_BEST: Final = 0.7  #: Least error of the other lift along the ray, relative to the own one's
_SHARES: Final = (0.01, 0.7)  #: Least and largest weight of the other lift along the ray
_CROSSED: Final = 0.6  #: Distance from the own lift, relative to that as they are, below which sides are exchanged
_MOST_EXCHANGED: Final = 0.4  #: Share of frames with exchanged sides from which the points are not used
_BETTER: Final = 0.8  #: Distance, relative to that of the points as they are, below which mirrored ones are right


@dataclass(frozen=True)
class Agreement:
    """How the points of another model agree with the own lift."""

    name: str  #: Of the file
    title: str  #: Of their convention
    scale: float  #: Metres of the body in a unit of the file
    delay: float  #: [s] by which the points are late
    R_world_file: Array  #: (3, 3)
    sigma: tuple[float, float]  #: [m] RMS standard deviations of its joints, and of the own lift's or NaN, in 3D
    doubt: str = ""  #: Why it is not used; '' where it is
    exchanged: float = 0.0  #: Share of its frames in which sides were exchanged back

    @property
    def warning(self) -> str:
        """That it is not used, and why; '' where it is."""
        return f"{self.name} is not used as a lift: {self.doubt}" if self.doubt else ""

    def __str__(self) -> str:
        if self.doubt:
            return f"{self.name} ({self.title}): left out, {self.doubt}"
        unit = next((f"in {unit}" for unit, m in METRES.items() if abs(np.log(self.scale / m)) < _UNIT), "")
        up = max(UP, key=lambda axis: float(self.R_world_file[2] @ UP[axis][2]))
        late = f"{abs(1000 * self.delay):.0f} ms {'late' if self.delay > 0 else 'early'}" if self.delay else "in time"
        own, other = (f"{1000 * size:.0f} mm" for size in reversed(self.sigma))
        own = "" if np.isnan(self.sigma[1]) else f", the own lift to {own}"
        found = f"{unit or 'in a unit of its own'} (scale {self.scale:.3g}), {up} up, {late}"
        found += f", sides exchanged back in {100 * self.exchanged:.0f} % of its frames" if self.exchanged else ""
        return f"{self.name} ({self.title}): {found}; joints to {other}{own}"


def external(
    lift: LiftPoints,
    own: Lifted,
    video: KeypointSequence,
    skeleton: SkeletonModel,
    bone_imus: BoneImuSequence | None = None,
) -> tuple[Lifted, Agreement]:
    """Return another model's points as a lift at the times of the own one, which are those of the video.
    `InvalidInputError`: names of no known convention, or they show fewer than `FEWEST` joints.

    Args:
        bone_imus: sensors at these times; on their segments they tell which lift is better.
    """
    if own.poses.names != SkeletonModel.default().names:
        raise InvalidInputError(f"{lift.name}: the points of another model need the 21-joint skeleton")
    title, usual, columns, segments, places, spread = placed_points(lift, skeleton)
    poses, times, clock = own.poses, lift.points.times, video.video_times
    R, p = poses.R_world_bone, poses.p_world_joint
    at = lift.points.p_world[:, columns]
    model = p[:, segments] + np.einsum("tkij,kj->tki", R[:, segments], places)
    joints = nearest_joints(segments, places, skeleton)
    offset, seen, mean = (
        model - p[:, joints],
        video.select(skeleton.names),
        partial(mean_joints, joints, spread, p.shape),
    )
    delay, scale, R_world_file, distance = _alignment(times, at, clock, model)

    def shown_at(delay: float) -> Array:
        late = signals.interpolate(times, at, clock + delay, LONGEST_GAP)
        return mean(scale * late @ R_world_file.T - offset)

    delay = _delay(lambda other: _misfit(shown_at(other), seen), delay)
    for _ in range(2):
        shown = shown_at(delay)
        scale, R_world_file = scale * by_bones(shown, skeleton), _by_image(shown, seen) @ R_world_file
    shown, exchanged = sides_mended(shown_at(delay), p, skeleton)
    turned = turned_to(R, p, shown, skeleton)
    positions = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p[:, 0], turned)
    sigma_own = np.where(np.isfinite(own.sigma_m), own.sigma_m, JOINT)  # (T, J, 2) across and along the ray, m
    known = _known(shown, skeleton)
    ray, off = so3.unit(p - video.camera.center_world), positions - p
    along = np.sum(off * ray, axis=-1)
    across = np.linalg.norm(off - along[..., None] * ray, axis=-1) / np.sqrt(2)
    difference = np.stack([across, along], axis=-1)  # (T, J, 2) per axis across and along the ray, m
    ratio = float(np.sqrt(np.mean((difference / sigma_own)[known] ** 2))) if known.any() else np.nan
    least = np.maximum(np.maximum(LEAST, usual), spread_of_joints(joints, spread, len(skeleton.names)))
    worse = np.zeros(len(skeleton.names)) if bone_imus is None else _by_sensors(R, turned, bone_imus, skeleton)
    error, sigma = _sigma(difference, sigma_own, known, _image_ratio(positions, p, seen), worse, least)
    sigma_rad = np.full(known.shape, _UNKNOWN)
    for j, ends in bearing(skeleton).items():
        shows = known[:, [end for pair in ends for end in pair]].all(axis=1)
        sigma_rad[shows, j] = np.sqrt(np.mean([direction(sigma, pair, skeleton) for pair in ends]))
    lifted = Lifted(
        replace(poses, p_world_joint=positions, R_world_bone=turned, sigma_rad=sigma_rad),
        np.where((sigma_rad < _UNKNOWN)[..., None, None], turned, np.nan),
        np.where(known[..., None], sigma, _UNKNOWN),
    )
    doubt = _doubt(times, at, clock, model, ratio, distance)
    if not doubt and exchanged > _MOST_EXCHANGED:
        doubt = f"left and right are exchanged in {100 * exchanged:.0f} % of its frames"
    sizes = [_size(np.broadcast_to(each, difference.shape)[known]) for each in (error, sigma_own)]
    return lifted, Agreement(lift.name, title, scale, delay, R_world_file, (sizes[0], sizes[1]), doubt, exchanged)


def sides_mended(shown: Array, p: Array, skeleton: SkeletonModel) -> tuple[Array, float]:
    """Return joints (T, J, 3) with legs or arms exchanged in frames in which they are nearer so to those of the own
    lift (T, J, 3), both from the middle of the hips; and the share of such frames.
    """
    out, wrong = shown.copy(), np.zeros(len(shown), dtype=bool)
    hips = skeleton.index("LeftUpLeg", "RightUpLeg")
    seen, own = (v - v[:, hips].mean(axis=1, keepdims=True) for v in (shown, p))
    for limb in kinematics.LIMBS[:2]:  # of the left side
        there = skeleton.index(*limb, *map(mirrored, limb))
        other = there[3:] + there[:3]
        straight, crossed = (np.linalg.norm(seen[:, j] - own[:, there], axis=-1).sum(axis=1) for j in (there, other))
        mended = crossed < _CROSSED * straight  # not where a joint is missing
        out[np.ix_(mended, there)] = shown[np.ix_(mended, other)]
        wrong |= mended
    return out, float(wrong.mean())


def _known(shown: Array, skeleton: SkeletonModel) -> Mask:
    """Return which joints (T, J) are known by those that are shown (T, J, 3): none without the hips, those of the trunk
    by hips and shoulders.
    """
    known: Mask = np.asarray(np.isfinite(shown).all(axis=-1))
    hips: Mask = np.asarray(known[:, skeleton.index("LeftUpLeg", "RightUpLeg")].all(axis=1))
    known = known & hips[:, None]
    trunk: Mask = np.asarray(hips & known[:, skeleton.index("LeftArm", "RightArm")].all(axis=1))
    known[:, [0, *skeleton.index(*SPINE, "Neck")]] = trunk[:, None]
    return known


def _size(sigma: Array) -> float:
    """RMS distance, m, of errors across and along the ray (N, 2); NaN of none."""
    return float(np.sqrt(np.mean(sigma**2 @ [2.0, 1.0]))) if len(sigma) else np.nan


def _doubt(times: Array, at: Array, clock: Array, model: Array, ratio: float, distance: float) -> str:
    """Return why points (T, K, 3) are not those of the video: nobody, another time or rate, mirrored, or else another
    motion; '' where they are.

    `ratio`: of the differences from the own lift to its standard deviations; NaN where there is no common frame.
    `distance`: from a model (T', K, 3) at `clock`, m.
    """
    shown: Mask = np.asarray(np.isfinite(at).all(axis=-1).sum(axis=1) >= FEWEST)
    if not shown.any():
        return f"it shows nobody: no frame has {FEWEST} of the points that are needed"
    first, last = times[shown][[0, -1]]
    if np.isnan(ratio):
        span = f"{first:.2f} to {last:.2f} s, the video {clock[0]:.2f} to {clock[-1]:.2f} s"
        return f"it has no frame of this video: it shows somebody from {span}"

    seconds, video = float(np.ptp(times)), float(np.ptp(clock))
    other_rate = len(times) == len(clock) and abs(seconds / max(video, 1e-9) - 1) > _SAME
    if other_rate and _alignment(clock, at, clock, model)[-1] < distance:
        return f"its times are at another rate: it lasts {seconds:.2f} s, the video {video:.2f} s with as many frames"
    if ratio <= _FOREIGN:
        return ""
    if _alignment(times, at * [-1.0, 1.0, 1.0], clock, model)[-1] < _BETTER * distance:
        return "its points are mirrored: its axes are left-handed, or left and right are exchanged"
    return "its motion is not that in the video: of another person or take, at another rate, or it fails here"


def placed_points(lift: LiftPoints, skeleton: SkeletonModel) -> tuple[str, Array, list[int], Array, Array, Array]:
    """Return the title of the points' convention, its usual errors (2,) across and along the ray, m, and the columns,
    segment, place (K, 3), m, and standard deviation of that place per axis (K,), m, of each point.

    Names are those of a convention, or of a marker set.
    """
    names = lift.points.names
    form = convention(lift.convention) if lift.convention else recognised(names)
    if form is not None:
        title, usual = form.layout.title, usual_errors(form, lift.points)
        named = zip(form.layout.found(names), form.segments, form.places, form.sigma, strict=True)
        rows = [row for row in named if row[0] is not None]
    else:
        markers = places_of(names)
        title, usual, sigma = f"markers, {markers.set_name}", np.zeros(2), markers.sigma_place.mean(axis=1)
        of = zip(markers.names, markers.segments, markers.p_bone_marker, sigma, strict=True)
        rows = [(names.index(name), segment, place, sd) for name, segment, place, sd in of]
    if (count := len({row[1] for row in rows})) < FEWEST:
        raise InvalidInputError(f"{lift.name}: its points are on {count} segments; give {FEWEST} or more")
    columns, segments, places, spread = zip(*rows, strict=True)
    size = skeleton.height / SkeletonModel.default().height
    at = np.array(skeleton.index(*segments))
    return title, usual, list(columns), at, size * np.array(places), size * np.array(spread)


def nearest_joints(segments: Array, places: Array, skeleton: SkeletonModel) -> Array:
    """Return the joint at an end of each point's segment that is nearest to it (K,)."""
    out = segments.copy()
    for k, (segment, place) in enumerate(zip(segments, places, strict=True)):
        ends = [segment, *kinematics.children_of(skeleton.parents, segment)]
        at = [np.zeros(3), *skeleton.joint_offsets[ends[1:]]]
        out[k] = ends[int(np.argmin(np.linalg.norm(np.array(at) - place, axis=1)))]
    return out


def _alignment(times: Array, points: Array, at: Array, model: Array) -> tuple[float, float, Array, float]:
    """Return delay, s, scale and rotation under which points (T, K, 3) agree best with a model (T', K, 3) at `at`, and
    their RMS distance, m.
    """
    step = max(1, len(at) // _SAMPLE)
    late = ((delay, signals.interpolate(times, points, at[::step] + delay, LONGEST_GAP)) for delay in _DELAYS)
    found = [(delay, *_similarity(seen, model[::step])) for delay, seen in late]
    delay, distance, scale, R = min(found, key=lambda row: row[1])
    return float(delay), scale, R, distance


def _delay(misfit: Callable[[float], float], near: float) -> float:
    """Return the delay, s, of the smallest misfit within 0.12 s; 0 where that is hardly worse."""
    grid = near + np.arange(-3, 4) * 0.04
    best = float(grid[int(np.argmin([misfit(float(delay)) for delay in grid]))])
    found = scipy.optimize.minimize_scalar(
        misfit, bounds=(best - 0.04, best + 0.04), method="bounded", options={"xatol": 2e-3, "maxiter": 12}
    )
    return float(found.x) if found.fun < (1 - _SAME) * misfit(0.0) else 0.0


def _misfit(shown: Array, video: KeypointSequence) -> float:
    """Return how far shown joints (T, J, 3) are from where they are seen after the best rotation, RMS, m."""
    step = max(1, len(shown) // _SAMPLE)
    shown, video = shown[::step], video[::step]
    off, _, known = _off_image(shown @ _by_image(shown, video, rounds=3).T, video)
    return float(np.sqrt(np.mean(np.minimum(np.sum(off[known] ** 2, axis=-1), 0.01)))) if known.any() else np.inf


def _similarity(points: Array, model: Array) -> tuple[float, float, Array]:
    """Return RMS distance, m, scale and rotation (3, 3) of the similarity that brings centred points (T, K, 3) to a
    model's, with Cauchy weights; infinite distance where there are none.
    """
    both: Mask = np.asarray(np.isfinite(points + model).all(axis=-1))
    enough = both.sum(axis=1) >= FEWEST
    if not enough.any():
        return np.inf, 1.0, np.eye(3)
    both = both[enough]
    x, y = (np.where(both[..., None], v[enough], 0.0) for v in (points, model))
    weight = both.astype(float)
    scale, R, size = 1.0, np.eye(3), np.inf
    for _ in range(5):
        share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
        a, b = (np.where(both[..., None], v - (share * v).sum(axis=1, keepdims=True), 0.0) for v in (x, y))
        moment = np.einsum("tki,tkj,tk->ij", b, a, weight)
        R = so3.nearest_rotation(moment)
        power = float(np.einsum("tki,tki,tk->", a, a, weight))
        scale = float(np.sum(R * moment)) / power if power > 0 else 1.0
        distance = np.linalg.norm(b - scale * a @ R.T, axis=-1)
        size = float(np.median(distance[both]))
        weight = both / (1 + (distance / max(2 * size, 1e-6)) ** 2)
    return float(np.sqrt(np.mean(np.minimum(distance[both], 0.3) ** 2))), scale, R


def mean_joints(joints: Array, spread: Array, shape: tuple[int, ...], points: Array) -> Array:
    """Return joints (T, J, 3) as the mean of what points (T, K, 3) say of theirs, by the standard deviations of their
    places (K,); NaN where none does.
    """
    out, weights = np.full(shape, np.nan), 1 / spread**2
    for joint in np.unique(joints):
        own, weight = points[:, joints == joint], weights[joints == joint, None]
        weight = np.where(np.isfinite(own).all(axis=-1, keepdims=True), weight, 0.0)
        total = weight.sum(axis=1)
        mean = (weight * np.nan_to_num(own)).sum(axis=1) / np.maximum(total, 1e-9)
        out[:, joint] = np.where(total > 0, mean, np.nan)
    return out


def spread_of_joints(joints: Array, spread: Array, count: int) -> Array:
    """Return the standard deviation (J, 1), m, of each joint's place by those of its points; 0 where it has none."""
    information = np.bincount(joints, 1 / spread**2, count)
    return np.asarray(np.where(information > 0, 1 / np.sqrt(np.maximum(information, 1e-9)), 0.0))[:, None]


def by_bones(shown: Array, skeleton: SkeletonModel) -> float:
    """Return the factor that gives bones between shown joints (T, J, 3) the skeleton's lengths, in the median."""
    ends = [j for j in range(1, len(skeleton.names)) if skeleton.names[j].endswith(("Leg", "Foot", "ForeArm", "Hand"))]
    bones = shown[:, ends] - shown[:, [skeleton.parents[j] for j in ends]]
    lengths = np.linalg.norm(bones, axis=-1)
    ratio = np.linalg.norm(skeleton.joint_offsets[ends], axis=1) / lengths
    return float(np.median(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else 1.0


def _by_image(shown: Array, video: KeypointSequence, rounds: int = 8) -> Array:
    """Return the rotation (3, 3) in world of all shown joints (T, J, 3) under which the camera sees them as it does, at
    any place in each frame: by Gauss-Newton steps with Cauchy weights.
    """
    R, turn = video.camera.R_camera_world, np.eye(3)
    step = max(1, len(shown) // _SAMPLE)
    shown, video = shown[::step], video[::step]
    for _ in range(rounds):
        off, by_turn, known = _off_image(shown @ (R.T @ turn @ R).T, video)
        if not known.any():
            break
        error = np.linalg.norm(off, axis=-1)
        size = float(np.median(error[known]))
        weight = np.repeat((known / (1 + (error / max(2 * size, 1e-9)) ** 2)).ravel(), 2)
        D, r = by_turn.reshape(-1, 3), off.ravel()
        turn = so3.exp(-np.linalg.solve(D.T @ (weight[:, None] * D), D.T @ (weight * r))) @ turn
    return np.asarray(R.T @ turn @ R)


def _off_image(joints: Array, video: KeypointSequence) -> tuple[Array, Array, Mask]:
    """Return how far joints (T, J, 3), each frame at the best place, are from where they are seen, (T, J, 2) m; the
    derivatives (T, J, 2, 3) by a rotation about the camera's axes; and which are known (T, J).

    A point X is seen at x if X + t is parallel to (x, 1): linear in the place t, which is eliminated in each frame.
    """
    camera = video.camera
    known: Mask = np.asarray(np.isfinite(joints).all(axis=-1) & video.seen)
    known = known & (known.sum(axis=1) >= FEWEST)[:, None]
    out, by_turn = np.zeros((*known.shape, 2)), np.zeros((*known.shape, 2, 3))
    frames = np.flatnonzero(known.any(axis=1))
    if not len(frames):
        return out, by_turn, known
    both = known[frames]
    x = np.where(both[..., None], camera.normalise(np.where(known[..., None], video.uv_px, 0.0)[frames]), 0.0)
    X = np.where(both[..., None], joints[frames], 0.0)
    X = X - X.sum(axis=1, keepdims=True) / both.sum(axis=1)[:, None, None]
    X = np.where(both[..., None], X, 0.0) @ camera.R_camera_world.T
    across = np.zeros((*x.shape[:2], 2, 3))  # (1, 0, -x), (0, 1, -y)
    across[..., 0, 0] = across[..., 1, 1] = 1.0
    across[..., 2] = -x
    sides = np.concatenate([-across @ so3.skew(X), across @ X[..., None]], axis=-1) * both[..., None, None]
    A, sides = (across * both[..., None, None]).reshape(len(x), -1, 3), sides.reshape(len(x), -1, 4)
    left = sides - A @ np.linalg.solve(np.swapaxes(A, 1, 2) @ A, np.swapaxes(A, 1, 2) @ sides)
    left = left.reshape(*both.shape, 2, 4)
    out[frames], by_turn[frames] = left[..., 3], left[..., :3]
    return out, by_turn, known


def bearing(skeleton: SkeletonModel) -> dict[int, list[tuple[int, int]]]:
    """Return segments and the pairs of joints whose directions show how each is turned, once for each axis."""
    at = skeleton.names.index
    chains = {at(a): [(at(a), at(b))] for limb in kinematics.LIMBS for a, b in pairwise(limb)}
    trunk = (0, at("Neck"))
    chains[0] = [trunk, trunk, (at("LeftUpLeg"), at("RightUpLeg"))]
    chains[at(SPINE[-1])] = [trunk, trunk, (at("LeftArm"), at("RightArm"))]
    return chains


def direction(sigma: Array, pair: tuple[int, int], skeleton: SkeletonModel) -> float:
    """Return the variance of the direction between two joints whose standard deviations are sigma (J, 2), rad^2."""
    places = kinematics.positions(
        skeleton.parents, skeleton.joint_offsets, np.zeros((1, 3)), np.tile(np.eye(3), (1, len(skeleton.names), 1, 1))
    )[0]
    return float(np.mean(sigma[list(pair)] ** 2) * 2 / np.sum((places[pair[0]] - places[pair[1]]) ** 2))


def turned_to(R: Array, p: Array, shown: Array, skeleton: SkeletonModel) -> Array:
    """Return orientations (T, J, 3, 3): those of the own lift, turned as the shown joints (T, J, 3) are to its own.

    Pelvis and upper trunk turn with hips or shoulders and the line between them; limbs by the smallest rotation.
    """
    at, out = skeleton.names.index, np.array(R)
    hips, arms = ([at(side + name) for side in ("Left", "Right")] for name in ("UpLeg", "Arm"))

    def across(joints: Array, pair: list[int]) -> Array:
        trunk = joints[:, arms].mean(axis=1) - joints[:, hips].mean(axis=1)
        return np.stack([joints[:, pair[0]] - joints[:, pair[1]], trunk], axis=1)

    pelvis, thorax = (_between(across(p, pair), across(shown, pair)) for pair in (hips, arms))
    for turn, names in ((pelvis, ("Hips", "Spine")), (thorax, (*SPINE[1:], "Neck", "Head", *CLAVICLES))):
        for name in names:
            out[:, at(name)] = turn @ R[:, at(name)]
    for limb in kinematics.LIMBS:
        upper, lower, end = map(at, limb)
        for a, b in ((upper, lower), (lower, end)):
            own, other = (so3.unit(v[:, b] - v[:, a]) for v in (p, shown))
            known = np.isfinite(other).all(axis=-1)
            out[known, a] = so3.minimal_rotation(own[known], other[known]) @ out[known, a]
        turn = out[:, lower] @ np.swapaxes(R[:, lower], -1, -2)
        out[:, end] = turn @ R[:, end]  # without points beyond: as the segment before
    return out


def _between(own: Array, other: Array) -> Array:
    """Return the rotations (T, 3, 3) that bring the directions of two vectors (T, 2, 3) to others; 1 where unknown."""
    known: Mask = np.asarray(np.isfinite(own + other).all(axis=(1, 2)))
    out = np.tile(np.eye(3), (len(own), 1, 1))
    moment = np.einsum("tki,tkj->tij", so3.unit(other[known]), so3.unit(own[known]))
    out[known] = so3.nearest_rotation(moment)
    return out


def _image_ratio(other: Array, own: Array, video: KeypointSequence) -> Array:
    """Return how far joints (T, J, 3) of another lift are from where they are seen, relative to the own's (J,)."""
    sizes = []
    for joints in (other, own):
        off, _, known = _off_image(joints, video)
        count = np.maximum(known.sum(axis=0), 1)
        sizes.append(np.sqrt((np.sum(off**2, axis=-1) * known).sum(axis=0) / count) + LEAST[0])
    return np.asarray(np.clip(sizes[0] / sizes[1], 1 / _MOST_RATIO, _MOST_RATIO))


def _by_sensors(own: Array, other: Array, imus: BoneImuSequence, skeleton: SkeletonModel) -> Array:
    """Return how far the bones of another lift's orientations (T, J, 3, 3) are from those of sensors, relative to the
    own's, for the joint at the end of each (J,); 0 where they are nearer, or where no sensor tells.
    """
    out = np.zeros(len(skeleton.names))
    for s, name in enumerate(imus.joints):
        joint, axis = skeleton.index(name)[0], skeleton.bone_axis(name)
        bones = np.linalg.norm([(R[:, joint] - imus.R_world_bone[:, s]) @ axis for R in (own, other)], axis=-1)
        bones = bones[:, np.isfinite(bones).all(axis=0)]
        ratio = np.sqrt(np.sum(bones[1] ** 2) / max(np.sum(bones[0] ** 2), 1e-9))
        out[kinematics.children_of(skeleton.parents, joint)] = ratio if ratio > 1 else 0.0
    return out


def _sigma(
    difference: Array, sigma_own: Array, known: Mask, ratio: Array, worse: Array, least: Array
) -> tuple[Array, Array]:
    """Return standard deviations (J, 2), m, of the other lift, and those that give it, as if independent, the weight
    that it has with the correlation that both show.

    `ratio`: of its errors in the image to the own's (J,). `worse`: of its errors to the own's by sensors, 0 where they
    do not tell (J,).
    """
    error, sigma = np.empty((2, *difference.shape[1:]))
    for j in range(len(error)):
        rows = known[:, j] if known[:, j].any() else slice(None)
        s = np.sqrt(np.mean(sigma_own[rows, j] ** 2, axis=0))
        d2 = np.mean(difference[rows, j] ** 2, axis=0)
        left = d2[1] - (1 - _CORRELATION**2) * s[1] ** 2
        seen = [ratio[j] * s[0], max(_CORRELATION * s[1] + np.sqrt(max(left, 0.0)), _BEST * s[1])]
        error[j] = np.maximum(np.maximum(seen, worse[j] * s), least[j])
        share = np.clip((1 + (s[1] ** 2 - error[j, 1] ** 2) / max(d2[1], 1e-9)) / 2, *_SHARES)
        sigma[j] = error[j, 0], s[1] * np.sqrt((1 - share) / share)
    sigma[0] = error[0]  # the root is the own lift's
    return error, sigma
