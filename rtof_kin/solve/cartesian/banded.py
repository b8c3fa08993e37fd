"""Cartesian energy of a fragment for the real-time solver: its Hessian as one narrow band.

Acceleration, bone vectors, jerk and the prior are linear in the positions: their energy is a quadratic form, computed
once per fragment. The rest are small elements, the reprojection of a landmark or a rigid distance, from functions of
one element mapped over all.

Without rigid distances the printed energy separates into groups of joints: those of a limb, and every other joint
alone. Ordered group by group, then frame by frame, the Hessian of 3,150 unknowns has a bandwidth of 27; with weighted
bone lengths all joints are coupled and it is 189.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import blas
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.choices import Compile
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.numerics.banded import Factor, Store
from rtof_kin.core.numerics.c_compiler import Buffered
from rtof_kin.core.numerics.simd import Mapped, compile_simd
from rtof_kin.core.numerics.simd_codegen import FrameFunction
from rtof_kin.solve.cartesian.problem import CURVED_BY, FragmentProblem


class BandedProblem:
    """Energy of a fragment's joint positions, a `levenberg_marquardt.Problem`.

    Its unknowns (N 3J,) are in the order of the band; `ordered` and `positions` convert.

    Attributes:
        at: columns of the quadratic form's entries in the band, and their distance from the diagonal.
    """

    def __init__(self, problem: FragmentProblem, compile: Compile = "auto") -> None:
        """Order the unknowns.

        Args:
            compile: 'auto' compiles the elements where there is a compiler, 'never' interprets.

        Raises:
            InvalidInputError: bone lengths are constraints, which only IPOPT can keep.
        """
        if problem.settings.bone_lengths == "constraint":
            raise InvalidInputError("bone_lengths 'constraint' needs backend 'ipopt', or take 'weighted'")
        N, J = problem.frames, len(problem.parents)
        points = 3 * np.arange(N * J)[:, None] + np.arange(3)
        parts = [(problem.landmark, points)]
        if problem.settings.bone_lengths == "weighted":
            a, b = (points.reshape(N, J, 3)[:, list(ends)] for ends in zip(*problem.pairs, strict=True))
            parts.append((problem.rigid_distance, np.concatenate([a, b], axis=-1).reshape(-1, 6)))
        parts += [(f, points.reshape(N, J, 3)[:, list(joints)].reshape(N, -1)) for joints, _, f in problem.elements]
        self._points = [term for _, term, _ in problem.elements]
        functions = [FrameFunction(function, (2,)) for function, _ in parts]
        code = compile_simd(functions) if compile == "auto" else {}
        self._curvature, self._slope_of = Buffered(problem.curvature), Buffered(problem.slope)
        row, column = problem.curvature.sparsity_out(0).get_triplet()
        self._order = _grouped(N * 3 * J, np.array(row), np.array(column), [i for _, i in parts])
        place = np.argsort(self._order)
        self.at = _entries(place[row], place[column])
        self._elements = [
            _Elements(given, place[index], code.get(given.function.name()))
            for given, (_, index) in zip(functions, parts, strict=True)
        ]
        width = max(int(at[1].max()) for at in (self.at, *(e.at for e in self._elements))) + 1
        self._base, self._store = np.zeros((N * 3 * J, width)), Store(N * 3 * J, width - 1, compile == "auto")
        self._band = self._store.entries[:, :width]

    def bind(self, values: dict[str, Array], parameters: Array) -> None:
        """Set the fragment to be evaluated."""
        curved_by = np.concatenate([np.ravel(values[name], order="F") for name in CURVED_BY])
        if not np.array_equal(curved_by, self._curvature.inputs[0]):  # often equal to the previous
            self._base[self.at] = self._curvature(curved_by)[0]
        gradient, constant = self._slope_of(parameters)
        self._slope, self._constant = gradient[self._order], float(constant[0])
        self._start = self.ordered(values["p_prior"].ravel(order="F"))
        camera = [values[n].ravel(order="F") for n in ("R_camera_world", "t_camera_world", "K")]
        k_visual, k_length = values["k"][0], values["k"][4]
        self._elements[0].own = np.concatenate([values["uv_px"].T, values["w_visual"][:, None]], axis=1)
        self._elements[0].shared = np.concatenate([*camera, values["sigma_reprojection"], [k_visual]])
        behind = len(self._elements) - len(self._points)
        for distances in self._elements[1:behind]:
            lengths, weights = np.broadcast_arrays(values["lengths"], values["w_length"][:, None])
            distances.own = np.stack([lengths.ravel(), weights.ravel()], axis=1)
            distances.shared = np.array([k_length])
        for term, element in zip(self._points, self._elements[behind:], strict=True):
            weight = values[term.weight][:, None]
            element.own = np.concatenate([values[term.observed].T, weight], axis=1)
            element.shared = np.zeros(1)
        self._known: tuple[Array, float, Array] | None = None

    def ordered(self, x: Array) -> Array:
        """Return the unknowns of positions x (N 3J,)."""
        return np.asarray(x[self._order])

    def positions(self, unknowns: Array) -> Array:
        """Return the positions (N 3J,) of unknowns."""
        x = np.empty_like(unknowns)
        x[self._order] = unknowns
        return x

    def retract(self, x: Array, step: Array) -> Array:
        """Return the unknowns after a step."""
        return np.asarray(x + step)

    def total(self, x: Array) -> float:
        """Return the energy."""
        return self._at_point(x)[1]

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N 3J,)."""
        return self._at_point(x)[2]

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient; keep the Hessian."""
        _, value, gradient = self._at_point(x)
        self._band[:] = self._base
        for element in self._elements:
            element.add_hessian(self._band)
        return value, gradient

    def factorise(self, damping: float) -> Factor:
        """Return the Cholesky factor of the Hessian plus `damping` on its diagonal."""
        return self._store.factorise(damping)

    def _at_point(self, x: Array) -> tuple[Array, float, Array]:
        """The point, and energy and gradient there."""
        if self._known is None or self._known[0] is not x:
            away = x - self._start
            turned = blas.dsbmv(self._base.shape[1] - 1, 1.0, self._base.T, away, lower=1)
            value = self._constant + float(away @ (self._slope + 0.5 * turned))
            gradient = self._slope + turned
            for element in self._elements:
                value += element.evaluate(x, gradient)
            self._known = x, value, gradient
        return self._known


class _Elements:
    """A small function over n places of the unknowns.

    Attributes:
        at: entries of its Hessian, as `BandedProblem.at`.
        own: (n, ...) observation of each element. shared: parameters of all elements.
    """

    def __init__(self, given: FrameFunction, index: Index, code: Any) -> None:
        self._index, size = index, index.shape[1]
        self._evaluate = Mapped(code, given, len(index))
        self.own, self.shared = np.zeros((len(index), 0)), np.zeros(0)
        r, c = np.tril_indices(size)
        self._entries = c * size + r  # CasADi's order of a dense matrix
        self.at = _entries(index[:, r], index[:, c])
        width = int(self.at[1].max()) + 1
        places, self._which = np.unique(self.at[0] * width + self.at[1], return_inverse=True)
        self._places = places // width, places % width
        self._distinct = len(places) == self.at[0].size

    def evaluate(self, x: Array, gradient: Array) -> float:
        """Return the energy at x and add the gradient."""
        value, own, self._hessian = self._evaluate(x[self._index], self.own, self.shared)
        if self._distinct:
            gradient[self._index.ravel()] += own.ravel()
        else:
            gradient += np.bincount(self._index.ravel(), own.ravel(), len(gradient))
        return float(value.sum())

    def add_hessian(self, band: Array) -> None:
        """Add the Hessian of the last evaluation."""
        hessian = self._hessian[:, self._entries]
        if self._distinct:
            band[self.at] += hessian
        else:
            summed = np.bincount(self._which.ravel(), hessian.ravel(), len(self._places[0]))
            band[self._places] += summed


def _grouped(size: int, row: Index, column: Index, elements: list[Index]) -> Index:
    """Order of the unknowns: uncoupled groups one after the other."""
    rows = [row, *(np.repeat(index[:, 0], index.shape[1]) for index in elements)]
    columns = [column, *(index.ravel() for index in elements)]
    i, j = np.concatenate(rows), np.concatenate(columns)
    _, group = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (size, size)), directed=False)
    return np.lexsort((np.arange(size), group))


def _entries(first: Index, second: Index) -> tuple[Index, Index]:
    """Columns in the band and distances from the diagonal of pairs of unknowns."""
    return np.minimum(first, second), np.abs(first - second)
