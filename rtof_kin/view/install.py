"""How to install what the pictures need."""

from typing import Final

INSTALL: Final = "pip install 'rtof_kin[view]'"
"""Command for the terminal."""
