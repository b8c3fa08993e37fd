"""Estimates and gain of self-calibration: ``python -m benchmarks calibration``."""
