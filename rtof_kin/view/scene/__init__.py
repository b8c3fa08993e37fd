"""The 3D scene of a motion in the browser: read by blocks, drawn by viser, on this machine only."""
