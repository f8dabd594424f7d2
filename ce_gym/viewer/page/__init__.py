"""Rollouts as one HTML page: the scene, its animation and the plots beside it."""
