"""Pose and focal length of a second camera from the person who moves before both.

Both videos are lifted to 3D, each in a world of its own. Their clocks are set by `find_video_offset`; a
rotation about the vertical and a translation lay one lift on the other. A bundle adjustment (Triggs et al.
2000) then estimates the second camera's pose, both focal lengths, the rest of the offset, the size of the
body and the joints in world, from their images in both cameras and from the lengths of the bones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_estimate import refocused
from rtof_kin.calibration.clocks import find_video_offset
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording

TURN, MOVE, FOCAL, DELAY, SIZE = slice(0, 3), slice(3, 6), slice(6, 8), 8, 9
"""Unknowns of all frames: the second camera's rotation vector in world, rad, and movement, m; logarithms of
the focal lengths' factors; seconds; logarithm of the size's factor."""
_UNKNOWNS: Final = 10
_UNKNOWN = 1e3  # [rad, m] Prior standard deviation of the second camera's heading and position
_NORMAL_MEDIAN = 0.6745  # Median of the absolute values of a standard normal distribution
_ROBUST = 2.0  # [sigma] Scale of the Cauchy loss


@dataclass(frozen=True)
class BundleSettings:
    """Prior standard deviations of a bundle adjustment."""

    sigma_focal: tuple[float, float] = (0.1, 0.1)  # [1] of each focal length; 0 where it is known
    sigma_delay: float = 0.05  # [s] of the second video's times
    sigma_size: float = 0.03  # [1] of the body's size
    sigma_tilt: float = np.radians(3.0)  # [rad] of the second camera's tilt as given, about each horizontal axis
    sigma_image: float = 0.004
    """[1] of a joint in an image per axis, relative to the focal length; residuals do not tell it where the
    joints are free."""
    sigma_shapes: tuple[float, float] = (0.06, 0.06)  # [m] of a joint of each shape about the mean of all, per axis
    sigma_bone: float = 0.025  # [m] of a bone's length in one frame
    sigma_start: float = 1.0  # [m] of a joint about its start, per axis
    frames_as_one: float = 1.0
    """Number of used frames in a row with the information of one: errors are correlated in time."""
    iterations: int = 60


@dataclass(frozen=True)
class Images:
    """Joints of F frames in the images of two cameras."""

    uv_px: Array  # (2, F, n, 2) undistorted; any value where unobserved
    weight: Array  # (2, F, n) 0 where unobserved, up to 1
    drift: Array  # (F, n, 2) velocity in the second image, px/s
    bones: Sequence[tuple[int, int, float]]  # Two joints and the length between them, m
    shapes: Array
    """(2, F, n, 3) joints as each video alone shows them, m, in world with the second camera as at the start;
    their mean is not used."""


@dataclass(frozen=True)
class Adjusted:
    """Result of a bundle adjustment."""

    cameras: tuple[Camera, Camera]
    p_world_joint: Array  # (F, n, 3) m
    x: Array  # (10,) unknowns of all frames; `TURN` to `SIZE`
    covariance: Array  # (10, 10) of them
    sigma: float  # Standard deviation of a joint in an image per axis, relative to the focal length


def adjust(cameras: tuple[Camera, Camera], images: Images, p_world_joint: Array, settings: BundleSettings) -> Adjusted:
    """Adjust the second camera to the images.

    Ten unknowns (the second camera's pose, both focal lengths, the delay of the second video, the size of the body) and
    the joints in world, which are eliminated frame by frame (Triggs et al. 2000, section 6.1). Residuals: the joints'
    images with a Cauchy loss, their shape as each video alone shows it, the lengths of the bones, and priors. From
    images alone, the angle between two distant cameras is hardly known (the bas-relief ambiguity).

    Args:
        cameras: at the start; the second one's pose within some tens of degrees.
        p_world_joint: (F, n, 3) start of the joints, m.
    """
    x, p, s = np.zeros(_UNKNOWNS), p_world_joint.copy(), settings
    deviations = [s.sigma_tilt] * 2 + [_UNKNOWN] * 4 + [max(sigma, 1e-6) for sigma in s.sigma_focal]
    prior = 1 / np.array([*deviations, s.sigma_delay, s.sigma_size]) ** 2
    now = cameras
    for _ in range(settings.iterations):
        system = _System(now, x, images, p, p_world_joint, settings)
        step, dp = system.step(prior * settings.frames_as_one)
        x, p = x + step, p + dp
        now = now[0], _moved(now[1], step[TURN], step[MOVE])
        if np.all(np.abs(step) < 1e-6):
            break
    system = _System(now, x, images, p, p_world_joint, settings)
    covariance = np.linalg.inv(np.diag(prior) + system.information / settings.frames_as_one)
    first, second = (refocused(camera, np.expm1(change)) for camera, change in zip(now, x[FOCAL], strict=True))
    return Adjusted((first, second), p, x, covariance, system.size)


def _moved(camera: Camera, turn: Array, move: Array) -> Camera:
    """The camera turned by a rotation vector in world, about its centre, and moved."""
    R = so3.nearest_rotation(camera.R_camera_world @ so3.exp(-turn))
    return replace(camera, R_camera_world=R, t_camera_world=-R @ (camera.center_world + move))


class _System:
    """Normal equations at one state, with the joints eliminated.

    Attributes:
        size: of the residuals at this state relative to the focal length.
        information: (10, 10) of the unknowns, without prior.
    """

    def __init__(
        self, cameras: tuple[Camera, Camera], x: Array, images: Images, p: Array, start: Array, settings: BundleSettings
    ) -> None:
        F, n = p.shape[:2]
        self._x, self._shape = x, p.shape
        self._H_pp = np.zeros((F, n, 3, n, 3))
        self._H_cp = np.zeros((F, _UNKNOWNS, n, 3))
        self._H_cc, self._g_c = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
        self._g_p = np.zeros(p.shape)
        s = settings.sigma_image
        errors = np.concatenate([self._add_image(c, cameras[c], images, p, s) for c in (0, 1)])
        # Residuals are smaller by the joints that were fitted to them.
        seen, joints = (images.weight > 0).sum(), (images.weight > 0).any(axis=0).sum()
        known = float(2 * seen + len(images.bones) * images.weight.shape[1])
        lost = np.sqrt(known / max(known - 3 * joints, 0.1 * known))
        self.size = float(np.median(np.abs(errors)) / _NORMAL_MEDIAN * lost)
        self._add_bones(images.bones, p, settings.sigma_bone)
        for c in (0, 1):
            self._add_shape(c, images.shapes[c], p, settings.sigma_shapes[c])
        each = np.arange(n)
        self._H_pp[:, each, :, each, :] += np.eye(3) / settings.sigma_start**2
        self._g_p += (p - start) / settings.sigma_start**2
        H_pp = self._H_pp.reshape(F, 3 * n, 3 * n)
        H_pc = self._H_cp.reshape(F, _UNKNOWNS, 3 * n).swapaxes(1, 2)
        right = np.concatenate([H_pc, self._g_p.reshape(F, 3 * n, 1)], axis=2)
        self._solved = np.linalg.solve(H_pp, right)
        eliminated = np.einsum("fpc,fpd->cd", H_pc, self._solved)
        self.information = self._H_cc - eliminated[:, :_UNKNOWNS]
        self._force = self._g_c - eliminated[:, _UNKNOWNS]

    def step(self, prior: Array) -> tuple[Array, Array]:
        """Gauss-Newton step (10,), and that of the joints (F, n, 3); prior: inverse variances relative to one frame."""
        step = -np.linalg.solve(self.information + np.diag(prior), self._force + prior * self._x)
        dp = -self._solved[..., _UNKNOWNS] - self._solved[..., :_UNKNOWNS] @ step
        return step, dp.reshape(self._shape)

    def _add_image(self, c: int, camera: Camera, images: Images, p: Array, sigma: float) -> Array:
        """Add the residuals of a camera, and return them relative to the focal length."""
        camera = refocused(camera, np.expm1(self._x[FOCAL][c]))
        at, R = camera.to_camera(p), camera.R_camera_world
        depth = np.maximum(at[..., 2:], 0.1)
        flat = at[..., :2] / depth
        spread = flat @ camera.K[:2, :2].T
        r = spread + camera.K[:2, 2] - images.uv_px[c]
        J = np.zeros((*r.shape, _UNKNOWNS))
        J_p = camera.K[:2, :2] @ (R[:2] - flat[..., None] * R[2]) / depth[..., None]
        J[..., FOCAL.start + c] = spread
        if c == 1:
            r = r - images.drift * self._x[DELAY]
            J[..., TURN] = J_p @ so3.skew(p - camera.center_world)
            J[..., MOVE] = -J_p
            J[..., DELAY] = -images.drift
        seen = images.weight[c] > 0
        squares, sigma = np.where(seen, np.sum(r**2, axis=-1), 0.0), sigma * camera.K[0, 0]
        w = images.weight[c] / (1 + squares / (_ROBUST * sigma) ** 2) / sigma**2
        each = np.arange(p.shape[1])
        self._H_pp[:, each, :, each, :] += np.einsum("fnki,fnkj,fn->nfij", J_p, J_p, w)
        self._g_p += np.einsum("fnki,fnk,fn->fni", J_p, r, w)
        self._H_cp += np.einsum("fnka,fnki,fn->fani", J, J_p, w)
        self._H_cc += np.einsum("fnka,fnkb,fn->ab", J, J, w)
        self._g_c += np.einsum("fnka,fnk,fn->a", J, r, w)
        return np.asarray(np.ravel(r[seen]) / camera.K[0, 0])

    def _add_shape(self, c: int, given: Array, p: Array, sigma: float) -> None:
        """Add the joints about their mean; those of the second camera turn with it."""
        n, w = p.shape[1], 1 / sigma**2
        shape = given - given.mean(axis=1, keepdims=True)
        if c == 1:
            shape = shape @ so3.exp(self._x[TURN]).T
            J = so3.skew(shape)
            self._H_cp[:, TURN] += w * J.transpose(0, 3, 1, 2)
            self._H_cc[TURN, TURN] += w * np.einsum("fnki,fnkj->ij", J, J)
        r = p - p.mean(axis=1, keepdims=True) - shape
        self._g_p += w * r
        self._H_pp += w * np.einsum("ij,ab->iajb", np.eye(n) - 1 / n, np.eye(3))
        if c == 1:
            self._g_c[TURN] += w * np.einsum("fnki,fnk->i", J, r)

    def _add_bones(self, bones: Sequence[tuple[int, int, float]], p: Array, sigma: float) -> None:
        w = 1 / sigma**2
        for a, b, length in bones:
            d = p[:, a] - p[:, b]
            distance = np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), 1e-6)
            u, long = d / distance, length * np.exp(self._x[SIZE])
            r, outer = distance[:, 0] - long, w * u[:, :, None] * u[:, None, :]
            for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                self._H_pp[:, i, :, j, :] += sign * outer
            for i, sign in ((a, 1), (b, -1)):
                self._g_p[:, i] += sign * w * r[:, None] * u
                self._H_cp[:, SIZE, i] -= sign * w * long * u
            self._H_cc[SIZE, SIZE] += w * len(p) * long**2
            self._g_c[SIZE] -= w * long * float(r.sum())


JOINTS: Final = (
    "Head",
    *(side + joint for side in ("Right", "Left") for joint in ("Arm", "ForeArm", "Hand")),
    *(side + joint for side in ("Right", "Left") for joint in ("UpLeg", "Leg", "Foot")),
)
"""Joints that detectors show; those of the trunk are only interpolated."""
_FEWEST_JOINTS = 6  # Joints that both cameras see in a used frame
_FEWEST_FRAMES: Final = 20
_MOST_FRAMES: Final = 240
_SENSED, _SEEN, _LIFTED = 0.03, 0.05, 0.06
"""[m] Standard deviations per axis of a joint about the mean of all: by the first camera with sensors, by the
first camera alone, by a lift."""
_USUAL_FOCAL = 0.1  # [1] Relative standard deviation of a focal length where a camera states none
_USUAL_TILT = np.radians(3.0)  # [rad] Standard deviation of the second camera's pitch and roll, likewise
_MEMORY = 3.0  # [s] for which a detector's errors count as one
_STEP = 0.1  # [s] of the difference that gives a joint's velocity in the image
_LARGEST_TURN_DEG = 5.0  # [deg] Standard deviation of the camera's orientation from which it is in doubt
_LARGEST_RESIDUAL = 0.03  # [1] Size of the residuals relative to the focal length, likewise


@dataclass(frozen=True)
class SecondCamera:
    """A second camera in the first one's world."""

    first: Camera  # The first camera with its focal length as estimated; its pose defines the world
    view: KeypointSequence  # The second camera and its keypoints on the first one's clock, a view of the recording
    offset: float  # [s] that was added to the second video's times
    sigma_offset: float  # [s] Its standard deviation
    sigma_position: Array  # (3,) of the second camera's position in world, m
    sigma_turn: Array  # (3,) of its orientation, about the axes of the world, rad
    sigma_focal: Array  # (2,) relative, of the two focal lengths
    doubt: str  # What may be wrong, in a sentence; empty where sure

    def apply(self, recording: Recording) -> Recording:
        """Return the recording with the second camera as a further view."""
        first = replace(recording.video, camera=self.first)
        return replace(recording, keypoints=first, views=(*recording.views, self.view))


def estimate_second_camera(
    first: KeypointSequence,
    poses: PoseSequence,
    second: KeypointSequence,
    lifted: PoseSequence,
    skeleton: SkeletonModel,
    *,
    sensed: bool = False,
    around: float | None = None,
    sigma_focal: tuple[float, float] | None = None,
) -> SecondCamera:
    """Estimate a second camera, which stands anywhere, from the moving person. `CalibrationError`: the two have too
    little in common; `InvalidInputError`: a video is too short, or the clocks have too little in common.

    Args:
        first: keypoints of the first camera, whose pose is the world's. poses: solved of them, with sensors or without.
        second: what the second camera sees, without outliers; its orientation is known up to the heading, within some
            degrees (`Camera.uncertainty`, or 3), and its position is not used. lifted: of it, in a world of its own.
        skeleton: gives the scale. sensed: whether the poses are those of sensors too.
        around: [s] offset of the clocks that is known within a second; None searches everywhere.
        sigma_focal: relative standard deviation of each focal length as given, 0 where it is calibrated; by
            default as the cameras state (`Camera.uncertainty`), and 10 % where they state nothing.
    """
    clock = find_video_offset(poses, lifted, around)
    view = second.on_clock(second.times + clock.offset)
    camera, lifted = _placed(second.camera, poses, replace(lifted, times=view.times))
    view, frames = replace(view, camera=camera), _frames(first, view.resample(first.times))
    usual = (CameraUncertainty(_USUAL_FOCAL, tilt) for tilt in (0.0, _USUAL_TILT))
    stated = [own.uncertainty or other for own, other in zip((first.camera, camera), usual, strict=True)]
    found = adjust(
        (first.camera, camera),
        _images(first, view, frames, skeleton, (poses, lifted)),
        poses.p_world_joint[frames][:, skeleton.index(*JOINTS)],
        BundleSettings(
            sigma_focal=sigma_focal or (stated[0].focal, stated[1].focal),
            sigma_tilt=float(np.hypot(stated[0].tilt, stated[1].tilt)),
            sigma_shapes=(_SENSED if sensed else _SEEN, _LIFTED),
            frames_as_one=max(1.0, _MEMORY * len(frames) / float(np.ptp(first.times[frames]))),
        ),
    )
    (one, other), sigma, delay = found.cameras, np.sqrt(np.diag(found.covariance)), float(found.x[DELAY])
    words = (*camera.assumed, "pose of the second camera, from the moving person")
    other = replace(other, assumed=tuple(dict.fromkeys(words)), uncertainty=None)
    if one.uncertainty is not None:
        one = replace(one, uncertainty=replace(one.uncertainty, focal=float(sigma[FOCAL][0])))
    return SecondCamera(
        first=one,
        view=replace(view, camera=other).on_clock(view.times + delay),
        offset=clock.offset + delay,
        sigma_offset=float(sigma[DELAY]),
        sigma_position=sigma[MOVE],
        sigma_turn=sigma[TURN],
        sigma_focal=sigma[FOCAL],
        doubt=clock.doubt or _doubt(found, sigma),
    )


def _placed(camera: Camera, first: PoseSequence, second: PoseSequence) -> tuple[Camera, PoseSequence]:
    times = first.times[(first.times >= second.times[0]) & (first.times <= second.times[-1])]
    p, q = (signals.interpolate(s.times, s.p_world_joint, times) for s in (first, second))
    H = np.einsum("tji,tjk->ik", p[:, 1:] - p[:, :1], q[:, 1:] - q[:, :1])
    R = so3.about_axis("z", float(np.arctan2(H[1, 0] - H[0, 1], H[0, 0] + H[1, 1])))
    d = np.median(p[:, 0] - q[:, 0] @ R.T, axis=0)
    R_camera_world = camera.R_camera_world @ R.T
    t = camera.t_camera_world - R_camera_world @ d
    p = second.p_world_joint @ R.T + d
    moved = replace(second, p_world_joint=p, R_world_bone=R @ second.R_world_bone)
    return replace(camera, R_camera_world=R_camera_world, t_camera_world=t), moved


def _frames(first: KeypointSequence, seen: KeypointSequence) -> Index:
    common = first.select(JOINTS).seen & seen.select(JOINTS).seen
    frames = np.flatnonzero(common.sum(axis=1) >= _FEWEST_JOINTS)
    if len(frames) < _FEWEST_FRAMES:
        raise CalibrationError(
            f"the two cameras see the person together in {len(frames)} frames only; let the person move "
            "for some seconds where both see all of the body"
        )
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES)).round().astype(int)
    return np.asarray(frames[chosen])


