"""Pictures of a motion: a 3D scene in the browser, the skeleton on the video."""
