"""Lists that other packages and scripts add to: formats of sensor files, layouts of detectors.

An installed package names what it adds in its ``pyproject.toml``, as an entry point, and every command and
function then knows it. A script adds for its own process.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cached_property
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from rtof_kin.core.errors import ExtensionError, InvalidInputError

T = TypeVar("T")


class Extensions(Generic[T]):
    """What is added to one list of this package."""

    def __init__(self, group: str, kind: type[T], name: Callable[[T], str]) -> None:
        """Describe the list."""
        self.group, self._kind, self._name = group, kind, name
        self._added: dict[str, T] = {}

    def all(self) -> tuple[T, ...]:
        """Return what installed packages and this process have added, in alphabetical order.

        Raises:
            ExtensionError: an installed package's cannot be loaded, or is of another type.
        """
        found = self._installed | self._added
        return tuple(found[name] for name in sorted(found))

    def add(self, item: T, built_in: Collection[str] = ()) -> None:
        """Add to the list of this process; an item added before under the same name is replaced.

        Raises:
            InvalidInputError: its name is taken.
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
