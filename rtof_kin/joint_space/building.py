"""Problems built once: for all bodies, recordings and fragments that they fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from rtof_kin.banded import Store
from rtof_kin.compiled import compiled
from rtof_kin.joint_space.frame_energy import FrameEnergy, Shape
from rtof_kin.joint_space.lane_problem import LaneFunctions, LaneProblem
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.prior import shipped_prior
from rtof_kin.joint_space.problem import JointProblem
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.skeleton import SkeletonModel


@dataclass(frozen=True)
class Built:
    """A problem, and what `Limits` of its states take."""

    problem: JointProblem
    functions: list[Any]
    code: Mapping[str, Any] | None = None

    def limits(self, space: StateSpace) -> Limits:
        """Limits of a body of the same kind."""
        return Limits(space, self.functions, self.code)


@lru_cache(maxsize=8)
def built_problem(
    name: str, shape: Shape, moving: tuple[str, ...], frames: int, hinges: bool, compile: str,
    jerk: tuple[float, ...], robust_acceleration: float,
) -> Built:  # fmt: skip
    """The problem of a fragment, built once for all bodies and recordings that it fits.

    Args:
        jerk: factors on the jerk of free motion, of the root's position and of every joint that moves.
    """
    energy, limits = _energy(name, shape, moving, hinges)
    space, prior = energy.space, shipped_prior(SkeletonModel.named(name).names)
    sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
    root, *turns = jerk
    tangent = np.repeat(sigma * turns, 3) @ (space.expand != 0)
    sigma_jerk = np.concatenate([np.full(3, root * prior.sigma_root_jerk), tangent])
    if compile == "auto" and not shape.unknowns and Store.available():
        lanes = _lanes(name, shape, moving, hinges, robust_acceleration)
        if lanes is not None:
            problem = LaneProblem(lanes, energy, frames, sigma_jerk)
            return Built(problem, limits.functions, lanes.code)
        compile = "never"
    functions, of_limits = _functions(name, shape, moving, hinges, compile)
    plain = JointProblem(space, functions, energy, frames, sigma_jerk, robust_acceleration)
    return Built(plain, of_limits)


@lru_cache(maxsize=8)
def _energy(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool
) -> tuple[FrameEnergy, Limits]:
    """A frame's energy and limits, built once for all bodies."""
    space = StateSpace(SkeletonModel.named(name), moving, hinges)
    return FrameEnergy(space, shape), Limits(space)


@lru_cache(maxsize=8)
def _lanes(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, robust: float
) -> LaneFunctions | None:
    """Their functions for several frames at once; None where they cannot be compiled."""
    energy, limits = _energy(name, shape, moving, hinges)
    return LaneFunctions.compiled(energy, robust, limits.for_lanes())


@lru_cache(maxsize=8)
def _functions(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, compile: str
) -> tuple[list[Any], list[Any]]:
    """Their functions one frame at a time, compiled where that is asked for."""
    energy, limits = _energy(name, shape, moving, hinges)
    functions = [*energy.functions(), *limits.functions]
    functions = compiled(functions) if compile == "auto" else functions
    count = len(energy.functions())
    return functions[:count], functions[count:]
