"""OSC messages and bundles for the tests of `rtof_kin.live`."""

from __future__ import annotations

from typing import Any

from pythonosc.osc_bundle_builder import OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder


def message(address: str, *values: Any, kind: str = "d") -> Any:
    """An OSC message; numbers have the type `kind`."""
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value, "s" if isinstance(value, str) else kind)
    return builder.build()


def bundle(time: float, *parts: Any) -> Any:
    """An OSC bundle with a time tag, s since 1970."""
    builder = OscBundleBuilder(time)
    for part in parts:
        builder.add_content(part)
    return builder.build()
