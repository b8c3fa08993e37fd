"""CovarianceInflation of pose covariances for correlated errors."""
