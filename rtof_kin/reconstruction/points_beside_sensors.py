"""The 3D points of another model beside sensors, without a video: joints measured in space, for mode ``imu``.

A ``.trc`` of Pose2Sim, Sports2D or OpenCap has axes, unit and clock of its own. With u and v the directions of a bone
by its sensor and in the file, and H = sum u' v'^T of their derivatives by time over all bones, the best rotation R of
the file's axes at an offset of the clocks has sum u' . R v' = tr(R^T H), the sum of H's singular values, the least with
the sign of det H (Wahba 1965): all offsets at once take a few FFTs, and neither what is up, nor a heading, nor constant
errors matter. At the best offset R follows from the directions, the scale from bones along them. Limbs whose sides are
exchanged are exchanged back.

Errors of such joints last for a second and more. Their sizes are estimated by the bones with a sensor, beyond the
sensor's own errors, and are at least the usual ones of the convention; `decorrelated` has what follows for covariances.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy import fft

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance, valid_positions
from rtof_kin.formats.world_axes import METRES
from rtof_kin.inertial.root_path import Contacts, RootPath, by_hand, detect_contacts, path_through_gaps, root_path
from rtof_kin.reconstruction import external_lift as lifts
from rtof_kin.reconstruction.external_lift import Agreement
from rtof_kin.solve.solution import FragmentSolution
from rtof_kin.solve.terms import Matrix, PointData, PointTerm
from rtof_kin.vision.lift_points import LiftPoints

_STEP: Final = 0.02  #: [s] between samples of directions
_CUTOFF_HZ: Final = 4.0
_FASTEST: Final = 6.0  #: [rad/s] Faster turns are shortened to it: exchanged sides jump
_COMMON: Final = 2.0  #: [s] Least overlap of file and sensors, or three quarters of the shorter one
_SHORTEST: Final = 0.5  #: [s] that a file shows, at least
_NEAR: Final = 0.5  #: [s] Offset that the clocks of one trial usually have
_AS_GOOD: Final = 0.85  #: Correlation relative to the best one, from which an offset within that is believed
_ALIKE: Final = 0.7  #: Correlation of directions' derivatives from which a file is of the same motion
_APART: Final = np.radians(25.0)  #: [rad] Median angle between the bones of both up to which it is
_MIRRORED: Final = 1.3  #: Correlation of mirrored points relative to that of the points, above which they are mirrored
_METRIC: Final = 0.08  #: Logarithm of the scale relative to a unit's, below which the file is believed to be in that
_SENSOR: Final = np.radians(5.0)  #: [rad] of a bone's direction by its sensor
_RAYLEIGH: Final = 1.1774  #: Median size of a vector with two normal components, relative to their standard deviation
_AROUND: Final = 0.02  #: [m] Motion of the hips' middle up to which points count as being about the hips
_ROOT, _UNSEEN = 0.01, 0.3  #: [m] Least standard deviation of the root in world, and that in gaps without foot sensors
_STANCE, _TILT = 0.03, np.radians(2.0)  #: [m], [rad] of a standing ankle's height in a second, and of what is up
_TURNS_HZ: Final = 2.0  #: [Hz] Faster turns of segments without a sensor are those by the sensors about them
_FACTOR: Final = 2.5
"""[1] Actual errors relative to the Hessian's, which takes frames as independent; of the motions of
``python -m benchmarks accuracy --subset validation`` with 8, 6 and 4 sensors and planted files."""


@dataclass(frozen=True)
class MeasuredJoints:
    """Joints of a file at the frames of sensors, on their axes."""

    p_world: Array  #: (T, J, 3) m; NaN where the file does not show them
    sigma: Array  #: (J,) m, standard deviation per axis
    R_world_bone: Array  #: (T, J, 3, 3) by the sensor where a segment has one, else by the file, bridged in its gaps
    root: Array  #: (T, 3) m, by all joints; NaN where too few are shown, and everywhere for points about the hips

    def terms(self, skeleton: SkeletonModel) -> tuple[PointTerm, ...]:
        """Return a term for each joint that is shown, of its place or, of points about the hips, that from the root."""
        shown, hips = np.isfinite(self.p_world).all(axis=2).any(axis=0), skeleton.names[0]
        names = [skeleton.names[j] for j in np.flatnonzero(shown)]
        if np.isfinite(self.root).any():
            return tuple(PointTerm(f"file_{name}", name, _in_world, 3) for name in names)
        return tuple(PointTerm(f"file_{name}", (name, hips), _from_root, 3) for name in names if name != hips)

    def observed(self, skeleton: SkeletonModel, factor: float) -> dict[str, PointData]:
        """Return the observations of these terms; `factor`: on their standard deviations."""
        at = {term.name: skeleton.index(term.joints[0])[0] for term in self.terms(skeleton)}
        return {name: PointData(self.p_world[:, j], factor * float(self.sigma[j])) for name, j in at.items()}


def _in_world(p: Matrix, observed: Matrix) -> Matrix:
    return p - observed


def _from_root(p: Matrix, root: Matrix, observed: Matrix) -> Matrix:
    return p - root - observed


def beside_sensors(
    lift: LiftPoints, alone: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel
) -> tuple[MeasuredJoints, Agreement]:
    """Return the joints of a file at the times, and on the axes, of sensors, and how they agree.
    `InvalidInputError`: names of no known convention, or of too few segments.

    Args:
        alone: poses by the sensors alone, at their times.
    """
    title, usual, columns, segments, places, spread = lifts.placed_points(lift, skeleton)
    times, at, clock, p = lift.points.times, lift.points.p_world[:, columns], alone.times, alone.p_world_joint
    joints, sensed = lifts.nearest_joints(segments, places, skeleton), skeleton.index(*bone_imus.joints)
    mean = partial(lifts.mean_joints, joints, spread)
    own = mean((len(times), *p.shape[1:]), at)
    bearing = lifts.bearing(skeleton).items()
    bones = np.array([*dict.fromkeys(ends for j, pairs in bearing if j in sensed for ends in pairs)], int).reshape(
        -1, 2
    )
    found = _common_clock(times, own, clock, p, bones)
    R_world_file, scale, R = found.R_world_file, lifts.by_bones(own, skeleton), alone.R_world_bone
    delay = found.delay
    for step in range(4):  # the first ones find clock, turn and scale of what the last one shows
        late = signals.interpolate(times, at, clock + delay, lifts.LONGEST_GAP)
        model = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p[:, 0], R)
        offset = model[:, segments] - model[:, joints] + np.einsum("tkij,kj->tki", R[:, segments], places)
        shown, exchanged = lifts.sides_mended(mean(p.shape, scale * late @ R_world_file.T - offset), p, skeleton)
        known = np.isfinite(shown).all(axis=2)
        whole: Mask = np.asarray(known.sum(axis=1) >= lifts.FEWEST)
        turned = lifts.turned_to(alone.R_world_bone, p, shown, skeleton)
        R = _bridged(clock, alone.R_world_bone, turned, whole, sensed)
        turn, size = _turn(shown, p, bones, alone.rate_hz), _size(shown, p, bones)
        R_world_file, scale = turn @ R_world_file, scale * size
        unit = min(METRES.values(), key=lambda m: abs(np.log(scale / m)))
        if abs(np.log(scale / unit)) < _METRIC:  # bones are known to some per cent, the cameras' distances better
            scale = unit
        if step == 1:  # with their own sides
            again = _common_clock(clock, shown, clock, p, bones)
            delay, found = delay + again.delay, found._replace(alike=again.alike)
    sigma, angle = _errors(shown, p, bones)
    least = lifts.spread_of_joints(joints, spread, len(sigma))[:, 0]
    sigma = np.maximum(np.maximum(sigma, least), max(float(usual.max()), lifts.LEAST[0]))
    root, rms = np.full(p[:, 0].shape, np.nan), np.nan
    if whole.any():
        from_root = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.zeros_like(root), turned)
        root[whole] = np.nanmedian((shown - from_root)[whole], axis=1)
        rms = float(np.sqrt(3 * np.mean(sigma[known.any(axis=0)] ** 2)))
        if np.nanstd(shown[:, skeleton.index("LeftUpLeg", "RightUpLeg")].mean(axis=1), axis=0).max() < _AROUND:
            root[:] = np.nan  # about the hips
    R = _bridged(clock, alone.R_world_bone, turned, whole, sensed, _variances(sigma, skeleton))
    doubt = _doubt(own, found, float(whole.sum()) / alone.rate_hz, angle)
    agreement = Agreement(lift.name, title, scale, delay, R_world_file, (rms, np.nan), doubt, exchanged)
    return MeasuredJoints(shown, sigma, R, root), agreement


class _Clock(NamedTuple):
    """What offset and rotation of a file's axes agree best, and how well."""

    delay: float  #: [s] by which the file is late
    R_world_file: Array
    alike: float  #: Correlation of the derivatives of directions in the common time
    mirrored: float  #: The largest one of mirrored points, relative to the largest one


