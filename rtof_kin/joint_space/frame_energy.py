"""The energy of one frame as symbols: its value, gradient and Gauss-Newton Hessian in tangent space.

Everything that looks at one instant alone is here; acceleration and jerk, which look at several, are in
`problem`, from the sensors' positions that this function gives. All derivatives are at the state itself
(tangent zero), where they are simplest. One function for a frame, mapped over the fragment: never the
whole fragment as one graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin import energies
from rtof_kin.joint_space.state import StateSpace

Array = NDArray[np.float64]
TERMS = ("visual", "orientation", "torso", "bone", "root", "floor", "prior")
"""Energy terms of a single frame."""
TORSO = ("Hips", "Spine3")
"""Segments whose orientation may be anchored to the start's."""
FEET = ("LeftFoot", "RightFoot")


@dataclass(frozen=True)
class Shape:
    """What a frame's function is built for."""

    landmarks: tuple[tuple[int, bool], ...]
    """Index of each landmark's segment, and whether it is the joint where that begins."""
    sensors: tuple[int, ...]
    """Joint index of each sensor's segment."""
    torso: tuple[int, ...]
    """Segments whose orientation may be anchored to the start's."""
    bones: tuple[tuple[int, int], ...]
    """Joint and child of the bones without a sensor, which may be anchored to the start's."""
    feet: tuple[int, ...]
    robust_reprojection: float
    robust_orientation: float
    floor_cutoff: float


@dataclass
class _Sum:
    """Energy, gradient and Hessian as residuals are added."""

    delta: Any
    values: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(TERMS, ca.SX(0)))
    gradient: Any = None
    hessian: Any = None

    def __post_init__(self) -> None:
        n = self.delta.numel()
        self.gradient, self.hessian = ca.SX(n, 1), ca.SX(n, n)

    def at_zero(self, expression: Any) -> Any:
        return ca.substitute(expression, self.delta, ca.SX.zeros(self.delta.numel(), 1))

    def jacobian(self, residual: Any) -> Any:
        return ca.sparsify(self.at_zero(ca.jacobian(residual, self.delta)))

    def add(
        self,
        term: str,
        residual: Any,
        weight: Any,
        loss: Callable[[Any], tuple[Any, Any]] = lambda s: (s, 1),
    ) -> None:
        """Add half of `loss` of a residual's weighted square."""
        r, J = self.at_zero(residual), self.jacobian(residual)
        value, slope = loss(weight * ca.sumsqr(r))
        self.values[term] += 0.5 * value
        self.gradient += J.T @ (weight * slope * r)
        self.hessian += ca.tril((J.T * (weight * slope)) @ J)

    def add_quadratic(self, term: str, residual: Any, precision: Any) -> None:
        """Add half of a quadratic form with a full matrix."""
        r, J = self.at_zero(residual), self.jacobian(residual)
        force = precision @ r
        self.values[term] += 0.5 * ca.dot(r, force)
        self.gradient += J.T @ force
        self.hessian += ca.tril(J.T @ (precision @ J))


