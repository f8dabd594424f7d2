"""Train, evaluate and export policies, in Python and by commands of `python -m ce_gym`.

    trained = ce_gym.learn.train("ce_gym/MiniCheetahVelocity-v0", out="runs/walk", settings={"steps": 4e6})
    results = ce_gym.learn.evaluate("runs/walk", transmission="none")

Training needs the extra `train`: `pip install "ce_gym[train]"`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

__all__ = ["evaluate", "train"]


def train(env_id: str = "", algo: str = "", **options: Any) -> Any:
    """Train a policy, save it, and return it as `runs.job.Trained`; Ctrl-C saves the policy and stops.

    Args:
        env_id: Registered environment id; may be empty with `resume`.
        algo: "ppo" (default), "shac", "distill" or "sb3".
        **options: `settings`, `out`, `seed`, `resume` and others, see `training.make_job`.

    Raises:
        ValueError: If a setting, an argument or the policy to resume cannot be used; one line.
    """
    from ce_gym.learn.training import make_job, run_job

    return run_job(make_job(env_id, algo, **options))


def evaluate(
    policy: str | Path,
    env_id: str | None = None,
    *,
    transmission: str | None = None,
    episodes: int = 256,
    seed: int | None = None,
    **env_args: Any,
) -> dict[str, Any]:
    """Play one episode in each of `episodes` environments with a policy's mean action, and return the statistics.

    Args:
        policy: A file (policy.zip, .npz or .onnx), the folder of a training run, or the name of a shipped policy.
        env_id: Registered environment id; None for the environment of training.
        transmission: Transmission level; None for the level of training.
        episodes: Number of episodes, played in parallel.
        seed: Seed of the first episode; None computes it from the weights.
        **env_args: Arguments of the environment in place of the arguments of training.

    Returns:
        Errors [m/s, rad/s], falls and others by name, see `evaluation.evaluation.evaluate`.

    Raises:
        PolicyError: If the policy cannot be used.
    """
    from ce_gym.learn.evaluation.evaluation import evaluate as evaluate_model
    from ce_gym.learn.evaluation.evaluation import load

    model = load(policy, env_id, transmission, env_args.items())
    return evaluate_model(model, model.record["env"], episodes=episodes, seed=seed, **model.record["env_kwargs"])
