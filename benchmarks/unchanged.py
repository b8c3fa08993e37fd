"""Compare what two versions of the code compute: every command's numbers, compiled and interpreted.

``python -m benchmarks unchanged --inputs IN --out A`` runs `STEPS` through the command line and keeps what they write;
IN is a folder of recordings that the first run makes. Run it with each version and the same IN, then
``python -m benchmarks unchanged --compare A B`` lists the largest difference of every file and fails above 1e-9.
Arrays are compared by name, tables by column, JSON by key, other text number by number; words, pages, figures and
measured durations are not compared. Twelve minutes of two cores.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 1e-9
"""Of every number, in its own unit (m, rad, s, deg, mm)."""
DEMO = Path(__file__).parent.parent / "models" / "demo"
WALK = Path(__file__).parent.parent / "tests" / "fixtures" / "mocap" / "02_01_excerpt.bvh"
MODES = {
    "rtof": "",
    "calibrated": "--calibrate",
    "cartesian": "--space cartesian",
    "rto": "--mode rto",
    "sf2": "--mode sf2",
    "lift": "--mode lift",
    "imu": "--mode imu",
}
"""The seven ways to reconstruct the demo, by their options."""
STEPS: list[tuple[str, str]] = [
    *((f"demo/{name}", f"reconstruct {DEMO} -o OUT {options}") for name, options in MODES.items()),
    ("calibration.toml", f"reconstruct {DEMO} --calibrate-only -o OUT"),
    ("long", "reconstruct IN/long -o OUT"),
    ("bare/rtof", "reconstruct IN/short -o OUT"),
    ("bare/rto", "reconstruct IN/short -o OUT --mode rto"),
    ("bare/paper", "reconstruct IN/short -o OUT --paper"),
    *((f"people/{name}", f"reconstruct IN/{name} -o OUT") for name in ("gait_1", "gait_2", "gait_3")),
    *((f"visits/{i}/{j}", f"reconstruct IN/squat_{i}_{j} -o OUT") for i in (1, 2) for j in (1, 2, 3)),
    ("analyse/demo", "report RUN/demo/rtof -o OUT.html --analysis OUT --weight 70 --no-figures"),
    ("analyse/gait", "report RUN/people/gait_1 -o OUT.html --analysis OUT --weight 70 --sex female --no-figures"),
    ("analyse/squat", "report RUN/visits/1/1 -o OUT.html --analysis OUT --repetitions squat --no-figures"),
    ("compare/modes", "compare RUN/demo/rtof RUN/demo/rto -o OUT"),
    ("compare/sides", "compare RUN/people/gait_1 --sides -o OUT"),
    ("compare/people", "compare RUN/people/gait_1 RUN/people/gait_2 --by cycle --spm -o OUT"),
    ("compare/aligned", "compare RUN/demo/rtof RUN/demo/sf2 --align -o OUT"),
    ("follow", "compare RUN/visits -o OUT --repetitions squat"),
    ("reference.json", "gait-reference RUN/people -o OUT --licence free --origin simulated --strides 1"),
    ("gait_3", "report RUN/people/gait_3 -o OUT.html --analysis OUT --gait-reference RUN/reference.json --no-figures"),
    ("evaluate", f"evaluate RUN/demo/rtof --truth {DEMO} --clinical -o OUT"),
    ("export", "export RUN/demo/rtof OUT --to csv,ros,parquet,osim,mot,sto,trc,c3d,bvh"),
    ("report.html", "report RUN/people/gait_1 -o OUT"),
    ("study", "study IN/short -o OUT --seconds 3 --path ranked --no-figures --threads 1"),
    ("plan", "plan squat -o OUT --draws 1 --threads 1"),
    ("simulate", f"simulate {WALK} -o OUT"),
    ("live.npz", "benchmarks.unchanged --replay IN/short OUT"),
]
"""Name of the result -> command; OUT is the result, RUN the folder of results, IN that of recordings."""
INTERPRETED = ("bare/rtof", "bare/rto", "bare/paper")
"""Steps that run a second time without compilation."""
KINDS = {".npz", ".h5", ".json", ".csv", ".mot", ".sto", ".trc", ".bvh", ".urdf", ".osim", ".c3d", ".parquet"}
"""Files that are compared."""
IGNORED = re.compile(
    r"(^|/)(elapsed|duration|seconds$|frames_per_second|solve_s|wall|cpu|version|created|date|sha256|digest|rtof_kin|threads)"
)
"""Keys of JSON that are not results."""


def make_inputs(folder: Path) -> None:
    """Make the recordings: excerpts of the demo, and movements of the library with drawn cameras and errors."""
    from dataclasses import replace

    from rtof_kin.body.skeleton import SkeletonModel
    from rtof_kin.plan.movements import movement
    from rtof_kin.recording.recording import Recording
    from rtof_kin.simulation.simulate import LIMB_SENSORS, SimulationSettings, simulate, standard_cameras

    demo = Recording.load(DEMO)
    demo.between(4.0, 12.0).save(folder / "short")
    body = SkeletonModel.default()
    sensors = (*LIMB_SENSORS, "Pelvis", "R_Foot", "L_Foot")
    kinds: dict[str, tuple[str, int | None]] = {f"gait_{i}": ("gait", None) for i in (1, 2, 3)}
    kinds |= {f"squat_{i}_{j}": ("squat", 4) for i in (1, 2) for j in (1, 2, 3)} | {"long": ("gait", 10)}
    for seed, (name, (kind, repetitions)) in enumerate(kinds.items()):
        poses = movement(kind, body, repetitions)
        simulate(
            poses,
            body.joint_offsets,
            camera=standard_cameras(poses, seed)[0],
            settings=replace(SimulationSettings.realistic(), sensors=sensors),
            seed=seed,
            name=name,
        ).save(folder / name)


def run(command: str, log: Path, **environment: str) -> float:
    """Run a command of the command line, or the replay; the seconds it took. A failure is kept in the log."""
    start = time.perf_counter()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as stream:
        done = subprocess.run(
            [sys.executable, "-m", *command.split()],
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
            check=False,
        )
    if done.returncode:
        print(f"exit {done.returncode}: {command}\n{log.read_text()[-600:]}", flush=True)
    return time.perf_counter() - start


def record(inputs: Path, out: Path, only: str) -> None:
    """Run all steps, into out/compiled and out/interpreted."""
    steps = [("compiled", name, command) for name, command in STEPS]
    steps += [("interpreted", name, command) for name, command in STEPS if name in INTERPRETED]
    for kind, name, command in steps:
        if not re.search(only, f"{kind}/{name}"):
            continue
        folder, target = out / kind, out / kind / name
        target.parent.mkdir(parents=True, exist_ok=True)
        command = re.sub(
            r"\bOUT\b", str(target), command if command.startswith("benchmarks") else f"rtof_kin.cli {command}"
        )
        command = re.sub(r"\bRUN\b", str(folder), re.sub(r"\bIN\b", str(inputs), command))
        environment = {"RTOF_KIN_COMPILE": "never"} if kind == "interpreted" else {}
        print(f"{run(command, out / 'logs' / kind / f'{name}.txt', **environment):6.1f} s  {kind}/{name}", flush=True)


def replay(recording_folder: Path, out: Path) -> None:
    """Give a recording sample by sample to the online estimator, in the order of time, and keep its poses."""
    from benchmarks.online.estimators import estimator, settings
    from benchmarks.online.running import run as estimates
    from rtof_kin.recording.recording import Recording

    recording = Recording.load(recording_folder)
    found = list(estimates(estimator(recording, recording.video.names, settings()), recording))
    names = ("times", "p_world_joint", "R_world_bone", "sigma_rad")
    np.savez(out, **{name: np.concatenate([getattr(one.poses, name) for one in found]) for name in names})


def numbers(path: Path) -> dict[str, Any]:
    """The results in a file of one of `KINDS` by name."""
    kind = path.suffix
    if kind == ".npz":
        with np.load(path) as file:
            return {name: file[name] for name in file if name != "header"}
    if kind == ".h5":
        from rtof_kin.core.files.hdf5 import read_arrays

        return {name: array for name, array in read_arrays(path).items() if name != "header"}
    if kind == ".json":
        return dict(_leaves(json.loads(path.read_text(encoding="utf-8")), ""))
    if kind == ".csv":
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
        return {name: np.array([_number(row[i]) for row in rows[1:] if i < len(row)]) for i, name in enumerate(rows[0])}
    if kind in {".mot", ".sto", ".trc", ".bvh", ".urdf", ".osim"}:
        return {"numbers": np.array([_number(word) for word in path.read_text(encoding="utf-8").split()])}
    if kind == ".c3d":
        import ezc3d

        data = ezc3d.c3d(str(path))["data"]
        return {"points": data["points"], "analogs": data["analogs"]}
    import pyarrow.parquet

    return {str(name): np.asarray(column) for name, column in pyarrow.parquet.read_table(path).to_pydict().items()}


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Numbers of JSON by their path."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, f"{path}/{key}")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{path}/{i}")
    elif isinstance(value, bool | int | float) and not IGNORED.search(path):
        yield path, np.array(value)


def difference(a: Path, b: Path) -> tuple[float, str]:
    """Largest difference of two files and its name; infinite where a name is gone, or shapes or gaps differ."""
    old, new = numbers(a), numbers(b)
    apart = {name: _difference(x, new[name]) if name in new else np.inf for name, x in old.items()}
    worst = max(apart, key=lambda name: apart[name], default="")
    gone = sum(name not in new for name in old)
    return apart.get(worst, 0.0), worst + (f" and {gone} names gone" if gone else "")


def _difference(x: Any, y: Any) -> float:
    x, y = np.asarray(x), np.asarray(y)
    if x.shape != y.shape:
        return np.inf
    if x.dtype.kind not in "fiub" or y.dtype.kind not in "fiub":
        return 0.0 if np.array_equal(x.astype(str), y.astype(str)) else np.inf
    x, y = x.astype(float), y.astype(float)
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    apart = np.where(same, 0.0, np.abs(x - y))
    return float(np.max(np.where(np.isnan(apart), np.inf, apart), initial=0.0))


def compare(a: Path, b: Path) -> int:
    """Print the largest difference of every file below `a`; the exit status."""
    worst, count = 0.0, 0
    for path in sorted(a.rglob("*")):
        if not path.is_file() or path.suffix not in KINDS:
            continue
        other = b / path.relative_to(a)
        if path.suffix == ".npz" and not other.exists():
            other = other.with_suffix(".h5")
        found, where = difference(path, other) if other.exists() else (np.inf, "the file is gone")
        count, worst = count + 1, max(worst, found)
        if found > 0.0:
            print(f"{found:9.2e}  {path.relative_to(a)}  {where}")
    print(f"{count} files, largest difference {worst:.2e}, allowed {TOLERANCE:.0e}")
    return 0 if count and worst <= TOLERANCE else 1


def main() -> int:
    """Run or compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=Path, help="folder of recordings; made where it is missing")
    parser.add_argument("--out", type=Path, help="folder for the results of this version")
    parser.add_argument("--only", default="", help="regular expression of the steps to run")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("A", "B"))
    parser.add_argument("--replay", nargs=2, type=Path, metavar=("RECORDING", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.compare:
        return compare(*options.compare)
    if options.replay:
        replay(*options.replay)
        return 0
    if options.inputs is None or options.out is None:
        parser.error("give --inputs and --out, or --compare A B")
    inputs = options.inputs.resolve()
    if not inputs.exists():
        make_inputs(inputs)
    record(inputs, options.out.resolve(), options.only)
    return 0


if __name__ == "__main__":
    sys.exit(main())
