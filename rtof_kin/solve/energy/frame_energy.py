"""Energy of one frame as CasADi symbols: value, gradient and Gauss-Newton Hessian in tangent space.

Residuals of a single instant are here; acceleration and jerk, which need several frames, are in `problem`. Derivatives
are taken at the state itself (tangent zero). A fragment maps the function of one frame over its frames.

A residual on a segment depends on the twist (v, w) of that segment in world: a point p of it moves by v + w x (p -
p_root). With G the derivative of the residual by the twist, it adds G^T G to the segment's 6 x 6 stiffness and G^T r
to its force. A joint moves its whole subtree, so it takes the sums over the subtree; with S_i the twist of joint i,
the Hessian's block of joints i and j (j in the subtree of i) is S_i^T K_j S_j: the composite-rigid-body algorithm
(Featherstone 2008, ch. 6) with stiffness in place of inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import casadi as ca
import numpy as np

from rtof_kin.solve import residuals as energies
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.point_terms import PointTerm

_Loss = Callable[[Any], tuple[Any, Any]]
"""Weighted squares -> their robust loss and its derivative."""
_Residual = Callable[[Any], Any]
"""Residual as a function of a point, or of a small rotation vector."""
TERMS: Final = ("visual", "orientation", "torso", "bone", "root", "floor", "prior")
"""Built-in energy terms of a single frame; the floor's includes the footholds."""
TORSO: Final = ("Hips", "Spine3")
"""Segments whose orientation may be anchored to the initial guess."""
_ROBUST_CONTACT: Final = 3.0
"""[sigma] Threshold of the pseudo-Huber loss of a foothold: contacts are inferred, not measured."""


@dataclass(frozen=True)
class Shape:
    """What a frame's function is built for; segments and joints are indices of the skeleton."""

    landmarks: tuple[tuple[int, bool], ...]
    """Segment of each landmark, and whether the landmark is the joint where the segment begins."""
    sensors: tuple[int, ...]
    """Segments that have a place for a sensor."""
    torso: tuple[int, ...]
    """Segments whose orientation may be anchored to the initial guess."""
    bones: tuple[tuple[int, int], ...]
    """Joint and child of the bones that may be anchored to the initial guess."""
    feet: tuple[int, ...]
    """Ankles that the floor acts on."""
    robust_orientation: float
    """[sigma] Threshold of the pseudo-Huber loss of orientations."""
    floor_cutoff: float
    """[m] Scale of the Cauchy loss of heights over the floor."""
    contacts: tuple[int, ...] = ()
    """Joints that may have footholds."""
    further: tuple[int, ...] = ()
    """Number of landmarks of each further camera; they are the last ones."""
    points: tuple[PointTerm, ...] = ()
    """Further residuals."""

    @property
    def cameras(self) -> tuple[int, ...]:
        """Camera of each landmark; the first is 0."""
        counts = (len(self.landmarks) - sum(self.further), *self.further)
        return tuple(c for c, count in enumerate(counts) for _ in range(count))


