"""Folders and files: atomic writing, safe reading of text, arrays and TOML."""
