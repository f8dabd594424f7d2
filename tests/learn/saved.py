"""Policies that a test has trained itself, read by Stable-Baselines3, which unpickles."""

from pathlib import Path

from stable_baselines3 import PPO

from ce_gym.policies import load_policy


def load_learner(path: Path) -> tuple[PPO, dict]:
    """Return a policy.zip and its record."""
    return PPO.load(path, device="cpu"), load_policy(path).record
