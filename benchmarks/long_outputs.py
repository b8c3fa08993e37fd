"""Memory and time of `analyse`, `report` and `export` on motions of a minute and an hour.

The motion is that of a folder, at 60 Hz with 8 sensors, repeated forth and back. Each command runs in a
process of its own; times are of the processor. An hour may cost 60 times as much as a minute.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.motion_file import COVARIANCES, MOTION, MotionWriter
from rtof_kin.body.skeleton import Motion

RATE_HZ: Final = 60
BLOCK: Final = 3600
POSES: Final = (
    "p_world_joint",
    "R_world_bone",
    "provenance",
    "valid",
    "orientation_observed",
    "direction_observed",
    "sigma_rad",
)
COMMANDS: Final = {
    "analyse": ("report", "--weight", "70", "--analysis"),
    "report": ("report", "--weight", "70"),
    "export": ("export",),
    "export, all formats but c3d": ("export", "--to", "csv,parquet,ros,osim,mot,sto,trc,bvh"),
}


def repeated(motion: Motion, start: int, stop: int) -> Motion:
    """Return frames [start, stop) of a motion that goes forth and back.

    Args:
        motion: with a confidence. start, stop: frames.
    """
    T = len(motion.q)
    frames = np.concatenate([np.arange(T), np.arange(T - 2, 0, -1)])[np.arange(start, stop) % (2 * T - 2)]
    times, poses, known = np.arange(start, stop) / RATE_HZ, motion.poses, motion.confidence
    poses = replace(poses, times=times, **{name: getattr(poses, name)[frames] for name in POSES})
    if known is not None:
        known = replace(known, times=times, **{name: getattr(known, name)[frames] for name in COVARIANCES})
    q = motion.q[frames]
    return Motion(motion.skeleton, q, poses, motion.skeleton.check(q), known)


def write_repeated(path: Path, motion: Motion, minutes: float) -> None:
    """Write a longer motion.

    Args:
        path: the file. motion: what is repeated. minutes: length.
    """
    frames = round(60 * RATE_HZ * minutes)
    with MotionWriter(path, motion.skeleton, mode="rtof") as writer:
        for start in range(0, frames, BLOCK):
            writer.append(repeated(motion, start, min(start + BLOCK, frames)))


def measured(command: tuple[str, ...], folder: Path, output: Path) -> dict[str, float]:
    """Return processor time, s, peak resident memory, MB, and size of the output, MB, of a command.

    Args:
        command: name and options. folder: of the motion. output: to write.
    """
    name, *options = command
    code = "import sys; from rtof_kin.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = [name, str(folder), "-o", str(output), *options]
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(arguments)}: failed")
    files = [output] if output.is_file() else [path for path in output.rglob("*") if path.is_file()]
    return {
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "output_mb": sum(path.stat().st_size for path in files) / 1e6,
    }


def main() -> None:
    """Measure one length and one command, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motion", type=Path, help="output folder of reconstruct, e.g. of the demo")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 60])
    parser.add_argument("--only", choices=[*COMMANDS], nargs="+", default=[*COMMANDS])
    parser.add_argument("--keep", type=Path, help="folder of the long motions, to use them again")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for minutes in options.minutes:
            folder = (options.keep or Path(temporary)) / f"{minutes:g}_minutes"
            if not folder.exists():
                folder.mkdir(parents=True)
                shutil.copy(options.motion / "summary.json", folder)
                write_repeated(folder / MOTION, Motion.load(options.motion), minutes)
            for name in options.only:
                output = Path(temporary) / "output"
                found = measured(COMMANDS[name], folder, output)
                print(json.dumps({"minutes": minutes, "command": name} | found), flush=True)
                if output.is_dir():
                    shutil.rmtree(output)
                else:
                    output.unlink()


if __name__ == "__main__":
    main()
