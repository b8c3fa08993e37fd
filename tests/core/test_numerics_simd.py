"""SIMD functions of several frames against CasADi's interpreter, frame by frame."""

from __future__ import annotations

import platform
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.numerics import c_compiler as module
from rtof_kin.core.numerics import simd
from rtof_kin.core.numerics.simd import GROUP, Columns, FrameFunction, Mapped, Over, compile_simd

Array = NDArray[np.float64]
pytestmark = pytest.mark.skipif(not any(map(shutil.which, module.COMPILERS)), reason="there is no C compiler")
VECTORS = [(), ("-mno-avx512f",), ("-mno-avx",)] if platform.machine() == "x86_64" else [()]
"""Compiler options for all vector lengths of this machine."""


@pytest.fixture(autouse=True)
def cache(compile_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and quick compilation."""
    monkeypatch.setattr(simd, "_OPTIONS", ("-O1",))
    return compile_cache


@pytest.fixture(params=VECTORS, ids=str)
def vectors(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each vector length in turn."""
    monkeypatch.setattr(simd, "native", lambda: (*module.native(), *request.param))


def everything() -> FrameFunction:
    """A function of all operations; its second input is shared."""
    x, s = ca.SX.sym("x", 4), ca.SX.sym("s", 2)
    a, b = x[0], x[1]
    numbers = [
        a + b,
        a - b,
        a * b,
        a / b,
        -a,
        a**2,
        2 * a,
        1 / b,
        a < b,
        a <= b,
        a == b,
        a != b,
        ca.logic_not(x[2]),
        ca.logic_and(x[2], x[3]),
        ca.logic_or(x[2], x[3]),
        ca.fmin(a, b),
        ca.fmax(a, b),
        ca.fabs(a),
        ca.sign(a),
        ca.sqrt(ca.fabs(a)),
        ca.floor(a),
        ca.log(ca.fabs(b)),
        ca.sin(a),
        ca.cos(a),
        ca.atan2(a, b),
        ca.if_else(a < b, a, b),
        ca.SX(2.5),
        s[0] * a + s[1],
        b,
    ]
    outputs = [ca.densify(ca.vertcat(*numbers)), ca.densify(x * s[1])]
    return FrameFunction.of(ca.Function("everything", [x, s], outputs), (1,))


def inputs(frames: int, size: int, seed: int = 0) -> Array:
    """(T, n) including equal, negative and zero numbers."""
    x = np.random.default_rng(seed).normal(size=(frames, size)) * 3
    x[::3, 1] = x[::3, 0]
    x[::2, 2:] = 0.0
    return x


def one_by_one(function: Any, x: Array, *shared: Array) -> list[Array]:
    rows = [[np.array(v).ravel() for v in function.call([row, *shared])] for row in x]
    return [np.array(column) for column in zip(*rows, strict=True)]


def code_of(*given: FrameFunction) -> dict[str, Any]:
    made = compile_simd(lambda: (given, None))
    assert made is not None
    assert {name: replace(g, expression=None) for name, g in made.functions.items()} == {
        g.name: replace(g, expression=None) for g in given
    }
    return made.code


@pytest.mark.usefixtures("vectors")
def test_every_operation_equals_the_interpreter() -> None:
    given, shared = everything(), np.array([0.7, -1.3])
    code = code_of(given)["everything"]
    for frames, of in ((1, code), (2, code), (7, code), (8, code), (9, code), (21, code), (9, None)):
        x = inputs(frames, 4, frames)
        mapped = Mapped(of, given, frames)
        for _ in range(2):
            for own, expected in zip(mapped(x, shared), one_by_one(given.expression, x, shared), strict=True):
                np.testing.assert_allclose(own, expected, rtol=1e-13, atol=1e-13)


def test_neighbouring_frames_are_the_shifted_array_and_zero_beyond() -> None:
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 2)
    given = FrameFunction.of(ca.Function("between", [x, y], [y - x]))
    columns = Columns(10)
    rows = np.random.default_rng(0).normal(size=(10, 2))
    here, out = columns.given(rows), columns.zeros(2)
    for code in (code_of(given)["between"], None):
        Over(code, given, 10, [columns.at(here, -1), columns.at(here)], [columns.at(out)])()
        np.testing.assert_array_equal(columns.rows(out), np.diff(rows, axis=0, prepend=0.0))
        Over(code, given, 9, [columns.at(here), columns.at(here, 1)], [columns.at(out)])()
        np.testing.assert_array_equal(columns.rows(out)[:9], np.diff(rows, axis=0))
        assert not columns.rows(out)[9].any()


@pytest.mark.usefixtures("vectors")
def test_placed_output_is_scattered_in_every_frame() -> None:
    x = ca.SX.sym("x", 3)
    numbers = ca.vertcat(*(x[i % 3] * (i + 1) for i in range(3 * GROUP)))
    given = FrameFunction.of(ca.Function("placed", [x], [ca.sum1(x), numbers]), placed=True)
    columns, rows = Columns(13), np.random.default_rng(0).normal(size=(13, 3))
    places, expected = np.array([40, 3, 21]), np.full((13, 60), -1.0)
    all_numbers = rows[:, np.arange(3 * GROUP) % 3] * np.arange(1, 3 * GROUP + 1)
    for g, place in enumerate(places):
        expected[:, place : place + GROUP] = all_numbers[:, g * GROUP : (g + 1) * GROUP]
    for code in (code_of(given)["placed"], None):
        total, matrix = columns.zeros(1), np.full((13, 60), -1.0)
        Over(code, given, 13, [columns.at(columns.given(rows))], [columns.at(total), matrix], places)()
        np.testing.assert_allclose(matrix, expected, rtol=1e-14)
        np.testing.assert_allclose(columns.rows(total)[:, 0], rows.sum(axis=1), rtol=1e-13, atol=1e-14)


def zeros(rows: int, frames: int = 9) -> Array:
    return Columns(frames).at(Columns(frames).zeros(rows))


def test_library_is_cached_by_function_and_sharing(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = everything()
    code_of(given)
    code_of(FrameFunction.of(given.expression))
    assert len(list(cache.glob("*.so"))) == 2
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert set(code_of(given)) == {"everything"}


@pytest.mark.parametrize("reason", ["compiler", "operation", "environment"])
def test_functions_that_cannot_be_compiled_have_no_code(
    reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    given, x = everything(), ca.SX.sym("x")
    if reason == "compiler":
        monkeypatch.setattr(shutil, "which", lambda name: None)
    elif reason == "environment":
        monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    else:
        given = FrameFunction.of(ca.Function("curve", [x], [ca.erf(x)]))
    assert compile_simd(lambda: ([given], None)) is None
    assert ("it is interpreted, which is slower" in caplog.text) == (reason != "environment")
    assert ("curve: no C is known for CasADi's operation" in caplog.text) == (reason == "operation")
