"""Packages that only some features need: imported where they are used; one sentence where missing."""

from __future__ import annotations

import logging
from importlib import import_module
from typing import Any

from rtof_kin.core.errors import MissingPackageError

_log = logging.getLogger(__name__)


def optional(module: str, extra: str, purpose: str = "this", remedy: str = "") -> Any:
    """Import a module of an optional package.

    Args:
        extra: this package's extra that installs it. purpose: what needs it, the subject of the error's sentence.

    Raises:
        MissingPackageError: it is not installed, or its libraries cannot be loaded.
    """
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:  # the last two: of a shared library
        absent = isinstance(error, ModuleNotFoundError) and (error.name or module).split(".")[0] == package
        why = "is not installed" if absent else f"cannot be loaded ({error})"
        said = f"{purpose} needs {package}, which {why}: {remedy or install(extra)}"
        raise MissingPackageError(said) from error


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