class FrameEnergy:
    """CasADi functions of one frame, of D tangent coordinates, L landmarks and S sensors.

    Attributes:
        terms: names of the energies.
        full: (state, observation, constant) -> energies, gradient (D), Hessian (D, D, lower part),
            positions of the sensors (3S), their Jacobian (3S, D), reprojection residuals (2L) in px.
        value: the same inputs -> energies, positions of the sensors, reprojection residuals. gradient: the same inputs
        and a force on the sensors' positions (3S) -> gradient with it. observation, constant: name -> symbol, in the
        order in which the second and third input have them. rows: name -> rows of the second input.
    """

    def __init__(self, space: StateSpace, shape: Shape) -> None:
        self.space, self.shape = space, shape
        self.terms = (*TERMS, *(term.name for term in shape.points))
        A, S = len(space.joints), len(shape.sensors)
        p_root, quats = ca.SX.sym("p", 3), ca.SX.sym("q", 4, A)
        self.observation = _observation(shape)
        self.constant = _constant(space, shape)
        stops = np.cumsum([symbol.numel() for symbol in self.observation.values()]).tolist()
        self.rows = dict(zip(self.observation, map(slice, [0, *stops], stops), strict=False))
        self._local = [quats[:, a] for a in range(A)]
        self._forward(p_root)
        self._total = _Composite(self.terms, space.skeleton.parents, self._p, self._R)
        residuals = self._observed()
        levers = self.constant["levers"]
        sensors = [self._p[j] + self._R[j] @ levers[:, s] for s, j in enumerate(shape.sensors)]
        force = ca.SX.sym("force", 3 * S)
        forces: dict[int, Any] = {}
        for s, j in enumerate(shape.sensors):
            pull = self._total.point(sensors[s]).T @ force[3 * s : 3 * s + 3]
            forces[j] = forces.get(j, 0) + pull
        gradient, hessian, twists = self._composed({})
        inputs = [
            ca.vertcat(p_root, ca.vec(quats)),
            ca.vertcat(*(ca.vec(v) for v in self.observation.values())),
            ca.vertcat(*(ca.vec(v) for v in self.constant.values())),
        ]
        points = ca.vertcat(*sensors) if sensors else ca.SX(0, 1)
        energy = ca.vertcat(*(self._total.values[term] for term in self.terms))
        J = self._sensor_jacobian(sensors, twists)
        self.full = _function("full", inputs, [energy, gradient, hessian, points, J, ca.vertcat(*residuals)])
        self.value = _function("value", inputs, [energy, points, ca.vertcat(*residuals)])
        self.gradient = _function("gradient", [*inputs, force], [self._composed(forces)[0]])

    def functions(self) -> list[Any]:
        """Return all functions, in the order in which they are compiled together."""
        return [self.full, self.value, self.gradient]

    def _forward(self, p_root: Any) -> None:
        """Quaternions, rotations and positions of all segments in world."""
        space, offsets = self.space, self.constant["offsets"]
        local = dict(zip(space.joints, self._local, strict=True))
        self._q: list[Any] = []
        self._R: list[Any] = []
        self._p: list[Any] = []
        for j, parent in enumerate(space.skeleton.parents):
            if parent < 0:
                q, p = local[j], p_root
            else:
                q = energies.quat_multiply(self._q[parent], local[j]) if j in local else self._q[parent]
                p = self._p[parent] + self._R[parent] @ offsets[:, j]
            self._q.append(q)
            self._p.append(p)
            self._R.append(energies.quat_matrix(q) if j in local else self._R[parent])

    def _observed(self) -> list[Any]:
        """Add all observations; the reprojection residuals."""
        O, C, shape, total = self.observation, self.constant, self.shape, self._total
        p, R, q = self._p, self._R, self._q

        def pixels(uv: Any, which: int) -> _Residual:
            K, R_camera_world, t_camera_world = (C[name] for name in camera_names(which))

            def residual(point: Any) -> Any:
                return energies.reprojection(R_camera_world @ point + t_camera_world, uv, K)

            return residual

        def orientation(j: int, measured: Any, W: Any) -> _Residual:
            return lambda e: W @ energies.orientation(_turned(q[j], e), measured)

        def bone(j: int, child: int, i: int) -> _Residual:
            b, start = C["offsets"][:, child], O["b_world"][:, i]
            return lambda e: energies.bone_vector(ca.SX(3, 1), R[j] @ (b + ca.cross(e, b)), start)

        visual = []
        for i, ((j, is_joint), camera) in enumerate(zip(shape.landmarks, shape.cameras, strict=True)):
            point = p[j] if is_joint else p[j] + R[j] @ C["places"][:, i]
            residual, robust = pixels(O["uv_px"][:, i], camera), _pseudo_huber(O["knee_visual"][camera])
            visual.append(total.add_point("visual", j, point, residual, O["w_visual"][i], robust))
        robust = _pseudo_huber(shape.robust_orientation)
        for s, j in enumerate(shape.sensors):
            turn = orientation(j, O["quat_sensor"][:, s], ca.reshape(C["whitening"][:, s], 3, 3))
            total.add_turn("orientation", j, turn, O["w_sensor"][s], robust)
        for i, j in enumerate(shape.torso):
            turn = orientation(j, O["quat_torso"][:, i], ca.DM.eye(3))
            total.add_turn("torso", j, turn, O["w_torso"][i], _cauchy)
        for i, (j, child) in enumerate(shape.bones):
            total.add_turn("bone", j, bone(j, child, i), O["w_bone"][i], _cauchy)
        total.add_point("root", 0, p[0], lambda x: energies.position(x, O["p_root"]), O["w_root"], _cauchy)
        for i, j in enumerate(shape.feet):
            weight = O["w_floor"][i]
            loss = _cut_off(weight, shape.floor_cutoff)
            total.add_point("floor", j, p[j], lambda x: energies.height(x, C["floor"]), weight, loss)
        for i, j in enumerate(shape.contacts):
            loss = _pseudo_huber(_ROBUST_CONTACT)
            total.add_point("floor", j, p[j], _at(O["p_contact"][:, i]), O["w_contact"][i], loss)
        for term in shape.points:
            j, loss = self.space.skeleton.names.index(term.joint), _pseudo_huber(term.robust)
            residual = partial(_of_point, term.residual, O[term.observed])
            total.add_point(term.name, j, p[j], residual, O[term.weight], loss)
        return visual

    def _composed(self, forces: dict[int, Any]) -> tuple[Any, Any, dict[int, Any]]:
        """Gradient, lower Hessian, and the twist (6, width) of each moving joint."""
        space, parents, total = self.space, self.space.skeleton.parents, self._total
        stiffness, force = total.collect(forces)
        gradient, hessian = ca.SX(space.size, 1), ca.SX(space.size, space.size)
        twists: dict[int, Any] = {}
        for a, j in enumerate(space.joints):
            turn = self._R[j] @ ca.DM(space.axes(a))
            twists[j] = ca.vertcat(ca.skew(self._p[j] - self._p[0]) @ turn, turn)
            if j == 0:
                twists[j] = ca.horzcat(ca.vertcat(ca.SX.eye(3), ca.SX(3, 3)), twists[j])
        for j, twist in twists.items():
            rows, pushed = space.columns(j), stiffness[j] @ twist
            gradient[rows] = twist.T @ force[j]
            i = j
            while i >= 0:
                if i in twists:
                    block = pushed.T @ twists[i]
                    hessian[rows, space.columns(i)] = ca.tril(block) if i == j else block
                i = parents[i]
        self._add_prior(gradient, hessian)
        return gradient, hessian, twists

    def _add_prior(self, gradient: Any, hessian: Any) -> None:
        """Add the quadratic form of the rotations of all joints but the root."""
        space, C = self.space, self.constant
        precision = self.observation["w_prior"] * C["precision"]
        vectors, slopes = [], []
        for a, q in enumerate(self._local[1:], start=1):
            mean, axes = C["quat_mean"][:, a - 1], ca.DM(space.axes(a))
            r, B = _derivative(_from_mean(q, mean, axes), axes.shape[1])
            vectors.append(r)
            slopes.append(B)
        J = ca.diagcat(*slopes)
        force = precision @ ca.vertcat(*vectors)
        self._total.values["prior"] = 0.5 * ca.dot(ca.vertcat(*vectors), force)
        gradient[6:] += J.T @ force
        hessian[6:, 6:] += ca.tril(J.T @ (precision @ J))

    def _sensor_jacobian(self, sensors: list[Any], twists: dict[int, Any]) -> Any:
        """(3S, D) of the sensors' positions."""
        J, parents = ca.SX(3 * len(sensors), self.space.size), self.space.skeleton.parents
        for s, j in enumerate(self.shape.sensors):
            i, moved = j, self._total.point(sensors[s])
            while i >= 0:
                if i in twists:
                    J[3 * s : 3 * s + 3, self.space.columns(i)] = moved @ twists[i]
                i = parents[i]
        return J


