"""Compiled functions are the interpreted ones, are kept, and are done without where they must be."""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import stat
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.numerics import c_compiler as module
from rtof_kin.core.numerics.c_compiler import cache_folder, compiled
from rtof_kin.solve.energy.frame_energy import FrameEnergy, Shape
from rtof_kin.solve.energy.state import StateSpace

pytestmark = pytest.mark.skipif(not any(map(shutil.which, module.COMPILERS)), reason="there is no C compiler")
POINT = np.array([0.3, -1.2, 2.5])


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and compilation turned on."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("RTOF_KIN_CACHE", str(folder))
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    return folder


def functions(scale: float = 1.0) -> list[Any]:
    """Two small functions, one of several outputs."""
    x = ca.SX.sym("x", 3)
    y = ca.vertcat(ca.sin(scale * x[0]) * x[1], ca.exp(x[2]) / x[1])
    return [
        ca.Function("first", [x], [y, ca.densify(ca.jacobian(y, x))]),
        ca.Function("second", [x], [ca.sumsqr(x)]),
    ]


def tiny_energy() -> FrameEnergy:
    """Of a body whose legs alone move: little to compile."""
    body = SkeletonModel.default()
    legs = ("LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg")
    hips, knee, foot = body.index("Hips", "LeftLeg", "LeftFoot")
    shape = Shape(
        landmarks=((knee, True), (foot, True), (foot, False)), sensors=(knee,), torso=(hips,),
        bones=((knee, foot),), feet=(foot,), robust_orientation=3.0,
        floor_cutoff=0.2,
    )  # fmt: skip
    return FrameEnergy(StateSpace(body, legs, hinged=True), shape)


def numbers(pair: list[Any]) -> list[np.ndarray[Any, Any]]:
    return [np.array(v) for function in pair for v in function.call([POINT])]


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*.so"))


def is_machine_code(function: Any) -> bool:
    return bool(function.class_name() == "External")


# --- the same numbers ----------------------------------------------------------------------------


def test_compiled_functions_give_the_same_numbers() -> None:
    interpreted, machine = functions(), compiled(functions())
    assert [f.name() for f in machine] == ["first", "second"]
    assert all(map(is_machine_code, machine))
    for a, b in zip(numbers(interpreted), numbers(machine), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    for a, b in zip(interpreted, machine, strict=True):
        assert a.sparsity_out(0) == b.sparsity_out(0)


def test_a_frame_of_the_energy_is_the_same_compiled_and_interpreted() -> None:
    energy = tiny_energy()
    rng = np.random.default_rng(0)
    interpreted = energy.functions()
    for one, two in zip(interpreted, compiled(interpreted), strict=True):
        assert is_machine_code(two)
        inputs = [rng.normal(size=one.size_in(i)) for i in range(one.n_in())]
        for a, b in zip(one.call(inputs), two.call(inputs), strict=True):
            np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-9, atol=1e-9)
        mapped = [np.tile(v, (1, 4)) if v.shape[1] == 1 else v for v in inputs]
        outputs = [np.array(f.map(4).call(mapped)[0]) for f in (one, two)]
        np.testing.assert_allclose(*outputs, rtol=1e-9, atol=1e-9)


# --- the cache -----------------------------------------------------------------------------------


def test_the_cache_is_where_the_environment_says(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_folder() == cache
    monkeypatch.delenv("RTOF_KIN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "rtof_kin"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "rtof_kin"


def test_functions_are_compiled_once_and_kept(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    compiled(functions())
    assert len(libraries(cache)) == 1
    endings = {path.suffix for path in cache.iterdir()}
    assert endings <= {".so", ".json", ".lock"}, "nothing is left over"
    assert "compiling the energy, once" in caplog.text
    caplog.clear()

    def fail(*arguments: Any, **options: Any) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(subprocess, "run", fail)
    again = compiled(functions())
    assert all(map(is_machine_code, again))
    assert not caplog.records


def test_other_functions_have_a_library_of_their_own(cache: Path) -> None:
    one, two = compiled(functions(1.0)), compiled(functions(2.0))
    assert len(libraries(cache)) == 2
    assert float(one[0](POINT)[0][0]) == pytest.approx(np.sin(0.3) * -1.2)
    assert float(two[0](POINT)[0][0]) == pytest.approx(np.sin(0.6) * -1.2)


def test_a_library_that_is_there_needs_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled(functions())
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert all(map(is_machine_code, compiled(functions())))


@pytest.mark.parametrize("damage", [b"", b"\x7fELF", b"this is not a library"])
def test_a_damaged_library_is_made_again(cache: Path, damage: bytes) -> None:
    given = functions(3.0)
    compiled(given)
    (library,) = libraries(cache)
    library.unlink()
    library.write_bytes(damage)
    again = compiled(given)
    for a, b in zip(numbers(given), numbers(again), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    assert all(map(is_machine_code, again))


def test_a_damaged_library_without_a_compiler_is_interpreted(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    compiled(functions(4.0))
    (library,) = libraries(cache)
    library.unlink()
    library.write_bytes(b"damaged")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    caplog.clear()
    given = functions(4.0)
    assert compiled(given) == given
    assert "interpreted, which is slower" in caplog.text


def in_a_process(scale: float) -> list[float]:
    (first, second) = compiled(functions(scale))
    assert is_machine_code(first)
    return [float(first(POINT)[0][0]), float(second(POINT))]


def test_of_two_processes_at_once_one_compiles_and_the_other_waits(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang"), tmp_path / "calls"
    counting = tmp_path / "bin" / "cc"
    counting.parent.mkdir()
    counting.write_text(f'#!/bin/sh\n[ "$1" = --version ] || echo once >> {calls}\nexec {real} "$@"\n')
    counting.chmod(0o755)
    monkeypatch.setenv("PATH", f"{counting.parent}{os.pathsep}{os.environ['PATH']}")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        results = pool.map(in_a_process, [5.0, 5.0, 5.0, 5.0], chunksize=1)
    expected = [np.sin(1.5) * -1.2, float(POINT @ POINT)]
    for result in results:
        assert result == pytest.approx(expected)
    assert calls.read_text().split() == ["once"]


# --- without ----------------------------------------------------------------------------------


def test_without_a_compiler_functions_are_interpreted_with_a_warning(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    given = functions()
    assert compiled(given) == given
    assert [r.levelno for r in caplog.records] == [logging.WARNING]
    assert "(there is no C compiler): it is interpreted, which is slower" in caplog.text
    assert not cache.exists()


def test_a_compiler_that_fails_leaves_the_functions_interpreted_with_a_warning(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    broken = tmp_path / "bin" / "cc"
    broken.parent.mkdir()
    broken.write_text("#!/bin/sh\necho no >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(shutil, "which", lambda name: str(broken))
    given = functions()
    assert compiled(given) == given
    assert "the energy could not be compiled" in caplog.text
    assert {path.suffix for path in cache.iterdir()} <= {".lock"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_cache_that_cannot_be_written_is_done_without(cache: Path) -> None:
    cache.mkdir()
    cache.chmod(0o500)
    given = functions()
    assert compiled(given) == given


def test_a_cache_that_is_a_file_is_done_without(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache.write_text("not a folder")
    given = functions()
    assert compiled(given) == given
    assert "the energy could not be compiled" in caplog.text


def test_the_environment_turns_it_off(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    given = functions()
    assert compiled(given) == given
    assert not cache.exists()


def test_a_cache_named_from_the_working_folder_is_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTOF_KIN_CACHE", "here")
    assert all(map(is_machine_code, compiled(functions(6.0))))
    assert len(libraries(tmp_path / "here")) == 1
