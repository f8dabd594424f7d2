"""Spatial vectors, the update of positions, and traced functions on numpy arrays: knows no robot."""