class _Composite:
    """Energy, and stiffness and force of every segment, to which residuals are added."""

    def __init__(self, terms: Sequence[str], parents: Sequence[int], p: list[Any], R: list[Any]) -> None:
        self._parents, self._p, self._R = parents, p, R
        self.values: dict[str, Any] = dict.fromkeys(terms, ca.SX(0))
        self.stiffness = [ca.SX(6, 6) for _ in parents]
        self.force = [ca.SX(6, 1) for _ in parents]

    def point(self, point: Any) -> Any:
        """(3, 6) derivative of a point by the twist of its segment."""
        return ca.horzcat(ca.SX.eye(3), -ca.skew(point - self._p[0]))

    def add_point(self, term: str, j: int, point: Any, residual: _Residual, weight: Any, loss: _Loss) -> Any:
        """Add a residual of a point of segment j and return it."""
        r, P = _derivative(lambda e: residual(point + e), 3)
        self._add(term, j, r, P @ self.point(point), weight, loss)
        return r

    def add_turn(self, term: str, j: int, residual: _Residual, weight: Any, loss: _Loss) -> None:
        """Add a residual of segment j turned by a small rotation vector in its own axes."""
        r, Q = _derivative(residual, 3)
        self._add(term, j, r, ca.horzcat(ca.SX(r.numel(), 3), Q @ self._R[j].T), weight, loss)

    def _add(self, term: str, j: int, r: Any, G: Any, weight: Any, loss: _Loss) -> None:
        """Add half of `loss` of a residual's weighted square."""
        value, slope = loss(weight * ca.sumsqr(r))
        self.values[term] += 0.5 * value
        self.force[j] += G.T @ (weight * slope * r)
        self.stiffness[j] += ca.tril2symm(ca.tril((G.T * (weight * slope)) @ G))

    def collect(self, extra: dict[int, Any]) -> tuple[list[Any], list[Any]]:
        """Stiffness and force of whole subtrees, with `extra` forces on segments."""
        stiffness, force = list(self.stiffness), list(self.force)
        for j, more in extra.items():
            force[j] = force[j] + more
        for j in range(len(self._parents) - 1, 0, -1):
            stiffness[self._parents[j]] = stiffness[self._parents[j]] + stiffness[j]
            force[self._parents[j]] = force[self._parents[j]] + force[j]
        return stiffness, force


