"""Errors of a 2D detector, as batched torch operations.

Errors are in pixels of a camera with a focal length of 1250 px; divided by it they are errors of x/z
and y/z. Windows are of four kinds: clean; white; independent, each joint with its own bias and slow drift;
realistic, with the errors of joints regressed from a real detector's points (`joint_errors`). The last two
have gaps, missing landmarks and image borders too.

Rigs and people differ in how a trunk moves: variations of a motion that are constant over a window. The bend between
pelvis and upper trunk is spread differently over the spine's joints, the pelvis is pitched differently against the rest
of the body, and clavicles rest and move differently; orientations of the upper trunk, arms and legs stay. The joints of
the trunk lie at other places between hips, shoulders and head. All joints follow by forward kinematics.

Sensors worn in a training window, and the errors of their orientations. Errors are constant over the half second of a
window: misalignment of the calibration, roll by soft tissue about the bone, heading of the sensor's reference frame,
lag between camera and sensors. At amplitude 1 they turn a limb's bone by 2.7 degrees and its segment about the bone by
4.7 degrees in the median, as measured on real recordings; the camera's detections come 1-3 frames late.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import tan
from typing import Final

import torch
from torch import Tensor

from lifting.body import Body, side_of
from lifting.training.joint_errors import (
    NEAREST_M,
    Draw,
    JointErrors,
    View,
    cross,
    exchanged,
    jumps,
    path_basis,
    smooth_errors,
)
from rtof_kin.body.kinematics import LUMBAR_PITCH
from rtof_kin.body.pose_prior import CLAVICLES, SPINE

FOCAL_PX: Final = 1250.0
HALF_WIDTH, HALF_HEIGHT = 960 / FOCAL_PX, 540 / FOCAL_PX  #: Half the image, in units of focal length
RATE_HZ: Final = 60.0


@dataclass(frozen=True)
class NoiseConfig:
    """Frequencies and sizes of errors; a realistic window scales bias and drift by its amplitude."""

    clean: float = 0.20  #: Share of windows without any error
    white: float = 0.10  #: Share of windows with white error only
    independent: float = 0.25  #: Share of windows in which joints err independently; the rest are realistic
    white_px: tuple[float, float] = (0.5, 6.0)  #: Range of the standard deviation per axis, px, of white windows
    amplitude: tuple[float, float] = (0.3, 1.5)
    """Range of the factor on the errors of a real detector, and on bias and drift of independent windows."""
    bias_px: float = 6.0  #: Standard deviation of the constant error per joint and axis, px
    drift_px: float = 5.0  #: Standard deviation of the slow error per joint and axis, px
    drift_memory: float = 0.5  #: Correlation time of the drift, s
    wrist_memory: float = 0.3  #: Correlation time of the drift at the wrists, s
    jitter_px: float = 0.3  #: Standard deviation of the white error of independent windows, px
    outlier_share: float = 0.04  #: Share of (frame, joint) of independent windows that are outliers
    outlier_px: float = 60.0  #: Standard deviation per axis of an outlier, constant within its run, px
    missing_share: float = 0.05  #: Share of (frame, joint) missing in runs
    run_s: tuple[float, float] = (0.2, 1.0)  #: Range of the length of outlier and missing runs, s
    gap_share: float = 0.10  #: Share of realistic windows that lose the whole body for some frames
    poor_share: float = 0.15  #: Share of these windows whose detector lacks about a fifth of the joints throughout
    sparse_share: float = 0.10  #: Share of these windows whose detector has no point between hips and shoulders
    truncated_share: float = 0.30  #: Share of these windows in which what is outside the image is unseen


PERFECT: Final = NoiseConfig(clean=1.0, white=0.0, independent=0.0)
TRAINING_NOISE: Final[Mapping[str, NoiseConfig]] = {
    "mixed": NoiseConfig(),
    "perfect": PERFECT,
    "realistic": NoiseConfig(clean=0.0, white=0.0, independent=0.0),
    "independent": NoiseConfig(clean=0.0, white=0.0, independent=1.0),
}
"""Kinds of 2D that a lifter may be trained for. perfect: no errors, for projected ground truth (5-7 mm
better there, not usable with a detector). realistic: a real detector alone. mixed: all kinds."""
VALIDATION_NOISE: Final = {
    kind: replace(TRAINING_NOISE[kind], amplitude=(1.0, 1.0), poor_share=0.0, sparse_share=0.0)
    for kind in ("realistic", "independent")
}
"""Noise of detectors at nominal amplitude."""


def add_noise(
    body: Body,
    config: NoiseConfig,
    xy: Tensor,
    seen: Tensor,
    draw: Draw,
    rate_hz: float = RATE_HZ,
    view: View | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulate detections; the first windows stay clean, then come white, independent and realistic ones.

    Args:
        xy: (B, 2, W, J) exact x/z and y/z in the camera. seen: (B, W, J) bool. rate_hz: of the windows, Hz.
        view: the bodies; None for joints that are not the table's, whose realistic windows are independent.

    Returns:
        Noisy xy (B, 2, W, J) and seen (B, W, J).
    """
    B = len(xy)
    shares = (config.clean, config.white, config.independent)
    clean, white, independent = (round(sum(shares[: n + 1]) * B) for n in range(3))
    independent = independent if view else B
    noisy = xy.clone()
    if white > clean:
        sigma = draw.between(config.white_px, white - clean, 1, 1, 1)
        noisy[clean:white] += sigma / FOCAL_PX * draw.normal(*xy[clean:white].shape)
    if independent > white:
        rows = slice(white, independent)
        some = replace(draw, batch=independent - white)
        noisy[rows] += _independent(body, config, xy.shape[2], some, rate_hz)
    if view and independent < B:
        rows = slice(independent, B)
        some = replace(draw, batch=B - independent)
        noisy[rows] = _realistic(body, config, xy[rows], view[rows], some, rate_hz)
    if white < B:
        some = replace(draw, batch=B - white)
        seen = torch.cat([seen[:white], _detected(body, config, noisy[white:], seen[white:], some, rate_hz)])
    return noisy, seen


