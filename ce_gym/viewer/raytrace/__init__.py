"""Ray-traced pictures of robots on the CPU, without a display."""
