"""What the last bits depend on: complete and without names."""

from __future__ import annotations

import getpass
import platform
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core import environment as module
from rtof_kin.core.environment import environment
from rtof_kin.core.files.compact import multiples
from rtof_kin.core.numerics import c_compiler


def test_environment_has_versions_and_neither_names_nor_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    found = environment()
    assert found["instructions"] == "OPENBLAS_CORETYPE=Haswell"
    assert found["numpy"] == np.__version__
    assert found["python"] == platform.python_version()
    assert found["threads"] == "3"
    assert "openblas" in found["BLAS of numpy"] or found["BLAS of numpy"]
    assert len(found["rtof_kin source"]) == 16
    text = "\n".join(found.values())
    assert str(Path.home()) not in text
    assert (platform.node() or "-") not in text.split()
    assert getpass.getuser() not in text.split()


def test_digest_of_the_source_follows_code_and_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rtof_kin/core/a.py", "lifting/b.py", "models/c.toml"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(module, "_ROOT", tmp_path)
    digests = [module.source_digest.__wrapped__()]
    for name in ("rtof_kin/core/a.py", "lifting/b.py", "models/c.toml"):
        (tmp_path / name).write_text("x = 2\n")
        digests.append(module.source_digest.__wrapped__())
    assert len(set(digests)) == 4


def test_evaluation_of_the_energy_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(c_compiler, "_USED", {})
    assert c_compiler.evaluated() == "interpreted"
    monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    assert c_compiler.built("x", lambda: "", lambda _: 1) is None
    assert c_compiler.evaluated() == "interpreted"
    monkeypatch.setattr(c_compiler, "_USED", {"energy": "compiled by cc: 12", "banded": "compiled by cc: 12"})
    assert c_compiler.evaluated() == "compiled by cc: 12"


def test_zero_that_is_written_is_positive() -> None:
    assert not np.signbit(multiples([-0.0, -1e-12, 0.0], 24)).any()
