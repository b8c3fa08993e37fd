"""Energy of a fragment as functions of a frame t and its neighbours, for SIMD code.

The same mathematics as `energy.problem` and `energy.jerk` on whole arrays: from values of the frames
around t, which are zero beyond the ends, to the contribution at t. Step t leads from frame t to t + 1,
with its inverse right Jacobian; acceleration t is that of frame t + 1, jerk t that of frames t to t + 3.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from rtof_kin.core.numerics.simd_codegen import FrameFunction
from rtof_kin.solve import residuals as energies
from rtof_kin.solve.energy.frame_energy import FrameEnergy
from rtof_kin.solve.energy.state import StateSpace


def retract(space: StateSpace) -> FrameFunction:
    """Return the function (state, tangent) -> state after the step."""
    x, d = ca.SX.sym("x", 3 + 4 * len(space.joints)), ca.SX.sym("d", space.size)
    turns, parts = ca.DM(space.expand) @ d[3:], [x[:3] + d[:3]]
    for a in range(len(space.joints)):
        half = turns[3 * a : 3 * a + 3] / 2
        squared: Any = ca.sumsqr(half)
        near = squared < 1e-16
        angle = ca.sqrt(ca.if_else(near, 1, squared))
        turn = ca.vertcat(ca.cos(angle), ca.sin(angle) / angle * half)
        turn = ca.if_else(near, ca.vertcat(1, half), turn)
        q = energies.quat_multiply(x[3 + 4 * a : 7 + 4 * a], turn)
        parts.append(q / ca.sqrt(ca.sumsqr(q)))
    return _function("retract", [x, d], [ca.vertcat(*parts)])


def step(space: StateSpace) -> FrameFunction:
    """Return the function (states of t and t + 1) -> step between them (D)."""
    x, y = (ca.SX.sym(name, 3 + 4 * len(space.joints)) for name in "xy")
    parts = [y[:3] - x[:3]]
    for a in range(len(space.joints)):
        q, r = (v[3 + 4 * a : 7 + 4 * a] for v in (x, y))
        turn = energies.quat_multiply(energies.quat_conjugate(q), r)
        turn = ca.if_else(turn[0] < 0, -1, 1) * turn
        squared: Any = ca.sumsqr(turn[1:])
        near = squared < 1e-18
        sine = ca.sqrt(ca.if_else(near, 1, squared))
        factor = ca.if_else(near, 2, 2 * ca.atan2(sine, turn[0]) / sine)
        parts.append(ca.DM(space.axes(a)).T @ (factor * turn[1:]))
    return _function("step", [x, y], [ca.vertcat(*parts)])


def inverse(space: StateSpace) -> FrameFunction:
    """Return the function (step) -> inverse right Jacobians (9 B) of its ball joints, column-major."""
    v, out = ca.SX.sym("v", space.size), []
    for columns in balls(space):
        turn = v[columns]
        squared: Any = ca.sumsqr(turn)
        near = squared < 1e-6
        safe = ca.if_else(near, 1, squared)
        angle, K = ca.sqrt(safe), ca.skew(turn)
        far = 1 / safe - (1 + ca.cos(angle)) / (2 * angle * ca.sin(angle))
        out.append(ca.vec(ca.SX.eye(3) + K / 2 + ca.if_else(near, 1 / 12, far) * (K @ K)))
    return _function("inverse", [v], [ca.vertcat(*out)])


def motion(energy: FrameEnergy, robust: float) -> FrameFunction:
    """Return the function of the acceleration of t + 1 and the jerk of t to t + 3.

    Inputs: steps t, t + 1, t + 2; weight of the jerk; sensors' positions at t, t + 1, t + 2; acceleration
    and its weights; sigma (D) of the jerk; rate. Outputs: energies (2) of acceleration and jerk, slopes
    (S) of the acceleration's loss, derivatives by second differences: of steps (D), of positions (3S).
    """
    size, S = energy.space.size, len(energy.shape.sensors)
    v, w_jerk = [ca.SX.sym(f"v{k}", size) for k in range(3)], ca.SX.sym("wj")
    p, a = [ca.SX.sym(f"p{k}", 3 * S) for k in range(3)], ca.SX.sym("a", 3 * S)
    w, sigma, rate = ca.SX.sym("w", S), ca.SX.sym("s", size), ca.SX.sym("f")
    jerk = energies.step_jerk(ca.horzcat(*v), rate) / sigma
    value: Any = ca.SX(0)
    slopes, forces = [], []
    for s in range(S):
        rows = slice(3 * s, 3 * s + 3)
        r = energies.acceleration(ca.horzcat(*(q[rows] for q in p)), a[rows], rate)
        squared = w[s] * ca.sumsqr(r)
        value += 0.5 * energies.pseudo_huber(squared, robust)
        slopes.append(w[s] * energies.pseudo_huber_weight(squared, robust))
        forces.append(slopes[-1] * r * rate**2)
    both = ca.vertcat(value, 0.5 * w_jerk * ca.sumsqr(jerk))
    outputs = [both, _stacked(slopes), w_jerk * jerk / sigma * rate**3, _stacked(forces)]
    return _function("motion", [*v, w_jerk, *p, a, w, sigma, rate], outputs, (9, 10))


def pulled(energy: FrameEnergy) -> FrameFunction:
    """Return the function (state, observation, constant, inputs of `Neighbours`) -> gradient (D)."""
    around, frame = Neighbours(energy), frame_inputs(energy)
    gradient = energy.gradient(*frame, around.force()) + around.jerk_gradient()
    return _function("pulled", [*frame, *around.inputs()], [gradient], (2,))


class Neighbours:
    """Symbols for what frame t receives from its neighbours through acceleration and jerk.

    Attributes:
        inverses: inverse right Jacobians of steps t - 1 and t, 3 x 3 for each ball joint.
    """

    def __init__(self, energy: FrameEnergy) -> None:
        self.space = energy.space
        count, size = 9 * len(balls(self.space)), 3 * len(energy.shape.sensors)
        self._forces = [ca.SX.sym(f"f{k}", size) for k in range(3)]
        self._tensions = [ca.SX.sym(f"e{k}", self.space.size) for k in range(4)]
        self._inverses = [ca.SX.sym(f"L{k}", count) for k in range(2)]
        self.inverses = [blocks(v) for v in self._inverses]

    def inputs(self) -> list[Any]:
        """Return the symbols: derivatives by second differences of positions t - 2 to t and of steps t - 3
        to t, and the inverse right Jacobians of steps t - 1 and t.
        """
        return [*self._forces, *self._tensions, *self._inverses]

    def force(self) -> Any:
        """Return the force (3S) on the sensors' positions at t."""
        f = self._forces
        return f[0] - 2 * f[1] + f[2]

    def jerk_gradient(self) -> Any:
        """Return the gradient (D) of the jerk's energy, through steps t - 1 and t."""
        e = self._tensions
        before, after = (e[k] - 2 * e[k + 1] + e[k + 2] for k in range(2))
        out: Any = before - after
        for columns, ending, beginning in zip(balls(self.space), *self.inverses, strict=True):
            out[columns] = ending.T @ before[columns] - beginning @ after[columns]
        return out


def frame_inputs(energy: FrameEnergy) -> list[Any]:
    """Return symbols for state, observation and constant of a frame."""
    value = energy.value
    return [ca.SX.sym(name, value.nnz_in(i)) for i, name in enumerate(("x", "observed", "constant"))]


def balls(space: StateSpace) -> list[slice]:
    """Return the tangent coordinates of the ball joints."""
    first = space.first[space.hinge_axis < 0]
    return [slice(int(i), int(i) + 3) for i in first]


def blocks(v: Any) -> list[Any]:
    """Return the 3 x 3 matrices of a vector (9 B) of their columns."""
    return [ca.reshape(v[9 * b : 9 * b + 9], 3, 3) for b in range(v.numel() // 9)]


def _stacked(parts: list[Any]) -> Any:
    return ca.vertcat(*parts) if parts else ca.SX(0, 1)


def _function(name: str, inputs: list[Any], outputs: list[Any], shared: tuple[int, ...] = ()) -> FrameFunction:
    return FrameFunction(ca.Function(name, inputs, [ca.densify(v) for v in outputs]), shared)
