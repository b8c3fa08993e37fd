"""Turning of a camera from the features of the background of its video, with OpenCV.

found = estimate_camera_motion("walk.mp4", detections, camera)
found.motion               # rotations; write_camera_motion("camera_motion.npz", found.motion)
found.turning().failed     # whether a camera that was said to stand still did not

Corners (Shi and Tomasi 1994) of keyframes are followed into each frame by pyramidal Lucas-Kanade, both ways,
after the frame was turned back by what is known of its rotation. A keyframe is made wherever the camera looks
more than a few degrees away from all earlier ones, and used again whenever it comes back: errors grow with
the range of the turning, not with time. Boxes around people are left out.

Rotation of a camera from corresponding points of two images, and the focal length that makes them agree. Bearings of
two images of a camera that turns about its optical centre differ by a rotation: least squares by Kabsch (1976),
outliers by random samples of two points (Fischler and Bolles 1981). The focal length follows from how displacements
grow towards the borders of the image (Hartley, IJCV 22, 1997: homographies K R K^-1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.packages import optional
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.video import VideoFrame, read_video

_SAMPLES: Final = 60
_HUBER: Final = 1.0  # px
_FACTOR: Final = 2.0  # between the given focal length and the shortest or longest that is tried
_CORRELATED: Final = 10.0  # points that err as one: those of one thing, of one keyframe
_LENS: Final = 0.01  # relative error of the focal length by unknown distortion of the lens


class Turned(NamedTuple):
    """Rotation between two images."""

    R_a_b: Array  #: (3, 3) bearings of b to those of a
    inliers: Mask  #: (n,) points that agree with it
    sigma: float  #: Standard deviation per axis, rad, of the axis that is known the least


class Pair(NamedTuple):
    """Corresponding points of two images of one camera, px."""

    uv_a: Array  #: (n, 2)
    uv_b: Array  #: (n, 2)


def bearings(camera: Camera, uv_px: Array) -> Array:
    """Return unit vectors (..., 3) in camera axes. uv_px: (..., 2)."""
    xy = camera.normalise(uv_px)
    return so3.unit(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1))


def turn_between(b_a: Array, b_b: Array, tolerance: float, rng: np.random.Generator | None = None) -> Turned:
    """Return the rotation with the most inliers, refined by all of them.

    Args:
        b_a, b_b: (n, 3) bearings of corresponding points, at least two. tolerance: of an inlier, rad.
        rng: source of random samples; None where all points are inliers.
    """
    inliers = np.ones(len(b_a), bool)
    if rng is not None:
        pick = rng.integers(len(b_a), size=(_SAMPLES, 2))
        R = so3.nearest_rotation(np.swapaxes(b_a[pick], -1, -2) @ b_b[pick])
        near = np.linalg.norm(b_a - np.einsum("sij,nj->sni", R, b_b), axis=-1) < tolerance
        inliers = near[int(np.argmax(near.sum(axis=1)))]
    for _ in range(3 if rng is not None else 1):
        R = so3.nearest_rotation(b_a[inliers].T @ b_b[inliers])
        off = np.linalg.norm(b_a - b_b @ R.T, axis=-1)
        if rng is not None:
            inliers = off < tolerance
    n = int(inliers.sum())
    information = n * np.eye(3) - b_a[inliers].T @ b_a[inliers]
    variance = float(np.mean(off[inliers] ** 2)) / 2 if n else np.inf
    return Turned(R, inliers, float(np.sqrt(variance / max(np.linalg.eigvalsh(information)[0], 1e-12))))


def with_focal(camera: Camera, factor: float) -> Camera:
    """Return the camera with another focal length."""
    return replace(camera, K=camera.K @ np.diag([factor, factor, 1.0]))


def focal_factor(camera: Camera, pairs: Sequence[Pair], sigma: float) -> tuple[float, float]:
    """Return the factor on the focal length with which rotations explain the points of turned images best, each pair
    with as many points, and its relative standard deviation; 1 and `sigma` without pairs.
    """
    if not pairs:
        return 1.0, sigma
    uv_a, uv_b = (np.stack(part) for part in zip(*pairs, strict=True))
    noise = 0.0

    def squares(log_factor: float) -> Array:
        own = with_focal(camera, float(np.exp(log_factor)))
        a, b = bearings(own, uv_a), bearings(own, uv_b)
        R = so3.nearest_rotation(np.swapaxes(a, -1, -2) @ b)
        b = b @ np.swapaxes(R, -1, -2)
        # In px: bearings towards the borders of a wider image would be closer together.
        off = np.linalg.norm(a[..., :2] / a[..., 2:] - b[..., :2] / b[..., 2:], axis=-1) * own.K[0, 0]
        return np.asarray(np.where(off < _HUBER, off**2, 2 * _HUBER * off - _HUBER**2))

    def cost(log_factor: float) -> float:
        return float(squares(log_factor).sum()) / noise / 2 / _CORRELATED + (log_factor / sigma) ** 2 / 2

    noise = max(float(np.median(squares(0.0))), 1e-4)
    for _ in range(2):  # the residual's size is that of the best focal length
        limit = float(np.log(_FACTOR))
        best = float(scipy.optimize.minimize_scalar(cost, bounds=(-limit, limit), method="bounded").x)
        noise = max(float(np.mean(squares(best))) / 2, 1e-4)
    step = 0.01
    curvature = (cost(best + step) - 2 * cost(best) + cost(best - step)) / step**2
    return float(np.exp(best)), min(sigma, float(np.hypot(1 / np.sqrt(max(curvature, sigma**-2)), _LENS)))


Gray = NDArray[np.uint8]
MOST_TURNED_DEG: Final = 0.5  #: Largest turn of a camera that stands still; less is noise and trembling of a tripod
_LONG_SIDE: Final = 720  # px of the image that is worked on
_FASTEST: Final = 0.024  # [s] between the frames that are looked at
_POINTS, _APART = 250, 9  # corners of a keyframe; px between them
_FEWEST, _LEAST_SHARE = 12, 0.3  # inliers of a rotation, and of the points that were followed
_TOLERANCE: Final = 1.5  # px
_BACK: Final = 0.7  # px between a point and itself, followed there and back
_NEW_KEY: Final = np.radians(5.0)  # from the nearest keyframe
_AGAIN: Final = np.radians(1.0)  # by which the guess was wrong, and the frame is turned back anew
_MARGIN: Final = 0.15  # of a person's box, as a share of its size
_INFLATION: Final = 3.0  # of the formal standard deviation, by the errors of planted rotations
_PAIRS, _PAIR_POINTS, _LEAST_TURN = 60, 40, np.radians(2.0)  # for the focal length


@dataclass(frozen=True)
class BackgroundMotion:
    """Turning of a camera by the background of its video."""

    motion: CameraMotion  #: Rotations of the frames; NaN where too little of the background could be followed
    camera: Camera  #: The camera with the focal length that the rotations were computed with
    sigma_focal: float  #: Relative standard deviation of that focal length
    points: int  #: Median number of background points that a rotation rests on

    @property
    def known(self) -> float:
        """Share of the frames whose rotation is known."""
        return float(np.isfinite(self.motion.R_first_camera).all(axis=(1, 2)).mean())

    @property
    def summary(self) -> str:
        """Range of the turning, its standard deviation and the focal length in words."""
        motion = self.motion
        return (
            f"the camera turned by up to {np.degrees(np.nanmax(motion.angles)):.1f} deg from its mean "
            f"orientation, known to {np.degrees(motion.sigma):.2f} deg in {100 * self.known:.0f} % of the "
            f"frames from {self.points} points of the background; focal length {self.camera.K[0, 0]:.0f} px "
            f"+- {100 * self.sigma_focal:.0f} %"
        )

    def turning(self, limit_deg: float = MOST_TURNED_DEG) -> Check:
        """Check that the camera stood still, by the turn from the mean orientation, 95th percentile of the frames."""
        turned = float(np.degrees(np.nanpercentile(self.motion.angles, 95)))
        return Check(
            "turning of the camera",
            "video",
            turned,
            limit_deg,
            "deg",
            "Declare its motion, [camera.motion] in recording.toml, or film from a tripod",
            cause="the camera did not stand still: it was held by hand, or moved",
        )


def estimate_camera_motion(
    video: str | Path,
    people: Detections | KeypointSequence | None,
    camera: Camera,
    *,
    sigma_focal: float = 0.0,
    progress: Callable[[str, int, int], None] | None = None,
) -> BackgroundMotion:
    """Estimate the turning of a camera from its video. `FileFormatError`: the video cannot be read; `RtofError`: OpenCV
    is not installed; `InvalidInputError`: the camera is of another image size, or the background has nothing to follow.

    Args:
        people: detected in it, whose boxes are left out.
        sigma_focal: relative standard deviation of its focal length; 0 where it is known and is not refined.
        progress: called with ("camera", frames done, frames in total).
    """
    boxes, follower, times = _boxes(people), None, list[float]()
    for frame in read_video(video):
        if progress is not None:
            progress("camera", frame.index + 1, max(frame.total, frame.index + 1))
        if times and frame.time - times[-1] < _FASTEST:
            continue
        follower = follower or _Follower(_camera_of(camera, frame))
        follower.follow(frame.image, boxes(frame.time))
        times.append(frame.time)
    assert follower is not None  # read_video raises where there is no frame
    own = follower.camera
    factor, sigma = (1.0, 0.0) if sigma_focal == 0 else focal_factor(own, follower.pairs(), sigma_focal)
    own, camera = with_focal(own, factor), with_focal(camera, factor)
    R, sigmas = follower.rotations(own)
    if np.isnan(R).all(axis=(1, 2)).mean() > 0.5:
        raise InvalidInputError(
            f"{video}: too little of the background can be followed to tell how the camera turned: it is "
            "blurred, plain, or people cover it; film from a tripod, or log the phone's gyroscope"
        )
    sizes = [len(link.pair.uv_a) for link in follower.links if link is not None]
    motion = CameraMotion(np.array(times), R, focal_px=float(camera.K[0, 0]))
    of_focal = sigma * np.sqrt(np.nanmean(motion.angles**2) / 3)  # per axis
    motion = replace(motion, sigma=float(np.hypot(np.nanmedian(sigmas), of_focal)))
    return BackgroundMotion(motion, camera, sigma, int(np.median(sizes)) if sizes else 0)


def _camera_of(camera: Camera, frame: VideoFrame) -> Camera:
    """Return the camera of a frame scaled down to `_LONG_SIDE`."""
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise InvalidInputError(
            f"the video has {width} x {height} px, its camera {camera.width_px} x {camera.height_px}; give "
            "the camera of this video"
        )
    scale = min(1.0, _LONG_SIDE / max(width, height))
    size = {"width_px": round(scale * width), "height_px": round(scale * height)}
    return replace(camera, K=np.diag([size["width_px"] / width, size["height_px"] / height, 1.0]) @ camera.K, **size)


def _boxes(people: Detections | KeypointSequence | None) -> Callable[[float], Array]:
    """Return a function of the time, s: boxes (P, 4) left, top, right, bottom around people, px of the whole image, in
    the nearest frame.
    """
    if people is None or people.times is None:
        return lambda time: np.empty((0, 4))
    times, uv = people.times, people.uv_px if isinstance(people, Detections) else people.uv_px[:, None]
    low, high = np.where(np.isnan(uv), np.inf, uv).min(axis=2), np.where(np.isnan(uv), -np.inf, uv).max(axis=2)
    margin = _MARGIN * np.maximum(high - low, 0.3 * (high - low).max(axis=-1, keepdims=True))
    boxes = np.concatenate([low - margin, high + margin], axis=-1)  # (T, P, 4)

    def at(time: float) -> Array:
        nearest = boxes[int(np.argmin(np.abs(times - time)))]
        return np.asarray(nearest[np.isfinite(nearest).all(axis=1)])

    return at


class _Key(NamedTuple):
    """A keyframe."""

    gray: Gray
    frame: int  #: Its number among the frames
    R_first_key: Array
    uv: Array  #: (n, 2) corners, px


class _Link(NamedTuple):
    """A frame that was followed from a keyframe."""

    key: int
    pair: Pair  #: Points of the keyframe and of the frame
    turned: Turned


class _Follower:
    """Follows the background from frame to frame."""

    def __init__(self, camera: Camera):
        self.camera = camera
        self.links: list[_Link | None] = []  #: Of each frame; None where it could not be followed
        self._cv2 = optional("cv2", "video")
        self._size = camera.width_px, camera.height_px
        self._tolerance = _TOLERANCE / float(camera.K[0, 0])
        self._keys: list[_Key] = []
        self._R = np.eye(3)  # R_first_camera of the latest frame that is known
        self._rng = np.random.default_rng(0)

    def follow(self, image: NDArray[np.uint8], boxes: Array) -> None:
        """Add a frame. image: (height, width, 3), BGR, whole. boxes: (P, 4) around people, px of the whole image."""
        cv2 = self._cv2
        boxes = boxes * np.tile(np.array(self._size) / image.shape[1::-1], 2)
        gray = cv2.cvtColor(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        if not self._keys:
            self._add_key(gray, boxes)
            return
        away = so3.angle_between(np.stack([key.R_first_key for key in self._keys]), self._R)
        link = None
        for key in np.argsort(away)[:3].tolist():
            link = self._followed(key, gray, boxes)
            if link is not None:
                break
        self.links.append(link)
        if link is None:
            return
        self._R = self._keys[link.key].R_first_key @ link.turned.R_a_b
        if so3.angle_between(self._keys[link.key].R_first_key, self._R) > _NEW_KEY:
            away = so3.angle_between(np.stack([key.R_first_key for key in self._keys]), self._R)
            if away.min() > _NEW_KEY:
                self._add_key(gray, boxes)

    def _add_key(self, gray: Gray, boxes: Array) -> None:
        mask = np.full(gray.shape, 255, np.uint8)
        for left, top, right, bottom in np.clip(boxes, 0, max(self._size)).astype(int):
            mask[top : bottom + 1, left : right + 1] = 0
        corners = self._cv2.goodFeaturesToTrack(gray, _POINTS, 0.01, _APART, mask=mask)
        uv = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(float)
        first = not self._keys
        self._keys.append(_Key(gray, 0 if first else len(self.links) - 1, self._R, uv))
        if first:
            whole = Turned(np.eye(3), np.ones(len(uv), bool), 0.0)
            self.links.append(_Link(0, Pair(uv, uv), whole))

    def _followed(self, number: int, gray: Gray, boxes: Array) -> _Link | None:
        """Follow a keyframe's corners into a frame; the second time with the rotation of the first."""
        key, R_first_now = self._keys[number], self._R
        for _ in range(3):
            guess = key.R_first_key.T @ R_first_now
            uv_key, uv_now = self._points(key, gray, guess)
            inside = (uv_now[:, None] >= boxes[:, :2]) & (uv_now[:, None] <= boxes[:, 2:])
            kept = ~inside.all(axis=-1).any(axis=-1)  # not on people
            pair = Pair(uv_key[kept], uv_now[kept])
            if len(pair.uv_a) < _FEWEST:
                return None
            a, b = (bearings(self.camera, uv) for uv in pair)
            turned = turn_between(a, b, self._tolerance, self._rng)
            share = turned.inliers.mean()
            if turned.inliers.sum() < _FEWEST or share < _LEAST_SHARE:
                return None
            if so3.angle_between(guess, turned.R_a_b) < _AGAIN:
                break
            R_first_now = key.R_first_key @ turned.R_a_b
        own = turned.inliers
        return _Link(number, Pair(pair.uv_a[own], pair.uv_b[own]), turned)

    def _points(self, key: _Key, gray: Gray, R_key_now: Array) -> tuple[Array, Array]:
        """Return points of a keyframe and of a frame, px, that was guessed to be turned by R_key_now."""
        cv2, K = self._cv2, self.camera.K
        if not len(key.uv):
            return key.uv, key.uv
        H = K @ R_key_now @ np.linalg.inv(K)  # pixels of the frame to those of the keyframe
        turned_back = cv2.warpPerspective(gray, H, self._size)
        start = key.uv.astype(np.float32).reshape(-1, 1, 2)
        there, found, _ = cv2.calcOpticalFlowPyrLK(key.gray, turned_back, start, None)
        back, again, _ = cv2.calcOpticalFlowPyrLK(turned_back, key.gray, there, None)
        off = np.linalg.norm((back - start)[:, 0], axis=-1)
        homogeneous = np.concatenate([there[:, 0].astype(float), np.ones((len(there), 1))], axis=1)
        uv = homogeneous @ np.linalg.inv(H).T
        uv = uv[:, :2] / uv[:, 2:]
        good = (found[:, 0] == 1) & (again[:, 0] == 1) & (off < _BACK)
        good &= ((uv > 4) & (uv < np.array(self._size) - 4)).all(axis=1)
        return key.uv[good], uv[good]

    def pairs(self) -> list[Pair]:
        """Return pairs of keyframes and frames turned far against each other, each with as many points."""
        links = [
            link
            for link in self.links
            if link is not None
            and len(link.pair.uv_a) >= _PAIR_POINTS
            and so3.angle_between(np.eye(3), link.turned.R_a_b) > _LEAST_TURN
        ]
        out = []
        for i in np.unique(np.linspace(0, len(links) - 1, _PAIRS).astype(int)) if links else ():
            pick = self._rng.choice(len(links[i].pair.uv_a), _PAIR_POINTS, replace=False)
            out.append(Pair(links[i].pair.uv_a[pick], links[i].pair.uv_b[pick]))
        return out

    def rotations(self, camera: Camera) -> tuple[Array, Array]:
        """Return R_first_camera (T, 3, 3) and its standard deviation (T,) with a camera's focal length."""
        R, variance = np.full((len(self.links), 3, 3), np.nan), np.full(len(self.links), np.nan)
        for t, link in enumerate(self.links):
            if t == 0:
                R[0], variance[0] = np.eye(3), 0.0
            elif link is not None:
                own = self._keys[link.key].frame
                a, b = (bearings(camera, uv) for uv in link.pair)
                turned = turn_between(a, b, self._tolerance)
                R[t] = R[own] @ turned.R_a_b
                variance[t] = variance[own] + turned.sigma**2
        return R, _INFLATION * np.sqrt(variance)