def _independent(body: Body, config: NoiseConfig, W: int, draw: Draw, rate_hz: float) -> Tensor:
    """Errors (B, 2, W, J) of joints that each have their own, in units of focal length."""
    B, J = draw.batch, len(body.names)
    bias = config.bias_px * draw.normal(B, 2, 1, J)
    drift = config.drift_px * _drift(body, config, W, draw, rate_hz)
    amplitude = draw.between(config.amplitude, B, 1, 1, 1)
    factor = torch.ones(J)  # larger at wrists and elbows, smaller at knees and ankles
    for limbs, size in ((body.arms, 1.3), (body.legs, 0.8)):
        for limb in limbs:
            factor[limb[1:]] = size
    error = (bias + drift) * (amplitude * factor.to(bias))
    error += config.jitter_px * draw.normal(B, 2, W, J)
    outlier = runs(config.outlier_share, W, J, draw, rate_hz, config.run_s)
    error += outlier[:, None] * (config.outlier_px * draw.normal(B, 2, 1, J))
    return error / FOCAL_PX


def _realistic(body: Body, config: NoiseConfig, xy: Tensor, view: View, draw: Draw, rate_hz: float) -> Tensor:
    """Detections (B, 2, W, J) of joints regressed from a real detector's points."""
    W, depth = xy.shape[2], view.joints[:, 2:, None].clamp_min(NEAREST_M)
    table = JointErrors.fitted().to(draw.device)
    amplitude = draw.between(config.amplitude, draw.batch)
    error = smooth_errors(body, table, view, amplitude, W, draw, rate_hz)
    error += jumps(body, view, W, draw, rate_hz)
    return exchanged(body, view, xy + error / depth, draw, rate_hz)


