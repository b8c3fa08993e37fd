"""Two benchmarks of the shipped demo, short: accuracy and speed of the solvers, within wide bounds.

``python -m benchmarks smoke`` (`make bench-smoke`) reconstructs the first six seconds in three ways and
fails where a figure is not finite or outside of its bounds. These catch what is broken; what is a little
worse is for `benchmarks.unchanged` and the harness.
"""

from __future__ import annotations

import sys
from time import perf_counter

from rtof_kin.core.resources import model_path
from rtof_kin.reconstruction.pipeline import reconstruct
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


def main() -> int:
    """Run, print a table, and return the exit status."""
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
