"""Accuracy of the joint-space solver; ``python -m benchmarks accuracy``."""
