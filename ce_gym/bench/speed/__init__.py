"""Time of forward dynamics and of sub-steps beside other simulators."""
