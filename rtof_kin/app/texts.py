"""All texts of the application: a file for each language in ``assets``; what it does not translate is as in English.

`TEXTS` are those of the language that was chosen last in this process: read them where they are shown, not at import.
"""

from __future__ import annotations

import locale
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from pydantic import BaseModel

from rtof_kin.core.files.text import load_toml

_CATALOGUES: Final = Path(__file__).parent / "assets"
_ENGLISH: Final = "en-US"


class Texts(BaseModel, frozen=True, extra="allow"):
    """The texts of a language: those by other names, and single ones as attributes. Names in braces are filled in."""

    __pydantic_extra__: dict[str, str]
    levels: tuple[str, ...]
    states: dict[str, str]
    corrections: dict[str, str]
    pages: dict[str, str]
    sources: dict[str, str]
    kinds: dict[str, str]
    stages: dict[str, str]
    steps: dict[str, str]
    poses: dict[str, str]
    options: dict[str, str]
    """What the engine says of options of the command line, as patterns, and how a page calls them."""
    segments: dict[str, str]
    """Segments that carry sensors."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> str: ...


@cache
def languages() -> dict[str, Texts]:
    """Return the catalogues by their codes."""
    english = load_toml(_CATALOGUES / "english.toml")
    found = (Texts(**english | load_toml(path)) for path in sorted(_CATALOGUES.glob("*.toml")))
    return {texts.code: texts for texts in found}


class _Chosen:
    def __init__(self) -> None:
        self.texts = languages()[_ENGLISH]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.texts, name)


_chosen: Final = _Chosen()
TEXTS: Final = cast(Texts, _chosen)


def speak(code: str = "") -> None:
    """Choose the language of this process; by default that of the machine, else English."""
    known = languages()
    local = (locale.getlocale()[0] or "").lower()  # German_Germany on Windows
    _chosen.texts = known.get(code) or known["de" if local.startswith(("de_", "german")) else _ENGLISH]


def worded(sentence: str) -> str:
    """Return a sentence of the engine in the words of a page: without options of the command line."""
    for pattern, words in TEXTS.options.items():
        sentence = re.sub(pattern, words, sentence)
    return sentence
