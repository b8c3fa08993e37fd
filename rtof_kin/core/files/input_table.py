"""`InputTable`: base of the models of TOML and JSON files that people write.

A model is the only source of a table's fields, types, units, defaults and documentation. What a file has wrong is one
error of the package with file, table, field and remedy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PrivateAttr,
    Strict,
    ValidationError,
    ValidatorFunctionWrapHandler,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from rtof_kin.core.array_types import Array
from rtof_kin.core.docstrings import field_docstrings
from rtof_kin.core.errors import FileFormatError, RtofError, UnknownNameError, did_you_mean
from rtof_kin.core.files.text import LARGEST_NUMBER, load_toml, measurable

_LONGEST: Final = 40  #: Most characters of a wrong value in a message
_NUMBER: Final = "is not a finite number"
_PROBLEMS: Final = {
    "string_type": "is not text; put it in quotes",
    "bool_type": "is neither true nor false",
    **dict.fromkeys(("int_type", "int_from_float"), "is not a whole number"),
    **dict.fromkeys(("float_type", "finite_number", "greater_than_equal", "less_than_equal"), _NUMBER),
}
"""What is wrong with a value, by pydantic's type of the error."""


# --- types of fields -----------------------------------------------------------------------------


class ArrayOf:
    """Annotation of an array of finite numbers of a shape; (None,) is a row of one or more."""

    def __init__(self, *shape: int | None, also: tuple[tuple[int, ...], ...] = (), remedy: str = ""):
        """Take the shape, others that are read too, and the end of the sentence about any other one."""
        self.shape, self._shapes, self._remedy = shape, (shape, *also), remedy
        self.size = " x ".join(map(str, shape)) if None not in shape else "one or more"

    def checked(self, value: Any) -> Array:
        """Return the array of nested lists."""
        try:
            if any(isinstance(one, str | bool) for one in np.array(value, dtype=object).flat):
                raise ValueError("text and truth values are no numbers")  # NumPy would convert them
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise _fault(f"not {self.size} numbers in brackets ({error})") from error
        if not any(self._fits(array.shape, shape) for shape in self._shapes):
            raise _fault(f"expected {self.size} numbers, got shape {array.shape}{self._remedy}")
        if array.size == 0:
            raise _fault("not a row of numbers in brackets")
        if not (np.all(np.isfinite(array)) and measurable(array)):
            raise _fault("contains a number that is not finite; every one is needed")
        return array

    @staticmethod
    def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
        return len(shape) == len(wanted) and all(n in (None, m) for n, m in zip(wanted, shape, strict=True))

    def __get_pydantic_core_schema__(self, _: Any, __: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.checked)

    def __get_pydantic_json_schema__(self, _: CoreSchema, __: GetJsonSchemaHandler) -> JsonSchemaValue:
        node: dict[str, Any] = {"type": "number"}
        for n in reversed(self.shape):
            items = {"minItems": 1, "items": node} if n is None else {"minItems": n, "maxItems": n, "items": node}
            node = {"type": "array", **items}
        return node


class OneOf:
    """Annotation of a text that is one of some choices, or the name of a file."""

    def __init__(self, known: Callable[[], Iterable[str]], file: str = ""):
        """Take the choices, which are read anew for every value, and the ending of a file that may stand there."""
        self.known, self._file = known, file

    def checked(self, value: str) -> str:
        """Return the value."""
        if self._file and value.lower().endswith(self._file):
            return value
        if value not in (known := [*self.known()]):
            raise PydanticCustomError("literal_error", "is no choice", {"expected": str(known)})
        return value

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.checked, handler(str))

    def __get_pydantic_json_schema__(self, _: CoreSchema, __: GetJsonSchemaHandler) -> JsonSchemaValue:
        one = {"type": "string", "enum": [*self.known()]}
        return {"anyOf": [one, {"type": "string", "pattern": f"\\{self._file}$"}]} if self._file else one


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


