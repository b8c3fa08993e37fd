"""The energy of one frame as symbols: its value, gradient and Gauss-Newton Hessian in tangent space.

Everything that looks at one instant alone is here; acceleration and jerk, which look at several, are in
`problem`, from the sensors' positions that this function gives. All derivatives are at the state itself
(tangent zero), where they are simplest. One function for a frame, mapped over the fragment: never the
whole fragment as one graph.

A residual on a segment depends on the twist (v, w) of that segment in world: a point p of it moves by
v + w x (p - p_root). With G its derivative by the twist, it adds G^T G to the segment's 6 x 6 stiffness
and G^T r to its force. A joint moves everything beyond it, so it sees the sums over its subtree; with S_i
the twist of joint i, the Hessian's block of joints i and j (j beyond i) is S_i^T K_j S_j: the
composite-rigid-body algorithm (Featherstone 2008, ch. 6), with stiffness in place of inertia. It needs a
fraction of the products that Jacobians of single residuals would.

What may be wrong all through a fragment (`UNKNOWNS`), y, is the same for all frames. With Y the
derivative of a residual by y, its segment's cross block takes G^T Y; that is summed over subtrees too,
and S_i^T times it are the rows of joint i. They and Y^T Y border the Hessian (`bordered`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import ShapeError, UnknownNameError
from rtof_kin.solve import residuals as energies
from rtof_kin.solve.energy.state import StateSpace

Array = NDArray[np.float64]
Loss = Callable[[Any], tuple[Any, Any]]
"""Weighted squares -> their robust loss and its derivative."""
Residual = Callable[[Any], Any]
"""Of a point, or of a small rotation vector."""
TERMS = ("visual", "orientation", "torso", "bone", "root", "floor", "prior")
"""Energy terms of a single frame; the floor's has the footholds too."""
TORSO = ("Hips", "Spine3")
"""Segments whose orientation may be anchored to the start's."""
_ROBUST_CONTACT = 3.0
"""[sigma] where the loss of a foothold turns from square to linear: contacts are judged, not seen."""
UNKNOWNS = ("scale", "delay", "heading", "mounting", "landmarks")
"""What may be wrong all through a fragment, by y; all are zero where nothing is.

scale (1): bones, places of landmarks and lever arms are 1 + y times as long; the start's bones, which are
    directions, are compared as they are.
delay (1): the video shows what was y seconds before its stamp.
heading (S): each sensor's reference is to be turned by y rad about world's z.
mounting (3S): each sensor's segment is turned by a rotation vector y, rad in the segment's axes, from
    where the sensor says it is: ``R_world_bone = R_measured @ exp(y)``.
landmarks (3L): each landmark is y metres from its place, in its segment's frame.
"""


@dataclass(frozen=True)
class Shape:
    """What a frame's function is built for."""

    landmarks: tuple[tuple[int, bool], ...]
    """Index of each landmark's segment, and whether it is the joint where that begins."""
    sensors: tuple[int, ...]
    """Joint index of each segment that there is a place for a sensor on."""
    torso: tuple[int, ...]
    """Segments whose orientation may be anchored to the start's."""
    bones: tuple[tuple[int, int], ...]
    """Joint and child of the bones that may be anchored to the start's."""
    feet: tuple[int, ...]
    robust_orientation: float
    floor_cutoff: float
    contacts: tuple[int, ...] = ()
    """Joints that at times stand still at a known place."""
    unknowns: tuple[str, ...] = ()
    """Which of `UNKNOWNS` are estimated, in the order in which they stand in y."""

    def __post_init__(self) -> None:
        if unknown := set(self.unknowns) - set(UNKNOWNS):
            raise UnknownNameError("quantity to estimate", sorted(unknown), UNKNOWNS)
        if len(set(self.unknowns)) < len(self.unknowns):
            raise ShapeError(f"unknowns {self.unknowns}: name each once")

    @property
    def columns(self) -> dict[str, slice]:
        """Where each unknown stands in y (G,): by sensor or landmark, then by axis."""
        S, L = len(self.sensors), len(self.landmarks)
        widths = {"scale": 1, "delay": 1, "heading": S, "mounting": 3 * S, "landmarks": 3 * L}
        stops = np.cumsum([widths[name] for name in self.unknowns]).tolist()
        return {n: slice(stop - widths[n], stop) for n, stop in zip(self.unknowns, stops, strict=True)}

    @property
    def unknown_count(self) -> int:
        """G."""
        return max((part.stop for part in self.columns.values()), default=0)


