"""Live estimation: sources of samples, the fixed-lag estimator, monitoring, recording and outputs."""
