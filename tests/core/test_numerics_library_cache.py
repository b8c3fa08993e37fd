"""A library is loaded from the cache only if this user compiled it; else it is compiled again."""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from rtof_kin.core.numerics import c_compiler as module
from rtof_kin.core.numerics.c_compiler import built, trusted

pytestmark = [
    pytest.mark.skipif(
        os.name != "posix" or not any(map(shutil.which, module.COMPILERS)), reason="no C compiler, or Windows"
    ),
    pytest.mark.usefixtures("compile_cache"),
]


def make(number: int) -> Path:
    """Compile a library of a number without loading it."""
    return Path(build(number, lambda library: library))


def answer(number: int) -> int:
    """Load the library of a number and return it."""
    return int(build(number, lambda library: ctypes.CDLL(str(library)).answer()))


def build(number: int, loaded: Callable[[Path], Any]) -> Any:
    text = f"int answer(void) {{ return {number}; }}"
    found = built(text, lambda: text, loaded, name="tiny")
    assert found is not None
    return found


def matches_record(library: Path) -> bool:
    record = json.loads(library.with_suffix(".json").read_text())
    return bool(record["sha256"] == hashlib.sha256(library.read_bytes()).hexdigest())


def others_may_write(path: Path) -> bool:
    return bool(path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH))


@pytest.mark.parametrize("endings", [(), (".so",), (".so", ".json")])
def test_damaged_or_exchanged_library_is_compiled_again(endings: tuple[str, ...]) -> None:
    one, two = make(4), make(5)
    for ending in endings:
        shutil.copy(two.with_suffix(ending), one.with_suffix(ending))
    if not endings:
        one.write_bytes(one.read_bytes()[:1000])
    assert answer(4) == 4
    assert matches_record(one)


@pytest.mark.parametrize("record", ["", "[]", "{}", None])
def test_library_without_a_complete_record_is_compiled_again(record: str | None) -> None:
    library = make(6)
    library.with_suffix(".json").unlink()
    if record is not None:
        library.with_suffix(".json").write_text(record)
    library.write_bytes(b"something else")
    make(6)
    assert matches_record(library)


def test_library_that_others_may_write_to_is_compiled_again() -> None:
    library = make(7)
    library.chmod(0o777)
    assert not others_may_write(make(7))


def test_new_cache_is_private_to_the_user(compile_cache: Path) -> None:
    make(8)
    assert stat.S_IMODE(compile_cache.stat().st_mode) == 0o700
    assert not any(map(others_may_write, compile_cache.iterdir()))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_cache_that_others_may_write_to_is_not_used(
    compile_cache: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    planted = make(9)
    compile_cache.chmod(mode)
    caplog.clear()
    private = make(9)
    assert private.parent != planted.parent
    assert stat.S_IMODE(private.parent.stat().st_mode) == 0o700
    assert answer(9) == 9
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert str(compile_cache) in record.message
    assert "RTOF_KIN_CACHE" in record.message


def test_cache_of_another_user_or_in_a_folder_of_others_is_not_used(
    compile_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compile_cache.mkdir(mode=0o700)
    compile_cache.parent.chmod(0o777)
    assert trusted(compile_cache) != compile_cache
    compile_cache.parent.chmod(0o1777)  # like /tmp: others cannot replace its folders
    assert trusted(compile_cache) == compile_cache
    other = os.stat_result((*os.stat(compile_cache)[:4], os.geteuid() + 1, *os.stat(compile_cache)[5:10]))
    real = Path.stat
    monkeypatch.setattr(Path, "stat", lambda p, **o: other if p == compile_cache else real(p, **o))
    assert trusted(compile_cache) != compile_cache


def test_leftovers_of_killed_builds_are_removed_and_running_builds_are_not(compile_cache: Path) -> None:
    library = make(10)
    library.unlink()
    for name in (library.stem, "other", "running"):
        (compile_cache / f"{name}.build").mkdir()
        (compile_cache / f"{name}.build" / "energy.c").write_text("half of")
    with FileLock(compile_cache / "running.lock"):
        assert answer(10) == 10
    assert [path.name for path in compile_cache.glob("*.build")] == ["running.build"]
