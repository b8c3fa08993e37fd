"""Solvers side by side on the same fragments, start and energy, and how fast the package's own are.

``python -m benchmarks.solvers``: the demo recording, N = 50, from SF2's poses. Every answer is scored by
the package's energy and gradient, whoever found it. Set OMP_NUM_THREADS=1; a machine that is busy with
other work shows longer times. ``--quick`` looks at little of everything, in a minute.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import pickle
import platform
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from benchmarks.peers import (
    Answer,
    CartesianScene,
    Ceres,
    Fragment,
    JointScene,
    Lbfgs,
    Scene,
    ScipyLeastSquares,
    Score,
    Solver,
    Trace,
)
from rtof_kin.cartesian import CartesianSolver
from rtof_kin.fragment import FragmentSolver
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.fragment_solution import SolverStatus
from rtof_kin.joint_space.ipopt import Ipopt
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.pipeline import reconstruct
from rtof_kin.recording import Recording
from rtof_kin.resources import model_path
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

Array = NDArray[np.float64]
Columns = dict[str, tuple[str, Callable[[Any], str]]]
"""Key of a row -> heading, format."""
Told = Callable[[str], None]
"""Called with what begins now."""
N = 50
PAPER_FPS = {20: 1256, 50: 743, 100: 423, 200: 227}
"""The paper's new frames per second by N."""
CERES_CAP, IPOPT_CAP, TIGHT_CAP = 100, 100, 200
"""Iteration caps of Ceres, of IPOPT, and of the real-time solver at its tight tolerance."""
TIGHT, IPOPT_TIGHT = 1e-9, 1e-6
"""Tolerances of the real-time solver and of IPOPT where their answers are compared."""
LEAST_EXCESS, LEAST_SECONDS = 1e-8, 1e-3
"""What lies below is drawn there."""
BASIN_MM = 1.0
"""Largest distance of a joint beyond which two answers count as different minima."""
SETTINGS: dict[str, FragmentSettings | JointSpaceSettings] = {
    "joint space": JointSpaceSettings(),
    "joint space, interpreted": JointSpaceSettings(compile="never"),
    "joint space, knees and elbows as ball joints": JointSpaceSettings(hinges=False),
    "joint space, sigma given": JointSpaceSettings(sigma_reprojection=8.0),
    "joint space, without limits": JointSpaceSettings(limits=False),
    "cartesian, energy as printed, IPOPT": replace(FragmentSettings.paper(), backend="ipopt"),
    "cartesian, energy as printed, real time": replace(
        FragmentSettings.paper(), backend="realtime"
    ),
    "cartesian, IPOPT": FragmentSettings(backend="ipopt"),
    "cartesian, real time": FragmentSettings(backend="realtime"),
    "cartesian, bone lengths as constraints, IPOPT": FragmentSettings(
        bone_lengths="constraint", backend="ipopt"
    ),
}


@dataclass(frozen=True)
class Material:
    """A recording and where solvers start."""

    skeleton: SkeletonModel
    start: PoseSequence
    keypoints: KeypointSequence
    imus: BoneImuSequence

    @classmethod
    def demo(cls) -> Material:
        """The demo recording with SF2's poses."""
        recording = Recording.load(model_path("demo"))
        imus = recording.bone_imus()
        assert imus is not None
        start = reconstruct(recording, mode="sf2").stages["sf2"]
        return cls(recording.skeleton, start, recording.keypoints, imus)

    def __getitem__(self, frames: slice) -> Material:
        return replace(
            self, start=self.start[frames], keypoints=self.keypoints[frames], imus=self.imus[frames]
        )

    def tiled(self, frames: int) -> Material:
        """As many frames, to and fro: no jump in position, the same accelerations."""
        T = len(self.start)
        index = np.arange(frames) % (2 * T)
        index = np.where(index < T, index, 2 * T - 1 - index)
        times = self.start.times[0] + np.arange(frames) / self.start.rate_hz
        start, seen, imus = self.start, self.keypoints, self.imus
        poses = PoseSequence(
            times, start.p_world_joint[index], start.R_world_bone[index], start.names
        )
        return Material(
            self.skeleton,
            poses,
            replace(seen, times=times, uv_px=seen.uv_px[index], confidence=seen.confidence[index]),
            replace(
                imus,
                times=times,
                R_world_bone=imus.R_world_bone[index],
                a_world=imus.a_world[index],
            ),
        )


