"""The package's solvers and the peers on both energies, and IPOPT against the real-time solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.peers.cartesian import CartesianScene
from benchmarks.peers.fragments import Answer, Fragment, Material, Trace
from benchmarks.peers.ipopt import Ipopt
from benchmarks.peers.joint_space import JointScene
from benchmarks.peers.solvers import Ceres, Lbfgs, Scene, ScipyLeastSquares
from benchmarks.solvers.measuring import Choice, Effort, Entry, Notify, Row, compared, curve, rising, spread, summaries
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.cartesian.solver import CartesianSolver
from rtof_kin.solve.joint_space.state import Limits
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.solution import SolverStatus

N = 50
CERES_CAP, IPOPT_CAP, TIGHT_CAP = 100, 200, 200
"""Iteration caps of Ceres, of IPOPT, and of the real-time solver at its tight tolerance."""
TIGHT, IPOPT_TIGHT = 1e-9, 1e-8
"""Tolerances of the real-time solver and of IPOPT where their answers are compared: either leaves about
1e-9 of the energy. Everywhere else they are those of the settings."""
BASIN_MM = 1.0
"""Largest distance of a joint beyond which two answers count as different minima."""
JOINT_SETTINGS = JointSpaceSettings(sigma_reprojection=8.0)
"""The peers do not estimate sigma."""


class Cartesian:
    """The package's Cartesian solver, its own or IPOPT."""

    def __init__(self, scene: CartesianScene, settings: CartesianSettings) -> None:
        """Build the same problem with other settings of the solver alone."""
        self.scene = scene
        own = scene.solver
        self._solver = CartesianSolver(own.skeleton, own.frames, settings, own.sensor_joints)

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; there is no trace."""
        scene = self.scene
        X, report = self._solver._solve_fragment(fragment.first, scene.start, scene.observations)
        converged = report.status is SolverStatus.CONVERGED
        return Answer(X.reshape(len(X), -1), report.seconds, report.iterations, converged)


class Joint:
    """The real-time solver or IPOPT on the joint-space problem, with limits or without."""

    def __init__(
        self,
        scene: JointScene,
        kind: type[LevenbergMarquardt] | type[Ipopt],
        limits: Limits | None,
        tolerance: float,
        iterations: int,
    ) -> None:
        self.scene, self._solver = scene, kind(scene.problem, limits)
        self._iterations, self._tolerance = iterations, tolerance

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer:
        """Minimise from the start; there is no trace."""
        began = perf_counter()
        self.scene.problem.bind(fragment.data)
        solved = self._solver.solve(fragment.x0, self._iterations, self._tolerance)
        seconds = perf_counter() - began
        multipliers = solved.multipliers if solved.multipliers.size else None
        return Answer(solved.x, seconds, solved.iterations, solved.converged, multipliers)


def peers(scene: Scene, effort: Effort, scipy_is_slow: bool) -> list[Entry]:
    """The peers on a scene's energy."""
    return [
        Entry("PyTorch L-BFGS, 20 steps", Lbfgs(scene, 20)),
        Entry(f"PyTorch L-BFGS, at most {effort.long_run}", Lbfgs(scene, effort.long_run), slow=True),
        Entry(
            f"SciPy least_squares, at most {effort.scipy_cap}",
            ScipyLeastSquares(scene, effort.scipy_cap),
            slow=scipy_is_slow,
        ),
        Entry("Ceres", Ceres(scene, CERES_CAP)),
    ]


