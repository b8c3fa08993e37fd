"""The Cartesian energy of a fragment of N frames, as symbols: the paper's eqs. 2-7.

::

    E(X) = k_V E_V + k_I (k_A E_A + k_B E_B + k_S E_S) + E_L + E_P

The state is X (N, J, 3), joint positions in world, m. Each term is the mean of its squared whitened residuals
(residuals divided by their standard deviations), so that the k do not depend on their number. E_L and E_P are added to
the printed energy (see `CartesianSettings`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any, Final

import numpy as np
from scipy.sparse.csgraph import connected_components

from rtof_kin.body.kinematics import children_of
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.numerics.c_compiler import BUILDING
from rtof_kin.core.packages import casadi as ca
from rtof_kin.solve import terms as energies
from rtof_kin.solve.settings import CartesianSettings
from rtof_kin.solve.terms import PointTerm

Bones = tuple[tuple[int, int], ...]  #: (joint, child) of each bone
Points = tuple[tuple[tuple[int, ...], PointTerm], ...]  #: Further residuals, each with its joints
TERMS: Final = ("visual", "acceleration", "bone", "smooth", "length", "prior")
"""Built-in terms; further ones are behind them."""


@dataclass(frozen=True)
class _Term:
    """Residuals of one term with the weight of each in the mean, over its variance."""

    residual: Any  #: (n,) SX
    weight: Any  #: (n,) SX, 0 without observation
    robust: float | None = None  #: Pseudo-Huber threshold of whitened residuals taken in groups
    group: int = 2  #: Residuals of a group
    exact: bool = False
    """Whether the Hessian is exact. Gauss-Newton oscillates on the stiff distances of bones parallel to the image
    plane, whose depth has no first-order effect."""


class FragmentProblem:
    """The fragment's nonlinear programme, built once; calls only pass numbers.

    Attributes:
        parameters: name -> shape of each parameter, in order.
        terms: name -> residuals.
        order: (3JN,) unknowns x are X.ravel()[order]: joints that no term couples apart, for a narrow band.
        value: (x, p) -> energy of each term (weighted), and the gradient dE/dx.
        hessian: (x, p) -> its lower part, whose rows and columns are `entries` (2, n).
    """

    def __init__(
        self,
        parents: tuple[int, ...],
        frames: int,
        sensor_bones: Bones,
        settings: CartesianSettings,
        points: Points = (),
    ) -> None:
        """Build the programme.

        Args:
            parents: (J,) of the tree. sensor_bones: (joint, child) with sensors.
            settings: standard deviations; the weights k are parameters.
        """
        self.parents, self.frames, self.settings, self.points = parents, frames, settings, points
        self.sensor_bones, self.pairs = sensor_bones, rigid_pairs(parents)
        J, N, B = len(parents), frames, len(sensor_bones)
        self.X = ca.SX.sym("X", 3 * J, N)
        shapes: dict[str, tuple[int, ...]] = {
            "R_camera_world": (3, 3),
            "t_camera_world": (3,),
            "K": (3, 3),
            "rate_hz": (),
            "sigma_reprojection": (),
            "uv_px": (2, N * J),
            "w_visual": (N * J,),
            "shares": (B,),
            "a_world": (3 * B, N - 2),
            "w_acceleration": (B, N - 2),
            "b_world": (3 * B, N),
            "w_bone": (B, N),
            "w_smooth": (N - 3,),
            "j_world": (3 * J, N - 3 if settings.as_printed else 0),
            "w_length": (N,),
            "lengths": (len(self.pairs),),
            "p_prior": (3 * J, N),
            "k": (len(TERMS),),
        }
        self.parameters = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
        for _, term in points:
            self.parameters |= {name: ca.SX.sym(name, rows, N) for name, (rows,) in term.symbols().items()}
        self.terms = self._terms()
        self._build()

    def pack(self, values: dict[str, Array]) -> Array:
        """Return the parameter vector. values: name -> array, with the shapes of `parameters`."""
        return np.concatenate([np.ravel(values[name], order="F") for name in self.parameters])

    def _joint(self, index: int) -> Any:
        """(3, N) path of one joint."""
        return self.X[3 * index : 3 * index + 3, :]

    def _terms(self) -> dict[str, _Term]:
        P, s, J, N = self.parameters, self.settings, len(self.parents), self.frames
        rate, projection = P["rate_hz"], P["K"] @ ca.horzcat(P["R_camera_world"], P["t_camera_world"])
        points = ca.vertcat(ca.reshape(self.X, 3, J * N), ca.SX.ones(1, J * N))
        seen = energies.reprojection(projection @ points, P["uv_px"], ca.SX.eye(3))
        accelerations, bones = [], []
        for k, (joint, child) in enumerate(self.sensor_bones):
            share = P["shares"][k]
            sensor = (1 - share) * self._joint(joint) + share * self._joint(child)
            rows = slice(3 * k, 3 * k + 3)
            accelerations.append(energies.acceleration(sensor, P["a_world"][rows, :] / rate**2, 1))
            bones.append(energies.bone_vector(self._joint(joint), self._joint(child), P["b_world"][rows, :]))
        target = P["j_world"] / rate**3 if s.as_printed else 0
        w_smooth = P["w_smooth"].T * (rate**3 / s.sigma_jerk) ** 2
        lengths = [
            energies.distance(self._joint(a), self._joint(b), P["lengths"][i]) for i, (a, b) in enumerate(self.pairs)
        ]
        w_length = P["w_length"].T / s.sigma_length**2
        return {
            "visual": _Term(
                ca.vec(seen / P["sigma_reprojection"]), ca.vec(ca.repmat(P["w_visual"].T, 2, 1)), s.huber_reprojection
            ),
            "acceleration": _spread(accelerations, P["w_acceleration"] * (rate**2 / s.sigma_acceleration) ** 2),
            "bone": _spread(bones, P["w_bone"] / s.sigma_bone**2),
            "smooth": _Term(ca.vec(energies.jerk(self.X, target, 1)), ca.vec(ca.repmat(w_smooth, 3 * J, 1))),
            "length": _Term(ca.vec(ca.vertcat(*lengths)), ca.vec(ca.repmat(w_length, len(lengths), 1)), exact=True),
            "prior": self._prior(),
            **{term.name: self._point_term(joints, term) for joints, term in self.points},
        }

    def _point_term(self, joints: tuple[int, ...], term: PointTerm) -> _Term:
        """A further residual of all frames, weighted like the prior: 1 / sigma^2 is part of the residual."""
        observed, weight = self.parameters[term.observed], self.parameters[term.weight]
        paths = [self._joint(joint) for joint in joints]
        residuals = [
            ca.sqrt(weight[t]) * term.at([path[:, t] for path in paths], observed[:, t]) for t in range(self.frames)
        ]
        stacked, count = ca.vertcat(*residuals), 3 * len(self.parents) * self.frames
        return _Term(stacked, ca.SX.ones(stacked.numel()) / count, term.robust, residuals[0].numel())

    def _prior(self) -> _Term:
        """Root and bone vectors (or every position) minus those of the start."""
        start, s, joints = self.parameters["p_prior"], self.settings, len(self.parents)
        rows, precision = [energies.position(self.X, start)], np.full(joints, s.sigma_prior**-2)
        if not s.as_printed:
            rows = [energies.position(self.X[:3, :], start[:3, :])]
            precision[1:] = s.sigma_prior_bone**-2
            for child, parent in enumerate(self.parents[1:], start=1):
                a, b = slice(3 * parent, 3 * parent + 3), slice(3 * child, 3 * child + 3)
                rows.append(energies.bone_vector(self.X[a, :], self.X[b, :], start[b, :] - start[a, :]))
        weight = np.tile(np.repeat(precision, 3), self.frames) / (3 * joints * self.frames)
        return _Term(ca.vec(ca.vertcat(*rows)), ca.SX(weight))

    def _build(self) -> None:
        x, p = ca.vec(self.X), ca.vertcat(*(ca.vec(v) for v in self.parameters.values()))
        values, hessian = [], ca.SX(x.numel(), x.numel())
        for name, term in self.terms.items():
            k = self.parameters["k"][TERMS.index(name)] if name in TERMS else 1
            free = name == "length" and self.settings.as_printed
            if free or term.residual.numel() == 0:
                values.append(ca.SX(0))
                continue
            value, curvature = _energy_and_curvature(term)
            values.append(k * value)
            if term.exact:
                hessian += ca.hessian(k * value, x)[0]
                continue
            J_r = ca.jacobian(term.residual, x)
            hessian += 2 * k * ca.mtimes(J_r.T, ca.diag(curvature) @ J_r)
        coupled = connected_components(ca.DM(hessian.sparsity(), 1).sparse(), directed=False)[1]
        self.order: Index = np.argsort(coupled, kind="stable")
        gradient, x = ca.gradient(sum(values), x)[self.order], x[self.order]
        self.value = ca.Function("value", [x, p], [ca.vertcat(*values), gradient], ["x", "p"], ["terms", "gradient"])
        lower = ca.tril(hessian[self.order, self.order])
        self.entries: Index = np.array(lower.sparsity().get_triplet())
        self.hessian = ca.Function("hessian", [x, p], [lower], ["x", "p"], ["hessian"])

    @cached_property
    def ipopt(self) -> Any:
        """(x0, p) -> x, by IPOPT."""
        x, p = self.value.sx_in()
        names, lam_f, lam_g = ["x", "p", "lam_f", "lam_g"], ca.SX.sym("lam_f"), ca.SX.sym("lam_g", 0)
        upper = [lam_f * self.hessian(x, p).T]
        hess_lag = ca.Function("hess_lag", [x, p, lam_f, lam_g], upper, names, ["triu_hess_gamma_x_x"])
        of_ipopt: dict[str, Any] = {
            "print_level": 0,
            "sb": "yes",
            "linear_solver": "mumps",
            "tol": self.settings.tolerance,
            "max_iter": self.settings.max_iterations,
            "mumps_scaling": 0,
            "mumps_permuting_scaling": 0,
            "mumps_pivot_order": 0,
            "nlp_scaling_method": "none",
        }
        quiet = dict.fromkeys(("print_time", "show_eval_warnings", "error_on_fail", "calc_lam_p", "calc_lam_x"), False)
        programme = {"x": x, "p": p, "f": ca.sum1(self.value(x, p)[0])}
        return ca.nlpsol("fragment", "ipopt", programme, {"hess_lag": hess_lag, "ipopt": of_ipopt, **quiet})


def fragment_problem(
    parents: tuple[int, ...], frames: int, sensor_bones: Bones, settings: CartesianSettings, points: Points = ()
) -> FragmentProblem:
    """Return the problem of `FragmentProblem`, built once for all bodies, weights k and solvers that share a tree."""
    with BUILDING:
        any_weights = replace(settings, k_V=1.0, k_I=1.0, k_A=1.0, k_B=1.0, k_S=1.0, ipopt=False)
        return _cached_problem(parents, frames, sensor_bones, any_weights, points)


_cached_problem = lru_cache(maxsize=8)(FragmentProblem)


def rigid_pairs(parents: tuple[int, ...]) -> Bones:
    """Return pairs of joints at a constant distance: bones, and siblings on one segment. parents: (J,) of the tree."""
    pairs = [(parent, child) for child, parent in enumerate(parents) if parent >= 0]
    for joint in range(len(parents)):
        pairs += combinations(children_of(parents, joint), 2)
    return tuple(pairs)


def _spread(residuals: list[Any], weights: Any) -> _Term:
    """Term of residuals (3, n) for each sensor, with weights (B, n) for all three components."""
    if not residuals:
        return _Term(ca.SX(0, 1), ca.SX(0, 1))
    return _Term(ca.vec(ca.vertcat(*residuals)), ca.vec(ca.kron(weights, ca.SX.ones(3, 1))))


def _energy_and_curvature(term: _Term) -> tuple[Any, Any]:
    """Value of a term, and the weights of its residuals in the Gauss-Newton Hessian."""
    if term.robust is None:
        return ca.dot(term.weight, term.residual**2), term.weight
    groups = ca.reshape(term.residual, term.group, -1)
    squared = ca.sum1(groups**2)
    per_group = ca.reshape(term.weight, term.group, -1)[0, :]
    value = ca.dot(per_group, energies.pseudo_huber(squared, term.robust))
    factor = energies.pseudo_huber_weight(squared, term.robust)
    return value, term.weight * ca.vec(ca.repmat(factor, term.group, 1))