def _observation(shape: Shape) -> dict[str, Any]:
    """Symbols of what is observed in a frame; weights are 1 / sigma^2, 0 where nothing is."""
    L, S, B, F = len(shape.landmarks), len(shape.sensors), len(shape.bones), len(shape.feet)
    symbols = {
        "uv_px": ca.SX.sym("uv", 2, L),
        "w_visual": ca.SX.sym("wv", L),
        "knee_visual": ca.SX.sym("kv", 1 + len(shape.further)),
        "quat_sensor": ca.SX.sym("qs", 4, S),
        "w_sensor": ca.SX.sym("ws", S),
        "quat_torso": ca.SX.sym("qt", 4, len(shape.torso)),
        "w_torso": ca.SX.sym("wt", len(shape.torso)),
        "b_world": ca.SX.sym("b", 3, B),
        "w_bone": ca.SX.sym("wb", B),
        "p_root": ca.SX.sym("pr", 3),
        "w_root": ca.SX.sym("wr"),
        "w_floor": ca.SX.sym("wf", F),
        "w_prior": ca.SX.sym("wp"),
    }
    if C := len(shape.contacts):
        symbols |= {"p_contact": ca.SX.sym("pc", 3, C), "w_contact": ca.SX.sym("wc", C)}
    for term in shape.points:
        symbols |= term.symbols()
    return symbols


def _constant(space: StateSpace, shape: Shape) -> dict[str, Any]:
    """Symbols of what is constant over a fragment: body, cameras, prior, floor."""
    S, turning = len(shape.sensors), len(space.joints) - 1
    shapes = (3, 3), (3, 3), (3, 1)
    cameras = [zip(camera_names(c), shapes, strict=True) for c in range(1 + len(shape.further))]
    return {
        "offsets": ca.SX.sym("o", 3, len(space.skeleton.names)),
        **{name: ca.SX.sym(name, *shape) for camera in cameras for name, shape in camera},
        "whitening": ca.SX.sym("W", 9, S),
        "levers": ca.SX.sym("l", 3, S),
        "places": ca.SX.sym("c", 3, len(shape.landmarks)),
        "quat_mean": ca.SX.sym("qm", 4, turning),
        "precision": ca.SX.sym("P", 3 * turning, 3 * turning),
        "floor": ca.SX.sym("f"),
    }


def camera_names(which: int) -> tuple[str, str, str]:
    """Return the names of the constants of a camera: intrinsic matrix, rotation and translation.

    Args:
        which: 0 for the first.
    """
    end = f"_{which}" if which else ""
    return f"K{end}", f"R_camera_world{end}", f"t_camera_world{end}"


def _function(name: str, inputs: list[Any], outputs: list[Any]) -> Any:
    """A CasADi function; ``cse`` would save a tenth of the evaluation and take longer than all the rest."""
    return ca.Function(name, inputs, [ca.densify(v) for v in outputs])


def _of_point(residual: Callable[[Any, Any], Any], observation: Any, point: Any) -> Any:
    return residual(point, observation)


def _at(foothold: Any) -> _Residual:
    return lambda x: energies.position(x, foothold)


def _turned(q: Any, e: Any) -> Any:
    """A quaternion after a small rotation vector in its own axes, to first order."""
    return energies.quat_multiply(q, ca.vertcat(1, e / 2))


def _from_mean(q: Any, mean: Any, axes: Any) -> _Residual:
    return lambda e: energies.rotation_vector(_turned(q, axes @ e), mean)


def _derivative(residual: _Residual, size: int) -> tuple[Any, Any]:
    """A residual and its Jacobian at 0."""
    e = ca.SX.sym("e", size)
    r = residual(e)
    zero = ca.SX.zeros(size, 1)
    return ca.substitute(r, e, zero), ca.sparsify(ca.substitute(ca.jacobian(r, e), e, zero))


def _pseudo_huber(delta: Any) -> _Loss:
    return lambda s: (energies.pseudo_huber(s, delta), energies.pseudo_huber_weight(s, delta))


def _cauchy(s: Any) -> tuple[Any, Any]:
    return energies.cauchy(s), energies.cauchy_weight(s)


def _cut_off(weight: Any, cutoff: float) -> _Loss:
    """Cauchy loss with its scale at a distance in m instead of at one sigma."""

    def loss(s: Any) -> tuple[Any, Any]:
        scale = weight * cutoff**2 + 1e-12
        return scale * energies.cauchy(s / scale), energies.cauchy_weight(s / scale)

    return loss
