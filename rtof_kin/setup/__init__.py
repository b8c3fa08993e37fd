"""From raw files to a recording: camera, clocks, alignment and assignment of sensors, recording.toml."""
