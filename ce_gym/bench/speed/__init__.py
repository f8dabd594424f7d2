"""Speed of forward dynamics and sub-steps, compared with other simulators."""