def _detected(body: Body, config: NoiseConfig, xy: Tensor, seen: Tensor, draw: Draw, rate_hz: float) -> Tensor:
    """What is seen (B, W, J) of detections (B, 2, W, J)."""
    B, _, W, J = xy.shape
    seen = seen & ~runs(config.missing_share, W, J, draw, rate_hz, config.run_s)
    seen &= ~_gaps(config, W, draw)[:, :, None]
    seen &= _landmark_set(body, config, draw)[:, None]
    truncated = draw.uniform(B, 1, 1) <= config.truncated_share
    inside = (xy[:, 0].abs() < HALF_WIDTH) & (xy[:, 1].abs() < HALF_HEIGHT)
    return seen & (inside | ~truncated)


def _drift(body: Body, config: NoiseConfig, W: int, draw: Draw, rate_hz: float) -> Tensor:
    """Unit-variance Ornstein-Uhlenbeck paths (B, 2, W, J) from their leading eigenvectors."""
    slow, fast = (
        path_basis(W, rate_hz, memory).to(draw.device) for memory in (config.drift_memory, config.wrist_memory)
    )
    weights = draw.normal(draw.batch, 2, slow.shape[1], len(body.names))
    drift = torch.matmul(slow, weights)
    wrists = [arm[-1] for arm in body.arms]
    drift[..., wrists] = torch.matmul(fast, weights[..., wrists])
    return drift


def runs(share: float, W: int, n: int, draw: Draw, rate_hz: float, seconds: tuple[float, float] = (0.2, 1.0)) -> Tensor:
    """Draw a mask (B, W, n) of runs. rate_hz: of the frames, Hz. seconds: range of the length of a run, s."""
    low, high = (s * rate_hz for s in seconds)
    length = draw.between((low, high), draw.batch, 1, n)
    start = -length + (W + length) * draw.uniform(draw.batch, 1, n)
    # A run of length L touches the window with probability proportional to W + L.
    there = draw.uniform(draw.batch, 1, n) < share * (W + length) / length
    frame = torch.arange(W, device=draw.device)[None, :, None]
    return there & (frame >= start) & (frame < start + length)


def _gaps(config: NoiseConfig, W: int, draw: Draw) -> Tensor:
    """(B, W) frames in which the whole body is unseen; never all of a window."""
    ends = draw.uniform(draw.batch, 2).sort(dim=1).values * W
    there = draw.uniform(draw.batch, 1) < config.gap_share
    frame = torch.arange(W, device=draw.device) + 0.5
    gap = there & (frame >= ends[:, :1]) & (frame < ends[:, 1:])
    return gap & ~gap.all(dim=1, keepdim=True)


def _landmark_set(body: Body, config: NoiseConfig, draw: Draw) -> Tensor:
    """(B, J) joints that the detector has at all."""
    rand = draw.uniform(draw.batch, len(body.names) + 1)
    which = rand[:, -1:]
    limbs = torch.zeros(len(body.names), dtype=torch.bool, device=draw.device)
    limbs[[j for limb in body.arms + body.legs for j in limb]] = True
    limbs[[j for j in range(len(body.names)) if j not in body.parents]] = True  # the head
    poor = which < config.poor_share
    sparse = (which >= config.poor_share) & (which < config.poor_share + config.sparse_share)
    return (~poor | (rand[:, :-1] > 0.2)) & (~sparse | limbs)


TRUNK: Final = ("Hips", *SPINE)  #: Segments from the pelvis to the upper trunk
PLACES: Final = {
    "Hips": (0.02, 0.0, 0.045),
    "Spine": (0.0, 0.0, 0.025),
    "Spine1": (0.015, 0.0, 0.025),
    "Spine2": (0.015, 0.0, 0.025),
    "Spine3": (0.015, 0.0, 0.025),
    "Neck": (0.015, 0.0, 0.015),
    "Head": (0.02, 0.0, 0.02),
    "Shoulder": (0.015, 0.02, 0.025),
    "Arm": (0.012, 0.012, 0.015),
    "UpLeg": (0.008, 0.008, 0.008),
}
"""Standard deviation of where rigs have the joints of the trunk, m, sideways for the right side; the lumbar
joint lies in the direction that defines the pelvis."""