# --- the package's own solvers, as peers of the peers --------------------------------------------


class Cartesian:
    """The package's Cartesian solver with one of its backends."""

    def __init__(self, scene: CartesianScene, settings: FragmentSettings) -> None:
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
        self, scene: JointScene, kind: type[LevenbergMarquardt] | type[Ipopt], limits: Limits | None,
        tolerance: float, iterations: int,
    ) -> None:  # fmt: skip
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


CARTESIAN_BACKENDS = {
    "IPOPT": replace(FragmentSettings.paper(), backend="ipopt"),
    "real time": replace(FragmentSettings.paper(), backend="realtime"),
}
"""The printed energy's settings for every backend."""


# --- measuring -----------------------------------------------------------------------------------


@dataclass
class Row:
    """One solver's answers to some fragments."""

    solver: str
    limits: bool = False
    firsts: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    energy: list[float] = field(default_factory=list)
    gradient: list[float] = field(default_factory=list)
    violation_deg: list[float] = field(default_factory=list)

    def add(self, fragment: Fragment, answer: Answer, score: Score) -> None:
        """One more fragment."""
        self.firsts.append(fragment.first)
        self.seconds.append(answer.seconds)
        self.iterations.append(answer.iterations)
        self.converged.append(answer.converged)
        for name, value in asdict(score).items():
            getattr(self, name).append(value)


@dataclass(frozen=True)
class Entry:
    """One line of a table: a solver, and whether it takes seconds for a fragment."""

    name: str
    solver: Solver
    slow: bool = False
    limits: bool = False


