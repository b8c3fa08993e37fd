"""Energy of a fragment of N frames in joint space, with its Gauss-Newton Hessian as a band.

::

    E = sum over frames of E_frame + 1/2 sum rho(|a - a_imu|^2 / sigma_A^2) + 1/2 sum |jerk|^2 / sigma_J^2

The functions of a frame and its neighbours (`stencils`) write energies, gradient and the Hessian where it is
factorised. They are evaluated in two ways with the same numbers up to rounding: by compiled code that takes several
frames at once, or interpreted by CasADi. The acceleration of a sensor couples neighbouring frames, so its blocks of the
Hessian lie up to two frames off the diagonal; the jerk couples frames up to three apart, each joint with itself only.

What is built and compiled once for all solvers of a process never changes. Each solver's energy has arrays of its own,
so that solvers may run in several threads. Expressions are kept for good: CasADi frees them as if there were one
thread.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import quaternions as quat
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.choices import Compile
from rtof_kin.core.numerics import simd
from rtof_kin.core.numerics.banded import Factor, Store
from rtof_kin.core.numerics.c_compiler import BUILDING
from rtof_kin.core.numerics.simd import Columns, Compiled, FrameFunction, Mapped, Over, compile_simd
from rtof_kin.solve.joint_space.layout import LAGS, FrameLayout
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.terms import PointTerm, Term

MEMORY: Final = LAGS - 1  #: Frames that a marginalised frame leaves a prior on
MADE_BY: Final = ("energy", "fragment", "layout", "state", "stencils", "terms")
"""Modules of this folder that an energy's expressions are made by; when one changes, it is built anew."""
BEYOND: Final = 2  #: Rows below the third block's diagonal that the axes of a joint reach


@dataclass(frozen=True)
class FragmentData:
    """Observations of a fragment of N frames; weights are 0 where there are none."""

    observation: dict[str, Array]  #: Name -> (N, ...), with the names of `FrameLayout.observation`
    constant: dict[str, Array]  #: Name -> value, with the names of `FrameLayout.constant`
    a_world: Array
    """(N - 2, P, 3) measured derivatives of the paths' points: accelerations of the sensors, m/s^2, first."""
    w_acceleration: Array  #: (N - 2, P) 1 / sigma^2 of each; of accelerations s^4/m^2
    w_jerk: Array  #: (N - 3,) weight of the jerk of four frames in a row
    rate_hz: float
    length_scale: float = 1.0  #: [1] Factor on the body's size: the jerk of the root is measured in body lengths


@dataclass(frozen=True)
class FragmentFunctions:
    """Functions of a frame that a `FragmentEnergy` calls, and their compiled code."""

    space: StateSpace
    layout: FrameLayout
    frames: Mapping[str, FrameFunction]
    groups: Mapping[str, Index]  #: Name of a function that writes the Hessian -> where (`stencils.HessianColumns`)
    code: Mapping[str, Any]  #: Name of the function -> code; empty where they are interpreted

    @classmethod
    def of(cls, space: StateSpace, terms: tuple[Term, ...], compile: Compile = "auto") -> FragmentFunctions:
        """Return the functions of an energy, compiled where possible. Their expressions are not built where the same
        ones were compiled before.
        """
        build = partial(_expressions, space, terms)
        found = compile_simd(build, made_of(space, terms)) if compile == "auto" else None
        if found is None:
            functions, remarks = build()
            found = Compiled({given.name: given for given in functions}, {}, remarks)
        groups = {name: np.array(at).reshape(-1, 2) for name, at in found.remarks["groups"].items()}
        return cls(space, FrameLayout.of(terms, *found.remarks["layout"]), found.functions, groups, found.code)


