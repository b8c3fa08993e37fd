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
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.bundle import DELAY, FOCAL, MOVE, TURN, Adjusted, BundleSettings, Images, adjust
from rtof_kin.setup.video_offset import VideoOffset, find_video_offset
from rtof_kin.vision.outlier_rejection import reject_keypoint_outliers

JOINTS: Final = (
    "Head",
    "RightArm",
    "RightForeArm",
    "RightHand",
    "LeftArm",
    "LeftForeArm",
    "LeftHand",
    "RightUpLeg",
    "RightLeg",
    "RightFoot",
    "LeftUpLeg",
    "LeftLeg",
    "LeftFoot",
)
"""Joints that detectors show; those of the trunk are only interpolated."""
_FEWEST_JOINTS: Final = 6
"""Joints that both cameras see in a used frame."""
_FEWEST_FRAMES: Final = 20
_MOST_FRAMES: Final = 240
_SENSED, _SEEN, _LIFTED = 0.03, 0.05, 0.06
"""[m] Standard deviations per axis of a joint about the mean of all: by the first camera with sensors, by the
first camera alone, by a lift."""
_USUAL_FOCAL: Final = 0.1
"""[1] Relative standard deviation of a focal length where a camera states none."""
_USUAL_TILT: Final = np.radians(3.0)
"""[rad] Standard deviation of the second camera's pitch and roll, likewise."""
_MEMORY: Final = 3.0
"""[s] for which a detector's errors count as one."""
_STEP: Final = 0.1
"""[s] of the difference that gives a joint's velocity in the image."""
_LARGEST_TURN_DEG: Final = 5.0
"""[deg] Standard deviation of the camera's orientation from which it is in doubt."""
_LARGEST_RESIDUAL: Final = 0.03
"""[1] Size of the residuals relative to the focal length, likewise."""


@dataclass(frozen=True)
class SecondCamera:
    """A second camera in the first one's world."""

    first: Camera
    """The first camera with its focal length as estimated; its pose defines the world."""
    view: KeypointSequence
    """The second camera and its keypoints on the first one's clock, a view of the recording."""
    offset: float
    """[s] that was added to the second video's times."""
    sigma_offset: float
    """[s] Its standard deviation."""
    sigma_position: Array
    """(3,) of the second camera's position in world, m."""
    sigma_turn: Array
    """(3,) of its orientation, about the axes of the world, rad."""
    sigma_focal: Array
    """(2,) relative, of the two focal lengths."""
    residual: float
    """Standard deviation of the joints in the images, relative to the focal length."""
    doubt: str
    """What may be wrong, in a sentence; empty where sure."""

    def apply(self, recording: Recording) -> Recording:
        """Return the recording with the second camera as a further view.

        Args:
            recording: of the first camera.
        """
        first = replace(recording.video, camera=self.first)
        return replace(recording, keypoints=first, views=(*recording.views, self.view))


def find_second_camera(
    recording: Recording,
    second: KeypointSequence,
    lifter: LifterLike | None = None,
    *,
    around: float | None = None,
    sigma_focal: tuple[float, float] | None = None,
) -> SecondCamera:
    """Estimate a second camera, which stands anywhere, from the moving person.

    Args:
        recording: of the first camera, whose pose is the world's, with sensors or without; its skeleton,
            from the height, gives the scale.
        second: what the second camera sees; its orientation is known up to the heading, within some
            degrees (`Camera.uncertainty`, or 3), and its position is not used.
        lifter: default: the shipped one.
        around: [s] offset of the clocks that is known within a second; None searches everywhere.
        sigma_focal: relative standard deviation of each focal length as given, 0 where it is calibrated; by
            default as the cameras state (`Camera.uncertainty`), and 10 % where they state nothing.

    Raises:
        CalibrationError: the two have too little in common.
        InvalidInputError: a video is too short, or the clocks have too little in common.
    """
    sensed = recording.imus is not None and recording.calibration is not None
    settings = ReconstructionSettings(confidence=False)
    alone = reconstruct(recording, mode="rtof" if sensed else "rto", lifter=lifter, settings=settings)
    first, poses, skeleton = alone.keypoints, alone.motion.poses, recording.skeleton
    assert first is not None
    second, _ = reject_keypoint_outliers(second)
    own = lift(second, skeleton, lifter).poses
    clock = find_video_offset(poses, own, around)
    view = second.on_clock(second.times + clock.offset)
    camera, own = _placed(second.camera, poses, replace(own, times=view.times))
    view, frames = replace(view, camera=camera), _frames(first, view.resample(first.times))
    found = adjust(
        (first.camera, camera),
        _images(first, view, frames, skeleton, (poses, own)),
        poses.p_world_joint[frames][:, skeleton.index(*JOINTS)],
        BundleSettings(
            sigma_focal=sigma_focal or (_focal(first.camera), _focal(camera)),
            sigma_tilt=float(np.hypot(_tilt(first.camera, 0.0), _tilt(camera, _USUAL_TILT))),
            sigma_shapes=(_SENSED if sensed else _SEEN, _LIFTED),
            frames_as_one=max(1.0, _MEMORY * len(frames) / float(np.ptp(first.times[frames]))),
        ),
    )
    return _result(found, view, clock)