class _Unknowns:
    """What is known and observed, as y changes it; as it is where that is not estimated."""

    def __init__(self, shape: Shape) -> None:
        self.y = ca.SX.sym("y", shape.unknown_count)
        self._of = {name: self.y[part] for name, part in shape.columns.items()}

    def scaled(self, v: Any) -> Any:
        """A vector in a segment."""
        return (1 + self._of["scale"]) * v if "scale" in self._of else v

    def seen(self, i: int, observation: dict[str, Any]) -> Any:
        """A landmark in the picture, px."""
        uv = observation["uv_px"][:, i]
        return uv + self._of["delay"] * observation["duv_px"][:, i] if "delay" in self._of else uv

    def place(self, i: int) -> Any:
        """What comes on top of a landmark's place, m; None where nothing does."""
        return self._of["landmarks"][3 * i : 3 * i + 3] if "landmarks" in self._of else None

    def orientation(self, s: int, q: Any) -> Any:
        """Of a segment, from what its sensor measured."""
        if "heading" in self._of:
            half = self._of["heading"][s] / 2
            q = energies.quat_multiply(ca.vertcat(ca.cos(half), 0, 0, ca.sin(half)), q)
        if "mounting" in self._of:
            v = self._of["mounting"][3 * s : 3 * s + 3]
            angle = ca.sqrt(ca.sumsqr(v) + 1e-18)
            q = energies.quat_multiply(q, ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) / angle * v))
        return q


class _Composite:
    """Energy, and stiffness and force of every segment's subtree, as residuals are added."""

    def __init__(self, parents: Sequence[int], p: list[Any], R: list[Any], y: Any) -> None:
        self._parents, self._p, self._R, self._y = parents, p, R, y
        self.values: dict[str, Any] = dict.fromkeys(TERMS, ca.SX(0))
        self.stiffness = [ca.SX(6, 6) for _ in parents]
        self.force = [ca.SX(6, 1) for _ in parents]
        G = y.numel()
        self.cross = [ca.SX(6, G) for _ in parents]
        self.y_force, self.y_stiffness = ca.SX(G, 1), ca.SX(G, G)

    def point(self, j: int, point: Any) -> Any:
        """(3, 6) derivative of a point of segment j by the segment's twist."""
        return ca.horzcat(ca.SX.eye(3), -ca.skew(point - self._p[0]))

    def add_point(self, term: str, j: int, point: Any, residual: Residual, weight: Any, loss: Loss) -> Any:
        """A residual of a point of segment j; gives it back."""
        r, P = _derivative(lambda e: residual(point + e), 3)
        self._add(term, j, r, P @ self.point(j, point), weight, loss)
        return r

    def add_turn(self, term: str, j: int, residual: Residual, weight: Any, loss: Loss) -> None:
        """A residual of segment j turned by a small rotation vector in its own axes."""
        r, Q = _derivative(residual, 3)
        self._add(term, j, r, ca.horzcat(ca.SX(r.numel(), 3), Q @ self._R[j].T), weight, loss)

    def _add(self, term: str, j: int, r: Any, G: Any, weight: Any, loss: Loss) -> None:
        """Half of `loss` of a residual's weighted square."""
        value, slope = loss(weight * ca.sumsqr(r))
        self.values[term] += 0.5 * value
        self.force[j] += G.T @ (weight * slope * r)
        self.stiffness[j] += ca.tril2symm(ca.tril((G.T * (weight * slope)) @ G))
        if self._y.numel():
            Y = ca.jacobian(r, self._y)
            self.cross[j] += (G.T * (weight * slope)) @ Y
            self.y_force += Y.T @ (weight * slope * r)
            self.y_stiffness += ca.tril2symm(ca.tril((Y.T * (weight * slope)) @ Y))

    def collect(self, extra: dict[int, Any]) -> tuple[list[Any], list[Any]]:
        """Stiffness and force of whole subtrees; `extra` forces on segments come on top."""
        stiffness, force = list(self.stiffness), list(self.force)
        for j, more in extra.items():
            force[j] = force[j] + more
        for j in range(len(self._parents) - 1, 0, -1):
            stiffness[self._parents[j]] = stiffness[self._parents[j]] + stiffness[j]
            force[self._parents[j]] = force[self._parents[j]] + force[j]
        return stiffness, force

    def collect_cross(self) -> list[Any]:
        """(6, G) of whole subtrees, by twist and y."""
        cross = list(self.cross)
        for j in range(len(self._parents) - 1, 0, -1):
            cross[self._parents[j]] = cross[self._parents[j]] + cross[j]
        return cross


