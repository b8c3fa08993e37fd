from __future__ import annotations

import subprocess
import sys


def modules_after(*statements: str) -> list[set[str]]:
    """Modules that a fresh interpreter has loaded after each of some statements."""
    code = "import sys" + "".join(f"\n{statement}\nprint(*sys.modules)" for statement in statements)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_the_package_does_not_load_torch() -> None:
    (loaded,) = modules_after("import rtof_kin, rtof_kin.reconstruction.pipeline, rtof_kin.core.resources")
    assert "casadi" in loaded
    assert "torch" not in loaded


def test_inference_does_not_load_training_which_needs_no_solver_and_no_plotting() -> None:
    inference = "import lifting.predict, lifting.streaming, lifting.onnx_export"
    first, then = modules_after(inference, "import lifting.training.train")
    assert not [name for name in first if name.startswith("lifting.training")]
    assert "torch" in then
    assert not then & {"pinocchio", "casadi", "matplotlib", "yourdfpy", "rich"}
