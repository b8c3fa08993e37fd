"""Time of a sensor study of the demo: processor and clock, number of reconstructions.

``python -m benchmarks study_cost`` measures the code of this checkout; ``--version NAME=DIR`` (several, in
turn) that of others, each a checkout. Writes results/study_cost.json and .md. Other programs slow it down,
also its processor time, so that only times of one call are to be compared.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
HERE = Path(__file__).parents[1]


def measured(name: str, code: Path, recording: Path) -> dict[str, Any]:
    """Seconds of one study with the code of a checkout, with imports and figures."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "rtof_kin.cli", "study", str(recording), "-o", f"{folder}/study"]
        environment = os.environ | {"PYTHONPATH": str(code), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, cwd=folder, check=True, capture_output=True, text=True)
        study = json.loads((Path(folder) / "study" / "study.json").read_text(encoding="utf-8"))
    clock, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    announced = re.search(r"(\d+) reconstructions", done.stdout)
    return {
        "version": name,
        "reconstructions": study.get("runs", int(announced.group(1)) if announced else None),
        "processor_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "clock_s": round(clock, 1),
        "busy": round(os.getloadavg()[0], 1),
        "order": [study["segments"][one] for one in _removed(study["path"])],
        "mean_deg": [round(one["loss_deg"], 3) for one in study["path"]],
    }


def _removed(path: list[dict[str, Any]]) -> list[str]:
    return [
        next(name for name in larger["sensors"] if name not in smaller["sensors"]) for larger, smaller in pairwise(path)
    ]


def markdown(rows: list[dict[str, Any]], cores: int) -> str:
    """The rows as a table."""
    lines = [
        "# Cost of a sensor study",
        "",
        f"`rtof-kin study models/demo`: 24 s at 60 Hz, 8 sensors, greedy, with figures; {cores} cores. "
        "Processor: user and system time of all processes, with imports and building of the solver in each. "
        "Busy: programs that wanted a core (load average) at the end; above the number of cores, the clock "
        "measures the others too.",
        "",
        "| version | reconstructions | processor s | clock s | busy |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        cells = (row[name] for name in ("version", "reconstructions", "processor_s", "clock_s", "busy"))
        lines.append(f"| {' | '.join(map(str, cells))} |")
    same = all((row["order"], row["mean_deg"]) == (rows[0]["order"], rows[0]["mean_deg"]) for row in rows)
    orders = "the same in all" if same else "not the same, see the JSON file"
    lines += ["", f"Order of removal and mean error of every set of it: {orders}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure every version and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--version", action="append", default=[], metavar="NAME=DIR")
    parser.add_argument("--recording", type=Path, default=HERE / "models" / "demo")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS / "study_cost.json")
    options = parser.parse_args()
    versions = [one.partition("=") for one in options.version] or [("this", "=", str(HERE))]
    rows = []
    for _ in range(options.repeats):
        for name, _, folder in versions:
            rows.append(measured(name, Path(folder).resolve(), options.recording.resolve()))
            print(rows[-1], flush=True)
    options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    text = markdown(rows, os.cpu_count() or 1)
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