class FrameEnergy:
    """CasADi functions of one frame.

    Attributes:
        full: (state, observation, constant) -> energies (7), gradient (D), Hessian (D, D, lower part),
            sensors' positions (3S), their Jacobian (3S, D), reprojection residuals (2L) in px.
        value: the same inputs -> energies, sensors' positions, reprojection residuals.
        gradient: and the force on the sensors' positions (3S) -> gradient with it.
    """

    def __init__(self, space: StateSpace, shape: Shape) -> None:
        """Build; takes about a second."""
        self.space, self.shape = space, shape
        names, parents = space.skeleton.names, space.skeleton.parents
        A, L, S = len(space.joints), len(shape.landmarks), len(shape.sensors)
        p_root, quats = ca.SX.sym("p", 3), ca.SX.sym("q", 4, A)
        delta = ca.SX.sym("d", space.size)
        turns = ca.reshape(ca.DM(space.expand) @ delta[3:], 3, A)
        local = {
            j: energies.quat_multiply(quats[:, a], ca.vertcat(1, turns[:, a] / 2))
            for a, j in enumerate(space.joints)
        }
        self.observation = {
            "uv_px": ca.SX.sym("uv", 2, L), "w_visual": ca.SX.sym("wv", L),
            "quat_sensor": ca.SX.sym("qs", 4, S), "w_sensor": ca.SX.sym("ws", S),
            "quat_torso": ca.SX.sym("qt", 4, len(shape.torso)), "w_torso": ca.SX.sym("wt"),
            "b_world": ca.SX.sym("b", 3, len(shape.bones)), "w_bone": ca.SX.sym("wb"),
            "p_root": ca.SX.sym("pr", 3), "w_root": ca.SX.sym("wr"), "w_floor": ca.SX.sym("wf"),
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
        O, C = self.observation, self.constant
        total = _Sum(delta)
        q: dict[int, Any] = {}
        R: dict[int, Any] = {}
        p: dict[int, Any] = {}
        for j, parent in enumerate(parents):
            if parent < 0:
                q[j], p[j] = local[j], p_root + delta[:3]
            else:
                q[j] = energies.quat_multiply(q[parent], local[j]) if j in local else q[parent]
                p[j] = p[parent] + R[parent] @ C["offsets"][:, j]
            R[j] = energies.quat_matrix(q[j]) if j in local else R[parent]
        residuals = []
        for i, (j, is_joint) in enumerate(shape.landmarks):
            point = p[j] if is_joint else p[j] + R[j] @ C["places"][:, i]
            camera = C["R_camera_world"] @ point + C["t_camera_world"]
            r = energies.reprojection(camera, O["uv_px"][:, i], C["K"])
            residuals.append(total.at_zero(r))
            total.add("visual", r, O["w_visual"][i], _pseudo_huber(shape.robust_reprojection))
        for s, j in enumerate(shape.sensors):
            r = energies.orientation(q[j], O["quat_sensor"][:, s])
            white = ca.reshape(C["whitening"][:, s], 3, 3) @ r
            total.add(
                "orientation", white, O["w_sensor"][s], _pseudo_huber(shape.robust_orientation)
            )
        for i, j in enumerate(shape.torso):
            r = energies.orientation(q[j], O["quat_torso"][:, i])
            total.add("torso", r, O["w_torso"], _cauchy)
        for i, (j, child) in enumerate(shape.bones):
            r = energies.bone_vector(p[j], p[child], O["b_world"][:, i])
            total.add("bone", r, O["w_bone"], _cauchy)
        total.add("root", energies.position(p[0], O["p_root"]), O["w_root"], _cauchy)
        for j in shape.feet:
            r = energies.height(p[j], C["floor"])
            total.add("floor", r, O["w_floor"], _cut_off(O["w_floor"], shape.floor_cutoff))
        vectors = [
            energies.rotation_vector(local[j], C["quat_mean"][:, a])
            for a, j in enumerate(space.joints[1:])
        ]
        total.add_quadratic("prior", ca.vertcat(*vectors), O["w_prior"] * C["precision"])
        sensors = [p[j] + R[j] @ C["levers"][:, s] for s, j in enumerate(shape.sensors)]
        points = ca.vertcat(*sensors) if sensors else ca.SX(0, 1)
        inputs = [
            ca.vertcat(p_root, ca.vec(quats)),
            ca.vertcat(*(ca.vec(v) for v in O.values())),
            ca.vertcat(*(ca.vec(v) for v in C.values())),
        ]
        energy = ca.vertcat(*(total.values[term] for term in TERMS))
        outputs = [ca.densify(v) for v in (energy, total.at_zero(points), ca.vertcat(*residuals))]
        force = ca.SX.sym("force", 3 * S)
        J = total.jacobian(points)
        option = {"cse": True}
        self.full = ca.Function(
            "full", inputs,
            [outputs[0], ca.densify(total.gradient), ca.densify(total.hessian), outputs[1],
             ca.densify(J), outputs[2]], option,
        )  # fmt: skip
        self.value = ca.Function("value", inputs, outputs, option)
        self.gradient = ca.Function(
            "gradient", [*inputs, force], [ca.densify(total.gradient + J.T @ force)], option
        )

    def functions(self) -> list[Any]:
        """All functions, in the order in which they are compiled together."""
        return [self.full, self.value, self.gradient]


def _pseudo_huber(delta: float) -> Callable[[Any], tuple[Any, Any]]:
    return lambda s: (energies.pseudo_huber(s, delta), energies.pseudo_huber_weight(s, delta))


def _cauchy(s: Any) -> tuple[Any, Any]:
    return energies.cauchy(s), energies.cauchy_weight(s)


def _cut_off(weight: Any, cutoff: float) -> Callable[[Any], tuple[Any, Any]]:
    """Cauchy's loss with its scale at a distance instead of at one sigma."""

    def loss(s: Any) -> tuple[Any, Any]:
        scale = weight * cutoff**2 + 1e-12
        return scale * energies.cauchy(s / scale), energies.cauchy_weight(s / scale)

    return loss
