"""Sources of samples: cameras, LSL, UDP, replays."""