def cartesian(material: Material, effort: Effort, notify: Notify) -> dict[str, Any]:
    """The printed energy: rows and curves."""
    scene = CartesianScene(material, N, CartesianSettings.paper())
    choice = Choice.of(scene, effort, len(material.start))
    entries = peers(scene, effort, scipy_is_slow=False)
    own = {"IPOPT": replace(scene.settings, ipopt=True), "real time": scene.settings}
    entries += [Entry(name, Cartesian(scene, settings)) for name, settings in own.items()]
    rows, traces = compared(scene, entries, choice, notify)
    fragment = scene.fragment(choice.typical)
    for name, settings in own.items():
        notify(f"{name}: energy against time")

        def capped(iterations: int, settings: CartesianSettings = settings) -> Cartesian:
            return Cartesian(scene, replace(settings, max_iterations=iterations))

        traces[name] = rising(capped, fragment, range(1, 9), effort.runs)
    return {
        "rows": summaries(rows, N // 2),
        "curves": {name: curve(scene, fragment, trace) for name, trace in traces.items()},
        **_details(entries, choice, rows),
    }


def joint(material: Material, effort: Effort, notify: Notify) -> dict[str, Any]:
    """The joint-space energy: rows without and with limits, curves, and IPOPT against real time."""
    scene = JointScene(material, N, JOINT_SETTINGS)
    choice = Choice.of(scene, effort, len(material.start))
    entries = peers(scene, effort, scipy_is_slow=True) + own_joint(scene, None)
    free, traces = compared(scene, entries, choice, notify)
    limited, _ = compared(scene, own_joint(scene, scene.limits), choice, notify)
    fragment = scene.fragment(choice.typical)
    for name, kind, caps, tolerance, runs in (
        ("IPOPT", Ipopt, (1, 2, 4, 8, 16, 32), JOINT_SETTINGS.tolerance, 1),
        ("real time", LevenbergMarquardt, range(1, 13), TIGHT, effort.runs),
    ):
        notify(f"{name}: energy against time")
        make = partial(Joint, scene, kind, None, tolerance)
        traces[name] = rising(make, fragment, caps, runs)
    everywhere = spread(10**6, N, len(material.start))[:: effort.agreement_every]
    return {
        "without_limits": summaries(free, N // 2),
        "with_limits": summaries(limited, N // 2),
        "curves": {name: curve(scene, fragment, trace) for name, trace in traces.items()},
        "degrees_of_freedom": {"per_frame": scene.space.size, "per_fragment": N * scene.space.size},
        "agreement": agreement(scene, everywhere, notify),
        **_details(entries, choice, [*free, *limited]),
    }


def own_joint(scene: JointScene, limits: Limits | None) -> list[Entry]:
    """The package's: IPOPT, real time as shipped and to convergence."""
    s, kept = scene.settings, limits is not None
    real = partial(Joint, scene, LevenbergMarquardt, limits)
    return [
        Entry("IPOPT", Joint(scene, Ipopt, limits, s.tolerance, IPOPT_CAP), limits=kept),
        Entry("real time", real(s.tolerance, s.annealing + s.max_iterations), limits=kept),
        Entry(f"real time, tolerance {TIGHT:g}", real(TIGHT, TIGHT_CAP), limits=kept),
    ]


def _details(entries: Sequence[Entry], choice: Choice, rows: Sequence[Row]) -> dict[str, Any]:
    """Results that the tables do not show."""
    (ceres,) = (e.solver for e in entries if isinstance(e.solver, Ceres))
    return {
        "ceres_share_in_python": median(ceres.shares),
        "typical_first_frame": choice.typical,
        "answers": [asdict(row) for row in rows],
    }


def agreement(scene: JointScene, firsts: Sequence[int], notify: Notify) -> dict[str, Any]:
    """IPOPT against the real-time solver, with limits, from the same start."""
    tight = Joint(scene, LevenbergMarquardt, scene.limits, TIGHT, TIGHT_CAP)
    ipopt = Joint(scene, Ipopt, scene.limits, IPOPT_TIGHT, IPOPT_CAP)
    both: list[dict[str, Any]] = []
    apart: list[dict[str, Any]] = []
    uncertified: list[dict[str, Any]] = []
    for first in firsts:
        notify(f"IPOPT against real time: frame {first}")
        fragment = scene.fragment(first)
        answers = {"real_time": tight.solve(fragment), "ipopt": ipopt.solve(fragment)}
        scores = {name: scene.score(fragment, a.x, a.multipliers) for name, a in answers.items()}
        p = [scene.positions(a.x) for a in answers.values()]
        mm = 1000 * float(np.linalg.norm(p[0] - p[1], axis=-1).max())
        row: dict[str, Any] = {"first_frame": first, "distance_mm": mm}
        row |= {name: asdict(score) for name, score in scores.items()}
        row |= {f"{name}_converged": a.converged for name, a in answers.items()}
        if not all(a.converged for a in answers.values()):
            uncertified.append(row)
        else:
            (apart if mm > BASIN_MM else both).append(row)
    differences = [abs(r["real_time"]["energy"] / r["ipopt"]["energy"] - 1) for r in both]
    return {
        "fragments": len(firsts),
        "same_minimum": len(both),
        "largest_relative_energy_difference": max(differences, default=None),
        "largest_distance_mm": max((r["distance_mm"] for r in both), default=None),
        "different_minima": apart,
        "not_certified_by_both": uncertified,
    }
