from __future__ import annotations

import subprocess
import sys


def modules_after(statement: str) -> set[str]:
    """Modules that a fresh interpreter has loaded after a statement."""
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_does_not_load_torch() -> None:
    loaded = modules_after("import rtof_kin, rtof_kin.reconstruction.pipeline, rtof_kin.core.resources")
    assert "casadi" in loaded
    assert "torch" not in loaded


def test_training_needs_no_solver_and_no_plotting() -> None:
    loaded = modules_after("import lifting.training.train, lifting.predict")
    assert "torch" in loaded
    assert not loaded & {"pinocchio", "casadi", "matplotlib", "yourdfpy", "rich"}


def test_inference_does_not_load_training() -> None:
    loaded = modules_after("import lifting.predict, lifting.streaming, lifting.onnx_export")
    assert not [name for name in loaded if name.startswith("lifting.training")]
