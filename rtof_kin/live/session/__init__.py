"""The session: clocks, checks, monitoring, recording, the loop."""