def _common_clock(times: Array, seen: Array, clock: Array, model: Array, bones: Array) -> _Clock:
    """Find the offset of the clocks of a file's joints (T, J, 3) and of poses (T', J, 3) by bones (B, 2)."""
    (first, v), (begin, u) = _derivatives(times, seen, bones), _derivatives(clock, model, bones)
    n, known_v, known_u = fft.next_fast_len(len(v) + len(u)), np.isfinite(v[..., 0]), np.isfinite(u[..., 0])

    def sums(a: Array, b: Array) -> Array:
        """Return sums over time and bones at all lags (n, ...)."""
        product = np.conj(fft.rfft(a, n, axis=0)) * fft.rfft(b, n, axis=0)
        return np.asarray(fft.irfft(product.sum(axis=1), n, axis=0))

    v, u = np.nan_to_num(v), np.nan_to_num(u)
    U, S, Vt = np.linalg.svd(np.stack([sums(v[..., [axis]], u) for axis in range(3)], axis=-1))
    sign = np.sign(np.linalg.det(U @ Vt))
    in_common = [sums(np.sum(v**2, axis=-1), known_u + 0.0), sums(known_v + 0.0, np.sum(u**2, axis=-1))]
    lags = np.arange(1 - len(v), len(u))
    common = np.minimum(len(v) + lags, len(u)) - np.maximum(lags, 0)
    enough = common >= min(_COMMON / _STEP, 0.75 * min(len(v), len(u)))
    size = np.sqrt(np.maximum(in_common[1] * np.sum(v**2), 1e-9))  # of the whole file: less in common, less alike
    gains, mirrored = (
        np.where(enough, ((S[:, 0] + S[:, 1] + way * sign * S[:, 2]) / size)[lags], -np.inf) for way in (1, -1)
    )
    offsets = np.asarray(first - begin - _STEP * lags, dtype=float)
    near = np.where(np.abs(offsets) <= _NEAR, gains, -np.inf)  # movements repeat
    scan = OffsetScan(offsets, gains, peak=int(np.argmax(near)) if near.max() > _AS_GOOD * gains.max() else -1)
    k = lags[scan.peak]
    R = (U[k] * [1.0, 1.0, sign[k]]) @ Vt[k]
    share = np.sqrt(max(in_common[0][k], 1e-9) / max(np.sum(v**2), 1e-9))
    return _Clock(scan.best, R, scan.gain / float(share), float(mirrored.max() / max(gains.max(), 1e-9)))


