from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording


def modules_after(*statements: str) -> list[set[str]]:
    """Modules that a fresh interpreter has loaded after each of some statements."""
    code = "import sys" + "".join(f"\n{statement}\nprint(*sys.modules)" for statement in statements)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_a_recording_is_reconstructed_without_torch(tmp_path: Path) -> None:
    demo = Recording.load(model_path("demo"))
    replace(demo, keypoints=demo.video[600:632], truth=None).save(tmp_path / "short")
    command = ["reconstruct", str(tmp_path / "short"), "-o", str(tmp_path / "out")]
    code = f"import sys\nfrom rtof_kin.cli import main\nassert main({command}) == 0"
    code += "\nimport lifting.streaming, rtof_kin.live.estimator, rtof_kin.app.server"
    code += "\nassert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert "rtof" in (tmp_path / "out" / "summary.json").read_text()


def test_inference_does_not_load_training_which_needs_no_solver_and_no_plotting() -> None:
    inference = "import lifting.predict, lifting.streaming"
    first, then = modules_after(inference, "import lifting.training.train")
    assert not [name for name in first if name.startswith("lifting.training")]
    assert "torch" in then - first
    assert not then & {"pinocchio", "casadi", "matplotlib", "yourdfpy", "rich"}
