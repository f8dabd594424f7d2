"""Rollouts: recorded motions of robots, in memory and in files."""
