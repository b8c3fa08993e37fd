"""The joint-space energy in plain NumPy and SciPy, from its description, and random problems for it.

An energy is a list of `Reference` terms: half the sum of a loss of squared norms of whitened residuals. Value,
gradient and Gauss-Newton Hessian follow from the residuals and their finite differences alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import planted
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.choices import Compile
from rtof_kin.solve.joint_space.energy import FrameEnergy
from rtof_kin.solve.joint_space.fragment import FragmentData, FragmentEnergy, FragmentFunctions
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.joint_space.terms import Acceleration, Bone, Floor, Orientation, Prior, Root, Torso, Visual
from rtof_kin.solve.terms import Term

Array = NDArray[np.float64]
Loss = Callable[[Array], tuple[Array, Array]]
"""Squared norms -> loss and its derivative."""
BODY = SkeletonModel.default()
RATE = 60.0
CAMERA = planted.camera()
DELTA_PX, DELTA_ORIENTATION, DELTA_ACCELERATION, CUTOFF = 2.0, 3.0, 1.5, 0.2
MOVING = ("Hips", "Spine", "LeftArm", "LeftForeArm", "RightUpLeg", "RightLeg")
SEEN = ("Hips", "LeftForeArm", "LeftHand", "RightLeg", "RightFoot", "LeftToe", "Nose")
ALL_SENSORS = ("Hips", "LeftForeArm", "RightUpLeg", "RightLeg")


def pseudo_huber(delta: float) -> Loss:
    return lambda s: (2 * delta**2 * (np.sqrt(1 + s / delta**2) - 1), 1 / np.sqrt(1 + s / delta**2))


def cauchy(s: Array) -> tuple[Array, Array]:
    return np.log(1 + s), 1 / (1 + s)


def cut_off(metres: float, sigma: float) -> Loss:
    """Cauchy's, with its scale at a distance."""
    scale = (metres / sigma) ** 2
    return lambda s: (scale * np.log(1 + s / scale), 1 / (1 + s / scale))


@dataclass(frozen=True)
class Reference:
    """Residuals (G, n) in sigmas: G groups, each with a loss of its squared norm."""

    name: str
    residuals: Array
    loss: Loss


def value(terms: list[Reference]) -> dict[str, float]:
    """Energy by name."""
    out: dict[str, float] = {}
    for term in terms:
        loss, _ = term.loss(np.sum(term.residuals**2, axis=-1))
        out[term.name] = out.get(term.name, 0.0) + 0.5 * float(loss.sum())
    return out


def derivatives(terms: Callable[[Array], list[Reference]], size: int, step: float = 1e-6) -> tuple[Array, Array]:
    """Gradient (n) and Gauss-Newton Hessian (n, n) at zero, from central differences of residuals."""
    here = terms(np.zeros(size))
    columns = []
    for i in range(size):
        d = np.zeros(size)
        d[i] = step
        plus, minus = (np.concatenate([t.residuals.ravel() for t in terms(s * d)]) for s in (1, -1))
        columns.append((plus - minus) / (2 * step))
    J, r = np.array(columns).T, np.concatenate([t.residuals.ravel() for t in here])
    slopes = [np.repeat(t.loss(np.sum(t.residuals**2, axis=-1))[1], t.residuals.shape[1]) for t in here]
    slope = np.concatenate(slopes)
    return J.T @ (slope * r), (J.T * slope) @ J


class Shape(NamedTuple):
    """Segments of what is observed."""

    landmarks: tuple[tuple[int, bool], ...]
    sensors: tuple[int, ...]
    torso: tuple[int, ...]
    bones: tuple[tuple[int, int], ...]
    feet: tuple[int, ...]
    contacts: tuple[int, ...]

    def terms(self, space: StateSpace) -> tuple[Term, ...]:
        """The energy's terms."""
        return (
            Visual(self.landmarks),
            Orientation(self.sensors, DELTA_ORIENTATION),
            Torso(self.torso),
            Bone(self.bones),
            Root(),
            Floor(self.feet, CUTOFF, self.contacts),
            Prior(len(space.joints) - 1),
            Acceleration(self.sensors, DELTA_ACCELERATION),
        )


@dataclass(frozen=True)
class Built:
    """A state space with the functions of its frames."""

    space: StateSpace
    shape: Shape
    energy: FrameEnergy
    names: tuple[str, ...]
    """Of the landmarks."""


