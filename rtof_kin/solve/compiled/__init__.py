"""The joint-space problem as compiled SIMD code."""
