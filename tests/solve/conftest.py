"""The tests of the solvers evaluate interpreted energies, each of its own, unless they ask for compiled ones."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="package", autouse=True)
def _interpreted() -> Iterator[None]:
    """Compiling an energy takes longer than the tests that use it; `compile_cache` turns it on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_COMPILE", "never")
        yield