@dataclass(frozen=True)
class RigConfig:
    """Sizes of the differences."""

    share: float = 0.6  #: Share of windows that are varied
    spread: float = 0.7  #: Standard deviation of the logarithm of the share of the bend that a joint of the spine takes
    spine: tuple[float, float, float] = (0.03, 0.07, 0.02)
    """Standard deviation of the constant turn of each segment of the spine about x, y and z, rad."""
    pelvis: tuple[float, float, float] = (0.02, 0.1, 0.02)  #: The same of the pelvis
    clavicle: tuple[float, float, float] = (0.12, 0.04, 0.10)  #: The same of the clavicles, left and right mirrored
    mobility: tuple[float, float] = (0.3, 1.2)  #: Range of the factor on the rotation of the clavicles
    places: float = 1.0  #: Factor on `PLACES`


def trunk_segments(body: Body) -> list[int]:
    """Return the indices of `TRUNK`, the clavicles and the neck; none if the body lacks any."""
    names = (*TRUNK, *CLAVICLES, "Neck")
    return [body.names.index(name) for name in names] if set(names) <= set(body.names) else []


def places(body: Body, config: RigConfig, draw: Draw) -> Tensor:
    """Draw displacements of the joints (B, J, 3) in their parents' frames, of the root in its own, m."""
    sizes = torch.tensor([PLACES.get(side_of(name)[1], (0.0, 0.0, 0.0)) for name in body.names])
    shift = config.places * sizes.to(draw.device) * draw.normal(draw.batch, len(body.names), 3)
    left = [j for j, name in enumerate(body.names) if side_of(name)[0] == "left"]
    shift[:, left] = shift[:, [body.mirrored[j] for j in left]] * shift.new_tensor([1.0, -1.0, 1.0])
    spine = body.names.index("Spine")
    shift[:, spine, 0] = tan(LUMBAR_PITCH) * shift[:, spine, 2]
    return shift


def turns(axes: Tensor, config: RigConfig, draw: Draw) -> Tensor:
    """Draw the turns (B, W, 8, 3, 3) in world from a motion's trunk, with x and z axes (B, 3, W, 2, 8) of
    `trunk_segments`, to another rig's.
    """
    B = len(axes)
    x, z = axes.unbind(dim=3)
    R = torch.stack([x, cross(z, x), z], dim=-1).permute(0, 2, 3, 1, 4)  # (B, W, 8, 3, 3)

    def constant(sizes: tuple[float, float, float], n: int) -> Tensor:
        return draw.normal(B, 1, n, 3) * axes.new_tensor(sizes)

    pelvis = R[:, :, 0] @ exp(constant(config.pelvis, 1))[:, :, 0]
    bend = log(pelvis.transpose(-1, -2) @ R[:, :, 4])
    share = (config.spread * draw.normal(B, 4)).softmax(dim=1).cumsum(dim=1)[:, None, :3, None]
    spine = pelvis[:, :, None] @ exp(share * bend[:, :, None] + constant(config.spine, 3))
    upper = R[:, :, 4:5]
    side = constant(config.clavicle, 1)
    rest = torch.cat([side, side * side.new_tensor([-1.0, 1.0, -1.0])], dim=2)
    mobility = draw.between(config.mobility, B, 1, 1, 1)
    clavicles = upper @ exp(mobility * log(upper.transpose(-1, -2) @ R[:, :, 5:7]) + rest)
    varied = torch.cat([pelvis[:, :, None], spine, upper, clavicles, R[:, :, 7:]], dim=2)
    return varied @ R.transpose(-1, -2)


