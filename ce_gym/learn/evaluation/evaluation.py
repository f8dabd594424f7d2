"""Evaluate a trained policy: errors of the commanded velocity, falls, torques and powers of the motors.

Evaluation uses the mean action, and a seed computed from the weights.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ce_gym.learn.evaluation.episodes import Predicts, open_environments, play, weights_seed, without_curricula
from ce_gym.learn.evaluation.tables import metrics, sections, two_columns
from ce_gym.policies import Policy, environment_of, load_policy


def load(
    path: str | Path,
    env: str | None = None,
    transmission: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
    threads: int | None = None,
) -> Policy:
    """Return a policy whose record has the environment of the evaluation.

    Args:
        path: See `ce_gym.load_policy`.
        env: Environment id from the command line; None keeps the id of the record.
        transmission: Transmission level of the environment; None keeps the level in the record.
        env_args: Arguments of the environment that replace arguments in the record.
        threads: Processor threads of the environment; None keeps its default.

    Raises:
        PolicyError: If the policy cannot be used, or its environment needs `--env`: see
            `ce_gym.policies.environment_of`.
    """
    policy = load_policy(path, transmission, env, dict(env_args))
    given = {"transmission": transmission, "num_threads": threads}
    options = {name: value for name, value in given.items() if value}
    kwargs = {**policy.record["env_kwargs"], **dict(env_args), **options}
    return replace(policy, record=policy.record | {"env": environment_of(policy.record, env), "env_kwargs": kwargs})


def evaluate(
    model: Predicts, env_id: str, *, episodes: int = 256, seed: int | None = None, **kwargs: Any
) -> dict[str, Any]:
    """Play one episode in each of `episodes` environments with the policy's mean action.

    Curricula are disabled: robots start on all terrain levels, and commands have their full range.

    Args:
        model: The policy.
        env_id: Registered environment id.
        episodes: Number of episodes, played in parallel.
        seed: Seed of the first environment; None computes it from the weights, see `episodes.weights_seed`.
        **kwargs: Arguments of the environment, such as `transmission`.

    Returns:
        - forward_error, lateral_error [m/s], yaw_rate_error [rad/s]: Mean absolute difference between commanded and
          actual base velocity, in base coordinates, over all steps.
        - velocity_error [m/s]: Mean length of the horizontal difference.
        - falls, timed_out, diverged: Fractions of episodes that ended with a failure, reached the time limit, or had a
          state that was not finite.
        - episode_length [s], reward: Means over episodes.
        - episodes, seed: Number of episodes, and seed of the first environment.
        - levels: Errors, falls and number of episodes for each terrain level, if the ground has levels.
        - commanded: Whether the policy observes commands; if False, errors have no meaning.
        - metrics/..., reward/...: Means of the metrics and rewards of the task.
    """
    seed = weights_seed(model) if seed is None else seed
    with open_environments(env_id, episodes, seed, **without_curricula(env_id, kwargs)) as (envs, obs):
        native: Any = envs.unwrapped
        blocks = getattr(native, "observation_structure", {"command": None})  # other packages' environments lack it
        commanded = any("command" in block for block in blocks)
        return play(model, envs, obs) | {"seed": seed, "commanded": commanded}


def report(result: dict[str, Any]) -> str:
    """Return a result of `evaluate` as Markdown tables, with the other results in it."""
    figures = {name: f"{value:.3f}" for name, value in metrics(result).items()}
    if result["commanded"]:
        figures = {
            "forward speed error": f"{result['forward_error']:.3f} m/s",
            "sideways speed error": f"{result['lateral_error']:.3f} m/s",
            "yaw rate error": f"{result['yaw_rate_error']:.3f} rad/s",
            "velocity error": f"{result['velocity_error']:.3f} m/s",
        }
    figures |= {name.replace("_", " "): f"{result[name]:.1%}" for name in ("falls", "timed_out", "diverged")}
    figures |= {"episode length": f"{result['episode_length']:.1f} s", "reward": f"{result['reward']:.2f}"}
    errors = ", of absolute errors over every step" if result["commanded"] else ""
    note = f"Means over {result['episodes']} episodes{errors}. Seed {result['seed']}."
    return "\n\n".join([two_columns("result", "", figures), note, *sections(result)])
