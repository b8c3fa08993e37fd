"""Interface of the joint-space energy of a fragment, and its two implementations' common constructor.

`JointProblem` evaluates whole arrays and is the reference; `SimdProblem` gives the same numbers from
compiled code that takes several frames at once. What is built and compiled once for all solvers of a
process never changes. Each solver's energy has arrays of its own, so that solvers may run in several
threads. Expressions are kept for good: CasADi frees them as if there were one thread.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

import numpy as np

from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.choices import Compile
from rtof_kin.core.numerics.banded import Factor, Store, StoredFactor
from rtof_kin.core.numerics.c_compiler import BUILDING, compiled
from rtof_kin.solve.compiled.simd_problem import SimdFunctions, SimdProblem
from rtof_kin.solve.energy.frame_energy import FrameEnergy, Shape
from rtof_kin.solve.energy.problem import FragmentData, JointProblem
from rtof_kin.solve.energy.state import StateSpace


class FragmentEnergy(Protocol):
    """Energy of N frames by their states x (N, 3 + 4A), with a banded Gauss-Newton Hessian.

    Values are kept for the array `x` itself: pass a new array for a new state.
    """

    space: StateSpace
    """State space, of D tangent coordinates."""
    energy: FrameEnergy
    """Energy of a single frame."""
    frames: int
    """N."""
    sigma_jerk: Array
    """(D,) standard deviations of the jerk, m/s^3 and rad/s^3."""

    def bind(self, data: FragmentData) -> None:
        """Set the data of the fragment to be evaluated."""

    def reweigh(self, name: str, weight: Array) -> None:
        """Replace the weights (N, ...) of one kind of observation.

        Args:
            name: one of `FrameEnergy.observation`. weight: 1 / sigma^2.
        """

    def retract(self, x: Array, step: Array) -> Array:
        """Return the state after a step (N, D), m and rad."""

    def value(self, x: Array) -> tuple[dict[str, float], Array]:
        """Return the energy per term and the reprojection residuals (N, L, 2), px."""

    def total(self, x: Array) -> float:
        """Return the energy."""

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N, D) in tangent coordinates, 1/m and 1/rad."""

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient (N, D); keep the Hessian for the methods below."""

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the diagonal blocks of the Hessian; the arguments broadcast."""

    def add_to_first(self, matrix: Array) -> None:
        """Add a symmetric matrix (k D, k D), k <= 3, to the blocks of the Hessian of the first k frames."""

    def lower_block(self, k: int) -> Array:
        """Return the Hessian's blocks (N - k, D, D) k frames below the diagonal: [t, r, c]."""

    def hessian(self) -> Array:
        """Return the whole Hessian (N D, N D), for a few frames."""

    def factorise(self, damping: float) -> Factor | StoredFactor:
        """Return the Cholesky factor of the Hessian plus `damping` on its diagonal.

        Raises:
            SolverError: it is not positive definite.
        """


def built_energy(
    name: str,
    shape: Shape,
    moving: tuple[str, ...],
    frames: int,
    hinges: bool,
    compile: Compile,
    jerk: tuple[float, ...],
    robust_acceleration: float,
    prior: PosePrior,
) -> FragmentEnergy:
    """Return an energy of N frames, compiled where possible.

    Args:
        jerk: factors on the standard deviation of the jerk, of the root's position and of every joint that moves.
        prior: of the body; has the standard deviations of the jerk.
    """
    with BUILDING:
        energy = _frame_energy(name, shape, moving, hinges)
        space = energy.space
        sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
        root, *turns = jerk
        tangent = np.repeat(sigma * turns, 3) @ (space.expand != 0)
        sigma_jerk = np.concatenate([np.full(3, root * prior.sigma_root_jerk), tangent])
        if compile == "auto" and Store.available():
            simd = _simd_functions(name, shape, moving, hinges, robust_acceleration)
            if simd is not None:
                return SimdProblem(simd, energy, frames, sigma_jerk)
            compile = "never"
        functions = _functions(name, shape, moving, hinges, compile)
        return JointProblem(space, functions, energy, frames, sigma_jerk, robust_acceleration)


@cache
def _frame_energy(name: str, shape: Shape, moving: tuple[str, ...], hinges: bool) -> FrameEnergy:
    return FrameEnergy(StateSpace(SkeletonModel.named(name), moving, hinges), shape)


@cache
def _simd_functions(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, robust: float
) -> SimdFunctions | None:
    """Functions of several frames at once; None where they cannot be compiled."""
    return SimdFunctions.compiled(_frame_energy(name, shape, moving, hinges), robust)


@cache
def _functions(name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, compile: Compile) -> list[Any]:
    """Functions of one frame, compiled where the banded solver alone cannot be."""
    functions = _frame_energy(name, shape, moving, hinges).functions()
    return compiled(functions) if compile == "auto" else functions
