"""Rewards, observations, terminations and metrics, and the context that they read."""
