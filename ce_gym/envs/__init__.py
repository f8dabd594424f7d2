"""Gymnasium environments: tasks, terms, and one batch behind single and vector environments."""

from ce_gym.envs.registration import environment_ids, register_environments

__all__ = ["environment_ids", "register_environments"]