def _result(found: Adjusted, view: KeypointSequence, clock: VideoOffset) -> SecondCamera:
    sigma, delay = np.sqrt(np.diag(found.covariance)), float(found.x[DELAY])
    words = (*view.camera.assumed, "pose of the second camera, from the moving person")
    camera = replace(found.cameras[1], assumed=tuple(dict.fromkeys(words)), uncertainty=None)
    first = found.cameras[0]
    if first.uncertainty is not None:
        left = replace(first.uncertainty, focal=float(sigma[FOCAL][0]))
        first = replace(first, uncertainty=left)
    return SecondCamera(
        first=first,
        view=replace(view, camera=camera).on_clock(view.times + delay),
        offset=clock.offset + delay,
        sigma_offset=float(sigma[DELAY]),
        sigma_position=sigma[MOVE],
        sigma_turn=sigma[TURN],
        sigma_focal=sigma[FOCAL],
        residual=found.sigma,
        doubt=clock.doubt or _doubt(found, sigma),
    )


def _focal(camera: Camera) -> float:
    """Relative standard deviation of a focal length."""
    return _USUAL_FOCAL if camera.uncertainty is None else camera.uncertainty.focal


def _tilt(camera: Camera, usual: float) -> float:
    """Standard deviation of a camera's pitch and roll, rad."""
    return usual if camera.uncertainty is None else camera.uncertainty.tilt


def _placed(camera: Camera, first: PoseSequence, second: PoseSequence) -> tuple[Camera, PoseSequence]:
    """The second camera and its lift, on its own clock and in its own world, in the first one's world."""
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
    """Used frames: evenly distributed ones in which both cameras see enough."""
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
    """The joints in both images, as each camera's poses have them, and the bones between them."""
    times, index = first.times[frames], skeleton.index(*JOINTS)
    seen = [keypoints.resample(times).select(JOINTS) for keypoints in (first, view)]
    straight = [k.camera.normalise(k.uv_px) @ k.camera.K[:2, :2].T + k.camera.K[:2, 2] for k in seen]
    later, earlier = (view.resample(times + d).select(JOINTS).uv_px for d in (_STEP, -_STEP))
    parents = {name: skeleton.names[skeleton.parents[skeleton.names.index(name)]] for name in JOINTS}
    return Images(
        uv_px=np.nan_to_num(np.stack(straight)),
        weight=np.stack([k.confidence for k in seen]),
        drift=np.nan_to_num((later - earlier) / (2 * _STEP)),
        shapes=np.stack([_at(poses, times)[:, index] for poses in shapes]),
        bones=[
            (JOINTS.index(parents[name]), i, skeleton.bone_lengths[name])
            for i, name in enumerate(JOINTS)
            if parents[name] in JOINTS
        ],
    )


def _at(poses: PoseSequence, times: Array) -> Array:
    """Positions (T, J, 3) at other times, constant beyond the ends."""
    inside = np.clip(times, poses.times[0], poses.times[-1])
    return signals.interpolate(poses.times, poses.p_world_joint, inside)


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
