"""Build the wheel, install it alone into a clean environment and run the demo from it.

Run by ``make test``; not a pytest module, since it needs minutes. The wheel brings every dependency
with it, so one that is not declared is noticed.
"""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(*command: str | Path, cwd: Path) -> None:
    """Run a command that must succeed."""
    subprocess.run([str(part) for part in command], cwd=cwd, check=True)


def main() -> None:
    """Build, install, run; raises where anything fails."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", folder, ROOT, cwd=folder)
        (wheel,) = folder.glob("*.whl")
        venv.create(folder / "env", with_pip=True)
        python = folder / "env" / "bin" / "python"
        constraints = ROOT / "constraints.txt"
        run(python, "-m", "pip", "install", "--quiet", "-c", constraints, wheel, cwd=folder)
        where = [python, "-c", "import rtof_kin; print(rtof_kin.__file__)"]
        found = subprocess.run(where, capture_output=True, text=True, check=True, cwd=folder).stdout
        assert str(folder) in found, f"the wheel's package is not the one imported: {found}"
        script = folder / "env" / "bin" / "rtof-kin"
        run(script, "demo", "-o", folder / "out", "--no-figures", cwd=folder)
        assert (folder / "out" / "motion.npz").is_file()
    print("1 passed, 0 failed")


if __name__ == "__main__":
    main()
