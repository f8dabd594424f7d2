"""Stability by time step, ground and robot."""
