"""A library is loaded from the cache only if this user compiled it; else it is compiled again."""

from __future__ import annotations

import ctypes
import logging
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtof_kin.core.numerics import c_compiler as module
from rtof_kin.core.numerics.c_compiler import built

pytestmark = [
    pytest.mark.skipif(
        os.name != "posix" or not any(map(shutil.which, module.COMPILERS)), reason="no C compiler, or Windows"
    ),
    pytest.mark.usefixtures("compile_cache"),
]
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
