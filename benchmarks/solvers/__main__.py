"""Solvers side by side on the same fragments, start and energy, and how fast the package's own are.

``python -m benchmarks solvers``: the demo recording, N = 50, from SF2's poses. Every answer is scored by
the package's energy and gradient, whoever found it. Set OMP_NUM_THREADS=1; a machine that is busy with
other work shows longer times. ``--quick`` looks at little of everything, in a minute.
"""

from __future__ import annotations

import os
from dataclasses import asdict
from time import perf_counter
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import study_parser
from benchmarks.harness import write_results
from benchmarks.peers.fragments import Material
from benchmarks.solvers.alone import build_times, by_duration, by_length, by_sensors, by_settings
from benchmarks.solvers.measuring import Effort, Notify
from benchmarks.solvers.report import figure, markdown
from benchmarks.solvers.side_by_side import N, cartesian, joint
from rtof_kin.core.environment import processor


def everything(effort: Effort, notify: Notify) -> dict[str, Any]:
    """All that is measured, one thing after the other."""
    material = Material.demo()
    return {
        "cartesian": cartesian(material, effort, notify),
        "joint": joint(material, effort, notify),
        "by_length": by_length(material, effort, notify),
        "by_settings": by_settings(material, effort, notify),
        "build_seconds": build_times(material, effort, notify),
        "by_sensors": by_sensors(material, effort, notify),
        "by_duration": by_duration(material, effort, notify),
    }


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("solvers", __doc__, motion=False)
    parser.add_argument("--quick", action="store_true", help="little of everything")
    options = parser.parse_args(arguments)
    effort = Effort.quick() if options.quick else Effort()
    console, threads = Console(stderr=True), os.environ.get("OMP_NUM_THREADS", "not set")
    if threads != "1":
        console.print(f"OMP_NUM_THREADS is {threads}, not 1: times are not those of one core")
    torch.set_num_threads(1)
    began = perf_counter()
    with Progress(console=console) as progress:
        task = progress.add_task("...", total=None)
        measured = everything(effort, lambda what: progress.update(task, description=what))
    machine = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": threads,
        "N": N,
        "seconds": perf_counter() - began,
    }
    command = "python -m benchmarks solvers" + (" --quick" if options.quick else "")
    result = {"command": command, "machine": machine, "effort": asdict(effort), **measured}
    text = markdown(result)
    write_results(options.out, result, text.removesuffix("\n"))
    figure(result, options.out.with_suffix(".png"))
    print(text)


if __name__ == "__main__":
    main()