class explained_by:  # reads as a word between types
    """Annotation with what an error says of any wrong value of a field."""

    def __init__(self, problem: str):
        """Take the end of the sentence that begins with the value."""
        self.problem = problem

    def checked(self, value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        """Return the value as the field has it."""
        try:
            return handler(value)
        except ValidationError as error:
            raise _fault(f"{_short(value)} {self.problem}") from error

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(self.checked, handler(kind))


Number = Annotated[float, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Positive = Annotated[float, Field(gt=0, le=LARGEST_NUMBER), explained_by("is not a positive number")]
Integer = Annotated[int, Field(ge=-(10**20), le=10**20), BeforeValidator(_whole)]
Count = Annotated[int, Field(ge=1, le=10**20), BeforeValidator(_whole), explained_by("is not a positive whole number")]
Vector2 = Annotated[Array, ArrayOf(2)]
Vector3 = Annotated[Array, ArrayOf(3)]
Quaternion = Annotated[Array, ArrayOf(4)]
Vector5 = Annotated[Array, ArrayOf(5)]
Matrix3 = Annotated[Array, ArrayOf(3, 3)]
Row = Annotated[Array, ArrayOf(None)]
Names = Annotated[tuple[str, ...], Strict(False), explained_by('is not a list of names; write e.g. ["Hips", "Spine"]')]


# --- tables --------------------------------------------------------------------------------------


class Rule(NamedTuple):
    """What a table must or must not have beside other fields."""

    problem: str = ""  #: Rest of the error's sentence about the first field that is excluded or missing
    given: tuple[str, ...] = ()  #: It holds where one of these is given,
    absent: tuple[str, ...] = ()  #: none of these is given,
    ending: str = ""  #: and the field ``file`` ends so
    excluded: tuple[str, ...] = ()
    required: tuple[str, ...] = ()

    def check(self, table: InputTable) -> None:
        """Raise `PydanticCustomError` if a table does not keep it."""
        if (self.given and not any(map(table.has, self.given))) or any(map(table.has, self.absent)):
            return
        if self.ending and not str(getattr(table, "file", "")).lower().endswith(self.ending):
            return
        for field in self.excluded:
            if table.has(field):
                raise _fault(self.problem, field)
        for field in self.required:
            if not table.has(field):
                raise _fault(self.problem or table.missing(field), field)


class InputTable(BaseModel):
    """A table of a file that people write; other fields than those of the model are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    rules: ClassVar[tuple[Rule, ...]] = ()
    _path: Path = PrivateAttr(default=Path())
    _name: str = PrivateAttr(default="")

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a TOML file; `FileFormatError` or `UnknownNameError`, which names file, field and remedy, where it does
        not exist, is not TOML or has something wrong.
        """
        return cls.of(load_toml(path), Path(path))

    @classmethod
    def of(cls, data: Any, path: Path, name: str = "") -> Self:
        """Make a table of plain data, whose name in the file is '' at the top level; errors as `read`."""
        try:
            table = cls.model_validate(data)
        except ValidationError as error:
            raise _explained(error, data, path, name) from error
        _locate(table, path, name)
        return table

    @property
    def path(self) -> Path:
        """File."""
        return self._path

    def where(self, field: str) -> str:
        """Return the name of a field in messages, e.g. ``[camera] width_px``."""
        return f"[{self._name}] {field}" if self._name else field

    def error(self, field: str, problem: str) -> FileFormatError:
        """Return an error about a field."""
        return FileFormatError(self._path, f"{self.where(field)}: {problem}")

    def has(self, field: str) -> bool:
        """Return whether a field is given."""
        return field in self.model_fields_set

    @classmethod
    def missing(cls, field: str) -> str:
        """Return the end of the sentence about a field that is not given."""
        return f"missing; add it: {cls.descriptions().get(field, field)}"

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Return the docstrings of the fields, which are read only where they are shown."""
        own = cls.__pydantic_generic_metadata__["origin"] or cls
        tables = [base for base in reversed(own.__mro__) if issubclass(base, InputTable) and base is not InputTable]
        return {name: text for table in tables for name, text in field_docstrings(table).items()}

    @model_validator(mode="before")
    @classmethod
    def _has_its_fields(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        unknown = [name for name in data if name not in cls.model_fields]
        if unknown and cls.model_config["extra"] == "forbid":
            names = {"unknown": unknown, "known": sorted(cls.model_fields)}
            raise PydanticCustomError("extra_forbidden", "unknown field", {"field": unknown[0], **names})
        for name, field in cls.model_fields.items():
            if field.is_required() and name not in data:
                raise _fault(cls.missing(name), name)
        return data

    @model_validator(mode="after")
    def _keeps_rules(self) -> Self:
        for rule in self.rules:
            rule.check(self)
        return self


def _fault(problem: str, field: str = "") -> PydanticCustomError:
    return PydanticCustomError("fault", "{problem}", {"problem": problem, "field": field})


def _locate(table: InputTable, path: Path, name: str) -> None:
    """Write file and name into a table and those inside it."""
    table._path, table._name = path, name
    for field in table.model_fields_set & set(type(table).model_fields):
        value, inner = getattr(table, field), f"{name}.{field}" if name else field
        if isinstance(value, InputTable):
            _locate(value, path, inner)
        elif isinstance(value, dict | tuple):
            rows = value.items() if isinstance(value, dict) else enumerate(value, start=1)
            for key, row in rows:
                if isinstance(row, InputTable):
                    _locate(row, path, f"{inner}.{key}")


# --- errors --------------------------------------------------------------------------------------


def _explained(found: ValidationError, data: Any, path: Path, name: str) -> RtofError:
    """Return the package's error about what is wrong first: unknown fields, which may be required ones misspelt."""
    first = min(found.errors(include_url=False), key=lambda error: error["type"] != "extra_forbidden")
    steps: list[Any] = list(first["loc"])
    context = first.get("ctx", {})
    steps += [context["field"]] if context.get("field") else []
    table, label = data, name
    while len(steps) > 1 and isinstance(table, dict):
        inner, step = table.get(steps[0]), str(steps[0])
        if isinstance(inner, list) and isinstance(steps[1], int):
            inner, step = inner[steps[1]], f"{step}.{steps.pop(1) + 1}"
        if not isinstance(inner, dict):
            break
        table, label = inner, f"{label}.{step}" if label else step
        del steps[0]
    if not steps:
        return FileFormatError(path, "not a table of fields with values")
    field, title = str(steps[0]), f"[{label}] " if label else ""
    if first["type"] == "extra_forbidden":
        return UnknownNameError("field", context["unknown"], context["known"], path, title.strip())
    problem = context.get("problem") or _problem(first, table.get(steps[0]), f"{label}.{field}" if label else field)
    return FileFormatError(path, f"{title}{field}: {problem}")


def _problem(found: ErrorDetails, value: Any, name: str) -> str:
    """Return what is wrong with a value of another kind than that of its field, and the remedy."""
    kind = found["type"]
    if kind == "literal_error":
        expected = found["ctx"]["expected"]
        known = re.findall("'([^']*)'", expected) or [expected]
        hint = did_you_mean([str(value)], known)
        return f"{_short(value)} is not one of {', '.join(known)}{'.' if hint else ''}{hint}"
    if kind in _PROBLEMS:
        return f"{_short(value)} {_PROBLEMS[kind]}"
    if kind in ("tuple_type", "list_type") or isinstance(found["loc"][-1], int):  # an element is no table
        return f"not tables in a row; begin each with [[{name}]]"
    return f"not a table; write its fields under [{name}]"


def _short(value: Any) -> str:
    return repr(value)[:_LONGEST]
