"""Frames, momentum and further quantities for controllers as traced functions; each file exports some by name."""
