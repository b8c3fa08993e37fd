"""Make models/movements: ``python -m models.build_movements CORPUS`` with the folder of free motion.

Of the corpus (training subjects of CMU alone) come the mean stride and the neutral posture (35_33), the trunk
in a crouch (01_01) and the sway of a person who stands still (martial_04). What it lacks (seats, lunges,
raised arms, turns) is made of key postures that quintic splines join at rest. Lengths are in leg lengths.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from benchmarks.rerigged import rerigged
from models.build_movements_stride import SIDES, STRIDE, Stride, mean_stride, smoother, walk
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.plan.movements import MOST_EXTENDED, ROTATION_UNIT, STORED_RATE_HZ, Stored, planted
from rtof_kin.simulation.mocap import MocapClip, read_corpus
from rtof_kin.simulation.simulate import low_passed

SUBJECT = "CMU035"  # whose neutral posture all pieces have
SKELETON = SkeletonModel.default()
UPPER = SKELETON.index(
    "Hips",
    "Spine",
    "Spine1",
    "Spine2",
    "Spine3",
    "Neck",
    "Head",
    *(f"{side}{part}" for side in SIDES for part in ("Shoulder", "Arm", "ForeArm", "Hand")),
)
FEET = SKELETON.index("LeftFoot", "RightFoot")
LEG = sum(SKELETON.bone_lengths[name] for name in ("LeftLeg", "LeftFoot"))
BALL = SKELETON.landmarks["LeftToeBase"][1]
STANCE, TOE_OUT = 0.135, np.radians(8.0)
"""[leg] half distance of the ankles; [rad] direction of the feet."""
SPARE = 0.008
"""Of the square of a leg's reach in walking, which keeps the knees bent by ten degrees."""
CLAVICLE_UP = 0.2
"""Of the elevation of an arm, rad/rad."""
SWAY_SECONDS, SWAY_WAVES = 2.28, 4


@dataclass(frozen=True)
class Key:
    """A posture: rotations of the upper body in the parents' frames (J, 3, 3), hips, balls and feet."""

    R: Array
    hips: Array
    """(3,) see `Stored`."""
    balls: Array
    """(2, 3) see `Stored`."""
    pitch: Array
    """(2,) of the feet, heel up, rad."""


@dataclass(frozen=True)
class Piece:
    """Motion at `STORED_RATE_HZ`: rotations in the parents' frames, those of legs only to begin with."""

    R_local: Array
    R_feet: Array
    hips: Array
    balls: Array

    def then(self, *others: Piece) -> Piece:
        """Join pieces that begin in the last frame of the one before."""
        pieces = (self, *others)
        names = ("R_local", "R_feet", "hips", "balls")
        return Piece(
            *(
                np.concatenate([getattr(p, name)[(0 if k == 0 else 1) :] for k, p in enumerate(pieces)])
                for name in names
            )
        )


def clip_of(corpus: Path, subject: str, name: str) -> MocapClip:
    """Return a clip of the corpus on the skeleton of the library, without jitter."""
    clip = next(c for c in read_corpus(corpus, [subject]) if c.name.split("[")[0] == name)
    return rerigged(replace(low_passed(clip, 6.0), subject=SUBJECT))


def mirrored(R_local: Array) -> Array:
    """Return rotations (J, 3, 3) of the mirror image of a posture."""
    flip = np.diag([1.0, -1.0, 1.0])
    swap = {"Left": "Right", "Right": "Left"}
    names = [next((swap[s] + n[len(s) :] for s in SIDES if n.startswith(s)), n) for n in SKELETON.names]
    return np.asarray(flip @ R_local[SKELETON.index(*names)] @ flip)


def symmetric(R_local: Array) -> Array:
    """Return the mean of a posture (J, 3, 3) and its mirror image."""
    return so3.nearest_rotation(R_local + mirrored(R_local))


