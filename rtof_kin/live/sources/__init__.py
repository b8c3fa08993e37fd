"""Sources of samples: cameras, LSL, replays."""