class FrameEnergy:
    """CasADi functions of one frame.

    Attributes:
        full: (state, observation, constant) -> energies (7), gradient (D), Hessian (D, D, lower part),
            sensors' positions (3S), their Jacobian (3S, D), reprojection residuals (2L) in px.
        value: the same inputs -> energies, sensors' positions, reprojection residuals.
        gradient: and the force on the sensors' positions (3S) -> gradient with it.
        rows: where each kind of observation stands in their second input.

    With G unknowns, `full` also gives the gradient by them (G), the rows of the Hessian between state and
    unknowns (D, G), that of the unknowns (G, G), and the derivative of the sensors' positions by them
    (3S, G); `gradient` also gives the one by them (G).
    """

    def __init__(self, space: StateSpace, shape: Shape) -> None:
        """Build; takes about half a second."""
        self.space, self.shape = space, shape
        names, parents = space.skeleton.names, space.skeleton.parents
        A, L, S = len(space.joints), len(shape.landmarks), len(shape.sensors)
        p_root, quats = ca.SX.sym("p", 3), ca.SX.sym("q", 4, A)
        self.observation = {
            "uv_px": ca.SX.sym("uv", 2, L), "w_visual": ca.SX.sym("wv", L),
            "knee_visual": ca.SX.sym("kv"),
            "quat_sensor": ca.SX.sym("qs", 4, S), "w_sensor": ca.SX.sym("ws", S),
            "quat_torso": ca.SX.sym("qt", 4, len(shape.torso)),
            "w_torso": ca.SX.sym("wt", len(shape.torso)),
            "b_world": ca.SX.sym("b", 3, len(shape.bones)), "w_bone": ca.SX.sym("wb", len(shape.bones)),
            "p_root": ca.SX.sym("pr", 3), "w_root": ca.SX.sym("wr"),
            "w_floor": ca.SX.sym("wf", len(shape.feet)),
            "w_prior": ca.SX.sym("wp"),
        }  # fmt: skip
        self.constant = {
            "offsets": ca.SX.sym("o", 3, len(names)), "K": ca.SX.sym("K", 3, 3),
            "R_camera_world": ca.SX.sym("R", 3, 3), "t_camera_world": ca.SX.sym("t", 3),
            "whitening": ca.SX.sym("W", 9, S), "levers": ca.SX.sym("l", 3, S),
            "places": ca.SX.sym("c", 3, L),
            "quat_mean": ca.SX.sym("qm", 4, A - 1), "precision": ca.SX.sym("P", 3 * A - 3, 3 * A - 3),
            "floor": ca.SX.sym("f"),
        }  # fmt: skip
        if shape.contacts:
            C = len(shape.contacts)
            self.observation |= {"p_contact": ca.SX.sym("pc", 3, C), "w_contact": ca.SX.sym("wc", C)}
        stops = np.cumsum([symbol.numel() for symbol in self.observation.values()]).tolist()
        self.rows = dict(zip(self.observation, map(slice, [0, *stops], stops), strict=False))
        self._unknowns = _Unknowns(shape)
        y, border = self._unknowns.y, shape.unknown_count > 0
        if "delay" in shape.unknowns:
            self.observation["duv_px"] = ca.SX.sym("duv", 2, L)  # px/s
        if border:
            self.constant["unknowns"] = y
        self._local = [quats[:, a] for a in range(A)]
        self._forward(p_root)
        self._total = _Composite(parents, self._p, self._R, y)
        residuals = self._observed()
        sensors = [
            self._p[j] + self._R[j] @ self._unknowns.scaled(self.constant["levers"][:, s])
            for s, j in enumerate(shape.sensors)
        ]
        force = ca.SX.sym("force", 3 * S)
        forces: dict[int, Any] = {}
        for s, j in enumerate(shape.sensors):
            pull = self._total.point(j, sensors[s]).T @ force[3 * s : 3 * s + 3]
            forces[j] = forces.get(j, 0) + pull
        gradient, hessian, twists = self._composed({})
        inputs = [
            ca.vertcat(p_root, ca.vec(quats)),
            ca.vertcat(*(ca.vec(v) for v in self.observation.values())),
            ca.vertcat(*(ca.vec(v) for v in self.constant.values())),
        ]
        points = ca.vertcat(*sensors) if sensors else ca.SX(0, 1)
        energy = ca.vertcat(*(self._total.values[term] for term in TERMS))
        outputs = [ca.densify(v) for v in (energy, points, ca.vertcat(*residuals))]
        J = self._sensor_jacobian(sensors, twists)
        bordering, pulled_y = self._border(points, force, twists) if border else ([], [])
        option = {"cse": True}
        self.full = ca.Function(
            "full", inputs,
            [outputs[0], *(ca.densify(v) for v in (gradient, hessian)), outputs[1], ca.densify(J),
             outputs[2], *bordering], option,
        )  # fmt: skip
        self.value = ca.Function("value", inputs, outputs, option)
        pulled = ca.densify(self._composed(forces)[0])
        self.gradient = ca.Function("gradient", [*inputs, force], [pulled, *pulled_y], option)

    def functions(self) -> list[Any]:
        """All functions, in the order in which they are compiled together."""
        return [self.full, self.value, self.gradient]

    # --- parts -----------------------------------------------------------------------------------

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
                p = self._p[parent] + self._R[parent] @ self._unknowns.scaled(offsets[:, j])
            self._q.append(q)
            self._p.append(p)
            self._R.append(energies.quat_matrix(q) if j in local else self._R[parent])

    def _observed(self) -> list[Any]:
        """Add everything observed; the reprojection residuals."""
        O, C, shape, total = self.observation, self.constant, self.shape, self._total
        p, R, q, unknowns = self._p, self._R, self._q, self._unknowns

        def pixels(i: int) -> Residual:
            uv = unknowns.seen(i, O)

            def residual(point: Any) -> Any:
                camera = C["R_camera_world"] @ point + C["t_camera_world"]
                return energies.reprojection(camera, uv, C["K"])

            return residual

        def orientation(j: int, measured: Any, W: Any) -> Residual:
            return lambda e: W @ energies.orientation(_turned(q[j], e), measured)

        def bone(j: int, child: int, i: int) -> Residual:
            b, start = C["offsets"][:, child], O["b_world"][:, i]
            return lambda e: energies.bone_vector(ca.SX(3, 1), R[j] @ (b + ca.cross(e, b)), start)

        visual, robust = [], _pseudo_huber(O["knee_visual"])
        for i, (j, is_joint) in enumerate(shape.landmarks):
            point = p[j] if is_joint else p[j] + R[j] @ unknowns.scaled(C["places"][:, i])
            if (more := unknowns.place(i)) is not None:
                point = point + R[j] @ more
            weight = O["w_visual"][i]
            visual.append(total.add_point("visual", j, point, pixels(i), weight, robust))
        robust = _pseudo_huber(shape.robust_orientation)
        for s, j in enumerate(shape.sensors):
            W = ca.reshape(C["whitening"][:, s], 3, 3)
            measured = unknowns.orientation(s, O["quat_sensor"][:, s])
            turn = orientation(j, measured, W)
            total.add_turn("orientation", j, turn, O["w_sensor"][s], robust)
        for i, j in enumerate(shape.torso):
            turn = orientation(j, O["quat_torso"][:, i], ca.DM.eye(3))
            total.add_turn("torso", j, turn, O["w_torso"][i], _cauchy)
        for i, (j, child) in enumerate(shape.bones):
            total.add_turn("bone", j, bone(j, child, i), O["w_bone"][i], _cauchy)
        total.add_point("root", 0, p[0], lambda x: energies.position(x, O["p_root"]), O["w_root"], _cauchy)
        for i, j in enumerate(shape.feet):
            weight = O["w_floor"][i]
            total.add_point(
                "floor", j, p[j], lambda x: energies.height(x, C["floor"]), weight,
                _cut_off(weight, shape.floor_cutoff),
            )  # fmt: skip
        for i, j in enumerate(shape.contacts):
            total.add_point(
                "floor", j, p[j], _stays(O["p_contact"][:, i]), O["w_contact"][i],
                _pseudo_huber(_ROBUST_CONTACT),
            )  # fmt: skip
        return visual

    def _composed(self, forces: dict[int, Any]) -> tuple[Any, Any, dict[int, Any]]:
        """Gradient, lower Hessian, and the twist (6, width) that each moving joint gives."""
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

    def _border(self, points: Any, force: Any, twists: dict[int, Any]) -> tuple[list[Any], list[Any]]:
        """What `full` and `gradient` give with unknowns."""
        total, cross = self._total, self._total.collect_cross()
        J = ca.jacobian(points, self._unknowns.y)
        rows = ca.SX(self.space.size, self._unknowns.y.numel())
        for j, twist in twists.items():
            rows[self.space.columns(j), :] = twist.T @ cross[j]
        pulled = ca.densify(total.y_force + J.T @ force)
        return [ca.densify(v) for v in (total.y_force, rows, total.y_stiffness, J)], [pulled]

    def _add_prior(self, gradient: Any, hessian: Any) -> None:
        """The quadratic form of all joints' rotations together."""
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
            i, moved = j, self._total.point(j, sensors[s])
            while i >= 0:
                if i in twists:
                    J[3 * s : 3 * s + 3, self.space.columns(i)] = moved @ twists[i]
                i = parents[i]
        return J