def turned(R: Array, **degrees: tuple[str, float]) -> Array:
    """Return a posture (J, 3, 3) with joints turned in their own frames: ``Spine=("y", 10)``."""
    R = R.copy()
    for name, (axis, angle) in degrees.items():
        (j,) = SKELETON.index(name)
        R[j] = R[j] @ so3.about_axis(axis, np.radians(angle))
    return R


def arms(R: Array, degrees: float, axis: str) -> Array:
    """Return a posture with both arms raised from hanging: forward about y, or sideways about x."""
    R = R.copy()
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        clavicle, arm, forearm = SKELETON.index(*(f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm")))
        up = np.radians(degrees)
        R_chest_arm = R[clavicle] @ R[arm]
        raised = so3.about_axis("y", -up) if axis == "y" else so3.about_axis("x", sign * up)
        palms = np.radians(90.0 * min(degrees / 60, 1.0))  # down in front, forward overhead
        outward = so3.about_axis("y", palms if axis == "y" else -0.5 * up)
        R[clavicle] = R[clavicle] @ so3.about_axis("x", sign * CLAVICLE_UP * up)
        R[arm] = R[clavicle].T @ raised @ R_chest_arm @ outward
        R[forearm] = so3.exp((1 - 0.7 * min(degrees / 60, 1)) * so3.log(R[forearm]))
    return R


def foot_rotations(pitch: Array, heading: Array | float = 0.0) -> Array:
    """Return R_world_foot (T, 2, 3, 3) of feet with pitch (T, 2), rad, heel up."""
    toe = np.asarray(heading)[..., None] + np.array([TOE_OUT, -TOE_OUT])
    return so3.about_axis("z", np.broadcast_to(toe, pitch.shape)) @ so3.about_axis("y", pitch)


def standing(R: Array) -> Key:
    """Return the posture in which all movements begin and end."""
    ankles = np.array([[0.0, STANCE, 0.0], [0.0, -STANCE, 0.0]])
    ball = foot_rotations(np.zeros((1, 2)))[0] @ [BALL[0], 0, 0] / LEG
    return Key(R, np.array([0.035, 0.0, 0.995]), ankles + ball, np.zeros(2))


def legs_begin(R_local: Array, R_feet: Array) -> Array:
    """Return rotations with legs whose knees point as the feet do, for `planted` to bend."""
    names = [f"{side}{part}" for side in SIDES for part in ("UpLeg", "Leg", "Foot")]
    R_local = R_local.copy()
    R_hips = R_local[:, 0]
    forward = R_feet[..., 0] * [1, 1, 0]
    yaw = so3.about_axis("z", np.arctan2(forward[..., 1], forward[..., 0]))
    for k in range(2):
        thigh, shank, foot = SKELETON.index(*names[3 * k : 3 * k + 3])
        R_local[:, thigh] = np.swapaxes(R_hips, -1, -2) @ yaw[:, k]
        R_local[:, shank] = np.eye(3)
        R_local[:, foot] = np.swapaxes(yaw[:, k], -1, -2) @ R_feet[:, k]
    return R_local


def through(keys: Sequence[Key], seconds: Sequence[float], lift: tuple[int, float] | None = None) -> Piece:
    """Return the motion through postures, at rest in the first and the last: a quintic spline.

    Args:
        keys, seconds: postures and their instants. lift: foot (0, 1) that is lifted by so many leg lengths.
    """
    at = np.arange(round(seconds[-1] * STORED_RATE_HZ) + 1) / STORED_RATE_HZ
    knots = np.asarray(seconds) * (at[-1] / seconds[-1])

    def spline(values: Array) -> Array:
        ends = [(order, np.zeros(values.shape[1:])) for order in (1, 2)]
        return np.asarray(make_interp_spline(knots, values, k=5, bc_type=(ends, ends))(at))

    steps = np.stack([so3.log(keys[0].R.swapaxes(-1, -2) @ key.R) for key in keys])
    R = keys[0].R @ so3.exp(spline(steps))
    hips, balls, pitch = (spline(np.stack([getattr(k, n) for k in keys])) for n in ("hips", "balls", "pitch"))
    if lift is not None:
        share = at / at[-1]
        balls[:, lift[0], 2] += lift[1] * 64 * (share * (1 - share)) ** 3
    R_feet = foot_rotations(pitch)
    return Piece(legs_begin(R, R_feet), R_feet, hips, balls)


def still(key: Key, seconds: float) -> Piece:
    """Return a posture that is kept."""
    return through([key, key], [0.0, seconds])


def write(folder: Path, name: str, before: Piece, cycle: Piece, after: Piece) -> None:
    """Write a movement, its legs bent for the default skeleton."""
    whole = before.then(cycle, after)
    times = np.arange(len(whole.hips)) / STORED_RATE_HZ
    R = kinematics.world_rotations(SKELETON.parents, whole.R_local)
    R[:, FEET] = whole.R_feet
    begin = Stored(kinematics.local_rotations(SKELETON.parents, R), whole.hips, whole.balls)
    poses = planted(begin, SKELETON, times)
    heel = SKELETON.landmarks["LeftHeel"][1][2]
    hip = SKELETON.joint_offsets[SKELETON.index("LeftUpLeg", "RightUpLeg")].mean(axis=0)
    lowered = LEG * whole.hips[0, 2] - heel - (poses.R_world_bone[0, 0] @ hip)[2] - poses.p_world_joint[0, 0, 2]
    local = kinematics.local_rotations(SKELETON.parents, poses.R_world_bone)
    vectors = np.round(so3.log(local) / ROTATION_UNIT).astype(np.int16)
    start = len(before.hips) - 1
    np.savez_compressed(
        folder / f"{name}.npz",
        rotations=np.diff(vectors, axis=0, prepend=np.zeros_like(vectors[:1])),
        hips=whole.hips.astype(np.float32),
        balls=whole.balls.astype(np.float32),
        cycle=np.array([start, start + len(cycle.hips) - 1]),
    )
    size = (folder / f"{name}.npz").stat().st_size
    print(f"{name}: {times[-1]:.1f} s, {size / 1000:.0f} kB, lowered by {lowered:.3f} m")


def squat(stand: Key, crouch: Array) -> Key:
    """Return the lowest posture of a squat."""
    R = stand.R.copy()
    trunk = SKELETON.index("Hips", "Spine", "Spine1", "Spine2", "Spine3")
    R[trunk] = crouch[trunk]
    R = turned(arms(R, 75.0, "y"), Neck=("y", -25.0))
    return replace(stand, R=R, hips=np.array([-0.20, 0.0, 0.60]))


def seat(stand: Key, crouch: Array) -> tuple[Key, Key, Key]:
    """Return the postures seated, leaning and leaving the seat."""
    trunk = SKELETON.index("Hips", "Spine", "Spine1", "Spine2", "Spine3")
    lean = stand.R.copy()
    lean[trunk] = crouch[trunk]
    lean = turned(arms(lean, 35.0, "y"), Neck=("y", -20.0))
    upright = arms(turned(stand.R, Hips=("y", -8.0), Spine=("y", 4.0), Spine1=("y", 4.0)), 30.0, "y")
    return (
        replace(stand, R=upright, hips=np.array([-0.40, 0.0, 0.53])),
        replace(stand, R=lean, hips=np.array([-0.385, 0.0, 0.533])),
        replace(stand, R=lean, hips=np.array([-0.27, 0.0, 0.60])),
    )


def lunge(stand: Key, side: int) -> Piece:
    """Return a lunge with the left (0) or right (1) leg, from standing to standing."""
    ahead = np.array([0.82, 0.0, 0.0])
    balls, pitch = stand.balls.copy(), np.zeros(2)
    balls[side] = balls[side] + ahead
    toward = np.array([0.0, 0.035 * (1 if side else -1), 0.0])
    shifted = replace(stand, hips=stand.hips + toward - [0, 0, 0.02])
    pitch[1 - side] = np.radians(22.0)
    R = turned(stand.R, Hips=("y", 4.0))
    stepped = replace(stand, R=R, hips=np.array([0.44, 0.0, 0.86]), balls=balls, pitch=pitch)
    deeper = np.zeros(2)
    deeper[1 - side] = np.radians(52.0)
    low = replace(stepped, R=turned(stand.R, Hips=("y", 8.0)), hips=np.array([0.42, 0.0, 0.60]), pitch=deeper)
    return through([stand, shifted], [0, 0.5]).then(
        through([shifted, stepped], [0, 0.8], (side, 0.10)),
        through([stepped, low, stepped], [0, 1.2, 2.4]),
        through([stepped, shifted], [0, 0.8], (side, 0.10)),
        through([shifted, stand], [0, 0.5]),
    )


def raises(stand: Key) -> Piece:
    """Return the arms raised forward, then sideways."""

    def by(axis: str) -> Piece:
        ways = [replace(stand, R=arms(stand.R, angle, axis)) for angle in (0.0, 80.0, 155.0, 155.0, 80.0, 0.0)]
        ways[0] = ways[-1] = stand
        return through(ways, [0.0, 1.0, 1.9, 2.2, 3.1, 4.1])

    return by("y").then(still(stand, 0.5), by("x"), still(stand, 0.5))


def sit_and_rise(stand: Key, crouch: Array) -> tuple[Piece, Piece]:
    """Return rising and sitting down."""
    seated, leaning, leaving = seat(stand, crouch)
    up = through([seated, leaning, leaving, stand], [0.0, 0.75, 1.1, 2.1])
    down = through([stand, leaving, leaning, seated], [0.0, 1.2, 1.6, 2.5])
    return up, down


def twist(stand: Key) -> Piece:
    """Return turns of the trunk to both sides."""
    left = turned(stand.R, **{n: ("z", 10.0) for n in ("Hips", "Spine", "Spine1", "Spine2", "Spine3")})
    right = turned(stand.R, **{n: ("z", -10.0) for n in ("Hips", "Spine", "Spine1", "Spine2", "Spine3")})
    keys = [stand, replace(stand, R=left), replace(stand, R=right), stand]
    return through(keys, [0.0, 1.0, 2.4, 3.4])


def write_sway(folder: Path, clip: MocapClip, frames: slice) -> None:
    """Write the sway of a person who stands still as a Fourier series."""
    p, R = clip.poses.p_world_joint[frames], clip.poses.R_world_bone[frames]
    local = kinematics.local_rotations(SKELETON.parents, R)
    turns = so3.log(np.swapaxes(so3.nearest_rotation(local.mean(axis=0)), -1, -2) @ local)
    leg = np.linalg.norm(clip.joint_offsets[SKELETON.index("LeftLeg", "LeftFoot")], axis=1).sum()
    values = np.concatenate([turns.reshape(len(p), -1), p[:, 0] / leg], axis=1)
    t = np.arange(len(p)) / clip.poses.rate_hz
    phase = 2 * np.pi * np.outer(t, np.arange(1, SWAY_WAVES + 1)) / SWAY_SECONDS
    basis = np.concatenate([np.cos(phase), np.sin(phase), np.ones((len(t), 1)), t[:, None]], axis=1)
    fit = np.linalg.lstsq(basis, values, rcond=None)[0][:-2].reshape(2, SWAY_WAVES, -1)
    rotations = np.zeros((2, SWAY_WAVES, len(SKELETON.names), 3))
    rotations[:, :, UPPER] = fit[..., :-3].reshape(2, SWAY_WAVES, -1, 3)[:, :, UPPER]
    hips = fit[..., -3:]
    hips[..., 2] = 0.0  # the legs decide the height
    np.savez_compressed(
        folder / "sway.npz", period=SWAY_SECONDS, rotations=rotations.astype(np.float32), hips=hips.astype(np.float32)
    )
    print(
        "sway: sd of the hips, mm:",
        (1000 * LEG * np.sqrt((hips**2).sum(axis=(0, 1)) / 2)).round(1),
        "largest sd of a joint, deg:",
        np.degrees(np.sqrt((rotations**2).sum(axis=(0, 1)) / 2).max()).round(2),
    )


def main(corpus: Path) -> None:
    """Write models/movements."""
    folder = Path(__file__).parent / "movements"
    folder.mkdir(exist_ok=True)
    stride = mean_stride(clip_of(corpus, *STRIDE), SKELETON, LEG)
    neutral = symmetric(stride.neutral)
    neutral[0] = np.eye(3)
    stand = standing(neutral)
    crouched = clip_of(corpus, "CMU001", "01_01").poses
    R_crouch = crouched.R_world_bone[98]
    crouch = symmetric(kinematics.local_rotations(SKELETON.parents, R_crouch))
    tilt = so3.about_axis("z", -so3.heading(R_crouch[0])) @ R_crouch[0]
    crouch[0] = so3.about_axis("y", float(np.arctan2(tilt[0, 2], tilt[2, 2])))
    write_sway(folder, clip_of(corpus, "CMU (martial, 135?)", "martial_04"), slice(478, 615))
    rest, short = still(stand, 1.0), still(stand, 0.4)
    low = squat(stand, crouch)
    one_squat = through([stand, low, stand], [0.0, 1.4, 2.8])
    up, down = sit_and_rise(stand, crouch)
    seated = still(seat(stand, crouch)[0], 1.0)
    write(folder, "squat", rest, one_squat.then(short), rest)
    write(folder, "sit_to_stand", seated, up.then(short, down, still(seat(stand, crouch)[0], 0.5)), seated)
    write(folder, "lunge", rest, lunge(stand, 1).then(short, lunge(stand, 0), short), rest)
    write(folder, "shoulder_raises", rest, raises(stand), rest)
    gait, go, few = (_walk(stride, stand, strides) for strides in (11, 9, 6))
    write(folder, "gait", rest, gait.then(rest), still(stand, 0.2))
    write(folder, "timed_up_and_go", seated, up.then(go, down, seated), still(seat(stand, crouch)[0], 0.2))
    exercises = one_squat.then(short, one_squat, short, raises(stand), twist(stand))
    write(folder, "calibration", rest, few.then(short, exercises, rest), still(stand, 0.2))


def _walk(stride: Stride, stand: Key, strides: int) -> Piece:
    """Return a walk out and back from standing to standing."""
    R, R_feet, hips, balls = walk(stride, stand.R, stand.hips, stand.balls, strides, TOE_OUT)
    ankles = balls - np.einsum("tsij,j->tsi", R_feet, BALL) / LEG + [0, 0, BALL[2] / LEG]
    offsets = SKELETON.joint_offsets[SKELETON.index("LeftUpLeg", "RightUpLeg")]
    hip = hips[:, None] + np.einsum("tij,sj->tsi", R[:, 0], offsets - offsets.mean(axis=0)) / LEG
    way = hip - ankles
    reach = np.sqrt(MOST_EXTENDED**2 - SPARE - np.sum(way[..., :2] ** 2, axis=-1))
    missing = np.maximum(way[..., 2] - reach, 0.0).max(axis=1)
    lowered = gaussian_filter1d(maximum_filter1d(missing, 21), 4.0)
    ends = smoother(np.minimum(np.arange(len(hips)), np.arange(len(hips))[::-1]) / 12)
    hips[:, 2] -= lowered * ends
    print(f"walk of {strides} strides: hips lowered by {LEG * lowered.min():.3f} to {LEG * lowered.max():.3f} m")
    return Piece(legs_begin(R, R_feet), R_feet, hips, balls)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
