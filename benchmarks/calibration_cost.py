"""What calibrating a recording from itself costs: ``python -m benchmarks calibration_cost``.

Runs ``rtof-kin reconstruct models/demo --no-figures`` with and without ``--calibrate``, in turns and in
processes of their own on one core, and divides their CPU seconds among the stages. Of several runs the
cheapest counts: other work on the machine only adds. ``--code FOLDER`` measures another version of the
package in turns with this one. The first run after a change of compiled code compiles.
"""

from __future__ import annotations

import argparse
import builtins
import functools
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

from benchmarks import harness

ROOT = Path(__file__).parents[1]
STAGES = {
    "load": ["recording.recording:Recording.load"],
    "clean the streams": ["reconstruction.prepare:cleaned"],
    "lift": ["reconstruction.prepare:lift"],
    "SF2": ["reconstruction.prepare:_refined"],
    "initial guess": ["reconstruction.prepare:initial_guess"],
    "build the energy": ["solve.joint_space.observations:built_energy"],
    "search for slipped sensors": ["reconstruction.pipeline:_slipped"],
    "calibration: observations": ["calibration.estimate:shared_fragments"],
    "calibration: first solve": ["calibration.shared_fragments:SharedFragments.begin"],
    "calibration: search for the delay": ["calibration.shared_fragments:SharedFragments._searched"],
    "calibration: derivatives by the unknowns": ["calibration.shared_fragments:SharedFragments.profile"],
    "calibration: states in each round": ["calibration.shared_fragments:SharedFragments.settle"],
    "calibration: the rest": ["reconstruction.pipeline:_calibrate"],
    "solve": ["reconstruction.prepare:Job.solve"],
    "bands": ["solve.joint_space.solver:state_covariances", "solve.joint_space.solver:confidence_of"],
    "checks": ["reconstruction.pipeline:_result"],
    "writing": ["report.export:export"],
    "summary": ["report.audit:audit", "cli.recordings:print_summary", "cli.recordings:print_sections"],
}
"""Stage -> functions; what one of them calls of another stage counts there."""
IMPORTS, OTHER = "imports", "everything else"
OWNERS = ("search for slipped sensors", "calibration: search for the delay")
"""Stages that keep what they solve."""


class Stopwatch:
    """CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running, self._since = [OTHER], 0.0  # all since the process began

    def charge(self) -> None:
        """Count what has passed for the stage that runs."""
        now = process_time()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def of(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with its seconds counted for a stage."""

        @functools.wraps(function)
        def timed(*given: Any, **more: Any) -> Any:
            self.charge()
            inside = next((name for name in self._running if name in OWNERS), stage)
            self._running.append(inside if stage != IMPORTS else IMPORTS)
            try:
                return function(*given, **more)
            finally:
                self.charge()
                self._running.pop()

        return timed


def profiled(calibrate: bool) -> dict[str, float]:
    """Run the command here and return CPU seconds by stage."""
    watch = Stopwatch()
    builtins.__import__ = watch.of(IMPORTS, builtins.__import__)
    for stage, functions in STAGES.items():
        for function in functions:
            module, _, path = function.partition(":")
            owner: Any = importlib.import_module(f"rtof_kin.{module}")
            *outer, name = path.split(".")
            for part in outer:
                owner = getattr(owner, part)
            if name in vars(owner):  # else another version of the code
                own = vars(owner)[name]
                bound = isinstance(own, classmethod)
                timed = watch.of(stage, own.__func__ if bound else own)
                setattr(owner, name, classmethod(timed) if bound else timed)
    from rtof_kin.cli import main as command

    with tempfile.TemporaryDirectory() as folder:
        arguments = ["reconstruct", str(ROOT / "models" / "demo"), "-o", f"{folder}/out", "--no-figures"]
        code = command([*arguments, *(["--calibrate"] if calibrate else [])])
    if code:
        sys.exit(code)
    watch.charge()
    return dict(watch.seconds)


def measured(code: Path, calibrate: bool) -> dict[str, float]:
    """Run the command in a process of its own, on one core."""
    environment = {**os.environ, "PYTHONPATH": f"{code}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
    script = f"import sys; sys.path.append({str(ROOT)!r})\n" + _SCRIPT.format(calibrate=calibrate)
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=code, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.stderr)
    found: dict[str, float] = json.loads(done.stderr.splitlines()[-1])
    return found


_SCRIPT = f"""
import importlib.util, json
spec = importlib.util.spec_from_file_location("calibration_cost", {str(Path(__file__).resolve())!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(json.dumps(module.profiled({{calibrate}})), file=sys.stderr)
"""


def table(found: dict[str, dict[bool, dict[str, float]]]) -> str:
    """Stages of every version, without and with calibration, as Markdown."""
    versions = list(found)
    heads = [f"{version}, {kind}" for version in versions for kind in ("as given", "calibrated")]
    lines = ["| stage, CPU s | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    rows = [found[version][calibrated] for version in versions for calibrated in (False, True)]
    for stage in (IMPORTS, *STAGES, OTHER):
        values = [row.get(stage, 0.0) for row in rows]
        if max(values) >= 0.005:
            lines.append(f"| {stage} | " + " | ".join(f"{value:.2f}" for value in values) + " |")
    totals = [sum(row.values()) for row in rows]
    lines.append("| **all** | " + " | ".join(f"**{total:.2f}**" for total in totals) + " |")
    for i, version in enumerate(versions):
        inside = [total - row.get(IMPORTS, 0.0) for total, row in zip(totals, rows, strict=True)]
        given, calibrated = totals[2 * i : 2 * i + 2]
        lines.append("")
        lines.append(
            f"{version}: with calibration {calibrated / given:.2f} times without; "
            f"{inside[2 * i + 1] / inside[2 * i]:.2f} times where imports are left out."
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks calibration_cost",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--code", type=Path, help="folder of another version of the package, before this one")
    parser.add_argument("--runs", type=int, default=3, help="of every kind")
    parser.add_argument("--out", type=Path, default=harness.HERE / "results" / "calibration_cost.md")
    options = parser.parse_args(arguments)
    versions = {"before": options.code.resolve()} if options.code else {}
    versions["now"] = ROOT
    found: dict[str, dict[bool, dict[str, float]]] = {name: {} for name in versions}
    for _ in range(options.runs):
        for name, code in versions.items():
            for calibrate in (False, True):
                new = measured(code, calibrate)
                best = found[name].get(calibrate, new)
                found[name][calibrate] = min(best, new, key=lambda row: sum(row.values()))
    text = table(found)
    options.out.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
