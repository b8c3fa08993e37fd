"""Solvers side by side, and how fast the package's own are; ``python -m benchmarks solvers``."""
