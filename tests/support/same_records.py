"""Equality of records to the last bit."""

from __future__ import annotations

from dataclasses import fields

import numpy as np


def assert_same(a: object, b: object, where: str = "recording") -> None:
    """Equal to the last bit, field by field, but for whether a unit was checked."""
    assert type(a) is type(b), where
    if hasattr(a, "__dataclass_fields__"):
        for field in fields(a):  # type: ignore[arg-type]
            if field.name != "unit_checked":
                assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, tuple):
        for i, (one, other) in enumerate(zip(a, b, strict=True)):  # type: ignore[call-overload]
            assert_same(one, other, f"{where}[{i}]")
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=where, strict=True)  # type: ignore[arg-type]
    else:
        assert a == b, where
