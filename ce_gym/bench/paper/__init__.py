"""Experiments of the constraint-embedding paper, repeated."""
