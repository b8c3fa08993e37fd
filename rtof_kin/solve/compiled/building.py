"""Problems for all bodies, recordings and fragments that they fit.

What is built and compiled once for all solvers of a process never changes. Each solver's problem has
arrays of its own, so that solvers may run in several threads at once. Expressions are kept for good:
CasADi frees them as if there were one thread.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from rtof_kin.body.pose_prior import shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.numerics.banded import Store
from rtof_kin.core.numerics.c_compiler import BUILDING, compiled
from rtof_kin.solve.compiled.simd_problem import LaneFunctions, LaneProblem
from rtof_kin.solve.energy.frame_energy import FrameEnergy, Shape
from rtof_kin.solve.energy.problem import JointProblem
from rtof_kin.solve.energy.state import StateSpace


def built_problem(
    name: str, shape: Shape, moving: tuple[str, ...], frames: int, hinges: bool, compile: str,
    jerk: tuple[float, ...], robust_acceleration: float,
) -> JointProblem:  # fmt: skip
    """A problem of a fragment, of its caller alone.

    Args:
        jerk: factors on the jerk of free motion, of the root's position and of every joint that moves.
    """
    with BUILDING:
        return _built(name, shape, moving, frames, hinges, compile, jerk, robust_acceleration)


def _built(
    name: str, shape: Shape, moving: tuple[str, ...], frames: int, hinges: bool, compile: str,
    jerk: tuple[float, ...], robust_acceleration: float,
) -> JointProblem:  # fmt: skip
    energy = _energy(name, shape, moving, hinges)
    space, prior = energy.space, shipped_prior(energy.space.skeleton.names)
    sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
    root, *turns = jerk
    tangent = np.repeat(sigma * turns, 3) @ (space.expand != 0)
    sigma_jerk = np.concatenate([np.full(3, root * prior.sigma_root_jerk), tangent])
    if compile == "auto" and not shape.unknowns and Store.available():
        lanes = _lanes(name, shape, moving, hinges, robust_acceleration)
        if lanes is not None:
            return LaneProblem(lanes, energy, frames, sigma_jerk)
        compile = "never"
    functions = _functions(name, shape, moving, hinges, compile)
    return JointProblem(space, functions, energy, frames, sigma_jerk, robust_acceleration)


@cache
def _energy(name: str, shape: Shape, moving: tuple[str, ...], hinges: bool) -> FrameEnergy:
    """A frame's energy, built once for all bodies."""
    return FrameEnergy(StateSpace(SkeletonModel.named(name), moving, hinges), shape)


@cache
def _lanes(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, robust: float
) -> LaneFunctions | None:
    """Its functions for several frames at once; None where they cannot be compiled."""
    return LaneFunctions.compiled(_energy(name, shape, moving, hinges), robust)


@cache
def _functions(name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, compile: str) -> list[Any]:
    """Its functions one frame at a time, compiled where that is asked for."""
    functions = _energy(name, shape, moving, hinges).functions()
    return compiled(functions) if compile == "auto" else functions
