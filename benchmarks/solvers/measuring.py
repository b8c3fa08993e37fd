"""Every solver on the same fragments, scored by the package's own energy and gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

import numpy as np

from benchmarks.peers.fragments import Answer, Fragment, Score, Solver, Trace
from benchmarks.peers.solvers import Scene

PAPER_FPS = {20: 1256, 50: 743, 100: 423, 200: 227}
"""The paper's new frames per second by N."""
Notify = Callable[[str], None]
"""Called with what begins now."""


@dataclass(frozen=True)
class Effort:
    """Numbers of fragments, repeats and frames."""

    fragments: int = 8
    slow_fragments: int = 3
    """Fragments for solvers that take seconds each."""
    agreement_every: int = 1
    """Every how many fragments IPOPT and the real-time solver are compared."""
    lengths: tuple[int, ...] = tuple(PAPER_FPS)
    frames: int = 1500
    """Frames of the recording, for settings and N; the demo has 1436."""
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
            fragments=3,
            slow_fragments=1,
            agreement_every=30,
            lengths=(20,),
            frames=100,
            runs=1,
            patience_s=0.0,
            tiled_s=(1, 2),
            long_run=40,
            scipy_cap=5,
            first_compilation=False,
        )


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
    scene: Scene, entries: Sequence[Entry], choice: Choice, notify: Notify
) -> tuple[list[Row], dict[str, Trace]]:
    """Rows of all solvers, and their traces of the typical fragment where they give any."""
    rows, traces = [_start_row(scene, choice.firsts)], {}
    for entry in entries:
        row, trace = Row(entry.name, entry.limits), Trace()
        if not entry.slow:
            notify(f"{entry.name}: once to warm up")
            entry.solver.solve(scene.fragment(choice.firsts[0]))
        for first in choice.slow if entry.slow else choice.firsts:
            notify(f"{entry.name}: frame {first}")
            fragment = scene.fragment(first)
            answer = entry.solver.solve(fragment, trace if first == choice.typical else None)
            row.add(fragment, answer, scene.score(fragment, answer.x, answer.multipliers))
        rows.append(row)
        if trace:
            traces[entry.name] = trace
    return rows, traces


def rising(make: Callable[[int], Solver], fragment: Fragment, caps: Sequence[int], runs: int) -> Trace:
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


def summaries(rows: Sequence[Row], new_frames: int) -> list[dict[str, Any]]:
    """Summaries of the rows of a table, relative to its lowest energies."""
    lowest: dict[int, float] = {}
    for row in rows:
        for first, energy in zip(row.firsts, row.energy, strict=True):
            lowest[first] = min(energy, lowest.get(first, np.inf))
    return [_summary(row, lowest, new_frames) for row in rows]


def _summary(row: Row, lowest: dict[int, float], new_frames: int) -> dict[str, Any]:
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


def _start_row(scene: Scene, firsts: Sequence[int]) -> Row:
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