def _derivatives(times: Array, joints: Array, bones: Array) -> tuple[float, Array]:
    """Return the first of even times, s, and derivatives of the bones' directions (T', B, 3), rad/s."""
    first = np.ceil(times[0] / _STEP)
    grid = _STEP * np.arange(first, max(times[-1] / _STEP, first + 3))
    w = np.gradient(_directions(signals.interpolate(times, joints, grid, lifts.LONGEST_GAP), bones), _STEP, axis=0)
    w *= np.minimum(1.0, _FASTEST / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-9))
    for b in range(len(bones)):
        w[:, b] = signals.low_pass_known(grid, w[:, b], _CUTOFF_HZ)
    return grid[0], w


def _along(joints: Array, bones: Array) -> Array:
    """Return the vectors (T, B, 3) of bones (B, 2) between joints (T, J, 3)."""
    return np.asarray(joints[:, bones[:, 1]] - joints[:, bones[:, 0]])


def _directions(joints: Array, bones: Array) -> Array:
    """Return the same of length 1; NaN where unknown."""
    along = _along(joints, bones)
    return np.asarray(along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9))


def _turn(shown: Array, p: Array, bones: Array, rate_hz: float) -> Array:
    """Return the rotation (3, 3) that brings the directions of shown bones to those of sensors, with Cauchy weights.

    The mean of a bone's directions, whose error is constant, counts as one of a second: else hanging limbs would turn
    the heading by how sensors sit on them.
    """
    v, u = (_directions(joints, bones) for joints in (shown, p))
    known = np.isfinite(v).all(axis=-1, keepdims=True)
    v, u, weight, turn = np.where(known, v, 0.0), np.where(known, u, 0.0), known.astype(float), np.eye(3)
    for _ in range(5 if known.any() else 0):
        share = weight / np.maximum(weight.sum(axis=0), 1e-9)
        means = [(share * x).sum(axis=0) for x in (u, v)]
        moving = np.einsum("tbk,tbi,tbj->ij", weight / rate_hz, u - means[0], v - means[1])
        turn = so3.nearest_rotation(moving + means[0].T @ means[1])
        off = np.linalg.norm(u - v @ turn.T, axis=-1, keepdims=True)
        weight = known / (1 + (off / max(2 * float(np.median(off[known])), 1e-6)) ** 2)
    return np.asarray(turn)


