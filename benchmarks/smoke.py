"""Benchmarks of the shipped demo, short: accuracy and speed of the solvers, within wide bounds, and a slowdown.

``python -m benchmarks smoke`` (`make bench-smoke`) reconstructs the first six seconds in three ways and
fails where a figure is not finite or outside of its bounds. These catch what is broken; what is a little
worse is for `benchmarks.unchanged` and the harness. ``--slowdown`` (`make test`) instead measures solving, covariances
and lifting of the demo's first eight seconds, and the whole command, in units of a matrix product of NumPy on the same
machine, and fails where one has become slower by 30 % on a kind of processor that `UNITS` knows, or by twice on
another, in two attempts.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time

import numpy as np

from rtof_kin.core.environment import processor
from rtof_kin.core.resources import model_path
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.settings import CartesianSettings
from rtof_kin.solve.solution import SolverStatus

SECONDS = 6.0
CASES = {
    "rtof, joint": ("rtof", ReconstructionSettings()),
    "rto, joint": ("rto", ReconstructionSettings()),
    "rtof, Cartesian": ("rtof", ReconstructionSettings(fragment=CartesianSettings())),
}
BOUNDS = {
    "mpjpe_rr_mm": (5.0, 120.0),
    "mpjpe_mm": (10.0, 400.0),
    "converged": (0.5, 1.0),
    "frames_per_second": (5.0, 1e5),
}
"""Figure -> lower and upper bound: errors of joints relative to the root and in world, share of fragments
solved to the tolerance, frames per second of the solver alone. An error below its bound is as wrong as one
above."""


def figures(recording: Recording, mode: str, settings: ReconstructionSettings) -> dict[str, float]:
    """Figures of one reconstruction by name, as in `BOUNDS`."""
    result = reconstruct(recording, mode=mode, settings=settings)  # type: ignore[arg-type]
    assert result.metrics is not None
    assert result.solution is not None
    solution = result.solution
    return {
        "mpjpe_rr_mm": result.metrics["mpjpe_rr_mm"],
        "mpjpe_mm": result.metrics["mpjpe_mm"],
        "converged": solution.count(SolverStatus.CONVERGED) / len(solution.fragments),
        "frames_per_second": len(result.motion.q) / sum(f.seconds for f in solution.fragments),
    }


def wrong(found: dict[str, float]) -> list[str]:
    """What is not a number between its bounds, in words."""
    return [
        f"{name} is {found[name]:g}, not between {low:g} and {high:g}"
        for name, (low, high) in BOUNDS.items()
        if not low <= found[name] <= high  # not a number is not either
    ]


def _spent() -> float:
    """Seconds of the processor in this process and those that it waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime


UNITS = {
    "AMD EPYC, instructions 25fc08b1": {"solve": 22.0, "covariances": 22.0, "lift": 27.5, "command": 560.0},
    "Intel(R) Xeon(R) Processor, instructions fc7df03f": {
        "solve": 43.0,
        "covariances": 21.0,
        "lift": 35.0,
        "command": 640.0,
    },
}
"""Kind of processor -> what each takes there, in matrix products of 512 x 512 numbers."""
SLOWER, ELSEWHERE, REPEATS = 1.3, 2.0, 8


def slowdown() -> list[str]:
    """Print what parts and the whole of a reconstruction take beside the same before, and return what is too slow.

    The least time of several rounds counts, in which all follow one another, so that other programs disturb all alike;
    of covariances, a difference of two times, the median.
    """
    recording, place = Recording.load(model_path("demo")).between(0.0, 8.0), TemporaryDirectory()
    recording.save(short := Path(place.name) / "short")
    program = [sys.executable, "-c", "import sys; from rtof_kin.cli import main; sys.exit(main())", "reconstruct"]
    command = [*program, str(short), "-o", str(Path(place.name) / "out"), "--overwrite"]
    job = Job.of(recording, None, None, None, None).with_solver(None)
    prepared = job.prepare("rtof")
    matrix = np.random.default_rng(0).normal(size=(512, 512))
    work: dict[str, Callable[[], object]] = {
        "product": lambda: [matrix @ matrix for _ in range(10)],
        "solve": lambda: job.solve(prepared, confidence=False),
        "both": lambda: job.solve(prepared, confidence=True),
        "lift": lambda: lift(prepared.recording.video, prepared.skeleton, None, prepared.bone_imus, None),
        "command": lambda: subprocess.run(command, check=True, capture_output=True),
    }
    spent: dict[str, list[float]] = {name: [] for name in work}
    with place:
        for number in range(REPEATS):
            for name, do in work.items():
                if name != "command" or number < REPEATS // 2:
                    began = _spent()
                    do()
                    spent[name].append(_spent() - began)
    both = spent.pop("both")
    least = {name: min(seconds) for name, seconds in spent.items()}
    least["covariances"] = float(np.median(np.subtract(both, spent["solve"])))
    unit, known = least.pop("product") / 10, UNITS.get(processor())
    slowest = {name: max(one[name] for one in UNITS.values()) for name in least}
    before, allowed = (known, SLOWER) if known else (slowest, ELSEWHERE)
    print(f"{processor()}, {'known' if known else 'not known'}: in products of {1000 * unit:.2f} ms")
    for name, seconds in least.items():
        print(f"{name:16} {seconds / unit:8.1f}, before {before[name]:8.1f}")
    slow = (name for name, seconds in least.items() if seconds / unit > allowed * before[name])
    return [f"{name} is slower than before by more than {100 * (allowed - 1):.0f} %" for name in slow]


def main() -> int:
    """Run, print a table, and return the exit status."""
    if "--slowdown" in sys.argv:
        faults = slowdown() and slowdown()  # a slowdown stays, a disturbance passes
        print(*faults, sep="\n")
        return 1 if faults else 0
    recording = Recording.load(model_path("demo"))
    recording, faults, began = recording.between(0.0, SECONDS), [], perf_counter()
    for case, (mode, settings) in CASES.items():
        found = figures(recording, mode, settings)
        faults += [f"{case}: {fault}" for fault in wrong(found)]
        print(f"{case:16}" + "".join(f"  {name} {value:8.2f}" for name, value in found.items()))
    print(f"{perf_counter() - began:.0f} s", *faults, sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
