"""What calibrating a recording from itself finds and gains: ``python -m benchmarks.calibration``."""