def _size(shown: Array, p: Array, bones: Array) -> float:
    """Return the factor that gives shown bones the skeleton's lengths along their directions by sensors: noise makes
    bones longer.
    """
    own = _along(p, bones)
    share = np.sum(_along(shown, bones) * own, axis=-1) / np.sum(own**2, axis=-1)
    return 1 / max(float(np.nanmedian(share)), 0.1) if np.isfinite(share).any() else 1.0


def _errors(shown: Array, p: Array, bones: Array) -> tuple[Array, float]:
    """Return standard deviations (J,) of the joints per axis, m, and the median angle of bones in file and sensors.

    With s of both joints of a bone of length l, and e of its sensor, directions differ by 2 s^2 / l^2 + e^2 per axis.
    """
    off = np.linalg.norm(_directions(shown, bones) - _directions(p, bones), axis=-1)
    known = np.isfinite(off).any(axis=0)
    if not known.any():
        return np.zeros(shown.shape[1]), np.inf
    middle, length = np.nanmedian(off[:, known], axis=0), np.linalg.norm(_along(p[:1], bones[known])[0], axis=-1)
    square = np.maximum((middle / _RAYLEIGH) ** 2 - _SENSOR**2, 0.0) * length**2 / 2
    out = np.full(shown.shape[1], float(np.mean(square)))
    for j in np.unique(bones[known]):
        out[j] = np.mean(square[(bones[known] == j).any(axis=1)])
    return np.sqrt(out), float(np.median(middle))


def _bridged(
    times: Array, R: Array, turned: Array, whole: Mask, sensed: list[int], variance: Array | float = 0.0
) -> Array:
    """Return orientations (T, J, 3, 3) by the file, in its gaps those by sensors turned as at the ends of a gap; and by
    sensors where segments have one.

    With `variance` (J, 3) of the file about the world's axes, rad^2, and d^2 of the turns between both in the mean, the
    best mean of both has 1 - variance / d^2 of a turn.
    """
    out = np.array(R)
    if whole.any():
        turns = turned[whole] @ np.swapaxes(R[whole], -1, -2)
        turns = signals.interpolate_rotations(times[whole], turns, np.clip(times, *times[whole][[0, -1]]))
        smooth = signals.low_pass(turns.reshape(len(times), -1), 1 / float(np.median(np.diff(times))), _TURNS_HZ)
        vectors = so3.log(so3.nearest_rotation(smooth.reshape(turns.shape)))
        share = 1 - variance / np.maximum(np.mean(vectors[whole] ** 2, axis=0), 1e-9)
        out = so3.exp(np.maximum(share, 0.0) * vectors) @ R
    out[:, sensed] = R[:, sensed]
    return out


def _variances(sigma: Array, skeleton: SkeletonModel) -> Array:
    """Return the variances (J, 3), rad^2, of segments about the world's axes by standard deviations (J,) of joints."""
    bearing, out = lifts.bearing(skeleton), np.zeros((len(sigma), 3))
    for j in range(len(out)):
        ends = next(bearing[i] for i in kinematics.line_to_root(skeleton.parents, j) if i in bearing)
        tilt, heading = (lifts.direction(sigma, pair, skeleton) for pair in (ends[0], ends[-1]))
        out[j] = tilt, tilt, heading
    return out


def _doubt(seen: Array, found: _Clock, seconds: float, angle: float) -> str:
    """Return why a file, which shows somebody for so many seconds, is not used; '' where it is."""
    if not (np.isfinite(seen).all(axis=-1).sum(axis=1) >= lifts.FEWEST).any():
        return f"it shows nobody: no frame has {lifts.FEWEST} of the points that are needed"
    if seconds < _SHORTEST or not np.isfinite(angle):
        return f"it shows bones with sensors for {seconds:.1f} s at their times, and {_SHORTEST:.1f} s are needed"
    if found.mirrored > _MIRRORED:
        return "its points are mirrored: its axes are left-handed, or left and right are exchanged"
    if found.alike < _ALIKE or angle > _APART:
        how = f"bones turn alike by {found.alike:.2f} of 1, and are {np.degrees(angle):.0f} deg apart"
        return f"its motion is not that of the sensors ({how}): of another person or trial, or it fails here"
    return ""


