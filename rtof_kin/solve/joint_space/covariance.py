"""Covariances of a fragment's states, and of the poses that follow from them.

At the optimum the Gauss-Newton Hessian is the inverse covariance of all states of the fragment, as far as the weights
are right. Only the diagonal blocks of its inverse are computed, the marginal covariance of each frame. Robust losses
count with their weight at the optimum, and an active limit holds its angle to a degree.

Covariance of unseen joints, by the pose prior. The Hessian takes the frames of a gap as independent draws
from the prior, coupled by the jerk: over seconds it knows an unseen leg better than any frame of it. People do not:
where nothing that a joint moves is seen, its angles return from the last observed ones to the prior's as those of free
motion do,

::

    variance = (1 - exp(-(t / TIME)^2)) P

with the time t to the nearest frame in which it was seen, and P the prior's covariance given the joints that are seen.
Neither constant was fitted. Of errors of legs and arms unseen for 2 and 5 s without sensors, 93 to 100 % lay in their
95 % bands on people outside of the fits in everyday motion (66 to 99 % by the Hessian alone), and 87 to 91 % in
exercises (61 to 80 %).
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from typing import Any, Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.c_compiler import BUILDING
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.core.numerics.simd import FrameFunction, Mapped, compile_simd
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.solve.joint_space.fragment import FragmentEnergy, made_of
from rtof_kin.solve.joint_space.layout import LAGS
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import StateSpace

_DAMPING: Final = 1e-6  #: Added to the Hessian's diagonal: an unobserved root gets a sigma of 1 km
_NOWHERE: Final = 3.0  #: [m] Standard deviation above which a position counts as unknown


def state_covariances(problem: FragmentEnergy, solver: LevenbergMarquardt, solved: Solved) -> Array:
    """Return the covariances (N, D, D) of the states' tangents; NaN where the Hessian is singular."""
    N, D = len(solved.x), problem.space.size
    solver.linearise(solved.x, solved.multipliers)
    try:
        factor = problem.factorise(_DAMPING)
    except SolverError:
        return np.full((N, D, D), np.nan)
    covariance = factor.inverse_diagonal(D, LAGS)
    covariance[~np.isfinite(covariance.sum(axis=(1, 2)))] = np.nan
    return covariance


def blended(earlier: Array, later: Array, share: Array) -> Array:
    """Return the covariances of states blended from two fragments; where one is NaN, the other's.

    The weighted mean is an upper bound for errors that are correlated in any way.

    Args:
        earlier, later: (T, D, D). share: (T,) weight of the later one in the blend.
    """
    mean = (later - earlier) * share[:, None, None] + earlier
    for one, other in ((earlier, later), (later, earlier)):
        lost = np.isnan(one[:, 0, 0])
        mean[lost] = other[lost]
    return np.asarray(mean)


def segment_pairs(skeleton: SkeletonModel) -> tuple[tuple[str, str], ...]:
    """Return the pairs of segments of a `Confidence`: each with the world, with its parent, and with the nearest
    ancestor that usually carries a sensor (upper arm with trunk, trunk with pelvis).
    """
    names, parents = skeleton.names, skeleton.parents
    carriers = {joint for joint, _ in skeleton.sensors.values()}
    pairs = [(WORLD, name) for name in names]
    pairs += [(names[parent], name) for name, parent in zip(names, parents, strict=True) if parent >= 0]
    for j in sorted(skeleton.index(*carriers)):
        above = [names[i] for i in kinematics.line_to_root(parents, j)[1:] if names[i] in carriers]
        pairs += [(above[0], names[j])] if above else []
    return tuple(dict.fromkeys(pairs))