@cache
def _expressions(space: StateSpace, terms: tuple[Term, ...]) -> tuple[list[FrameFunction], dict[str, Any]]:
    """The functions of a frame, and what a `FragmentFunctions` has beside them."""
    from rtof_kin.solve.joint_space import stencils
    from rtof_kin.solve.joint_space.energy import FrameEnergy

    energy = FrameEnergy(space, terms)
    hessian = stencils.linear(energy), stencils.coupled(energy)
    functions = [
        stencils.retract(space),
        FrameFunction.of(energy.value, (2,)),
        stencils.step(space),
        stencils.inverse(space),
        stencils.motion(energy),
        stencils.pulled(energy),
        *(columns.frame for columns in hessian),
    ]
    layout, groups = energy.layout, {columns.frame.name: columns.groups.tolist() for columns in hessian}
    return functions, {"layout": [layout.names, layout.paths, layout.observation, layout.constant], "groups": groups}


def made_of(space: StateSpace, terms: tuple[Term, ...]) -> str:
    """What identifies the expressions of an energy; nothing where a term is from outside, whose source may change."""
    if any(isinstance(term, PointTerm) or not type(term).__module__.startswith("rtof_kin.") for term in terms):
        return ""
    body = space.skeleton
    return f"{_sources()} {body.names} {body.parents} {space.joints} {space.hinge_axis.tolist()} {terms}"


@cache
def _sources() -> str:
    """SHA-256 of the files that make expressions and code of them."""
    here, numerics = Path(__file__).parent, Path(simd.__file__).parent
    files = [here.with_name("terms.py"), *(here / f"{name}.py" for name in MADE_BY)]
    files += [numerics / name for name in ("simd.py", "simd_codegen.py", "simd.h")]
    return sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


@dataclass(frozen=True)
class MarginalPrior:
    """Energy of the first three frames of a window, from the frames that have left it.

    ::

        E(x) = eta^T d + 1/2 d^T Lambda d        d = x - x_0 in tangent coordinates

    (Sibley, Matthies & Sukhatme 2010; Dong-Si & Mourikis 2011). Linearisation points x_0 are kept.
    """

    x: Array  #: (3, 3 + 4A) linearisation points
    precision: Array  #: (3D, 3D) Lambda
    slope: Array  #: (3D,) eta

    @classmethod
    def none(cls, space: StateSpace, x: Array) -> MarginalPrior:
        """Return a prior without information. x: (3, 3 + 4A) any states."""
        size = MEMORY * space.size
        return cls(x, np.zeros((size, size)), np.zeros(size))

    def at(self, space: StateSpace, x: Array) -> tuple[float, Array]:
        """Return the energy and its gradient (3, D) by tangents at x. x: (3, 3 + 4A)."""
        if np.array_equal(self.x, x):
            return 0.0, self.slope.reshape(MEMORY, -1)
        d = space.difference(self.x, x).ravel()
        pulled = self.precision @ d
        force = (self.slope + pulled).reshape(MEMORY, -1)
        turns = (d.reshape(MEMORY, -1)[:, 3:] @ space.expand.T).reshape(MEMORY, -1, 3)
        torque = (force[:, 3:] @ space.expand.T).reshape(turns.shape)
        torque = np.einsum("taij,tai->taj", quat.right_jacobian_inverse(turns), torque)
        gradient = np.concatenate([force[:, :3], torque.reshape(MEMORY, -1) @ space.expand], axis=1)
        return float(d @ (self.slope + pulled / 2)), gradient


