"""Check the distribution: contents, reproducibility, and the wheel alone in a clean environment.

Run by ``make test``; not a pytest module, since it needs minutes. First the wheel without extras, which needs
neither torch nor matplotlib; then with the extra of the lifter, the demo. Every dependency comes with the
wheel, so one that is not declared is noticed.
"""

import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MOST_MB = 15
NEEDED = {
    "rtof_kin/models/lifter.npz",
    "rtof_kin/models/lifter.md",
    "rtof_kin/models/demo/recording.toml",
    "rtof_kin/core/numerics/banded.c",
    "rtof_kin/core/numerics/simd.h",
    "rtof_kin/py.typed",
}
LICENCES = {"LICENSE", "NOTICE", "LICENSES/LicenseRef-CMU-Mocap.txt"}


def run(*command: str | Path, cwd: Path) -> None:
    """Run a command that must succeed."""
    subprocess.run([str(part) for part in command], cwd=cwd, check=True)


def built(source: Path, folder: Path, *kinds: str) -> tuple[Path, ...]:
    """Build distributions of these kinds, and return their files."""
    run(sys.executable, "-m", "build", "--no-isolation", *kinds, "-o", folder, source, cwd=folder.parent)
    return tuple(sorted(folder.iterdir()))


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_contents(wheel: Path, sdist: Path) -> None:
    """Check size and contents of the distributions."""
    assert wheel.stat().st_size < MOST_MB * 1e6, f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB"
    names = set(zipfile.ZipFile(wheel).namelist())
    dist_info = f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"
    assert {name.split("/")[0] for name in names} == {"rtof_kin", "lifting", dist_info}
    assert names >= NEEDED | {f"{dist_info}/licenses/{name}" for name in LICENCES}, NEEDED - names
    assert not [name for name in names if "/build_" in name or name.endswith((".so", ".pyc"))]
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert inside >= {"Makefile", "tests/check_wheel.py", "models/build_demo.py", "constraints.txt", *LICENCES}
    assert not [name for name in inside if name.startswith((".venv", "out/", "benchmarks/results"))]
    run(sys.executable, "-m", "twine", "--no-color", "check", "--strict", wheel, sdist, cwd=wheel.parent)


def check_reproducible(wheel: Path, sdist: Path, folder: Path) -> None:
    """Build again from the source distribution, in another place, and compare."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    again, first = built(source, folder / "dist", "--sdist", "--wheel"), (wheel, sdist)
    assert {p.name: sha256(p) for p in again} == {p.name: sha256(p) for p in first}, "builds differ"


def check_plain(environment: Path, folder: Path) -> None:
    """Use the package without torch and matplotlib; where training is asked for, one sentence."""
    python, script = environment / "bin" / "python", environment / "bin" / "rtof-kin"
    code = "import importlib.util, rtof_kin\nprint(rtof_kin.__file__, rtof_kin.__version__)\n"
    code += "assert not [n for n in ('torch', 'matplotlib', 'av', 'ray') if importlib.util.find_spec(n)]"
    found = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True, cwd=folder).stdout
    file, version = found.split()
    assert file.startswith(str(environment)), f"the wheel's package is not the one imported: {found}"
    said = subprocess.run([script, "--version"], capture_output=True, text=True, check=True, cwd=folder).stdout
    assert said == f"rtof-kin {version}\n", said
    demo = Path(file).parent / "models" / "demo"
    run(script, "inspect", demo, cwd=folder)
    run(script, "reconstruct", demo, "--mode", "imu", "-o", "motion", cwd=folder)
    run(script, "report", "motion", "--analysis", "angles", cwd=folder)
    run(script, "export", "motion", "-o", "files", cwd=folder)
    run(script, "report", "motion", "-o", "report.html", cwd=folder)
    assert (folder / "angles" / "angles.csv").is_file()
    assert not (folder / "motion" / "figures").exists()
    refused = subprocess.run([script, "train", demo, "-o", "none.npz"], capture_output=True, text=True, cwd=folder)
    assert refused.returncode == 2, refused
    assert 'needs torch, which is not installed: pip install "rtof-kin[train]"' in refused.stderr, refused.stderr
    run(script, "run", "--demo", "-o", "out", cwd=folder)
    assert (folder / "out" / "motion.h5").is_file()


def main() -> None:
    """Build, check, install, run; raises where anything fails."""
    began = time.monotonic()
    os.environ["RTOF_KIN_COMPILE"] = "never"  # the quickstart compiles
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sdist, wheel = sorted(built(ROOT, folder / "dist", "--sdist", "--wheel"), key=lambda p: p.suffix)
        check_contents(wheel, sdist)
        (folder / "again").mkdir()
        check_reproducible(wheel, sdist, folder / "again")
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB; {time.monotonic() - began:.0f} s", flush=True)
        venv.create(folder / "env", with_pip=True)
        python = folder / "env" / "bin" / "python"
        run(python, "-m", "pip", "install", "--quiet", wheel, cwd=folder)
        check_plain(folder / "env", folder)
        print(f"without extras: {time.monotonic() - began:.0f} s", flush=True)
    print(f"1 passed, 0 failed in {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
