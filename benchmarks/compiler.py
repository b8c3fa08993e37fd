"""Cost of a run with the solver compiled for this processor, for any processor, and interpreted.

    OMP_NUM_THREADS=1 python -m benchmarks compiler > benchmarks/results/compiler.md

Each run is a process of its own with `rtof-kin reconstruct models/demo`: once with an empty cache of compiled
code, and twice with the cache filled.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

BUILDS: Final = {
    "compiled for this processor (`-march=native`)": "_",
    "compiled with AVX2 and FMA (`-march=x86-64-v3`)": "c_compiler.native = lambda: ('-march=x86-64-v3',)",
    "compiled for any processor": "c_compiler.native = lambda: ()",
    "interpreted": "os.environ[c_compiler.SWITCH] = 'never'",
}
"""Title of a build -> statement that selects it before anything is compiled."""
TASKS: Final = {"reconstruct": (), "reconstruct --calibrate": ("--calibrate",)}
DEMO: Final = str(Path(__file__).parents[1] / "models" / "demo")
_CODE: Final = """
import os, sys
from rtof_kin.core.numerics import c_compiler
_ = None
{select}
from rtof_kin.cli import main
sys.exit(main(sys.argv[1:]))
"""


def run(select: str, task: tuple[str, ...], cache: Path, out: Path) -> tuple[float, float]:
    """Run the demo in a new process, and return its wall and CPU time, s."""
    command = [sys.executable, "-c", _CODE.format(select=select), "reconstruct", DEMO, *task, "-o", str(out)]
    before, began = os.times(), time.perf_counter()
    subprocess.run(
        [*command, "--overwrite"],
        check=True,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "RTOF_KIN_CACHE": str(cache)},
    )
    after, wall = os.times(), time.perf_counter() - began
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return wall, cpu


def main() -> None:
    """Print the table."""
    print("| run | solver | first run [CPU s] | later runs [CPU s] | [wall s] | frames per CPU s | error [mm] |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, task in TASKS.items():
        for title, select in BUILDS.items():
            with tempfile.TemporaryDirectory() as folder:
                out, cache = Path(folder) / "out", Path(folder) / "cache"
                first = run(select, task, cache, out)[1]
                wall, cpu = min((run(select, task, cache, out) for _ in range(2)), key=lambda times: times[1])
                summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            frames, error = summary["frames"], list(summary["metrics"].values())[-1]["mpjpe_mm"]
            row = (name, title, f"{first:.1f}", f"{cpu:.1f}", f"{wall:.1f}", f"{frames / cpu:.0f}", f"{error:.3f}")
            print(f"| {' | '.join(row)} |", flush=True)
    print(f"\n{frames} frames; {platform.machine()}, {platform.system()}, Python {platform.python_version()}")


if __name__ == "__main__":
    main()
