"""Other simulators and dynamics libraries on the same robots."""
