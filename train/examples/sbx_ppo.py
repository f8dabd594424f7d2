# pyright: reportMissingImports=false
"""SBX, Stable-Baselines3 in JAX, on a native batch through the adapter for Stable-Baselines3."""

from sbx import PPO

from ce_gym.adapters.sb3 import make_sb3_vec_env

envs = make_sb3_vec_env("ce_gym/MiniCheetahStand-v0", 64)
PPO("MlpPolicy", envs, n_steps=64, batch_size=1024, n_epochs=5, gamma=0.98, learning_rate=1e-3).learn(1_000_000)
