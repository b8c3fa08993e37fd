"""The mean stride of a recorded walk, and a walk along a path made of it (for models/build_movements.py).

The stride is a Fourier series of every channel over the phase, in units of the leg's length. Along the path
each stance has one contact_point; the ball of the foot moves from one to the next as it did in the recorded swing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.plan.movements import STORED_RATE_HZ
from rtof_kin.simulation.mocap import MocapClip

STRIDE = ("CMU035", "35_33")
SIDES = ("Left", "Right")
HARMONICS, GRID = 7, 400  # GRID: samples of a stride
PERIODS = np.arange(0.85, 1.4, 0.005)  # [s] that are tried
STANDS = 0.36
"""Largest speed of a ball of the foot that stands, share of the mean of the stride."""
LOW = 0.010
"""[leg] Largest height of such a ball."""
EARLY = 0.12
"""Strides at start and stop in which both feet stand."""
TURN, TURN_STEP = 1.9, 0.55
"""[leg] length of a half turn's path; share of a step within it."""
FOOT, SOFT = 0.245, 0.005
"""[leg] distance from heel to ball; roundness of a foot's meeting with the floor."""
EDGE = 0.12
"""Share of a swing at either end in which it passes to rest."""
LEAST_LIFT = 0.5
"""Of a short step, share of the recorded height of a swing."""
RAMP = 1.0
"""Strides in which steps grow to full length at the start, and shrink at the stop."""
LOOK_AHEAD, HEAD_TURN = 0.5, 0.5
"""[leg] of the path to which the head turns, and by what share."""


@dataclass(frozen=True)
class Stride:
    """Mean stride as functions of the phase (in strides), walking along x."""

    period: float
    """s."""
    length: float
    """leg."""
    neutral: Array
    """(J, 3, 3) mean rotations in the parents' frames."""
    series: Callable[[Array], Array]
    """Phase (T,) -> (T, 3 J + 3 + 6 + 2): rotation vectors from `neutral`, hips, balls, pitch of the feet."""

    def split(self, phase: Array) -> tuple[Array, Array, Array, Array]:
        """Return rotation vectors (T, J, 3), hips (T, 3), balls (T, 2, 3) and pitch (T, 2)."""
        values, J = self.series(phase), len(self.neutral)
        turns, hips, balls, pitch = np.split(values, [3 * J, 3 * J + 3, 3 * J + 9], axis=1)
        return turns.reshape(-1, J, 3), hips, balls.reshape(-1, 2, 3), pitch


def mean_stride(clip: MocapClip, skeleton: SkeletonModel, leg_default: float) -> Stride:
    """Return the mean stride of a walk straight ahead.

    Args:
        clip: the walk. skeleton: its joints, of leg length `leg_default`, m.
    """
    p, R = clip.poses.p_world_joint, clip.poses.R_world_bone
    t = np.arange(len(p)) / clip.poses.rate_hz
    way = np.polyfit(t, p[:, 0, :2], 1)[0]
    back = so3.about_axis("z", -np.arctan2(way[1], way[0]))
    p, R = p @ back.T, back @ R
    leg = np.linalg.norm(clip.joint_offsets[skeleton.index("LeftLeg", "LeftFoot")], axis=1).sum()
    speed = float(np.linalg.norm(way) / leg)
    feet, thighs = (skeleton.index(*(f"{s}{n}" for s in SIDES)) for n in ("Foot", "UpLeg"))
    ball = np.array([skeleton.landmarks[f"{s}ToeBase"][1] for s in SIDES]) * leg / leg_default
    pitch = -np.arcsin(R[:, feet][..., 2, 0])
    moving = np.linalg.norm(np.gradient(p[:, feet], axis=0), axis=-1) * clip.poses.rate_hz
    flat = moving < 0.15
    pitch -= [np.median(pitch[flat[:, s], s]) for s in range(2)]
    ankles = p[:, feet] / leg
    ankles[..., 2] -= [np.median(ankles[flat[:, s], s, 2]) for s in range(2)]
    turned = np.einsum("tsij,sj->tsi", so3.about_axis("y", pitch), ball) / leg
    balls = ankles + turned - [0, 0, ball[0, 2] / leg]
    hips = p[:, thighs].mean(axis=1) / leg
    hips[:, 2] -= np.mean([np.median(p[flat[:, s], feet[s], 2]) for s in range(2)]) / leg
    ahead = np.stack([speed * t, *2 * [0 * t]], axis=-1)
    middle = (hips - ahead).mean(axis=0) * [1, 1, 0]
    local = kinematics.local_rotations(skeleton.parents, R)
    neutral = so3.nearest_rotation(local.mean(axis=0))
    turns = so3.log(np.swapaxes(neutral, -1, -2) @ local)
    values = np.concatenate(
        [
            turns.reshape(len(t), -1),
            hips - ahead - middle,
            (balls - (ahead + middle)[:, None]).reshape(len(t), -1),
            pitch,
        ],
        axis=1,
    )
    period = min(PERIODS, key=lambda T: float(_fit(t, values[:, -8:], T)[1]))
    weights = _fit(t, values, period)[0]

    def series(phase: Array) -> Array:
        return _basis(phase) @ weights

    print(f"stride of {clip.name}: {period:.2f} s, {speed * period * leg_default:.2f} m, {t[-1] / period:.1f} strides")
    return Stride(float(period), speed * float(period), neutral, series)


