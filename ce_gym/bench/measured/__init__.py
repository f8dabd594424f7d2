"""Comparisons with measurements of real systems."""
