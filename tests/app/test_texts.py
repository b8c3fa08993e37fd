"""Every text is in every language, and is read where it is shown."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from string import Formatter
from typing import Any

import pytest

import rtof_kin.app
from rtof_kin.app.store import State, Store
from rtof_kin.app.texts import TEXTS, languages, speak
from rtof_kin.setup.sources import SourceKind

ENGLISH = languages()["en-US"].model_dump()
PAGES = sorted(Path(rtof_kin.app.__file__).parent.glob("*.py"))
SAME = {"title", "options", "person"}
"""What is not translated."""


@pytest.fixture(autouse=True)
def english() -> Iterator[None]:
    speak("en-US")
    yield
    speak("en-US")


def pieces(value: Any) -> list[str]:
    """The texts of a name, also several."""
    return [value] if isinstance(value, str) else list(value.values() if isinstance(value, dict) else value)


def braces(text: str) -> set[tuple[Any, ...]]:
    return {found[1:] for found in Formatter().parse(text) if found[1] is not None}


@pytest.mark.parametrize("code", [code for code in languages() if code != "en-US"])
@pytest.mark.parametrize("name", sorted({*ENGLISH} - SAME))
def test_text_is_translated_with_the_same_braces(name: str, code: str) -> None:
    own, other = ENGLISH[name], languages()[code].model_dump()[name]
    assert own != other, f"{name} is not translated: {own!r}"
    for one, two in zip(pieces(own), pieces(other), strict=True):
        assert braces(one) == braces(two)
        assert bool(one.strip()) == bool(two.strip())
    if isinstance(own, dict) and name != "steps":  # else the keys are names of the engine
        assert list(own) == list(other)


def test_the_texts_that_pages_read_are_those_of_the_catalogues() -> None:
    read = set[str]()
    for path in PAGES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "TEXTS":
                read.add(node.attr)
    assert read == {*ENGLISH} - {"language"}
    assert all({*texts.model_dump()} == {*ENGLISH} for texts in languages().values())


def test_every_state_and_kind_of_file_has_a_name() -> None:
    assert set(TEXTS.states) == {state.value for state in State}
    assert set(TEXTS.sources) == {kind.value for kind in SourceKind}


def test_texts_follow_the_language(monkeypatch: pytest.MonkeyPatch) -> None:
    assert TEXTS.people == "People"
    speak("de")
    assert (TEXTS.people, TEXTS.code) == ("Personen", "de")
    for local, code in (("de_AT", "de"), ("German_Germany", "de"), ("den_CA", "en-US"), (None, "en-US")):
        monkeypatch.setattr("locale.getlocale", lambda local=local: (local, "UTF-8"))
        speak("xx")
        assert TEXTS.code == code


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_no_text_is_read_at_import(path: Path) -> None:
    """It would stay in the language of the first moment."""
    late = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda

    def read(node: ast.AST) -> Iterator[int]:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "TEXTS":
            yield node.lineno
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, late):
                yield from read(child)
            elif not isinstance(child, ast.Lambda):  # default values are made at import
                for default in filter(None, (*child.args.defaults, *child.args.kw_defaults)):
                    yield from read(default)

    assert not list(read(ast.parse(path.read_text(encoding="utf-8"))))


def test_choices_of_a_workspace_are_kept_and_damage_is_none(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert (store.settings.language, store.settings.toured) == ("", False)
    store.choose(language="de")
    store.choose(toured=True)
    assert (Store(tmp_path).settings.language, Store(tmp_path).settings.toured) == ("de", True)
    for damage in ("", "{", '{"toured": "perhaps"}', "[]"):
        (tmp_path / ".settings.json").write_text(damage)
        assert not Store(tmp_path).settings.toured
