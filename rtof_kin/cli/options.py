"""Options of commands: from the parameters of their functions and the fields of settings.

A command is a function with typed parameters and a docstring; cyclopts makes options of them. A parameter of
a settings' dataclass that is annotated with `Fields` becomes one option for each named field, with the field's
docstring, type and default, so that no field is described twice.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from functools import partial, wraps
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Final, Literal, get_args, get_origin, get_type_hints

from cyclopts import Parameter, Token, convert

from rtof_kin.core.docstrings import field_docstrings
from rtof_kin.setup.settings import ReconstructionTask, SetupSettings

Function = Callable[..., Any]


class Fields:
    """Fields of a settings' dataclass that become options of a command.

    `names`: of the fields, separated by spaces. `renamed`: field -> option, without dashes. `of`: 'module:class', where
    the parameter is annotated as a mapping; the command then gets only the values that were given. group: title in the
    help. defaults: field -> default, where it is not that of the class.
    """

    def __init__(
        self, names: str = "", of: str = "", group: str = "", defaults: Mapping[str, Any] | None = None, **renamed: str
    ):
        self.options = {name: name for name in names.split()} | renamed
        self.of, self.group, self.defaults = of, group, defaults or {}


def command(function: Function) -> Function:
    """Return a function whose parameters are all options, with converters that accept a comma as decimal point
    and lists with commas, and settings filled from their fields.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    filled: dict[str, tuple[type, Fields]] = {}
    for parameter in inspect.signature(function).parameters.values():
        hint = hints[parameter.name]
        chosen = next((one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Fields)), None)
        if chosen is None:
            parameters.append(parameter.replace(annotation=_option(hint, parameter.default)))
            continue
        module, _, name = chosen.of.partition(":")
        settings = getattr(import_module(module), name) if chosen.of else get_args(hint)[0]
        filled[parameter.name] = settings, chosen
        parameters += _options_of(*filled[parameter.name])

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        for name, (settings, chosen) in filled.items():
            given = {field: named.pop(field) for field in chosen.options if field in named}
            named[name] = given if chosen.of else settings(**{**chosen.defaults, **given})
        return function(*arguments, **named)

    parameters.sort(key=lambda one: one.kind)
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {one.name: one.annotation for one in parameters}
    text = inspect.cleandoc(function.__doc__ or "")
    call.__doc__ = re.sub(r"(?<=\S)\n(?: {8,}|(?=\S))", " ", text)  # paragraphs in one line, for any width
    return call


def _options_of(settings: type, chosen: Fields) -> Iterable[inspect.Parameter]:
    """Yield the options of some fields of a dataclass."""
    described = descriptions(settings)
    known: Mapping[str, Field[Any]] = {field.name: field for field in fields(settings)}
    annotations = {name: known[name].type for name in chosen.options}  # types of other fields may be costly to import
    plain = type(settings.__name__, (), {"__annotations__": annotations, "__module__": settings.__module__})
    hints = get_type_hints(plain, include_extras=True)
    for name, option in chosen.options.items():
        default, factory = chosen.defaults.get(name, known[name].default), known[name].default_factory
        if default is MISSING and callable(factory):
            default = factory()
        required = default is MISSING
        usual = "" if required or default is None else str(default)
        if isinstance(default, tuple):
            usual = ",".join(map(str, default))
        how = Parameter(name=f"--{option.replace('_', '-')}", help=described[name], show_default=False)
        if chosen.group:
            how = Parameter.combine(how, Parameter(group=chosen.group))
        if usual and not isinstance(default, bool):
            how = Parameter.combine(how, Parameter(show_default=partial(_constant, usual)))
        kind = hints[name] | None if chosen.of and not required else hints[name]
        hint = _option(kind, MISSING if required else default, how)
        empty = inspect.Parameter.empty if required else None if chosen.of else default
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=empty, annotation=hint)


def _constant(text: str, _: Any) -> str:
    return text


def descriptions(settings: type) -> dict[str, str]:
    """Return the docstring of each field of a class, in one line that begins with a small letter."""
    lines = {name: text.replace("`", "").removesuffix(".") for name, text in field_docstrings(settings).items()}
    return {name: line[0].lower() + line[1:] if line[1:2].islower() else line for name, line in lines.items()}