@cache
def built(kind: str) -> Built:
    """A body whose trunk, arm and leg alone move. 'bare': landmarks alone. 'whole': everything seen and sensed.
    'balls': without hinges, one sensor. 'feet': no camera, two sensors, contact points. After 'all ' all joints move.
    """
    index, of_all, kind = BODY.index, kind.startswith("all "), kind.removeprefix("all ")
    sensors = {"bare": (), "whole": ALL_SENSORS, "balls": ("LeftForeArm", "RightLeg"), "feet": ("Hips", "RightLeg")}[
        kind
    ]
    seen = () if kind == "feet" else BODY.names if of_all else SEEN
    anchored = kind in ("whole", "balls")
    inner = [BODY.names[p] for p in BODY.parents if p >= 0]
    space = StateSpace(BODY, inner if of_all else MOVING, hinged=kind != "balls")
    shape = Shape(
        landmarks=tuple((index(BODY.landmarks[n][0])[0], n in BODY.names) for n in seen),
        sensors=tuple(index(*sensors)),
        torso=tuple(index("Hips")) if anchored else (),
        bones=((index("RightLeg")[0], index("RightFoot")[0]),) if anchored else (),
        feet=tuple(index("RightFoot")) if anchored else (),
        contacts=() if seen else tuple(index("RightFoot")),
    )
    return Built(space, shape, FrameEnergy(space, shape.terms(space)), seen)


def states(space: StateSpace, frames: int, seed: int = 0, step: float = 0.05) -> Array:
    """Random smooth states (N, 3 + 4A) in front of the camera.

    Args:
        step: radians from frame to frame, and a fifth of it in metres.
    """
    rng = np.random.default_rng(seed)
    rest = np.zeros((1, 3 + 4 * len(space.joints)))
    rest[:, 3::4] = 1.0
    rest[:, :3] = [0.1, -0.2, 1.0]
    first = 0.4 * rng.normal(size=(1, space.size)) * np.r_[np.full(3, 0.2), np.ones(space.size - 3)]
    x = [space.retract(rest, first)]
    scale = step * np.r_[np.full(3, 0.2), np.ones(space.size - 3)]
    drift = scale * rng.normal(size=(1, space.size))
    for _ in range(frames - 1):
        x.append(space.retract(x[-1], drift + 0.3 * scale * rng.normal(size=(1, space.size))))
    return np.concatenate(x)


