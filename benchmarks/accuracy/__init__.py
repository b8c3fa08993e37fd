"""How accurate the joint-space solver is; ``python -m benchmarks.accuracy``."""
