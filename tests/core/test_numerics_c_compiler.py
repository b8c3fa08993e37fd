"""Compiled functions equal interpreted ones, are cached, and are interpreted if they cannot be compiled."""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rtof_kin.core.numerics import c_compiler as module
from rtof_kin.core.numerics.c_compiler import built
from rtof_kin.core.numerics.simd import FrameFunction, Mapped, compile_simd
from rtof_kin.core.resources import cache_folder

pytestmark = [
    pytest.mark.skipif(not any(map(shutil.which, module.COMPILERS)), reason="there is no C compiler"),
    pytest.mark.usefixtures("compile_cache"),
]
POINT = np.array([0.3, -1.2, 2.5])


def functions(scale: float = 1.0) -> list[FrameFunction]:
    """Two small functions, one with several outputs."""
    x = ca.SX.sym("x", 3)
    y = ca.vertcat(ca.sin(scale * x[0]) * x[1], ca.cos(x[2]) / x[1])
    first = ca.Function("first", [x], [y, ca.densify(ca.jacobian(y, x))])
    return [FrameFunction.of(f) for f in (first, ca.Function("second", [x], [ca.sumsqr(x)]))]


def code_of(given: list[FrameFunction]) -> dict[str, Any]:
    """Code of functions; nothing where they cannot be compiled."""
    made = compile_simd(lambda: (given, None))
    return {} if made is None else made.code


def check_compiled(given: list[FrameFunction]) -> None:
    """Check that functions are machine code and give the numbers of the interpreted ones."""
    code = code_of(given)
    assert set(code) == {f.name for f in given}
    for f in given:
        own, plain = (Mapped(made, f, 1)(POINT[None]) for made in (code[f.name], None))
        for x, y in zip(own, plain, strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-14)


def test_cache_folder_follows_the_environment(
    compile_cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_folder() == compile_cache
    monkeypatch.delenv("RTOF_KIN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "rtof_kin"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "rtof_kin"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTOF_KIN_CACHE", "relative")
    check_compiled(functions())
    assert len(list(tmp_path.glob("relative/*.so"))) == 1


def test_functions_are_compiled_once_and_loaded_without_a_compiler(
    compile_cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    check_compiled(functions())
    check_compiled(functions(2.0))
    assert len(list(compile_cache.glob("*.so"))) == 2
    assert {path.suffix for path in compile_cache.iterdir()} <= {".so", ".lock"}
    assert "compiling the energy, once" in caplog.text
    caplog.clear()

    def fail(*arguments: Any, **options: Any) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(subprocess, "run", fail)
    check_compiled(functions())
    monkeypatch.setattr(shutil, "which", lambda name: None)
    check_compiled(functions(2.0))
    assert not caplog.records


def in_a_process(scale: float) -> list[float]:
    given = functions(scale)
    code = code_of(given)
    return [float(Mapped(code[f.name], f, 1)(POINT[None])[0][0, 0]) for f in given]


def test_only_one_of_several_processes_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = next(filter(None, map(shutil.which, module.COMPILERS))), tmp_path / "calls"
    counting = tmp_path / "bin" / "cc"
    counting.parent.mkdir()
    counting.write_text(f'#!/bin/sh\n[ "$1" = --version ] || echo once >> {calls}\nexec {real} "$@"\n')
    counting.chmod(0o755)
    monkeypatch.setenv("PATH", f"{counting.parent}{os.pathsep}{os.environ['PATH']}")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        results = pool.map(in_a_process, [5.0, 5.0, 5.0, 5.0], chunksize=1)
    for result in results:
        assert result == pytest.approx([np.sin(1.5) * -1.2, float(POINT @ POINT)])
    assert calls.read_text().split() == ["once"]


@pytest.mark.parametrize("reason", ["no compiler", "failing compiler", "no cache", "environment"])
def test_functions_that_cannot_be_compiled_are_interpreted(
    compile_cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, reason: str
) -> None:
    message = "the energy could not be compiled"
    if reason == "no compiler":
        monkeypatch.setattr(shutil, "which", lambda name: None)
        message = "(there is no C compiler): it is interpreted, which is slower"
    elif reason == "failing compiler":
        broken = compile_cache.parent / "cc"
        broken.write_text("#!/bin/sh\necho no >&2\nexit 1\n")
        broken.chmod(0o755)
        monkeypatch.setattr(shutil, "which", lambda name: str(broken))
    elif reason == "no cache":
        compile_cache.write_text("not a folder")
    else:
        monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    given = functions()
    assert code_of(given) == {}
    if reason == "environment":
        assert not caplog.records
    else:
        assert [r.levelno for r in caplog.records][-1] == logging.WARNING
        assert message in caplog.text
    assert not list(compile_cache.parent.glob("cache/*.so"))


# --- cache of libraries --------------------------------------------------------------------------

TEXT = "int answer(void) {{ return {}; }}"


def make(number: int) -> Path:
    """Compile a library of a number without loading it."""
    return Path(build(number, lambda library: library))


def answer(number: int) -> int:
    """Load the library of a number and return it."""
    return int(build(number, lambda library: ctypes.CDLL(str(library)).answer()))


def build(number: int, loaded: Callable[[Path], Any]) -> Any:
    text = TEXT.format(number)
    found = built(text, lambda: text, loaded, name="tiny")
    assert found is not None
    return found


def others_may_write(path: Path) -> bool:
    return bool(path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def test_library_that_cannot_be_loaded_is_compiled_again() -> None:
    library = make(4)
    library.write_bytes(b"something else")
    assert answer(4) == 4


def test_library_that_others_may_write_to_is_compiled_again() -> None:
    library = make(7)
    library.chmod(0o777)
    assert not others_may_write(make(7))


def test_new_cache_is_private_to_the_user(compile_cache: Path) -> None:
    make(8)
    assert stat.S_IMODE(compile_cache.stat().st_mode) == 0o700
    assert not any(map(others_may_write, compile_cache.iterdir()))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_nothing_is_loaded_from_a_cache_that_others_may_write_to(
    compile_cache: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    make(9)
    compile_cache.chmod(mode)
    caplog.clear()
    assert built(TEXT.format(9), lambda: TEXT.format(9), lambda library: library, name="tiny") is None
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert f"others may write to {compile_cache}" in record.message
    assert "RTOF_KIN_CACHE" in record.message


def test_cache_of_another_user_or_in_a_folder_of_others_is_not_used(
    compile_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_used() -> bool:
        return built(TEXT.format(9), lambda: TEXT.format(9), lambda library: library, name="tiny") is not None

    compile_cache.mkdir(mode=0o700)
    compile_cache.parent.chmod(0o777)
    assert not is_used()
    compile_cache.parent.chmod(0o1777)  # like /tmp: others cannot replace its folders
    assert is_used()
    other = os.stat_result((*os.stat(compile_cache)[:4], os.geteuid() + 1, *os.stat(compile_cache)[5:10]))
    real = Path.stat
    monkeypatch.setattr(Path, "stat", lambda p, **o: other if p == compile_cache else real(p, **o))
    assert not is_used()