def exp(rotvec: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    angle = rotvec.norm(dim=-1).clamp_min(1e-9)[..., None, None]
    x, y, z = rotvec.unbind(dim=-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*rotvec.shape, 3)
    one = torch.eye(3, device=rotvec.device)
    R: Tensor = one + (angle.sin() / angle) * cross + ((1 - angle.cos()) / angle**2) * (cross @ cross)
    return R


def log(R: Tensor) -> Tensor:
    """Return rotation vectors (..., 3), rad, of rotations (..., 3, 3) below half a turn."""
    S = R - R.transpose(-1, -2)
    twice = torch.stack([S[..., 2, 1], S[..., 0, 2], S[..., 1, 0]], dim=-1)
    sin = (twice.norm(dim=-1) / 2).clamp_min(1e-7)
    angle = torch.atan2(sin, (R.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2)
    rotvec: Tensor = twice / 2 * (angle / sin)[..., None]
    return rotvec


@dataclass(frozen=True)
class SensorConfig:
    """Sets of sensors and sizes of errors; those of orientations are scaled by an amplitude per window."""

    none: float = 0.30  #: Share of windows without any sensor
    limbs: float = 0.30  #: Share of windows with sensors on upper arms, forearms, thighs and shanks
    limbs_and_trunk: float = 0.12  #: Share with these and sensors on pelvis and upper trunk
    ends: float = 0.08  #: Share with sensors on forearms and shanks
    every: float = 0.06  #: Share with all sensors; the rest have random subsets
    amplitude: tuple[float, float] = (0.2, 1.8)  #: Range of the factor on misalignment and roll
    misalignment: float = 0.037  #: Standard deviation about each axis of the segment, rad
    roll: float = 0.11  #: Standard deviation of the additional error about the bone, rad
    heading: float = 0.03  #: Standard deviation of a sensor's heading, rad
    lag: tuple[float, float] = (-1.0, 4.0)  #: Range of the lead of the sensors over the camera, frames
    missing: float = 0.03  #: Share of (frame, sensor) lost, in runs


SENSED_TRUNK = ("Hips", "Spine3")  #: Segments of the pelvis and upper trunk sensors


def worn(body: Body, config: SensorConfig, draw: Draw) -> Tensor:
    """Draw the sensors of each window, (B, S) bool."""
    limbs = {j for limb in body.arms + body.legs for j in limb[:2]}
    ends = {limb[1] for limb in body.arms + body.legs}
    trunk = {body.names.index(name) for name in SENSED_TRUNK if name in body.names}
    sets = [
        (config.none, set()),
        (config.limbs, limbs),
        (config.limbs_and_trunk, limbs | trunk),
        (config.ends, ends),
        (config.every, set(body.sensor_joints)),
    ]
    which = draw.uniform(draw.batch, 1)
    chance = draw.uniform(draw.batch, 1)
    mask = draw.uniform(draw.batch, len(body.sensors)) < chance
    below = 1.0
    for share, joints in sets:
        chosen = torch.tensor([j in joints for j in body.sensor_joints], device=draw.device)
        mask = torch.where((which < below) & (which >= below - share), chosen, mask)
        below -= share
    return mask


def with_errors(bones: Tensor, axes_world: Tensor, config: SensorConfig, draw: Draw) -> Tensor:
    """Return true axes (B, 3, W, 2, S) as sensors measure them; bones (S, 3) are unit vectors along the bones
    in their segments' frames, zero where there is none.
    """
    B, S = draw.batch, len(bones)
    factor = draw.between(config.amplitude, B, 1, 1)
    turn = config.misalignment * draw.normal(B, S, 3)
    turn = factor * (turn + config.roll * draw.normal(B, S, 1) * bones)
    E = exp(turn)
    x, z = axes_world.unbind(dim=3)
    y = cross(z, x)

    def column(k: int) -> Tensor:
        a, b, c = (E[:, None, None, :, i, k] for i in range(3))
        return a * x + b * y + c * z

    reported = torch.stack([column(0), column(2)], dim=3)
    heading = (config.heading * draw.normal(B, S))[:, None, None]
    east, north, up = reported.unbind(dim=1)
    cos, sin = heading.cos(), heading.sin()
    return torch.stack([cos * east - sin * north, sin * east + cos * north, up], dim=1)
