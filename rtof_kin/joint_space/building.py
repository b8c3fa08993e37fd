"""Problems built once: for all bodies, recordings and fragments that they fit."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from rtof_kin.compiled import compiled
from rtof_kin.joint_space.frame_energy import FrameEnergy, Shape
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.prior import shipped_prior
from rtof_kin.joint_space.problem import JointProblem
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.skeleton import SkeletonModel


@lru_cache(maxsize=8)
def built_problem(
    name: str, shape: Shape, moving: tuple[str, ...], frames: int, hinges: bool, compile: str,
    jerk: float, robust_acceleration: float,
) -> tuple[JointProblem, list[Any]]:  # fmt: skip
    """The problem of a fragment, built once for all bodies and recordings that it fits."""
    energy, functions, of_limits = _functions(name, shape, moving, hinges, compile)
    space, prior = energy.space, shipped_prior(SkeletonModel.named(name).names)
    sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
    tangent = np.repeat(sigma, 3) @ (space.expand != 0)
    sigma_jerk = jerk * np.concatenate([np.full(3, prior.sigma_root_jerk), tangent])
    problem = JointProblem(space, functions, energy, frames, sigma_jerk, robust_acceleration)
    return problem, of_limits


@lru_cache(maxsize=8)
def _functions(
    name: str, shape: Shape, moving: tuple[str, ...], hinges: bool, compile: str
) -> tuple[FrameEnergy, list[Any], list[Any]]:
    """A frame's functions and those of its limits, built (and compiled) once for all bodies."""
    space = StateSpace(SkeletonModel.named(name), moving, hinges)
    energy = FrameEnergy(space, shape)
    functions = [*energy.functions(), *Limits(space).functions]
    functions = compiled(functions) if compile == "auto" else functions
    count = len(energy.functions())
    return energy, functions[:count], functions[count:]
