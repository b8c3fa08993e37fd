"""Frames per second of the fragment solver, from SF2 output to blended output, on one core.

``python -m benchmarks.speed``: the demo recording's first 20 s, N = 50, N/2 new frames a solve,
everything counted but the one-time build of the problem (its time is reported beside). Set
OMP_NUM_THREADS=1. Median of several runs; a machine busy with other work shows lower numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

from rtof_kin.fragment import FragmentSolver
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.pipeline import reconstruct
from rtof_kin.recording import Recording
from rtof_kin.resources import model_path
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

SETTINGS: dict[str, FragmentSettings | JointSpaceSettings] = {
    "joint space": JointSpaceSettings(),
    "joint space, interpreted": JointSpaceSettings(compile="never"),
    "joint space, knees and elbows as ball joints": JointSpaceSettings(hinges=False),
    "joint space, sigma given": JointSpaceSettings(sigma_reprojection=8.0),
    "joint space, without limits": JointSpaceSettings(limits=False),
    "cartesian, unconstrained energy as printed": FragmentSettings.paper(),
    "cartesian": FragmentSettings(),
    "cartesian, bone lengths as constraints": FragmentSettings(bone_lengths="constraint"),
}


def measure(
    settings: FragmentSettings | JointSpaceSettings,
    start: PoseSequence,
    keypoints: KeypointSequence,
    imus: BoneImuSequence,
    recording: Recording,
    runs: int,
) -> dict[str, Any]:
    """Build once (with one fragment solved), solve several times."""
    began = perf_counter()
    solver = FragmentSolver(recording.skeleton, 50, settings, imus.joints)
    solver.solve(start[:26], keypoints[:26], imus)
    build = perf_counter() - began
    rates, cpu_rates = [], []
    for _ in range(runs):
        began, cpu = perf_counter(), process_time()
        solution = solver.solve(start, keypoints, imus)
        rates.append(len(start) / (perf_counter() - began))
        cpu_rates.append(len(start) / (process_time() - cpu))
    return {
        "frames_per_second": median(rates),
        "frames_per_cpu_second": median(cpu_rates),
        "iterations_per_fragment": solution.iterations / len(solution.fragments),
        "status": solution.status.name,
        "build_seconds": build,
    }


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--frames", type=int, default=1200, help="of the demo recording")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "speed.json"
    )
    options = parser.parse_args()
    recording = Recording.load(model_path("demo"))
    bone_imus = recording.bone_imus()
    assert bone_imus is not None
    frames = slice(0, options.frames)
    keypoints, imus = recording.keypoints[frames], bone_imus[frames]
    sf2 = reconstruct(recording, mode="sf2").stages["sf2"][frames]
    rows = {}
    print("| settings | frames/s | iterations | status | build s |\n|---|---|---|---|---|")
    for name, settings in SETTINGS.items():
        row = measure(settings, sf2, keypoints, imus, recording, options.runs)
        rows[name] = row
        print(
            f"| {name} | {row['frames_per_second']:.0f} | {row['iterations_per_fragment']:.1f} | "
            f"{row['status']} | {row['build_seconds']:.1f} |",
            flush=True,
        )
    machine = {"processor": platform.processor(), "cores": os.cpu_count(), "N": 50}
    result = {"command": "python -m benchmarks.speed", "machine": machine, "rows": rows}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
