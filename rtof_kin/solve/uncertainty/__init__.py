"""Inflation of pose covariances for correlated errors."""
