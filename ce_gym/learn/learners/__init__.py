"""Learners: PPO, SHAC, distillation, PPO of Stable-Baselines3."""
