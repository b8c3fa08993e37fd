"""The Cartesian energy of a fragment for the real-time solver: its Hessian as one narrow band.

Acceleration, bone vectors, jerk and the prior are linear in the positions: their part of the energy is a
quadratic form, found once a fragment. What is left are small elements: one landmark's reprojection, one
rigid distance. They come from the same catalogue, as functions of one element mapped over all.

Without rigid distances the printed energy falls into independent groups of joints: those of a limb, and
every other joint alone. Ordered group by group, then frame by frame, the Hessian of 3,150 unknowns is a
band of 27; with weighted bone lengths all joints hang together, and it is one of 189.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rtof_kin.core.errors import ShapeError
from rtof_kin.core.numerics.banded import Factor, Store, StoredFactor, factorise
from rtof_kin.core.numerics.c_compiler import Buffered
from rtof_kin.core.numerics.simd import Columns, Over, compile_simd
from rtof_kin.core.numerics.simd_codegen import FrameFunction
from rtof_kin.solve.cartesian.problem import CURVED_BY, FragmentProblem

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class BandedProblem:
    """A fragment's energy of its joint positions, as `LevenbergMarquardt` asks for it.

    Its unknowns (N 3J,) are in the order of the band; `ordered` and `positions` go to and fro.

    Attributes:
        at: columns of the quadratic form's entries in the band, and how far below the diagonal.
    """

    def __init__(self, problem: FragmentProblem, compile: str = "auto") -> None:
        """Order the unknowns.

        Args:
            compile: 'auto' compiles the elements once where there is a compiler, 'never' interprets.

        Raises:
            ShapeError: bone lengths are constraints, which IPOPT alone can keep.
        """
        if problem.settings.bone_lengths == "constraint":
            raise ShapeError("bone_lengths 'constraint' needs backend 'ipopt', or take 'weighted'")
        N, J = problem.frames, len(problem.parents)
        points = 3 * np.arange(N * J)[:, None] + np.arange(3)
        parts = [(problem.landmark, points)]
        if problem.settings.bone_lengths == "weighted":
            a, b = (points.reshape(N, J, 3)[:, list(ends)] for ends in zip(*problem.pairs, strict=True))
            parts.append((problem.rigid_distance, np.concatenate([a, b], axis=-1).reshape(-1, 6)))
        functions = [FrameFunction(function, (2,)) for function, _ in parts]
        code = (compile_simd(functions) if compile == "auto" else None) or {}
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
        stored = compile == "auto" and Store.available()
        self._base, self._store = np.zeros((N * 3 * J, width)), None
        self._band = np.zeros_like(self._base)
        if stored:
            self._store = Store(N * 3 * J, width - 1)
            self._band = self._store.entries[:, :width]

    def bind(self, values: dict[str, Array], parameters: Array) -> None:
        """Take the fragment that is asked about from now on: by name, and packed."""
        curved_by = np.concatenate([np.ravel(values[name], order="F") for name in CURVED_BY])
        if not np.array_equal(curved_by, self._curvature.inputs[0]):  # often the same as before
            self._base[self.at] = self._curvature(curved_by)[0]
        gradient, constant = self._slope_of(parameters)
        self._slope, self._constant = gradient[self._order], float(constant[0])
        self._start = self.ordered(values["p_prior"].ravel(order="F"))
        camera = [values[n].ravel(order="F") for n in ("R_camera_world", "t_camera_world", "K")]
        k_visual, k_length = values["k"][0], values["k"][4]
        shared = np.concatenate([*camera, values["sigma_reprojection"], [k_visual]])
        own = np.concatenate([values["uv_px"].T, values["w_visual"][:, None]], axis=1)
        self._elements[0].bind(own, shared)
        if len(self._elements) > 1:
            lengths, weights = np.broadcast_arrays(values["lengths"], values["w_length"][:, None])
            own = np.stack([lengths.ravel(), weights.ravel()], axis=1)
            self._elements[1].bind(own, np.array([k_length]))
        self._known: tuple[Array, float, Array] | None = None

    def ordered(self, x: Array) -> Array:
        """Unknowns of positions."""
        return np.asarray(x[self._order])

    def positions(self, unknowns: Array) -> Array:
        """Positions of unknowns."""
        x = np.empty_like(unknowns)
        x[self._order] = unknowns
        return x

    def retract(self, x: Array, step: Array) -> Array:
        """The unknowns after a step."""
        return np.asarray(x + step)

    def total(self, x: Array) -> float:
        """The energy."""
        return self._at_point(x)[1]

    def gradient(self, x: Array) -> Array:
        """(N 3J,) dE/dx."""
        return self._at_point(x)[2]

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Energy and gradient; the Hessian is kept for `factorise`."""
        _, value, gradient = self._at_point(x)
        self._band[:] = self._base
        for element in self._elements:
            element.add_hessian(self._band)
        return value, gradient

    def factorise(self, damping: float) -> Factor | StoredFactor:
        """Cholesky factor of the Hessian kept, plus `damping` on its diagonal."""
        if self._store is not None:
            return self._store.factorise(damping)
        band = self._band.copy()
        band[:, 0] += damping
        return factorise(band)

    def _at_point(self, x: Array) -> tuple[Array, float, Array]:
        """The point, energy and gradient there."""
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
    """One small function over n places of the unknowns.

    Attributes:
        at: of its Hessian's entries, as `BandedProblem.at`.
    """

    def __init__(self, given: FrameFunction, index: Index, code: Any) -> None:
        self._index, size = index, index.shape[1]
        self._over = _Interpreted(given, index) if code is None else _Compiled(given, index, code)
        r, c = np.tril_indices(size)
        self._entries = c * size + r  # CasADi's order of a dense matrix
        self.at = _entries(index[:, r], index[:, c])
        width = int(self.at[1].max()) + 1
        places, self._which = np.unique(self.at[0] * width + self.at[1], return_inverse=True)
        self._places = places // width, places % width
        self._alone = len(places) == self.at[0].size

    def bind(self, own: Array, shared: Array) -> None:
        """Take what each element observes (n, ...) and what is the same for all."""
        self._over.bind(own, shared)

    def evaluate(self, x: Array, gradient: Array) -> float:
        """The energy at x; its gradient is added."""
        value, own, self._hessian = self._over.evaluate(x)
        if self._alone:
            gradient[self._index.ravel()] += own.ravel()
        else:
            gradient += np.bincount(self._index.ravel(), own.ravel(), len(gradient))
        return float(value.sum())

    def add_hessian(self, band: Array) -> None:
        """Add the Hessian of the last evaluation."""
        hessian = self._hessian[:, self._entries]
        if self._alone:
            band[self.at] += hessian
        else:
            summed = np.bincount(self._which.ravel(), hessian.ravel(), len(self._places[0]))
            band[self._places] += summed