def _stays(foothold: Any) -> Residual:
    return lambda x: energies.position(x, foothold)


def _turned(q: Any, e: Any) -> Any:
    """A quaternion after a small rotation vector in its own axes, to first order."""
    return energies.quat_multiply(q, ca.vertcat(1, e / 2))


def _from_mean(q: Any, mean: Any, axes: Any) -> Residual:
    return lambda e: energies.rotation_vector(_turned(q, axes @ e), mean)


def _derivative(residual: Residual, size: int) -> tuple[Any, Any]:
    """A residual and its Jacobian at 0."""
    e = ca.SX.sym("e", size)
    r = residual(e)
    zero = ca.SX.zeros(size, 1)
    return ca.substitute(r, e, zero), ca.sparsify(ca.substitute(ca.jacobian(r, e), e, zero))


def _pseudo_huber(delta: Any) -> Loss:
    return lambda s: (energies.pseudo_huber(s, delta), energies.pseudo_huber_weight(s, delta))


def _cauchy(s: Any) -> tuple[Any, Any]:
    return energies.cauchy(s), energies.cauchy_weight(s)


def _cut_off(weight: Any, cutoff: float) -> Loss:
    """Cauchy's loss with its scale at a distance instead of at one sigma."""

    def loss(s: Any) -> tuple[Any, Any]:
        scale = weight * cutoff**2 + 1e-12
        return scale * energies.cauchy(s / scale), energies.cauchy_weight(s / scale)

    return loss
