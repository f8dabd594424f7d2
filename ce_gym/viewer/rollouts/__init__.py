"""Rollouts: what a robot did, recorded and kept in a file."""
