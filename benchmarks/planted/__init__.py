"""Faults planted in right recordings: which are named in the first line, and what the bands cover if not."""