@cache
def _covariances(
    name: str, moving: tuple[str, ...], hinged: bool, pairs: tuple[tuple[str, str], ...]
) -> tuple[FrameFunction, Any]:
    """Return the function of `Frame.covariances` and its compiled code, None where there is none."""
    space = StateSpace(SkeletonModel.named(name), moving, hinged)

    def build() -> tuple[list[FrameFunction], None]:
        from rtof_kin.solve.joint_space.energy import Frame

        names = [WORLD, *space.skeleton.names]  # WORLD becomes -1
        at = [(names.index(parent) - 1, names.index(child) - 1) for parent, child in pairs]
        return [FrameFunction.of(Frame(space, ()).covariances(at), (1,))], None

    with BUILDING:
        found = compile_simd(build, f"{made_of(space, ())} {pairs}")
        return (found.functions["covariances"], found.code["covariances"]) if found else (build()[0][0], None)


def confidence_of(
    space: StateSpace, times: Array, x: Array, covariance: Array, fixed: Collection[str] = ()
) -> Confidence:
    """Return the covariances of positions and orientations from those of tangents (T, D, D) at states x (T, 3 + 4A)."""
    T, names, pairs = len(x), space.skeleton.names, segment_pairs(space.skeleton)
    function, code = _covariances(space.skeleton.name, space.names, bool((space.hinge_axis >= 0).any()), pairs)
    (entries,) = Mapped(code, function, T)(x, space.skeleton.joint_offsets.ravel(), covariance.reshape(T, -1))
    entries[np.isnan(covariance[:, 0, 0])] = np.nan  # zeros, too
    positions, relative, turned = np.split(entries.reshape(T, -1, 3, 3), [len(names), 2 * len(names)], axis=1)
    positions[np.trace(positions, axis1=2, axis2=3) > 3 * _NOWHERE**2] = np.nan
    turned[:, [child not in space.names or child in fixed for _, child in pairs]] = np.nan  # turned with the parent
    return Confidence(times, names, positions, relative, pairs, turned)


SPREAD: Final = 1.0  #: [1] Factor on the standard deviations of the solver's prior
TIME: Final = 0.5  #: [s] In which the angles of an unseen joint forget the observed ones


def unseen_times(data: Observations) -> Array:
    """Return the time (T, A), s, to the nearest frame in which a landmark or a sensor is seen that the joint moves; inf
    where there is none in the recording. The root counts as seen.
    """
    space, joints, parents = data.space, data.skeleton.names, data.skeleton.parents
    seen = np.concatenate([data.confidence > 0, data.rows["w_sensor"] > 0], axis=1)
    lines = [kinematics.line_to_root(parents, j)[at_joint:] for j, at_joint in data.points.on]
    lines += [kinematics.line_to_root(parents, joints.index(name)) for name in data.sensors]
    out = np.zeros((len(seen), len(space.joints)))
    frames = np.arange(len(seen))
    for a, joint in enumerate(space.joints[1:], start=1):
        known = np.flatnonzero(seen[:, [joint in line for line in lines]].any(axis=1))
        before, after = np.searchsorted(known, frames, "right"), np.searchsorted(known, frames) + 1
        ends = np.concatenate([[-np.inf], known, [np.inf]])
        out[:, a] = np.minimum(frames - ends[before], ends[after] - frames)
    return out / data.rate_hz


def unseen_covariance(data: Observations, times: Array) -> Array:
    """Return the covariances (T, D, D) of the states' tangents in frames of `unseen_times`; 0 where all is seen."""
    space = data.space
    owner = np.repeat(np.arange(len(space.joints)), np.where(space.hinge_axis < 0, 3, 1))[3:]
    precision = space.expand[3:, 3:].T @ data.constant["precision"] @ space.expand[3:, 3:]
    share = np.sqrt(-np.expm1(-((times[:, owner] / TIME) ** 2)))
    hidden = share > 0
    out = np.zeros((len(times), space.size, space.size))
    patterns, which = np.unique(hidden, axis=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        frames, columns = np.flatnonzero(which.ravel() == i), np.flatnonzero(pattern)
        if len(columns):
            own = SPREAD**2 * np.linalg.inv(precision[np.ix_(columns, columns)])
            scale = share[np.ix_(frames, columns)]
            at = 6 + columns
            out[np.ix_(frames, at, at)] = scale[:, :, None] * own * scale[:, None, :]
    return out