class FragmentEnergy:
    """Energy of N frames by their states x (N, 3 + 4A), with a banded Gauss-Newton Hessian.

    Values are kept for the array `x` itself: pass a new array for a new state.

    Attributes:
        space: of D tangent coordinates. energy: layout of that of a single frame. frames: N.
        names: of the terms, those of a frame first. sigma_jerk: (D,) of the jerk, m/s^3 and rad/s^3.
    """

    def __init__(self, functions: FragmentFunctions, frames: int, sigma_jerk: Array) -> None:
        """Bind the functions to arrays. sigma_jerk: equal for the axes of a joint."""
        self.space, self.energy, self.frames, self.sigma_jerk = functions.space, functions.layout, frames, sigma_jerk
        self.names = (*self.energy.names, *dict.fromkeys(self.energy.paths), "smooth")
        self._functions, self._columns = functions, Columns(frames)
        size, P, value = self.space.size, len(self.energy.paths), functions.frames["value"]
        self._matrix = Store(frames * size, (LAGS - 1) * size + BEYOND, bool(functions.code))
        zeros = self._columns.zeros
        self._x, self._observed = map(zeros, value.inputs[:2])
        self._constant, self._rate = np.zeros(value.inputs[2]), np.zeros(1)
        self._sigma = np.array(sigma_jerk, dtype=float)
        self._terms, self._points, self._residuals = map(zeros, value.outputs)
        self._step, self._tension, self._gradient_now = zeros(size), zeros(size), zeros(size)
        self._motion_energy = zeros(len(self.names) - len(self.energy.names))
        self._slope, self._force = zeros(P), zeros(3 * P)
        self._a, self._w, self._w_jerk = zeros(3 * P), zeros(P), zeros(1)
        self._inverse = zeros(functions.frames["inverse"].outputs[0])
        self._changing = zeros(functions.frames["linear"].outputs[1])
        self._coefficients = zeros(3 * LAGS)
        self._retract = Mapped(functions.code.get("retract"), functions.frames["retract"], frames)
        self._bind_functions()
        self._jerk_of: tuple[Array, float] | None = None
        self._known: tuple[Array, list[float]] | None = None
        self._inverse_known = False
        self._prior: MarginalPrior | None = None
        self._prior_at: tuple[Array, float, Array] | None = None
        self._filled = 0  #: Columns to which `add_to_first` has added

    def _bind_functions(self) -> None:
        """Bind arrays to functions; frames are numbered as in `stencils`."""
        N, at = self.frames, self._columns.at
        frame, shared = [at(self._x), at(self._observed), self._constant], [self._sigma, self._rate]
        around = [
            *(at(self._force, k) for k in (-2, -1, 0)),
            *(at(self._tension, k) for k in (-3, -2, -1, 0)),
            *(at(self._inverse, k) for k in (-1, 0)),
        ]
        moving = [
            *(at(self._step, k) for k in range(3)),
            at(self._w_jerk),
            *(at(self._points, k) for k in range(3)),
            at(self._a),
            at(self._w),
            *shared,
        ]
        slopes = [self._motion_energy, self._slope, self._tension, self._force]
        self._run = {
            "value": self._over("value", N, frame, [self._terms, self._points, self._residuals]),
            "step": self._over("step", N - 1, [at(self._x), at(self._x, 1)], [self._step]),
            "inverse": self._over("inverse", N - 1, [at(self._step)], [self._inverse]),
            "pulled": self._over("pulled", N, [*frame, *around], [self._gradient_now]),
            "motion": self._over("motion", N - 2, moving, slopes),
        }
        coefficients = at(self._coefficients)
        linear = [*frame, *around, *(at(self._slope, k) for k in (-2, -1, 0)), coefficients, *shared]
        coupled = [
            *(at(self._changing, k) for k in range(3)),
            *(at(self._slope, k) for k in (-1, 0)),
            *(at(self._inverse, k) for k in (-1, 0, 1, 2)),
            coefficients,
            *shared,
        ]
        self._run["linear"] = self._placed("linear", linear, [at(self._gradient_now), at(self._changing)])
        self._run["coupled"] = self._placed("coupled", coupled, [])

    def _over(self, name: str, frames: int, inputs: list[Array], outputs: list[Array]) -> Over:
        functions = self._functions
        to = [self._columns.at(array) for array in outputs]
        return Over(functions.code.get(name), functions.frames[name], frames, inputs, to)

    def _placed(self, name: str, inputs: list[Array], outputs: list[Array]) -> Over:
        functions, step = self._functions, self._matrix.step
        band, groups = self._matrix.entries.reshape(self.frames, -1), functions.groups[name]
        places = (groups[:, 0] + step * groups[:, 1]).astype(np.int64)
        return Over(functions.code.get(name), functions.frames[name], self.frames, inputs, [*outputs, band], places)

    def bind(self, data: FragmentData) -> None:
        """Set the data of the fragment to be evaluated."""
        self._known, inside, N = None, self._columns.inside, self.frames
        rows = [data.observation[n].reshape(N, -1) for n in self.energy.observation]
        self._observed[:, inside] = np.concatenate(rows, axis=1).T
        constant = [np.ravel(data.constant[n], order="F") for n in self.energy.constant]
        self._constant[:] = np.concatenate(constant)
        self._rate[:] = data.rate_hz
        first = inside.start
        self._a[:, first : first + N - 2] = data.a_world.reshape(N - 2, -1).T
        self._w[:, first : first + N - 2] = data.w_acceleration.T
        self._w_jerk[0, first : first + N - 3] = data.w_jerk
        self._sigma[:] = self.sigma_jerk * np.where(np.arange(self.space.size) < 3, data.length_scale, 1.0)
        before = self._jerk_of
        if before is None or before[1] != data.rate_hz or (before[0] != data.w_jerk).any():
            self._jerk_of = data.w_jerk.copy(), data.rate_hz
            self._coefficients[:, inside] = jerk_coefficients(N, data.w_jerk, data.rate_hz).T

    def condition(self, prior: MarginalPrior) -> None:
        """Add a prior of the first frames to energy, gradient and Hessian, but not to `value`."""
        if prior is not self._prior:
            self._prior, self._prior_at = prior, None

    def before(self, x: Array) -> tuple[float, Array]:
        """Return the prior's energy and gradient (3, D), kept until another array or prior is given."""
        if self._prior is None:
            return 0.0, np.zeros(0)
        if self._prior_at is None or self._prior_at[0] is not x:
            self._prior_at = (x, *self._prior.at(self.space, x[:MEMORY]))
        return self._prior_at[1:]

    def reweigh(self, name: str, weight: Array) -> None:
        """Replace the weights (N, ...), 1 / sigma^2, of one kind of observation, of `FrameLayout.observation`."""
        self._known = None
        columns = weight.reshape(self.frames, -1).T
        self._observed[self.energy.rows[name], self._columns.inside] = columns

    def retract(self, x: Array, step: Array) -> Array:
        """Return the state after a step (N, D), m and rad."""
        return self._retract(x, step)[0]

    def value(self, x: Array) -> tuple[dict[str, float], Array]:
        """Return the energy per term and the reprojection residuals (N, L, 2), px."""
        terms = self._evaluated(x)
        residuals = self._columns.rows(self._residuals)
        return dict(zip(self.names, terms, strict=True)), residuals.reshape(self.frames, -1, 2)

    def total(self, x: Array) -> float:
        """Return the energy."""
        return sum(self._evaluated(x)) + self.before(x)[0]

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N, D) in tangent coordinates, 1/m and 1/rad."""
        self._turned(x)
        self._run["pulled"]()
        gradient = self._columns.rows(self._gradient_now)
        if self._prior is not None:
            gradient[:MEMORY] += self.before(x)[1]
        return gradient

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient (N, D); keep the Hessian for the methods below."""
        terms = self._turned(x)
        self._matrix.entries[: self._filled] = 0.0  # entries that no term has are not written below
        self._filled = 0
        self._run["linear"]()
        self._run["coupled"]()
        gradient = self._columns.rows(self._gradient_now)
        if self._prior is None:
            return sum(terms), gradient
        own, slope = self.before(x)
        self.add_to_first(self._prior.precision)
        gradient[:MEMORY] += slope
        return sum(terms) + own, gradient

    def _evaluated(self, x: Array) -> list[float]:
        """Energies at x as in `value`, kept until another state or other data are given."""
        if self._known is None or self._known[0] is not x:
            self._x[:, self._columns.inside] = x.T
            for name in ("value", "step", "motion"):
                self._run[name]()
            parts = self._terms.sum(axis=1).tolist() + self._motion_energy.sum(axis=1).tolist()
            self._known, self._inverse_known = (x, parts), False
        return self._known[1]

    def _turned(self, x: Array) -> list[float]:
        """Energies at x, with the inverse right Jacobians of the steps."""
        terms = self._evaluated(x)
        if not self._inverse_known:
            self._run["inverse"]()
            self._inverse_known = True
        return terms

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the diagonal blocks of the Hessian; the arguments broadcast."""
        band = self._matrix.entries.reshape(-1)
        size, step = self.space.size, self._matrix.step
        places, lower = frames * size * (step + 1) + columns * step + rows, rows >= columns
        shape = np.broadcast_shapes(places.shape, values.shape)
        chosen = np.broadcast_to(lower, shape)
        places, values = np.broadcast_to(places, shape), np.broadcast_to(values, shape)
        np.add.at(band, places[chosen], values[chosen])

    def add_to_first(self, matrix: Array) -> None:
        """Add a symmetric matrix (k D, k D), k <= 3, to the blocks of the Hessian of the first k frames."""
        self._filled = len(matrix)
        first = self._as_square(len(matrix))
        # Above the diagonal the view shows other columns: nothing is added there.
        first += matrix * _band_mask(len(matrix), self._matrix.band)

    def hessian(self) -> Array:
        """Return the whole Hessian (N D, N D)."""
        return symmetric(self.lower_hessian())

    def lower_hessian(self) -> Array:
        """Return the Hessian (N D, N D) on and below its diagonal; zeros above."""
        return np.asarray(self._as_square(self._matrix.size) * _band_mask(self._matrix.size, self._matrix.band))

    def _as_square(self, size: int) -> Array:
        """Writable view of the first columns in which only entries of the band are those of the matrix."""
        flat = self._matrix.entries.reshape(-1)
        steps = (flat.itemsize, self._matrix.step * flat.itemsize)
        return np.lib.stride_tricks.as_strided(flat, (size, size), steps)

    def factorise(self, damping: float) -> Factor:
        """Return the Cholesky factor of the Hessian plus `damping` on its diagonal. `SolverError`: it is not positive
        definite.
        """
        return self._matrix.factorise(damping)


def jerk_coefficients(frames: int, w_jerk: Array, rate_hz: float) -> Array:
    """Return (N, 12) coefficients of the jerk's Hessian in the blocks 0 to 3 frames later: of a frame's derivative of
    the step before it, of the step after it, and of both for steps about one axis; 0 beyond the end.

    Args:
        w_jerk: (N - 3,) weights. rate_hz: frames per second.
    """
    N, t = frames, np.arange(frames)
    second, third = (np.sqrt(w_jerk)[:, None] * np.diff(np.eye(N - 3 + n), n=n, axis=0) * rate_hz**3 for n in (2, 3))
    S = np.zeros((N + 4, N + 4))  # of the steps, padded with rows and columns of zeros
    S[1:N, 1:N] = second.T @ second
    square = third.T @ third
    out = np.zeros((N, 3 * LAGS))
    for k in range(LAGS):
        out[:, k], out[:, LAGS + k] = S[t + k, t], S[t + k, t + 1]
        out[: N - k, 2 * LAGS + k] = np.diag(square, -k)
    return out


def built_energy(
    name: str,
    terms: tuple[Term, ...],
    moving: tuple[str, ...],
    frames: int,
    hinges: bool,
    compile: Compile,
    sigma: Array,
) -> FragmentEnergy:
    """Return an energy of N frames of a skeleton, compiled where possible; sigma: (D,) `terms.jerk_sigma`."""
    with BUILDING:
        return FragmentEnergy(_functions(name, terms, moving, hinges, compile), frames, sigma)


@cache
def _functions(
    name: str, terms: tuple[Term, ...], moving: tuple[str, ...], hinges: bool, compile: Compile
) -> FragmentFunctions:
    return FragmentFunctions.of(StateSpace(SkeletonModel.named(name), moving, hinges), terms, compile)


def symmetric(lower: Array) -> Array:
    """Return the symmetric matrix (n, n) that has the entries of a matrix on and below its diagonal."""
    return np.where(_lower(len(lower)), lower, lower.T)


@cache
def _lower(size: int) -> Mask:
    return np.tri(size, dtype=bool)


@cache
def _band_mask(size: int, band: int) -> Array:
    """1 for entries of a band on and below the diagonal, else 0."""
    below = np.subtract.outer(np.arange(size), np.arange(size))
    return np.asarray(((below >= 0) & (below <= band)).astype(float))
