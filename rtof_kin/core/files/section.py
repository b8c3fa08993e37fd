"""A table of a TOML file, read field by field; every error names file, field and remedy."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.text import LARGEST_NUMBER, load_toml, measurable


class Section:
    """A table of a TOML file. `close` refuses fields that were not read.

    Every method that reads a field raises `FileFormatError` if it is missing or of the wrong kind.
    """

    def __init__(self, path: Path, data: dict[str, Any], name: str = ""):
        """Take the file, the table and its name ('' for the top level); `data` is the table."""
        self.path, self.name = path, name
        self.data = data
        self._asked: set[str] = set()

    @classmethod
    def of_file(cls, path: Path) -> Self:
        """Read the top level of a file.

        Raises:
            FileFormatError: it does not exist or is not TOML.
        """
        return cls(path, load_toml(path))

    def where(self, field: str) -> str:
        """Return the name of a field in messages, e.g. ``[camera] width_px``."""
        return f"[{self.name}] {field}" if self.name else field

    def error(self, field: str, problem: str) -> FileFormatError:
        """Return an error about a field."""
        return FileFormatError(self.path, f"{self.where(field)}: {problem}")

    def has(self, field: str) -> bool:
        """Return whether a field exists, and mark it as read."""
        self._asked.add(field)
        return field in self.data

    def __len__(self) -> int:
        return len(self.data)

    def keys(self) -> list[str]:
        """Return the names of all fields, and mark them as read."""
        self._asked.update(self.data)
        return list(self.data)

    # --- values ----------------------------------------------------------------------------------

    def _value(self, field: str, missing: str) -> Any:
        if not self.has(field):
            left = [name for name in self.data if name not in self._asked]
            for near in get_close_matches(field, left, n=1, cutoff=0.8):
                missing = f"there is {near!r}, which may be misspelt"
            raise self.error(field, f"missing; {missing}")
        return self.data[field]

    def text(self, field: str, default: str | None = None) -> str:
        """Return a string; required unless there is a default."""
        if default is not None and not self.has(field):
            return default
        value = self._value(field, f'add e.g. {field} = "..."')
        if not isinstance(value, str):
            raise self.error(field, f"{value!r} is not text; put it in quotes")
        return value

    def optional_text(self, field: str) -> str | None:
        """Return a string, or None if absent."""
        return self.text(field) if self.has(field) else None

    def number(self, field: str, default: float | None = None) -> float:
        """Return a finite number; required unless there is a default."""
        if default is not None and not self.has(field):
            return default
        value = self._value(field, f"add e.g. {field} = 1.0")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(field, f"{value!r} is not a finite number")
        if not abs(value) <= LARGEST_NUMBER:
            raise self.error(field, f"{str(value)[:40]} is not a finite number")
        return float(value)

    def optional_number(self, field: str) -> float | None:
        """Return a finite number, or None if absent."""
        return self.number(field) if self.has(field) else None

    def integer(self, field: str, default: int | None = None) -> int:
        """Return a whole number; required unless there is a default."""
        value = self.number(field, None if default is None else float(default))
        if value != int(value):
            raise self.error(field, f"{value!r} is not a whole number")
        return int(value)

    def flag(self, field: str) -> bool:
        """Return whether a field is true; false if absent."""
        value = self.has(field) and self.data[field]
        if not isinstance(value, bool):
            raise self.error(field, f"{value!r} is neither true nor false")
        return value

    def array(self, field: str, shape: Sequence[int]) -> Array:
        """Return a required array of finite numbers of a given shape."""
        size = " x ".join(map(str, shape))
        value = self._value(field, f"add {size} numbers")
        try:
            if any(isinstance(one, str | bool) for one in np.array(value, dtype=object).flat):
                raise ValueError("text and truth values are no numbers")  # NumPy would convert them
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error(field, f"not {size} numbers in brackets ({error})") from error
        if array.shape != tuple(shape):
            raise self.error(field, f"expected {size} numbers, got shape {array.shape}")
        if not (np.all(np.isfinite(array)) and measurable(array)):
            raise self.error(field, "contains a number that is not finite; every one is needed")
        return array

    def numbers(self, field: str) -> Array:
        """Return a required row of one or more finite numbers."""
        value = self._value(field, "add one or more numbers in brackets")
        if not isinstance(value, list) or not value:
            raise self.error(field, "not a row of numbers in brackets")
        return self.array(field, (len(value),))

    def optional_array(self, field: str, shape: Sequence[int]) -> Array | None:
        """Return an array of finite numbers, or None if absent."""
        return self.array(field, shape) if self.has(field) else None

    def optional_names(self, field: str) -> tuple[str, ...] | None:
        """Return a list of strings, or None if absent."""
        if not self.has(field):
            return None
        value = self.data[field]
        if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
            raise self.error(field, 'not a list of names; write e.g. ["Hips", "Spine"]')
        return tuple(value)

    def table(self, field: str) -> Section:
        """Return a table inside this one; empty if absent."""
        value = self.data[field] if self.has(field) else {}
        name = f"{self.name}.{field}" if self.name else field
        if not isinstance(value, dict):
            raise self.error(field, f"not a table; write its fields under [{name}]")
        return Section(self.path, value, name)

    def tables(self, field: str) -> list[Section]:
        """Return the tables of an array of tables, written ``[[field]]``; none if absent."""
        values = self.data[field] if self.has(field) else []
        if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
            raise self.error(field, f"not tables in a row; begin each with [[{field}]]")
        name = f"{self.name}.{field}" if self.name else field
        return [Section(self.path, value, f"{name}.{i}") for i, value in enumerate(values, start=1)]

    def close(self) -> None:
        """Refuse fields that were not read: they are misspelt or of another format.

        Raises:
            UnknownNameError: names them and the nearest valid field.
        """
        unknown = [field for field in self.data if field not in self._asked]
        if unknown:
            table = f"[{self.name}]" if self.name else ""
            raise UnknownNameError("field", unknown, sorted(self._asked), self.path, table)
