"""Levenberg-Marquardt, banded systems, the C compiler and SIMD code generation."""