def _images(
    first: KeypointSequence,
    view: KeypointSequence,
    frames: Index,
    skeleton: SkeletonModel,
    shapes: Sequence[PoseSequence],
) -> Images:
    times, index = first.times[frames], skeleton.index(*JOINTS)
    seen = [keypoints.resample(times).select(JOINTS) for keypoints in (first, view)]
    straight = [k.camera.normalise(k.uv_px) @ k.camera.K[:2, :2].T + k.camera.K[:2, 2] for k in seen]
    later, earlier = (view.resample(times + d).select(JOINTS).uv_px for d in (_STEP, -_STEP))
    parents = {name: skeleton.names[skeleton.parents[skeleton.names.index(name)]] for name in JOINTS}
    return Images(
        uv_px=np.nan_to_num(np.stack(straight)),
        weight=np.stack([k.confidence for k in seen]),
        drift=np.nan_to_num((later - earlier) / (2 * _STEP)),
        shapes=np.stack(
            [signals.interpolate(s.times, s.p_world_joint, np.clip(times, *s.times[[0, -1]]))[:, index] for s in shapes]
        ),  # constant beyond the ends
        bones=[
            (JOINTS.index(parents[name]), i, skeleton.bone_lengths[name])
            for i, name in enumerate(JOINTS)
            if parents[name] in JOINTS
        ],
    )


def _doubt(found: Adjusted, sigma: Array) -> str:
    """Why the pose may be wrong; empty where sure."""
    turn = float(np.degrees(sigma[TURN].max()))
    if turn > _LARGEST_TURN_DEG:
        return (
            f"the second camera's orientation is known to {turn:.1f} degrees only; let the person move "
            "more, arms and legs too, where both cameras see all of the body"
        )
    if found.sigma > _LARGEST_RESIDUAL:
        return (
            f"the joints lie {100 * found.sigma:.1f} cm for each metre of distance from where both cameras "
            "together expect them; check that both show the same person, and that no video is mirrored"
        )
    return ""
