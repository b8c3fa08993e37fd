"""What is loaded from the cache is what was compiled, by this user; else it is compiled again."""

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
from rtof_kin.core.numerics.c_compiler import built
from rtof_kin.core.numerics.library_cache import trusted

pytestmark = pytest.mark.skipif(
    os.name != "posix" or not any(map(shutil.which, module.COMPILERS)), reason="no C compiler, or Windows"
)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and compilation turned on."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("RTOF_KIN_CACHE", str(folder))
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    return folder


def make(number: int) -> Path:
    """Compile a library that knows a number; it is not loaded."""
    return Path(ask(number, lambda library: library))


def answer(number: int) -> int:
    """What the library for a number says."""
    return int(ask(number, lambda library: ctypes.CDLL(str(library)).answer()))


def ask(number: int, loaded: Callable[[Path], Any]) -> Any:
    text = f"int answer(void) {{ return {number}; }}"
    found = built(text, lambda: text, loaded, name="tiny")
    assert found is not None
    return found


def is_what_its_record_says(library: Path) -> bool:
    record = json.loads(library.with_suffix(".json").read_text())
    return bool(record["sha256"] == hashlib.sha256(library.read_bytes()).hexdigest())


def others_may_write(path: Path) -> bool:
    return bool(path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH))


# --- damage --------------------------------------------------------------------------------------


def test_a_truncated_library_is_compiled_again() -> None:
    library = make(1)
    whole = library.read_bytes()
    library.write_bytes(whole[: len(whole) // 2])
    assert make(1).read_bytes() == whole
    assert answer(1) == 1


def test_libraries_under_each_others_names_are_compiled_again() -> None:
    one, two = make(2), make(3)
    held = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(held)
    assert (answer(2), answer(3)) == (2, 3)


def test_a_library_and_its_record_under_anothers_name_are_compiled_again() -> None:
    one, two = make(4), make(5)
    for ending in (".so", ".json"):
        shutil.copy(two.with_suffix(ending), one.with_suffix(ending))
    assert answer(4) == 4
    assert is_what_its_record_says(one)


@pytest.mark.parametrize("record", ["", "[]", "{}", None])
def test_a_library_without_a_whole_record_is_compiled_again(record: str | None) -> None:
    library = make(6)
    library.with_suffix(".json").unlink()
    if record is not None:
        library.with_suffix(".json").write_text(record)
    library.write_bytes(b"something else")
    make(6)
    assert is_what_its_record_says(library)


def test_a_library_that_others_may_write_to_is_compiled_again() -> None:
    library = make(7)
    library.chmod(0o777)
    assert not others_may_write(make(7))


# --- who may write -------------------------------------------------------------------------------


def test_a_new_cache_is_the_users_alone(cache: Path) -> None:
    make(8)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    assert not any(map(others_may_write, cache.iterdir()))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_nothing_is_loaded_from_a_cache_that_others_may_write_to(
    cache: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    planted = make(9)
    cache.chmod(mode)
    caplog.clear()
    private = make(9)
    assert private.parent != planted.parent
    assert stat.S_IMODE(private.parent.stat().st_mode) == 0o700
    assert answer(9) == 9
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert str(cache) in record.message
    assert "RTOF_KIN_CACHE" in record.message


def test_a_cache_in_a_folder_that_others_may_write_to_is_not_used(cache: Path) -> None:
    cache.mkdir(mode=0o700)
    cache.parent.chmod(0o777)
    assert trusted(cache) != cache
    cache.parent.chmod(0o1777)  # as /tmp: others cannot replace what is there
    assert trusted(cache) == cache


def test_a_cache_of_another_user_is_not_used(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir(mode=0o700)
    assert trusted(cache) == cache
    other = os.stat_result((*os.stat(cache)[:4], os.geteuid() + 1, *os.stat(cache)[5:10]))
    real = Path.stat
    monkeypatch.setattr(Path, "stat", lambda p, **o: other if p == cache else real(p, **o))
    assert trusted(cache) != cache


# --- builds --------------------------------------------------------------------------------------


def test_what_killed_builds_left_is_removed_and_builds_going_on_are_left_alone(cache: Path) -> None:
    library = make(10)
    library.unlink()
    killed, other, going_on = (
        library.with_suffix(".build"), cache / "other.build", cache / "busy.build"
    )  # fmt: skip
    for folder in (killed, other, going_on):
        folder.mkdir()
        (folder / "energy.c").write_text("half of")
    with FileLock(going_on.with_suffix(".lock")):
        assert answer(10) == 10
    assert [path.name for path in cache.glob("*.build")] == [going_on.name]
