"""rsl_rl's PPO on a native batch; train/rsl_rl_ppo.py also reads settings files and writes a policy."""

from rsl_rl.runners import OnPolicyRunner

from ce_gym.adapters.rsl_rl import make_rsl_rl_vec_env

envs = make_rsl_rl_vec_env("ce_gym/MiniCheetahVelocity-v0", 512)
network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "tanh"}
settings = {
    "num_steps_per_env": 24,
    "save_interval": 50,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {
        **network,
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.6, "std_type": "log"},
    },
    "critic": {**network},
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 3,
        "num_mini_batches": 4,
        "gamma": 0.98,
        "lam": 0.95,
        "entropy_coef": 0.001,
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.01,
    },
}
runner = OnPolicyRunner(envs, settings, "runs/rsl_rl")
runner.learn(4_000_000 // (24 * 512), init_at_random_ep_len=True)
