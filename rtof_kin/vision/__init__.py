"""2D detectors: files, layouts, tracking of one person, regression of landmarks, outlier rejection."""
