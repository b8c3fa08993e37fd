"""From a recording to a motion: prepare, lift, SF2, solve, and consistency checks."""