def random_data(b: Built, x: Array, seed: int = 1) -> FragmentData:
    """Random observations of states, with outliers and some weights of zero."""
    rng = np.random.default_rng(seed)
    N, L, S = len(x), len(b.names), len(b.shape.sensors)
    places = np.array([BODY.landmarks[n][1] for n in b.names]).reshape(-1, 3)
    p, R = poses(b, x)
    seen = [p[:, j] + R[:, j] @ c for (j, _), c in zip(b.shape.landmarks, places, strict=True)]
    uv = CAMERA.project(np.reshape(seen, (L, N, 3)).swapaxes(0, 1)) + 6 * rng.normal(size=(N, L, 2))
    uv[rng.random((N, L)) < 0.2] += 100.0

    def weights(sigma: float, *shape: int) -> Array:
        return np.asarray(rng.uniform(0.3, 1.0, shape) * (rng.random(shape) > 0.15) / sigma**2)

    def turned(joints: tuple[int, ...], radians: float) -> Array:
        error = Rotation.from_rotvec(radians * rng.normal(size=(N * len(joints), 3)))
        matrices = R[:, list(joints)].reshape(-1, 3, 3)
        quat = (Rotation.from_matrix(matrices) * error).as_quat(scalar_first=True)
        sign = rng.choice([-1.0, 1.0], size=(len(quat), 1))  # both name the same rotation
        return np.asarray((sign * quat).reshape(N, len(joints), 4))

    share = np.random.default_rng(seed + 1000).uniform(0.3, 1.7, (N, 2))
    A = len(b.space.joints)
    root = rng.normal(size=(3 * A - 3, 3 * A - 3))
    whitening = np.array([np.diag(rng.uniform(2, 9, 3)) + rng.normal(size=(3, 3)) for _ in range(S)])
    mean = Rotation.from_rotvec(0.3 * rng.normal(size=(A - 1, 3))).as_quat(scalar_first=True)
    bones = [p[:, c] - p[:, j] for j, c in b.shape.bones]
    b_world = np.stack(bones, axis=1) if bones else np.zeros((N, 0, 3))
    levers = 0.1 * rng.normal(size=(3, S))
    sensors = [p[:, j] + R[:, j] @ levers[:, s] for s, j in enumerate(b.shape.sensors)]
    a_world = np.array([np.diff(at, n=2, axis=0) * RATE**2 for at in sensors]).reshape(S, N - 2, 3)
    data = FragmentData(
        observation={
            "uv_px": uv,
            "w_visual": weights(5.0, N, L),
            "knee_visual": np.full(N, DELTA_PX),
            "quat_sensor": turned(b.shape.sensors, 0.3),
            "w_sensor": weights(1.0, N, S),
            "quat_torso": turned(b.shape.torso, 0.2),
            "w_torso": weights(0.2, N)[:, None] * share[:, : len(b.shape.torso)],
            "b_world": b_world + 0.1 * rng.normal(size=b_world.shape),
            "w_bone": weights(0.08, N)[:, None] * np.linspace(1.0, 0.5, len(b.shape.bones)),
            "p_root": x[:, :3] + 0.2 * rng.normal(size=(N, 3)),
            "w_root": weights(0.15, N),
            "w_floor": np.tile(weights(0.03, N)[:, None], len(b.shape.feet)),
            "w_prior": weights(1.0, N),
        },
        constant={
            "offsets": BODY.joint_offsets.T,
            "K": CAMERA.K,
            "R_camera_world": CAMERA.R_camera_world,
            "t_camera_world": CAMERA.t_camera_world,
            "whitening": np.array([W.ravel(order="F") for W in whitening]).reshape(-1, 9).T,
            "levers": levers,
            "places": places.T,
            "quat_mean": mean.T,
            "precision": root @ root.T + 0.5 * np.eye(len(root)),
            "floor": np.array([0.15]),
        },
        a_world=np.swapaxes(a_world, 0, 1) + 3 * rng.normal(size=(N - 2, S, 3)),
        w_acceleration=weights(1.5, N - 2, S),
        w_jerk=(rng.random(N - 3) > 0.2).astype(float),
        rate_hz=RATE,
    )
    feet = list(b.shape.contacts)
    data.observation["p_contact"] = p[:, feet] + 0.05 * rng.normal(size=(N, len(feet), 3))
    data.observation["w_contact"] = weights(0.02, N, len(feet))
    return data