@dataclass(frozen=True)
class Choice:
    """First frames of the fragments that are looked at."""

    firsts: list[int]
    slow: list[int]
    """Those for slow solvers."""
    typical: int
    """The one whose start has the median energy; its traces are kept."""

    @classmethod
    def of(cls, scene: Scene, effort: Effort, length: int) -> Choice:
        """Fragments evenly over a recording; for slow solvers only ones without padding."""
        firsts = spread(effort.fragments, scene.frames, length)
        whole = [first for first in firsts if 0 <= first <= length - scene.frames] or firsts
        energies = {f.first: scene.score(f, f.x0).energy for f in map(scene.fragment, whole)}
        typical = sorted(whole, key=energies.__getitem__)[len(whole) // 2]
        others = [first for first in whole if first != typical]
        places = np.linspace(0, len(others), effort.slow_fragments + 1)[1:-1].astype(int)
        return cls(firsts, sorted({typical, *(others[i] for i in places if others)}), typical)


def compared(
    scene: Scene, entries: Sequence[Entry], choice: Choice, told: Told
) -> tuple[list[Row], dict[str, Trace]]:
    """Rows of all solvers, and their traces of the typical fragment where they give any."""
    rows, traces = [start_row(scene, choice.firsts)], {}
    for entry in entries:
        row, trace = Row(entry.name, entry.limits), Trace()
        if not entry.slow:
            told(f"{entry.name}: once to warm up")
            entry.solver.solve(scene.fragment(choice.firsts[0]))
        for first in choice.slow if entry.slow else choice.firsts:
            told(f"{entry.name}: frame {first}")
            fragment = scene.fragment(first)
            answer = entry.solver.solve(fragment, trace if first == choice.typical else None)
            row.add(fragment, answer, scene.score(fragment, answer.x, answer.multipliers))
        rows.append(row)
        if trace:
            traces[entry.name] = trace
    return rows, traces


def rising(
    make: Callable[[int], Solver], fragment: Fragment, caps: Sequence[int], runs: int
) -> Trace:
    """A trace of a solver without callbacks: run afresh with rising iteration caps.

    Fewer iterations took at most the time that more did, whatever else the machine was doing.
    """
    seconds, states = [0.0], [fragment.x0]
    for cap in caps:
        solver = make(cap)
        answers = [solver.solve(fragment) for _ in range(runs)]
        seconds.append(min(a.seconds for a in answers))
        states.append(answers[0].x)
        if answers[0].converged:
            break
    at_most = np.minimum.accumulate(seconds[::-1])[::-1]
    return list(zip(at_most.tolist(), states, strict=True))


def curve(scene: Scene, fragment: Fragment, trace: Trace) -> list[tuple[float, float]]:
    """Seconds and the lowest energy up to then, of at most about 150 points of a trace."""
    places = np.unique(np.geomspace(1, len(trace), 150).astype(int)) - 1
    points = [(trace[i][0], scene.score(fragment, trace[i][1]).energy) for i in places]
    lowest = np.minimum.accumulate([energy for _, energy in points])
    return [(seconds, float(low)) for (seconds, _), low in zip(points, lowest, strict=True)]


def best(rows: Sequence[Row]) -> dict[int, float]:
    """Lowest energy of every fragment among some rows."""
    found: dict[int, float] = {}
    for row in rows:
        for first, energy in zip(row.firsts, row.energy, strict=True):
            found[first] = min(energy, found.get(first, np.inf))
    return found


def summary(row: Row, lowest: dict[int, float], new_frames: int) -> dict[str, Any]:
    """Medians over the fragments of a row; of gradients and violations the largest."""
    ratios = [e / lowest[first] for first, e in zip(row.firsts, row.energy, strict=True)]
    seconds = median(row.seconds)
    return {
        "solver": row.solver,
        "limits": row.limits,
        "fragments": len(row.firsts),
        "milliseconds": 1000 * seconds or None,
        "iterations": median(row.iterations),
        "converged": sum(row.converged),
        "energy": median(row.energy),
        "ratio_to_best": median(ratios),
        "largest_ratio": max(ratios),
        "gradient": max(row.gradient),
        "violation_deg": max(row.violation_deg),
        "frames_per_second": new_frames / seconds if seconds else None,
    }


def summaries(rows: Sequence[Row], new_frames: int) -> list[dict[str, Any]]:
    """Of all rows of one table, compared with its lowest energies."""
    lowest = best(rows)
    return [summary(row, lowest, new_frames) for row in rows]


def start_row(scene: Scene, firsts: Sequence[int]) -> Row:
    """The start itself, scored."""
    row = Row("start (SF2)")
    for fragment in map(scene.fragment, firsts):
        row.add(fragment, Answer(fragment.x0, 0.0, 0, False), scene.score(fragment, fragment.x0))
    return row


def spread(count: int, frames: int, length: int) -> list[int]:
    """First frames of so many fragments, evenly over all of a recording."""
    firsts = np.arange(-(frames // 2), length, frames // 2)
    chosen = np.linspace(0, len(firsts) - 1, min(count, len(firsts)))
    return [int(firsts[round(i)]) for i in chosen]


# --- the two energies ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Effort:
    """How much is looked at."""

    fragments: int = 8
    slow_fragments: int = 3
    """By solvers that take seconds for each."""
    agreement_every: int = 1
    """Every how many fragments IPOPT and the real-time solver are compared."""
    lengths: tuple[int, ...] = tuple(PAPER_FPS)
    frames: int = 600
    """Of the recording, for settings and N."""
    runs: int = 3
    patience_s: float = 10.0
    """After which no further run of the same settings begins."""
    tiled_s: tuple[int, ...] = (10, 20, 40)
    long_run: int = 2000
    """Steps that L-BFGS is given at most where it runs on."""
    scipy_cap: int = 60
    """Evaluations that SciPy is given at most."""
    first_compilation: bool = True

    @classmethod
    def quick(cls) -> Effort:
        """Little of everything."""
        return cls(
            fragments=3, slow_fragments=1, agreement_every=30, lengths=(20,), frames=100, runs=1,
            patience_s=0.0, tiled_s=(1, 2), long_run=40, scipy_cap=5, first_compilation=False,
        )  # fmt: skip


def peers(scene: Scene, effort: Effort, scipy_is_slow: bool) -> list[Entry]:
    """The peers on a scene's energy."""
    return [
        Entry("PyTorch L-BFGS, 20 steps", Lbfgs(scene, 20)),
        Entry(f"PyTorch L-BFGS, at most {effort.long_run}", Lbfgs(scene, effort.long_run), slow=True),
        Entry(
            f"SciPy least_squares, at most {effort.scipy_cap}",
            ScipyLeastSquares(scene, effort.scipy_cap), slow=scipy_is_slow,
        ),
        Entry("Ceres", Ceres(scene, CERES_CAP)),
    ]  # fmt: skip


def cartesian(material: Material, effort: Effort, told: Told) -> dict[str, Any]:
    """The printed energy: rows and curves."""
    m = material
    scene = CartesianScene(m.skeleton, N, FragmentSettings.paper(), m.start, m.keypoints, m.imus)
    choice = Choice.of(scene, effort, len(m.start))
    entries = peers(scene, effort, scipy_is_slow=False)
    entries += [Entry(name, Cartesian(scene, s)) for name, s in CARTESIAN_BACKENDS.items()]
    rows, traces = compared(scene, entries, choice, told)
    fragment = scene.fragment(choice.typical)
    for name, settings in CARTESIAN_BACKENDS.items():
        told(f"{name}: energy against time")
        make = partial(_capped, scene, settings)
        traces[name] = rising(make, fragment, range(1, 9), effort.runs)
    return {
        "rows": summaries(rows, N // 2),
        "curves": {name: curve(scene, fragment, trace) for name, trace in traces.items()},
        **_details(entries, choice, rows),
    }


def _capped(scene: CartesianScene, settings: FragmentSettings, iterations: int) -> Cartesian:
    return Cartesian(scene, replace(settings, max_iterations=iterations))


def joint(material: Material, effort: Effort, told: Told) -> dict[str, Any]:
    """The joint-space energy: rows without and with limits, curves, and IPOPT against real time."""
    m = material
    settings = JointSpaceSettings(sigma_reprojection=8.0)
    scene = JointScene(m.skeleton, N, settings, m.start, m.keypoints, m.imus)
    choice = Choice.of(scene, effort, len(m.start))
    entries = peers(scene, effort, scipy_is_slow=True) + own_joint(scene, settings, None)
    free, traces = compared(scene, entries, choice, told)
    limited, _ = compared(scene, own_joint(scene, settings, scene.limits), choice, told)
    fragment = scene.fragment(choice.typical)
    for name, kind, caps, tolerance, runs in (
        ("IPOPT", Ipopt, (1, 2, 4, 8, 16, 32), settings.tolerance, 1),
        ("real time", LevenbergMarquardt, range(1, 13), TIGHT, effort.runs),
    ):
        told(f"{name}: energy against time")
        make = partial(Joint, scene, kind, None, tolerance)
        traces[name] = rising(make, fragment, caps, runs)
    everywhere = spread(10**6, N, len(m.start))[:: effort.agreement_every]
    return {
        "without_limits": summaries(free, N // 2),
        "with_limits": summaries(limited, N // 2),
        "curves": {name: curve(scene, fragment, trace) for name, trace in traces.items()},
        "degrees_of_freedom": {"per_frame": scene.space.size, "per_fragment": N * scene.space.size},
        "agreement": agreement(scene, everywhere, told),
        **_details(entries, choice, [*free, *limited]),
    }


def own_joint(
    scene: JointScene, settings: JointSpaceSettings, limits: Limits | None
) -> list[Entry]:
    """The package's: IPOPT, real time as shipped and to convergence."""
    most, tolerance, kept = (
        settings.annealing + settings.max_iterations,
        settings.tolerance,
        bool(limits),
    )
    real = partial(Joint, scene, LevenbergMarquardt, limits)
    return [
        Entry("IPOPT", Joint(scene, Ipopt, limits, tolerance, IPOPT_CAP), limits=kept),
        Entry("real time", real(tolerance, most), limits=kept),
        Entry(f"real time, tolerance {TIGHT:g}", real(TIGHT, TIGHT_CAP), limits=kept),
    ]


def _details(entries: Sequence[Entry], choice: Choice, rows: Sequence[Row]) -> dict[str, Any]:
    """What the tables do not show."""
    (ceres,) = (e.solver for e in entries if isinstance(e.solver, Ceres))
    return {
        "ceres_share_in_python": median(ceres.shares),
        "typical_first_frame": choice.typical,
        "answers": [asdict(row) for row in rows],
    }


def agreement(scene: JointScene, firsts: Sequence[int], told: Told) -> dict[str, Any]:
    """IPOPT against the real-time solver, with limits, from the same start."""
    tight = Joint(scene, LevenbergMarquardt, scene.limits, TIGHT, TIGHT_CAP)
    ipopt = Joint(scene, Ipopt, scene.limits, IPOPT_TIGHT, IPOPT_CAP)
    both: list[dict[str, Any]] = []
    apart: list[dict[str, Any]] = []
    uncertified: list[dict[str, Any]] = []
    for first in firsts:
        told(f"IPOPT against real time: frame {first}")
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


# --- the package alone ---------------------------------------------------------------------------


def rate(solver: FragmentSolver, material: Material, effort: Effort) -> dict[str, Any]:
    """New frames per second of a whole recording, from SF2's output to blended output; median of runs."""
    rates: list[float] = []
    began, m = perf_counter(), material
    while len(rates) < effort.runs and (not rates or perf_counter() - began < effort.patience_s):
        before = perf_counter()
        solution = solver.solve(m.start, m.keypoints, m.imus)
        rates.append(len(m.start) / (perf_counter() - before))
    return {
        "frames_per_second": median(rates),
        "iterations_per_fragment": solution.iterations / len(solution.fragments),
        "converged": sum(f.status is SolverStatus.CONVERGED for f in solution.fragments),
        "fragments": len(solution.fragments),
    }


def by_settings(material: Material, effort: Effort, told: Told) -> list[dict[str, Any]]:
    """Frames per second of some settings; building the problem, with one fragment, is timed beside."""
    rows, m = [], material[: effort.frames]
    for name, settings in SETTINGS.items():
        told(name)
        began = perf_counter()
        solver = FragmentSolver(m.skeleton, N, settings, m.imus.joints)
        solver.solve(m.start[: N // 2 + 1], m.keypoints[: N // 2 + 1], m.imus)
        build = perf_counter() - began
        rows.append({"settings": name, **rate(solver, m, effort), "build_seconds": build})
    return rows


def by_length(material: Material, effort: Effort, told: Told) -> list[dict[str, Any]]:
    """New frames per second for every N, of both spaces and backends."""
    rows = []
    for frames in effort.lengths:
        row: dict[str, Any] = {"N": frames, "paper": PAPER_FPS[frames]}
        length = max(effort.frames, 2 * frames)
        m = material[:length]
        solvers: dict[str, FragmentSettings | JointSpaceSettings] = {
            f"cartesian, {name}": settings for name, settings in CARTESIAN_BACKENDS.items()
        }
        solvers["joint, real time"] = JointSpaceSettings()
        for name, settings in solvers.items():
            told(f"N = {frames}: {name}")
            solver = FragmentSolver(m.skeleton, frames, settings, m.imus.joints)
            solver.solve(m.start[:frames], m.keypoints[:frames], m.imus)
            row[name] = rate(solver, m, effort)["frames_per_second"]
        told(f"N = {frames}: joint, IPOPT")
        given = JointSpaceSettings(sigma_reprojection=8.0)
        scene = JointScene(m.skeleton, frames, given, m.start, m.keypoints, m.imus)
        ipopt = Joint(scene, Ipopt, scene.limits, given.tolerance, IPOPT_CAP)
        inner = map(scene.fragment, spread(effort.slow_fragments + 2, frames, length)[1:-1])
        row["joint, IPOPT"] = frames / 2 / median(ipopt.solve(f).seconds for f in inner)
        rows.append(row)
    return rows


_BUILD = """
import sys, time, pickle
skeleton, start, keypoints, imus = pickle.load(open(sys.argv[1], "rb"))
from rtof_kin.fragment import FragmentSolver
began = time.perf_counter()
solver = FragmentSolver(skeleton, 50, None, imus.joints)
solver.solve(start, keypoints, imus)
print(time.perf_counter() - began)
"""


def build_times(material: Material, effort: Effort, told: Told) -> dict[str, float]:
    """Seconds until the first fragment of a new process is solved, once everything is imported."""
    out = {}
    with tempfile.TemporaryDirectory() as name:
        path = Path(name, "material.pickle")
        m = material[: N // 2 + 1]
        path.write_bytes(pickle.dumps((m.skeleton, m.start, m.keypoints, m.imus)))
        kinds = {"compiled, from the cache": {}, "interpreted": {"RTOF_KIN_COMPILE": "never"}}
        if effort.first_compilation:
            kinds["compiled for the first time"] = {"RTOF_KIN_CACHE": str(Path(name, "empty"))}
        for kind, change in kinds.items():
            told(f"build: {kind}")
            seconds = []
            for _ in range(1 if "RTOF_KIN_CACHE" in change else effort.runs):
                done = subprocess.run(
                    [sys.executable, "-c", _BUILD, str(path)], env={**os.environ, **change},
                    check=True, capture_output=True, text=True,
                )  # fmt: skip
                seconds.append(float(done.stdout))
            out[kind] = median(seconds)
    return out


def by_duration(material: Material, effort: Effort, told: Told) -> list[dict[str, Any]]:
    """Time and memory of recordings of several lengths, block by block as they stream."""
    solver, rows = FragmentSolver(material.skeleton, N, None, material.imus.joints), []
    rate_hz = material.start.rate_hz
    for seconds in (effort.tiled_s[0], *effort.tiled_s):  # once more than counted, to warm up
        told(f"{seconds} s of recording")
        m = material.tiled(round(seconds * rate_hz))
        gc.collect()
        before, most, began = resident_mb(), 0.0, perf_counter()
        for block in solver.stream(m.start, m.keypoints, m.imus):
            most = max(most, resident_mb() - before)
            del block
        took = perf_counter() - began
        rows.append(
            {"recording_seconds": seconds, "seconds": took, "seconds_per_second": took / seconds,
             "resident_growth_mb": most}
        )  # fmt: skip
    return rows[1:]


def resident_mb() -> float:
    """Memory of this process that is resident now, MB; where that is not told, the most there was."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * resource.getpagesize() / 1e6
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


# --- what is written -----------------------------------------------------------------------------


def table(rows: Sequence[dict[str, Any]], columns: Columns) -> str:
    """Rows as Markdown; a column is key -> (heading, format), and what is missing or NaN is a dash."""
    lines = ["| " + " | ".join(heading for heading, _ in columns.values()) + " |"]
    lines.append("|---" * len(columns) + "|")
    for row in rows:
        cells = []
        for key, (_, shown) in columns.items():
            value = row.get(key)
            missing = value is None or (isinstance(value, float) and np.isnan(value))
            cells.append("-" if missing else shown(value))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def digits(count: int) -> Callable[[Any], str]:
    """A number with so many decimals."""
    return lambda value: f"{value:.{count}f}"


def significant(value: float) -> str:
    """A number with three digits."""
    return f"{value:.3g}"


_COMMON: Columns = {
    "solver": ("solver", str),
    "milliseconds": ("ms a fragment", digits(1)),
    "iterations": ("iterations", digits(0)),
    "energy": ("energy [1]", lambda value: f"{value:.5g}"),
    "ratio_to_best": (
        "to the best",
        lambda value: f"{value:.6f}" if value < 1.1 else f"{value:.2f}",
    ),
    "largest_ratio": ("at worst", lambda value: f"{value:.6f}" if value < 1.1 else f"{value:.2f}"),
    "gradient": ("largest gradient", significant),
}
_RATE: Columns = {
    "frames_per_second": ("new frames/s", significant),
    "fragments": ("fragments", str),
    "converged": ("of them converged", str),
}


def markdown(result: dict[str, Any]) -> str:
    """All tables."""
    c, j, effort = result["cartesian"], result["joint"], result["effort"]
    joint_columns = {**_COMMON, "violation_deg": ("limits violated by deg", digits(2)), **_RATE}
    settings_columns: Columns = {
        "settings": ("settings", str),
        "frames_per_second": ("frames/s", digits(0)),
        "iterations_per_fragment": ("iterations a fragment", digits(1)),
        "converged": ("converged", str),
        "fragments": ("of fragments", str),
        "build_seconds": ("build s", digits(1)),
    }
    lengths = {name: (name, digits(1)) for name in result["by_length"][0]}
    lengths |= {name: (name, str) for name in ("N", "paper")}
    durations: Columns = {
        "recording_seconds": ("recording s", str),
        "seconds": ("solved in s", digits(2)),
        "seconds_per_second": ("s per s", digits(3)),
        "resident_growth_mb": ("resident memory grew by MB", digits(1)),
    }
    builds = [{"how": name, "s": value} for name, value in result["build_seconds"].items()]
    filled = {
        "command": result["command"], "N": N, "threads": result["machine"]["threads"],
        "cartesian": table(c["rows"], {**_COMMON, **_RATE}), "runs": effort["runs"],
        "cartesian_share": 100 * c["ceres_share_in_python"], "frames": effort["frames"],
        "joint_share": 100 * j["ceres_share_in_python"], **j["degrees_of_freedom"],
        "without_limits": table(j["without_limits"], joint_columns),
        "with_limits": table(j["with_limits"], joint_columns),
        "agreement": "\n".join(_agreement_lines(j["agreement"])),
        "by_length": table(result["by_length"], lengths),
        "by_settings": table(result["by_settings"], settings_columns),
        "builds": table(builds, _BUILDS),
        "by_duration": table(result["by_duration"], durations),
    }  # fmt: skip
    return _TEXT.format(**filled)


_TEXT = """# Solvers side by side

`{command}`: demo recording, N = {N}, 8 sensors, from SF2, one core (OMP_NUM_THREADS={threads}).
Medians over fragments, of gradients and violations the largest. Every answer is scored by the package's
own energy and gradient; "to the best" compares it with the lowest energy that a solver of the same table
found for that fragment. Solvers that take seconds were given fewer fragments. `solvers.png` shows one
fragment.

## Cartesian, energy as printed

{cartesian}

Gradient in 1/m. Ceres has a block of parameters a frame and a sparse Cholesky of single entries;
{cartesian_share:.0f} % of its time are residuals and Jacobians called back in Python.

## Joint space, without limits ({per_frame} degrees of freedom a frame, {per_fragment} a fragment)

{without_limits}

Gradient in 1/m and 1/rad. L-BFGS gets the package's value and gradient through an `autograd.Function`,
on tangent coordinates of the start; SciPy and Ceres get whitened residuals with the robust losses in
them, on the same coordinates. {joint_share:.0f} % of Ceres' time are residuals and Jacobians called back
in Python. Real time is the solver as shipped, and once more with a tight tolerance.

## Joint space, with limits

{with_limits}

The gradient is the Lagrangian's. The peers know no limits.

## IPOPT against real time, joint space with limits

{agreement}

## Fragment length

{by_length}

New frames per second, from SF2's output to blended output (joint, IPOPT: of a few solves).
Cartesian: the energy as printed; joint: the default settings (IPOPT: with sigma given).

## Settings

{by_settings}

Median of at most {runs} runs over {frames} frames; build: until the first fragments are solved, in a
process that may have built parts of it for rows above.

## Building the problem

{builds}

In a process of its own, imports apart.

## Length of the recording

{by_duration}

The demo to and fro, streamed block by block.
"""


def _agreement_lines(found: dict[str, Any]) -> list[str]:
    lines = [
        f"Of {found['fragments']} fragments both certify the same minimum in {found['same_minimum']}"
        f" (joints within {BASIN_MM:g} mm): largest relative difference of the energy"
        f" {found['largest_relative_energy_difference'] or 0:.1e}, largest distance of a joint"
        f" {found['largest_distance_mm'] or 0:.4f} mm."
    ]
    for kind, heading in (
        ("different_minima", "Both certify, different minima"),
        ("not_certified_by_both", "Not certified by both"),
    ):
        rows = [
            {
                "first": r["first_frame"], "mm": r["distance_mm"],
                **{f"{s}_{what}": r[s][what] for s in ("real_time", "ipopt")
                   for what in ("energy", "violation_deg")},
                **{f"{s}_ok": "yes" if r[f"{s}_converged"] else "no" for s in ("real_time", "ipopt")},
            }
            for r in found[kind]
        ]  # fmt: skip
        if rows:
            lines += ["", f"{heading}:", "", table(rows, _BASINS)]
    return lines


_BUILDS: Columns = {"how": ("joint space", str), "s": ("s to the first fragment", digits(1))}
_BASINS: Columns = {
    "first": ("first frame", str),
    "real_time_energy": ("real time: energy", digits(4)),
    "ipopt_energy": ("IPOPT: energy", digits(4)),
    "mm": ("apart mm", digits(2)),
    "real_time_violation_deg": ("real time: limits violated by deg", digits(3)),
    "ipopt_violation_deg": ("IPOPT: by deg", digits(3)),
    "real_time_ok": ("real time certifies", str),
    "ipopt_ok": ("IPOPT certifies", str),
}


def figure(result: dict[str, Any], path: Path) -> None:
    """Energy against time of the typical fragment in both spaces."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawn, axes = pyplot.subplots(1, 2, figsize=(13, 5), layout="constrained")
    titles = {"cartesian": "Cartesian, energy as printed", "joint": "joint space, without limits"}
    for axis, (space, title) in zip(axes, titles.items(), strict=True):
        curves = result[space]["curves"]
        lowest = min(energy for points in curves.values() for _, energy in points)
        for name, points in curves.items():
            seconds, energy = np.array(points).T
            above = np.maximum(energy / lowest - 1, LEAST_EXCESS)
            axis.plot(np.maximum(seconds, LEAST_SECONDS), above, marker=".", label=name)
        axis.set(xscale="log", yscale="log", xlabel="time [s]")
        axis.set_ylabel("energy above the lowest found, as a share of it [1]")
        axis.set_title(f"{title}, {N} frames from {result[space]['typical_first_frame']}")
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize="small")
    drawn.savefig(path, dpi=130)
    pyplot.close(drawn)


def everything(effort: Effort, told: Told) -> dict[str, Any]:
    """All that is measured, one thing after the other."""
    material = Material.demo()
    return {
        "cartesian": cartesian(material, effort, told),
        "joint": joint(material, effort, told),
        "by_length": by_length(material, effort, told),
        "by_settings": by_settings(material, effort, told),
        "build_seconds": build_times(material, effort, told),
        "by_duration": by_duration(material, effort, told),
    }


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solvers", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="little of everything")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "solvers.json"
    )
    options = parser.parse_args(arguments)
    effort = Effort.quick() if options.quick else Effort()
    console, threads = Console(stderr=True), os.environ.get("OMP_NUM_THREADS", "not set")
    if threads != "1":
        console.print(f"OMP_NUM_THREADS is {threads}, not 1: times are not those of one core")
    torch.set_num_threads(1)
    began = perf_counter()
    with Progress(console=console) as progress:
        task = progress.add_task("...", total=None)
        measured_ = everything(effort, lambda what: progress.update(task, description=what))
    machine = {
        "processor": platform.processor(), "cores": os.cpu_count(), "threads": threads, "N": N,
        "seconds": perf_counter() - began,
    }  # fmt: skip
    command = "python -m benchmarks.solvers" + (" --quick" if options.quick else "")
    result = {"command": command, "machine": machine, "effort": asdict(effort), **measured_}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    text = markdown(result)
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")
    figure(result, options.out.with_suffix(".png"))
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
