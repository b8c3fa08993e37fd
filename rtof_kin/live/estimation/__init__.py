"""Online estimation: window, sensors' samples, the estimator and its refinement."""
