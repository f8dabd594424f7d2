"""Multilayer perceptrons compiled with numba: outputs, gradients, updates."""
