"""Stability over steps, grounds and robots."""
