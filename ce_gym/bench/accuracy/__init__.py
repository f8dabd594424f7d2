"""Time against error of methods and simulators."""