class _Interpreted:
    """Value, gradient and Hessian of all elements, one after the other."""

    def __init__(self, given: FrameFunction, index: Index) -> None:
        self._index, self._mapped = index, Buffered(given.function.map(len(index)))

    def bind(self, own: Array, shared: Array) -> None:
        self._mapped.inputs[1][:] = own.ravel()
        self._mapped.inputs[2].reshape(len(own), -1)[:] = shared

    def evaluate(self, x: Array) -> list[Array]:
        """Arrays with a row for each element, which hold until the next call."""
        outputs = self._mapped(x[self._index].ravel())
        return [output.reshape(len(self._index), -1) for output in outputs]


class _Compiled:
    """The same, several at once."""

    def __init__(self, given: FrameFunction, index: Index, code: Any) -> None:
        f, columns = given.function, Columns(len(index))
        self._index, self._shared = index.T.copy(), np.zeros(f.nnz_in(2))
        inputs = [columns.zeros(f.nnz_in(i)) for i in range(2)]
        outputs = [columns.zeros(f.nnz_out(i)) for i in range(f.n_out())]
        at = [columns.at(array) for array in (*inputs, *outputs)]
        self._over = Over(code, given, len(index), [*at[:2], self._shared], at[2:])
        self._x, self._own = (array[:, columns.inside] for array in inputs)
        self._outputs = [array[:, columns.inside].T for array in outputs]

    def bind(self, own: Array, shared: Array) -> None:
        self._own[:], self._shared[:] = own.T, shared

    def evaluate(self, x: Array) -> list[Array]:
        """As `_Interpreted.evaluate`."""
        self._x[:] = x[self._index]
        self._over()
        return self._outputs


def _grouped(size: int, row: Index, column: Index, elements: list[Index]) -> Index:
    """Order of the unknowns: groups that nothing couples one after the other, else as they are."""
    rows = [row, *(np.repeat(index[:, 0], index.shape[1]) for index in elements)]
    columns = [column, *(index.ravel() for index in elements)]
    i, j = np.concatenate(rows), np.concatenate(columns)
    _, group = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (size, size)), directed=False)
    return np.lexsort((np.arange(size), group))


def _entries(first: Index, second: Index) -> tuple[Index, Index]:
    """Columns in the band and rows below the diagonal of some pairs of unknowns."""
    return np.minimum(first, second), np.abs(first - second)
