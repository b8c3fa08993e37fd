"""Compare the numbers of two versions of the code: the demo and one motion of the harness.

``python -m benchmarks.unchanged --corpus DIR --out A`` runs every case through the command line and
keeps each `motion.npz`. Run it once with each version, then
``python -m benchmarks.unchanged --compare A B`` lists the largest difference of every case and fails
above 1e-9. `summary.json`, files of figures and the report are not compared.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

TOLERANCE = 1e-9
"""Of every number in `motion.npz`, in its own unit (m, rad, s)."""
DEMO = Path(__file__).parent.parent / "models" / "demo"
CASES = {
    "rtof": ("--calibrate",),
    "rtof_given": (),
    "rtof_cartesian": ("--space", "cartesian"),
    "rto": ("--mode", "rto"),
    "sf2": ("--mode", "sf2"),
    "lift": ("--mode", "lift"),
    "imu": ("--mode", "imu"),
}
"""Name of a case -> options of `rtof-kin reconstruct`."""


def record(corpus: Path, out: Path) -> None:
    """Reconstruct the demo and a harness motion in every case, into out/RECORDING/CASE."""
    from benchmarks.harness import SENSOR_SETS, recorded, test_clips

    clip = test_clips(corpus)[0]
    recorded(clip, 0, "realistic", SENSOR_SETS["8"], 0).save(out / "harness_recording")
    for name, recording in (("demo", DEMO), ("harness", out / "harness_recording")):
        for case, options in CASES.items():
            folder = out / name / case
            command = ["-m", "rtof_kin.cli", "reconstruct", str(recording), "-o", str(folder)]
            subprocess.run([sys.executable, *command, "--no-figures", *options], check=True)


def difference(a: Path, b: Path) -> float:
    """Largest difference of two `.npz` files; infinite where names, shapes or gaps differ."""
    with np.load(a) as first, np.load(b) as second:
        if set(first) != set(second):
            return np.inf
        return max(_difference(first[name], second[name]) for name in first)


def _difference(x: np.ndarray, y: np.ndarray) -> float:
    if x.shape != y.shape:
        return np.inf
    if x.dtype.kind not in "fiub":
        return 0.0 if np.array_equal(x, y) else np.inf
    x, y = x.astype(float), y.astype(float)
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    apart = np.where(same, 0.0, np.abs(x - y))
    return float(np.max(np.where(np.isnan(apart), np.inf, apart), initial=0.0))


def compare(a: Path, b: Path) -> int:
    """Print the largest difference of every file below `a`; the exit status."""
    worst = 0.0
    files = sorted(p.relative_to(a) for p in a.rglob("*.npz"))
    for file in files:
        found = difference(a / file, b / file) if (b / file).exists() else np.inf
        print(f"{found:9.2e}  {file}")
        worst = max(worst, found)
    print(f"{len(files)} files, largest difference {worst:.2e}, allowed {TOLERANCE:.0e}")
    return 0 if files and worst <= TOLERANCE else 1


def main() -> int:
    """Run or compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--corpus", type=Path, help="folder of free motion (README.md here)")
    parser.add_argument("--out", type=Path, help="folder for the results of this version")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("A", "B"))
    options = parser.parse_args()
    if options.compare:
        return compare(*options.compare)
    if options.corpus is None or options.out is None:
        parser.error("give --corpus and --out, or --compare A B")
    record(options.corpus, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