def _basis(phase: Array) -> Array:
    angle = 2 * np.pi * np.outer(phase, np.arange(1, HARMONICS + 1))
    return np.concatenate([np.cos(angle), np.sin(angle), np.ones((len(phase), 1))], axis=1)


def _fit(t: Array, values: Array, period: float) -> tuple[Array, float]:
    """Return the weights of a periodic function with a trend, which is left out, and the squares' sum."""
    basis = np.concatenate([_basis(t / period), (t - t.mean())[:, None]], axis=1)
    weights = np.linalg.lstsq(basis, values, rcond=None)[0]
    return weights[:-1], float(np.sum((values - basis @ weights) ** 2))


def smoother(x: Array) -> Array:
    """Return the minimum-jerk step from 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


@dataclass(frozen=True)
class _Path:
    """Course of a walk out and back, at `GRID` samples a stride."""

    phase: Array
    amplitude: Array
    s: Array
    heading: Array
    xy: Array

    def at(self, values: Array, phase: Array | float) -> Array:
        """Interpolate one of the fields at phases from the start."""
        flat = values.reshape(len(values), -1)
        columns = [np.interp(phase, self.phase, column) for column in flat.T]
        return np.stack(columns, axis=-1).reshape((*np.shape(phase), *values.shape[1:]))


def _path(stride: Stride, strides: int) -> _Path:
    """Return a walk out, a half turn to the left, back and another half turn."""
    phase = np.arange(strides * GRID + 1) / GRID
    total = stride.length * strides

    def heading_of(s: Array, total: float) -> Array:
        straight = (total - 2 * TURN) / 2
        return np.pi * (smoother((s - straight) / TURN) + smoother((s - total + TURN) / TURN))

    ramp = smoother(phase / RAMP) * smoother((strides - phase) / RAMP)
    s = total * phase / strides
    amplitude = ramp
    for _ in range(60):
        straight = (total - 2 * TURN) / 2
        inside = [
            smoother((s - a) / 0.8 + 0.5) - smoother((s - a - TURN) / 0.8 + 0.5) for a in (straight, total - TURN)
        ]
        amplitude = ramp * (1 - (1 - TURN_STEP) * np.clip(sum(inside), 0, 1))
        rate = stride.length * amplitude
        s = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2) / GRID])
        total = float(s[-1])
    heading = heading_of(s, total)
    fine = np.linspace(0, total, 40001)
    course = heading_of(fine, total)
    velocity = np.stack([np.cos(course), np.sin(course)], axis=-1)
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum((velocity[1:] + velocity[:-1]) / 2, axis=0) * fine[1]])
    xy = np.stack([np.interp(s, fine, column) for column in xy.T], axis=-1)
    return _Path(phase, amplitude, s, heading, xy)


def _contacts(stride: Stride) -> list[tuple[float, float]]:
    """Return the phases [on, off) in which each ball stands."""
    phase = np.arange(2 * GRID) / GRID
    ball = stride.split(phase)[2]
    speed = np.abs(np.gradient(ball[..., 0], 1 / GRID, axis=0) / stride.length + 1)
    out = []
    for side in range(2):
        stands = (speed[:, side] < STANDS) & (ball[:, side, 2] < LOW)
        begins = np.flatnonzero(stands[1:] & ~stands[:-1]) + 1
        ends = np.flatnonzero(~stands[1:] & stands[:-1]) + 1
        spans = [(b, min(e for e in ends if e > b)) for b in begins if any(e > b for e in ends)]
        on, off = max(spans, key=lambda span: span[1] - span[0])
        out.append((on / GRID % 1, on / GRID % 1 + (off - on) / GRID))
    return out


def walk(
    stride: Stride, stand_R: Array, stand_hips: Array, stand_balls: Array, strides: int, toe_out: float
) -> tuple[Array, Array, Array, Array]:
    """Return a walk out and back at `STORED_RATE_HZ`, from standing to standing.

    Args:
        stride: that is repeated. stand_R, stand_hips, stand_balls: posture that it begins and ends in.
        strides: number. toe_out: direction of the feet, rad.

    Returns:
        Rotations in the parents' frames (T, J, 3, 3), R_world_foot (T, 2, 3, 3), hips and balls.
    """
    contacts = _contacts(stride)
    off_0, on_1 = contacts[0][1], contacts[1][0]
    start = (on_1 + off_0) / 2 + round(on_1 - off_0) / 2  # the feet change
    path = _path(stride, strides)
    times = np.arange(int(strides * stride.period * STORED_RATE_HZ)) / STORED_RATE_HZ
    phase = np.linspace(0, strides, len(times) + 1)
    a, course, xy, s = (path.at(v, phase) for v in (path.amplitude, path.heading, path.xy, path.s))
    turns, hips_own, _, pitch = stride.split(phase + start)
    along = np.stack([np.cos(course), np.sin(course)], axis=-1)
    left = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    hips = np.empty((len(phase), 3))
    forward = a * hips_own[:, 0] + (1 - a) * stand_hips[0]
    hips[:, :2] = xy + forward[:, None] * along + (a * hips_own[:, 1])[:, None] * left
    hips[:, 2] = a * hips_own[:, 2] + (1 - a) * stand_hips[2]
    difference = so3.log(np.swapaxes(stand_R, -1, -2) @ stride.neutral @ so3.exp(turns))
    R = stand_R @ so3.exp(a[:, None, None] * difference)
    R[:, 0] = so3.about_axis("z", course) @ R[:, 0]
    ahead = np.interp(s + LOOK_AHEAD, path.s, path.heading) - course
    R[:, 5] = R[:, 5] @ so3.about_axis("z", HEAD_TURN * ahead)
    balls, heading = np.empty((len(phase), 2, 3)), np.empty((len(phase), 2))
    for side in range(2):
        balls[:, side], heading[:, side] = _foot(stride, path, phase, start, side, contacts[side], stand_balls[side])
    toe, pitch = heading + np.array([toe_out, -toe_out]), a[:, None] * pitch
    R_feet = so3.about_axis("z", toe) @ so3.about_axis("y", pitch)
    balls[..., 2] = _above(balls[..., 2], -FOOT * np.sin(pitch))
    return R, R_feet, hips, balls


def _above(height: Array, least: Array) -> Array:
    """Return heights that are not below the least, smoothly and but for a millimetre."""
    return np.asarray((height + least + np.sqrt((height - least) ** 2 + SOFT**2) - SOFT) / 2)


def _foot(
    stride: Stride, path: _Path, phase: Array, start: float, side: int, contact: tuple[float, float], stand: Array
) -> tuple[Array, Array]:
    """Return the ball (T, 3) of a foot and its heading (T,): contact points, and recorded swings between."""
    last = path.phase[-1]
    on, off = (value - start for value in contact)
    first = int(np.floor(-on)) - 2
    spans = [(on + k, off + k) for k in range(first, first + int(last) + 5)]
    spans = [(b, e) for b, e in spans if e > -EARLY and b < last + EARLY]
    holds, headings = [], []
    for b, e in spans:
        middle = 0.0 if b <= EARLY else last if e >= last - EARLY else (b + e) / 2
        a, course, xy = (path.at(v, middle) for v in (path.amplitude, path.heading, path.xy))
        own = stride.split(np.array([middle + start]))[2][0, side]
        place = a * own[:2] + (1 - a) * stand[:2]
        holds.append(xy + so3.about_axis("z", course)[:2, :2] @ place)
        headings.append(float(course))
    ball, heading = np.zeros((len(phase), 3)), np.empty(len(phase))
    ball[:, :2], heading[:] = holds[0], headings[0]
    for k in range(len(spans) - 1):
        begin, end = spans[k][1], spans[k + 1][0]
        share = np.clip((phase - begin) / (end - begin), 0, 1)
        own = stride.split(begin + share * (end - begin) + start)[2][:, side]
        ends = stride.split(np.array([begin, end]) + start)[2][:, side]
        moved = own[:, 0] + stride.length * share * (end - begin) - ends[0, 0]
        u = moved / (ends[1, 0] - ends[0, 0] + stride.length * (end - begin))
        window = smoother(share / EDGE) * smoother((1 - share) / EDGE)
        u = window * u + (1 - window) * smoother(share)
        after = phase > begin
        ball[after, :2] = (holds[k] + u[:, None] * (holds[k + 1] - holds[k]))[after]
        heading[after] = (headings[k] + smoother(share) * (headings[k + 1] - headings[k]))[after]
        rise = own[:, 2] - ends[0, 2] - share * (ends[1, 2] - ends[0, 2])
        lift = max(float(path.at(path.amplitude, (begin + end) / 2)), LEAST_LIFT)
        lift = 0.0 if np.allclose(holds[k], holds[k + 1]) else lift
        inside = after & (phase < end)
        ball[inside, 2] = (lift * window * rise)[inside]
    return ball, heading