def sigma_jerk(space: StateSpace) -> Array:
    """(D,), different for every joint and equal for its axes."""
    joint = 200.0 + 50.0 * (np.arange(3 * len(space.joints)) // 3)
    return np.concatenate([np.full(3, 40.0), joint @ (space.expand != 0)])


@cache
def functions(kind: str, compile: Compile) -> FragmentFunctions:
    b = built(kind)
    return FragmentFunctions.of(b.space, b.shape.terms(b.space), compile)


def problem(kind: str, frames: int, compile: Compile = "never") -> FragmentEnergy:
    """A fragment's problem."""
    b = built(kind)
    return FragmentEnergy(functions(kind, compile), frames, sigma_jerk(b.space))


def poses(b: Built, x: Array) -> tuple[Array, Array]:
    """Joint positions and segment orientations of states, joint by joint."""
    N = len(x)
    turns = np.moveaxis(matrices(x[:, 3:].reshape(-1, 4)).reshape(N, -1, 3, 3), 1, 0)
    turned = dict(zip(b.space.joints, turns, strict=True))
    p, R = np.zeros((N, len(BODY.names), 3)), np.zeros((N, len(BODY.names), 3, 3))
    for j, parent in enumerate(BODY.parents):
        if parent < 0:
            R[:, j] = turned[j]
        else:
            R[:, j] = R[:, parent] @ turned[j] if j in turned else R[:, parent]
        p[:, j] = x[:, :3] if parent < 0 else p[:, parent] + R[:, parent] @ BODY.joint_offsets[j]
    return p, R


def chord(R_measured: Array, R: Array) -> Array:
    """2 sin(angle / 2) along the axis of the rotation from measured to actual, in the segment's axes."""
    vector = Rotation.from_matrix(np.swapaxes(R_measured, -1, -2) @ R).as_rotvec()
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(np.sinc(angle / 2 / np.pi) * vector)


def matrices(quat_wxyz: Array) -> Array:
    return Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()


def frame_terms(b: Built, x: Array, data: FragmentData) -> list[Reference]:
    """Terms of single frames, for all frames."""
    O, C = data.observation, data.constant
    p, R = poses(b, x)
    root = {name: np.sqrt(O[name]) for name in O if name.startswith("w_")}
    out = []
    for i, (j, is_joint) in enumerate(b.shape.landmarks):
        point = p[:, j] + (0 if is_joint else R[:, j] @ C["places"][:, i])
        r = CAMERA.project(point) - O["uv_px"][:, i]
        out.append(Reference("visual", root["w_visual"][:, i, None] * r, pseudo_huber(DELTA_PX)))
    for s, j in enumerate(b.shape.sensors):
        W = C["whitening"][:, s].reshape(3, 3).T
        r = chord(matrices(O["quat_sensor"][:, s]), R[:, j]) @ W.T
        loss = pseudo_huber(DELTA_ORIENTATION)
        out.append(Reference("orientation", root["w_sensor"][:, s, None] * r, loss))
    for i, j in enumerate(b.shape.torso):
        r = chord(matrices(O["quat_torso"][:, i]), R[:, j])
        out.append(Reference("torso", root["w_torso"][:, i, None] * r, cauchy))
    for i, (j, child) in enumerate(b.shape.bones):
        r = p[:, child] - p[:, j] - O["b_world"][:, i]
        out.append(Reference("bone", root["w_bone"][:, i, None] * r, cauchy))
    out.append(Reference("root", root["w_root"][:, None] * (p[:, 0] - O["p_root"]), cauchy))
    for i, j in enumerate(b.shape.feet):
        for t in np.flatnonzero(O["w_floor"][:, i]):
            loss = cut_off(CUTOFF, 1 / root["w_floor"][t, i])
            height = root["w_floor"][t, i] * (p[t, j, 2:] - C["floor"])
            out.append(Reference("floor", height[None], loss))
    for i, j in enumerate(b.shape.contacts):
        r = root["w_contact"][:, i, None] * (p[:, j] - O["p_contact"][:, i])
        out.append(Reference("floor", r, pseudo_huber(3.0)))
    local = x[:, 7:].reshape(len(x), -1, 4)
    inverse_mean = np.swapaxes(matrices(C["quat_mean"].T), -1, -2)
    turns = inverse_mean @ matrices(local.reshape(-1, 4)).reshape(*local.shape[:2], 3, 3)
    vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(len(x), -1)
    white = vectors @ np.linalg.cholesky(C["precision"])
    return [*out, Reference("prior", root["w_prior"][:, None] * white, lambda s: (s, np.ones_like(s)))]


def temporal_terms(b: Built, x: Array, data: FragmentData) -> list[Reference]:
    """Acceleration of the sensors and jerk of the tangent coordinates."""
    p, R = poses(b, x)
    out = []
    for s, j in enumerate(b.shape.sensors):
        sensor = p[:, j] + R[:, j] @ data.constant["levers"][:, s]
        r = np.diff(sensor, n=2, axis=0) * data.rate_hz**2 - data.a_world[:, s]
        w = np.sqrt(data.w_acceleration[:, s, None])
        out.append(Reference("acceleration", w * r, pseudo_huber(DELTA_ACCELERATION)))
    steps = [np.diff(x[:, :3], axis=0)]
    before, after = (Rotation.from_quat(part[:, 3:].reshape(-1, 4), scalar_first=True) for part in (x[:-1], x[1:]))
    turns = (before.inv() * after).as_rotvec().reshape(len(x) - 1, -1, 3)
    for a, axis in enumerate(b.space.hinge_axis):
        steps.append(turns[:, a] if axis < 0 else turns[:, a, axis : axis + 1])
    jerk = np.diff(np.concatenate(steps, axis=1), n=2, axis=0) * data.rate_hz**3
    white = np.sqrt(data.w_jerk)[:, None] * jerk / sigma_jerk(b.space)
    return [*out, Reference("smooth", white, lambda s: (s, np.ones_like(s)))]


def terms_about(b: Built, x: Array, data: FragmentData) -> Callable[[Array], list[Reference]]:
    """Step (N D) -> all terms of a fragment at the state retracted by it."""

    def terms(d: Array) -> list[Reference]:
        y = b.space.retract(x, d.reshape(len(x), -1))
        return frame_terms(b, y, data) + temporal_terms(b, y, data)

    return terms


def one_frame(data: FragmentData, t: int) -> FragmentData:
    """The observations of a single frame."""
    observation = {name: values[t : t + 1] for name, values in data.observation.items()}
    none: Any = np.zeros((0, 0, 3))
    return FragmentData(observation, data.constant, none, none, none, data.rate_hz)
