"""Robots for other simulators: written as MJCF and stepped by MuJoCo."""
