"""Residuals of one frame or some in a row, as CasADi functions; half their squares are the energy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from benchmarks.peers.fragments import Fragment
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics import c_compiler


@dataclass(frozen=True)
class Window:
    """Residuals of some frames in a row, as symbols."""

    name: str
    width: int
    residual: Any
    z: Any
    """(width F,) variables, frame by frame."""
    parameters: tuple[Any, ...]
    values: Callable[[Fragment], Array]
    """Fragment -> (windows, P) values of the parameters."""


@dataclass(frozen=True)
class Residuals:
    """The same residuals at every frame; half their squares are a part of the energy."""

    width: int
    """Frames in a row that they see."""
    values: Callable[[Fragment], Array]
    """Fragment -> (windows, P) parameters."""
    value: Any
    """(z (width F,), parameters (P,)) -> residuals (R,)."""
    jacobian: Any
    """The same -> residuals and their sparse Jacobian (R, width F)."""

    def windows(self, frames: int) -> int:
        """Number of residuals in N frames."""
        return frames - self.width + 1


def built(windows: Sequence[Window]) -> list[Residuals]:
    """CasADi functions of the residuals, compiled together as the package's are."""
    functions = []
    for w in windows:
        inputs, option = [w.z, ca.vertcat(*(ca.vec(p) for p in w.parameters))], {"cse": True}
        r = ca.densify(ca.vec(w.residual))
        functions.append(ca.Function(f"{w.name}_value", inputs, [r], option))
        functions.append(ca.Function(f"{w.name}_jacobian", inputs, [r, ca.jacobian(r, w.z)], option))
    built = compiled(functions)
    return [Residuals(w.width, w.values, built[2 * i], built[2 * i + 1]) for i, w in enumerate(windows)]


def symbols(**shapes: tuple[int, int]) -> dict[str, Any]:
    """CasADi symbols by name."""
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def column(value: Array, count: int) -> Array:
    """The same value, column-major, for every window."""
    return np.tile(np.ravel(value, order="F"), (count, 1))


def rows_of(z: Array, width: int) -> Array:
    """(N - width + 1, width F) rows of some frames in a row."""
    view = np.lib.stride_tricks.sliding_window_view(z, width, axis=0)
    return np.swapaxes(view, 1, 2).reshape(len(view), -1)


def huber(r: Any, weight: Any, delta: float) -> Any:
    """Residuals whose squares sum to `energies.pseudo_huber` of the weighted square."""
    factor = 2 / (1 + ca.sqrt(1 + weight * ca.sumsqr(r) / delta**2))
    return ca.sqrt(weight) * ca.sqrt(factor) * r


def cauchy(r: Any, weight: Any) -> Any:
    """Residuals whose squares sum to `energies.cauchy` of the weighted square."""
    squared = weight * ca.sumsqr(r) + 1e-12
    return ca.sqrt(weight) * ca.sqrt(ca.log1p(squared) / squared) * r


def compiled(functions: list[Any]) -> list[Any]:
    """CasADi functions as scalar machine code; as they are where it cannot be compiled."""

    def source() -> str:
        generator = ca.CodeGenerator("energy.c")
        for function in functions:
            generator.add(function)
        return str(generator.dump())

    def loaded(library: Path) -> list[Any]:
        return [ca.external(function.name(), str(library)) for function in functions]

    made_of = "".join(function.serialize() for function in functions)
    return c_compiler.built(made_of, source, loaded) or functions
