"""The joint-space energy: state, residuals of a frame, jerk and the problem of a fragment."""
