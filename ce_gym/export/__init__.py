"""Robots written for other simulators: MJCF."""
