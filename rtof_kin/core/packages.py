"""Packages that only some features need: imported where they are used; one sentence where missing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from functools import cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from rtof_kin.core.errors import ExtensionError, InvalidInputError, MissingPackageError

_log = logging.getLogger(__name__)


def optional(module: str, extra: str, purpose: str = "this", remedy: str = "") -> Any:
    """Import a module of an optional package, which this package's extra installs; `MissingPackageError`, which says
    what needs it, where it is not installed, or its libraries cannot be loaded.
    """
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:  # the last two: of a shared library
        absent = isinstance(error, ModuleNotFoundError) and (error.name or module).split(".")[0] == package
        why = "is not installed" if absent else f"cannot be loaded ({error})"
        said = f"{purpose} needs {package}, which {why}: {remedy or install(extra)}"
        raise MissingPackageError(said) from error


class on_use:  # reads as an adverb of an import
    """A module that is imported when something of it is used for the first time."""

    def __init__(self, name: str) -> None:
        """Take the module's name."""
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


casadi: Any = on_use("casadi")  #: A compiled energy does not need it


def install(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return f'pip install "rtof-kin[{extra}]"'


def can_draw() -> bool:
    """Return whether figures can be drawn; if not, a warning says what to install."""
    try:
        optional("matplotlib", "figures", "a figure")
    except MissingPackageError as missing:
        _log.warning("figures are left out: %s", missing)
        return False
    return True


T = TypeVar("T")


class Extensions(Generic[T]):
    """What is added to one list of this package.

    An installed package names it in its ``pyproject.toml``, as an entry point of `group`, and every command and
    function then knows it; a script adds it for its own process.
    """

    def __init__(self, group: str, kind: type[T], name: Callable[[T], str]) -> None:
        self.group, self._kind, self._name = group, kind, name
        self._added: dict[str, T] = {}

    def all(self) -> tuple[T, ...]:
        """Return what installed packages and this process have added, by name; `ExtensionError` where an installed
        package's cannot be loaded, or is of another type.
        """
        found = self._installed | self._added
        return tuple(found[name] for name in sorted(found))

    def add(self, item: T, built_in: Collection[str] = ()) -> None:
        """Add to the list of this process, in place of an earlier one of this name; a built-in name raises
        `InvalidInputError`.
        """
        if self._name(item) in built_in:
            raise InvalidInputError(f"{self._name(item)!r} is the name of one that is built in; choose another")
        self._added[self._name(item)] = item

    @cached_property
    def _installed(self) -> dict[str, T]:
        """Name -> item of installed packages."""
        found = {}
        for point in entry_points(group=self.group):
            where = f"entry point {point.value!r} of {point.dist.name if point.dist else 'a package'}"
            try:
                item = point.load()
            except Exception as error:
                problem = f"{where} cannot be loaded: {error}; repair or uninstall that package"
                raise ExtensionError(problem) from error
            if not isinstance(item, self._kind):
                raise ExtensionError(f"{where} is a {type(item).__name__}, not a {self._kind.__name__}")
            found[self._name(item)] = item
        return found