def _option(hint: Any, default: Any, how: Parameter | None = None) -> Any:
    """Return a type with what cyclopts needs to read and to show it."""
    own = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Parameter)]
    plain = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    optional = NoneType in get_args(plain) and len(get_args(plain)) == 2
    inner = next(one for one in get_args(plain) if one is not NoneType) if optional else plain
    usual = Parameter(show_default=False if default in ((), "") else None, negative=None if inner is bool else ())
    if inner is bool:
        usual = Parameter(negative=() if default is False else None, show_default=False)
    elif inner is float:
        usual = Parameter(converter=_decimal, metavar="X")
    elif inner == tuple[int, int]:
        usual = Parameter(converter=_size, n_tokens=1, metavar="WxH", negative=())
    elif inner == tuple[Path, ...]:
        usual = Parameter(consume_multiple=True, metavar="FILE", negative=(), show_default=False)
    elif get_origin(inner) is tuple and get_args(inner)[-1] is Ellipsis:
        usual = Parameter.combine(usual, Parameter(converter=_listed, n_tokens=1, metavar="NAMES"))
    elif get_origin(inner) is Literal and any("_" in str(choice) for choice in get_args(inner)):
        choices = [str(choice).replace("_", "-") for choice in get_args(inner)]
        usual = Parameter(converter=lambda _, tokens: tokens[0].value.replace("-", "_"), choices=choices)
    return Annotated[plain, Parameter.combine(usual, how, *own)]


def _decimal(_: Any, tokens: Sequence[Token]) -> float:
    text = tokens[0].value
    try:
        return float(text.replace(",", "."))
    except ValueError as error:
        raise ValueError(f"{text!r} is not a number, such as 1.72 (without its unit)") from error


def _listed(hint: Any, tokens: Sequence[Token]) -> tuple[Any, ...]:
    """Return the parts of texts that are separated by commas, each once; 'none' is an empty list."""
    texts = [part.strip() for token in tokens for part in token.value.split(",")]
    kind = get_args(next((one for one in (hint, *get_args(hint)) if get_origin(one) is tuple), hint))[0]
    return tuple(dict.fromkeys(convert(kind, [text]) for text in texts if text and text != "none"))


def _size(_: Any, tokens: Sequence[Token]) -> tuple[int, int]:
    text = tokens[0].value
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise ValueError(f"{text!r} is not width x height, such as 1920x1080")
    return int(width), int(height)


# --- options of several commands: each has one name and one meaning -----------------------------------------------


def written(what: str, metavar: str = "OUT") -> Parameter:
    """Return the option -o for what a command writes."""
    return Parameter(name=("--output", "-o"), metavar=metavar, help=what)


Output = Annotated[Path, written("folder to write")]
File = Annotated[Path, written("file to write", "FILE")]
Overwrite = Annotated[bool, Parameter(help="replace what an earlier run wrote there")]
Model = Annotated[ReconstructionTask, Fields("model")]
PERSON: Final = "subject update_subject"
"""Fields of `ReconstructionTask` for the person's file, of commands that may update it."""
Models = Annotated[SetupSettings, Fields("model_dir provider people_every")]
FetchModels = Annotated[
    Literal["rtmpose", "mediapipe"] | None,
    Parameter(
        help="agree to download the detector's models once: rtmpose (26 points, 158 MB) or mediapipe (33 points, "
        "10 MB); prints licence and checksums"
    ),
]
Seconds = Annotated[float | None, Parameter(metavar="S", help="use as many seconds at most")]
Seed = Annotated[int, Parameter(help="of everything drawn at random; the same seed, the same numbers")]
Threads = Annotated[
    int | None, Parameter(metavar="N", help="processor cores that are used; default: all that this process may use")
]
Paper = Annotated[bool, Parameter(group="Solver", help="the energy as printed, in cartesian space")]
_SOLVER: Final = "frames space guards lift_with_sensors"
SOLVER: Final = Fields(_SOLVER, group="Solver")
"""Fields of `ReconstructionSettings` that are options."""
CERTIFIED: Final = f"{_SOLVER} certificate"  #: Those of commands that also certify a recording
Start = Annotated[float | None, Parameter(metavar="S", help="begin at this time")]
Stop = Annotated[float | None, Parameter(metavar="S", help="end at this time")]
Fps = Annotated[float, Parameter(metavar="HZ", help="poses per second of what is written or sent, at most")]
Browser = Annotated[bool, Parameter(help="open the browser")]
