"""Speed of the package's solvers by settings, fragment length and recording length."""

from __future__ import annotations

import gc
import os
import pickle
import resource
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from benchmarks.peers.fragments import Material
from benchmarks.peers.ipopt import Ipopt
from benchmarks.peers.joint_space import JointScene
from benchmarks.solvers.measuring import PAPER_FPS, Effort, Notify, spread
from benchmarks.solvers.side_by_side import IPOPT_CAP, JOINT_SETTINGS, Joint, N
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.solution import SolverStatus

SETTINGS: dict[str, CartesianSettings | JointSpaceSettings] = {
    "joint space": JointSpaceSettings(),
    "joint space, interpreted": JointSpaceSettings(compile="never"),
    "joint space, knees and elbows as ball joints": JointSpaceSettings(hinges=False),
    "joint space, sigma given": JOINT_SETTINGS,
    "joint space, without limits": JointSpaceSettings(limits=False),
    "cartesian, energy as printed": CartesianSettings.paper(),
    "cartesian, energy as printed, IPOPT": replace(CartesianSettings.paper(), ipopt=True),
    "cartesian": CartesianSettings(),
    "cartesian, IPOPT": CartesianSettings(ipopt=True),
}


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
        "median_gradient": median(f.optimality for f in solution.fragments),
        "largest_gradient": max(f.optimality for f in solution.fragments),
    }


def by_settings(material: Material, effort: Effort, notify: Notify) -> list[dict[str, Any]]:
    """Frames per second of some settings; building the problem, with one fragment, is timed beside."""
    rows, m = [], material[: effort.frames]
    for name, settings in SETTINGS.items():
        notify(name)
        began = perf_counter()
        solver = FragmentSolver(m.skeleton, N, settings, m.imus.joints)
        solver.solve(m.start[: N // 2 + 1], m.keypoints[: N // 2 + 1], m.imus)
        build = perf_counter() - began
        rows.append({"settings": name, **rate(solver, m, effort), "build_seconds": build})
    return rows


def by_length(material: Material, effort: Effort, notify: Notify) -> list[dict[str, Any]]:
    """New frames per second for every N, of both spaces."""
    rows = []
    for frames in effort.lengths:
        row: dict[str, Any] = {"N": frames, "paper": PAPER_FPS[frames]}
        length = max(effort.frames, 2 * frames)
        m = material[:length]
        solvers: dict[str, CartesianSettings | JointSpaceSettings] = {
            "cartesian": CartesianSettings.paper(),
            "cartesian, IPOPT": replace(CartesianSettings.paper(), ipopt=True),
            "joint, real time": JointSpaceSettings(),
        }
        for name, settings in solvers.items():
            notify(f"N = {frames}: {name}")
            solver = FragmentSolver(m.skeleton, frames, settings, m.imus.joints)
            solver.solve(m.start[:frames], m.keypoints[:frames], m.imus)
            row[name] = rate(solver, m, effort)["frames_per_second"]
        notify(f"N = {frames}: joint, IPOPT")
        scene = JointScene(m, frames, JOINT_SETTINGS)
        ipopt = Joint(scene, Ipopt, scene.limits, JOINT_SETTINGS.tolerance, IPOPT_CAP)
        inner = map(scene.fragment, spread(effort.slow_fragments + 2, frames, length)[1:-1])
        row["joint, IPOPT"] = frames / 2 / median(ipopt.solve(f).seconds for f in inner)
        rows.append(row)
    return rows


def by_sensors(material: Material, effort: Effort, notify: Notify) -> list[dict[str, Any]]:
    """Time of a new frame with none to all of the sensors, those of the recording in their order."""
    rows, m = [], material[: effort.frames]
    for count in range(0, len(m.imus.joints) + 1, 2):
        notify(f"{count} sensors")
        worn = replace(m, imus=m.imus.select(m.imus.joints[:count]))
        solver = FragmentSolver(m.skeleton, N, None, worn.imus.joints)
        solver.solve(m.start[: N // 2 + 1], m.keypoints[: N // 2 + 1], worn.imus)  # builds and compiles
        found = rate(solver, worn, effort)
        kept = ("frames_per_second", "iterations_per_fragment", "converged", "fragments")
        rows.append({"sensors": count, "us": 1e6 / found["frames_per_second"], **{name: found[name] for name in kept}})
    return rows


_BUILD = """
import sys, time, pickle
skeleton, start, keypoints, imus = pickle.load(open(sys.argv[1], "rb"))
from rtof_kin.solve.fragment_solver import FragmentSolver
began = time.perf_counter()
solver = FragmentSolver(skeleton, 50, None, imus.joints)
solver.solve(start, keypoints, imus)
print(time.perf_counter() - began)
"""


def build_times(material: Material, effort: Effort, notify: Notify) -> dict[str, float]:
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
            notify(f"build: {kind}")
            seconds = []
            for _ in range(1 if "RTOF_KIN_CACHE" in change else effort.runs):
                done = subprocess.run(
                    [sys.executable, "-c", _BUILD, str(path)],
                    env={**os.environ, **change},
                    check=True,
                    capture_output=True,
                    text=True,
                )
                seconds.append(float(done.stdout))
            out[kind] = median(seconds)
    return out


def by_duration(material: Material, effort: Effort, notify: Notify) -> list[dict[str, Any]]:
    """Time and memory of recordings of several lengths, block by block as they stream."""
    solver, rows = FragmentSolver(material.skeleton, N, None, material.imus.joints), []
    rate_hz = material.start.rate_hz
    for seconds in (effort.tiled_s[0], *effort.tiled_s):  # once more than counted, to warm up
        notify(f"{seconds} s of recording")
        m = material.tiled(round(seconds * rate_hz))
        gc.collect()
        before, most, began = resident_mb(), 0.0, perf_counter()
        guess, imus = solver._guess(m.start, m.keypoints, m.imus, None)
        for block in solver._solver.run(guess, m.keypoints, imus, None, None):
            most = max(most, resident_mb() - before)
            del block
        took = perf_counter() - began
        rows.append(
            {
                "recording_seconds": seconds,
                "seconds": took,
                "seconds_per_second": took / seconds,
                "resident_growth_mb": most,
            }
        )
    return rows[1:]


def resident_mb() -> float:
    """Resident memory of this process, MB; its maximum where the current value is not available."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * resource.getpagesize() / 1e6
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
