"""Checks of bodies, constraints, drives, collisions and whole robots."""