def on_path(
    points: MeasuredJoints,
    alone: PoseSequence,
    path: RootPath,
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    ankle_height: float,
    said: Iterable[Correction] = (),
) -> tuple[MeasuredJoints, PoseSequence, RootPath, Contacts]:
    """Return measured joints where the sensors' path begins, poses with their directions where no sensor is and on a
    path by the points and sensors, and contacts.

    Args:
        alone: poses by the sensors alone, on their path. ankle_height: z in world of a standing ankle, m.
        said: feet that stand as a person said.
    """
    shown = np.array(np.isfinite(points.p_world).all(axis=2))
    seen: Mask = np.asarray(np.isfinite(points.root).all(axis=1))
    shown[:, 0] |= seen
    both = np.where(alone.provenance >= Provenance.IMU, Provenance.CAMERA_AND_IMU, Provenance.CAMERA)
    whole = shown.any(axis=1, keepdims=True) & skeleton.orientation_observed()
    poses = replace(
        alone,
        R_world_bone=points.R_world_bone,
        provenance=np.where(shown, both, alone.provenance).astype(np.uint8),
        orientation_observed=alone.orientation_observed | whole,
    )
    if not seen.any():
        poses = rooted(poses, path.p_world, skeleton)
        return points, poses, path, by_hand(detect_contacts(poses, bone_imus, skeleton), poses.times, said)
    begin, every = int(np.argmax(seen)), np.arange(len(seen))
    shift = (path.p_world - points.root)[begin]
    shift[2] = np.median((path.p_world - points.root)[seen, 2])
    root = np.stack([np.interp(every, every[seen], one[seen]) for one in (points.root + shift).T], axis=1)
    poses = rooted(poses, root, skeleton)
    contacts = by_hand(detect_contacts(poses, bone_imus, skeleton, from_poses=True), poses.times, said)
    level, middle = _level(poses, contacts, skeleton), root.mean(axis=0)
    root, points_shown = (middle + (x - middle) @ level.T for x in (points.root + shift, points.p_world + shift))
    p = root_path(poses, bone_imus, contacts, skeleton, ankle_height, root).p_world
    poses = rooted(poses, p, skeleton)
    gaps = path_through_gaps(poses, seen, bone_imus, skeleton)
    drift = np.where(seen, 0.0, _UNSEEN) if gaps is None else gaps.sigma
    path = RootPath(p, np.hypot(_ROOT, drift))
    return replace(points, p_world=points_shown, root=root), poses, path, contacts


def rooted(poses: PoseSequence, root: Array, skeleton: SkeletonModel) -> PoseSequence:
    """Return poses with their root on a path (T, 3), m."""
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, root, poses.R_world_bone)
    valid = valid_positions(poses.provenance, poses.times, skeleton.parents)
    return replace(poses, p_world_joint=p, valid=valid)


def _level(poses: PoseSequence, contacts: Contacts, skeleton: SkeletonModel) -> Array:
    """Return the rotation (3, 3) about level axes that brings standing ankles to one height, 1 where they stand at one
    place: sensors leave a degree or two of what is up, which metres of walking show.
    """
    ankles = poses.p_world_joint[:, skeleton.index(*contacts.joints)][contacts.standing]
    ankles = ankles - ankles.mean(axis=0) if len(ankles) else np.zeros((1, 3))
    level, weight = ankles[:, :2], 1 / (_STANCE**2 * poses.rate_hz)
    slope = np.linalg.solve(weight * level.T @ level + np.eye(2) / _TILT**2, weight * level.T @ ankles[:, 2])
    return so3.exp(np.array([-slope[1], slope[0], 0.0]))


def decorrelated(solution: FragmentSolution, path: RootPath) -> Confidence | None:
    """Return the covariances of a solution with such points, for errors that last, and positions in world with those of
    the path.
    """
    if solution.confidence is None:
        return None
    wide = solution.confidence.scaled(_FACTOR**2)
    wide = wide if solution.spread is None else wide.plus(solution.spread)
    drift = np.nan_to_num(path.sigma)[:, None, None, None] ** 2 * np.eye(3)
    return replace(wide, position_covariance=wide.position_covariance + drift)
