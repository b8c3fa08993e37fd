"""The estimator of live streams: accuracy against lag, speed, an hour with faults, a camera that is off."""
