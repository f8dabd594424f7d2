"""Evaluate a trained policy: errors of the commanded velocity, falls, torques and powers of the motors.

Evaluation uses the mean action, and a seed computed from the weights.

    python train/evaluate.py runs/mini_cheetah_velocity --transmission armature
    python train/evaluate.py policy.onnx --suites --pushes --crossing --json result.json
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.console import EPISODES, add_json_argument, whole
from ce_gym.learn.evaluate.crossing import crossing_table
from ce_gym.learn.evaluate.episodes import Predicts, play, weights_seed, without_curricula
from ce_gym.learn.evaluate.pushes import push_table
from ce_gym.learn.evaluate.suites import level_table, suite_table
from ce_gym.policies import Policy, environment_of, load_policy

WEIGHTS_SEED = whole(0, 2**32 - 1)
"""Type of `--seed` in evaluations, which may use all 32 bits."""


def load(
    path: str | Path,
    env: str | None = None,
    transmission: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
) -> Policy:
    """Return a policy whose record has the environment of the evaluation.

    Args:
        path: See `ce_gym.load_policy`.
        env: Environment id from the command line; None keeps the id of the record.
        transmission: Level at which the policy will run.
        env_args: Arguments of the environment that replace arguments in the record.

    Raises:
        PolicyError: If the policy cannot be used, or its environment needs `--env`: see
            `ce_gym.policies.environment_of`.
    """
    policy = load_policy(path, transmission)
    chosen = {
        "env": environment_of(policy.record, env),
        "env_kwargs": {**policy.record["env_kwargs"], **dict(env_args)},
    }
    return replace(policy, record=policy.record | chosen)


def env_kwargs(record: dict[str, Any], transmission: str | None = None) -> dict[str, Any]:
    """Return the environment arguments in a record, with another transmission level if one is given."""
    kwargs = dict(record["env_kwargs"])
    return kwargs | {"transmission": transmission} if transmission else kwargs


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
    with closing(make_sb3_vec_env(env_id, episodes, seed, **without_curricula(env_id, kwargs))) as envs:
        native: Any = envs.envs.unwrapped
        blocks = getattr(native, "observation_structure", {"command": None})  # other packages' environments lack it
        commanded = any("command" in block for block in blocks)
        return play(model, envs) | {"seed": seed, "commanded": commanded}


def report(result: dict[str, Any]) -> str:
    """Return the main results as text, one per line, and tables of the other results."""
    rows = _error_rows(result) if result["commanded"] else _metric_rows(result)
    rows += [
        ("falls", f"{result['falls']:.1%}", f"of {result['episodes']} episodes, seed {result['seed']}"),
        ("time-outs", f"{result['timed_out']:.1%}", "on its feet to the end" if result["commanded"] else ""),
        ("episode length", f"{result['episode_length']:.1f} s", "mean"),
        ("reward per episode", f"{result['reward']:.2f}", ""),
    ]
    if result["diverged"]:
        rows.append(("diverged", f"{result['diverged']:.1%}", "stopped because the state was not finite"))
    lines = [f"{name:<20} {figure:<12} {note}".rstrip() for name, figure, note in rows + _effort_rows(result)]
    tables = [table(result[key]) for key, table in TABLES.items() if key in result]
    return "\n\n".join(["\n".join(lines), *tables])


TABLES = {"levels": level_table, "crossing": crossing_table, "suites": suite_table, "pushes": push_table}
"""Functions that format the other results, by key."""


def _error_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return errors of the commanded velocity: name, value, note."""
    return [
        ("forward speed error", f"{result['forward_error']:.3f} m/s", "mean absolute, over every step"),
        ("lateral speed error", f"{result['lateral_error']:.3f} m/s", ""),
        ("yaw rate error", f"{result['yaw_rate_error']:.3f} rad/s", ""),
        ("velocity error", f"{result['velocity_error']:.3f} m/s", "horizontal, mean length"),
    ]


def _metric_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the metrics of the task: name, value, note."""
    return [(name, f"{figure:.3f}", "mean over episodes") for name, figure in metrics(result).items()]


def metrics(result: dict[str, Any]) -> dict[str, float]:
    """Return the metrics of the task, by name with spaces."""
    values = {key: x for key, x in result.items() if key.startswith("metrics/")}
    return {key.removeprefix("metrics/").replace("_", " "): x for key, x in values.items()}


def _effort_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return results of the motors: name, value, note; no rows if they were not measured."""
    motors = result.get("effort")
    if not motors:
        return []
    rows = [("power", f"{motors['power']:.0f} W", f"of driving motors, at {motors['speed']:.2f} m/s")]
    if motors["cost_of_transport"] is not None:
        net = f"braking lost; {motors['cost_of_transport_net']:.2f} if braking is recovered"
        rows.append(("cost of transport", f"{motors['cost_of_transport']:.2f}", net))
    for what in ("torque", "power"):
        if motors[f"mean_{what}"] is not None:
            figures = f"{motors[f'mean_{what}']:.0%}, {motors[f'peak_{what}']:.0%}"
            rows.append((f"motor {what}", figures, f"of its limit, mean and peak ({motors[f'peak_{what}_at']})"))
    return rows


def add_arguments(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Add the arguments of evaluations: number of episodes, seed, output as JSON."""
    parser.add_argument(
        "--episodes", type=EPISODES, default=episodes, metavar="N", help=f"episodes, in parallel (default {episodes})"
    )
    text = "seed of the first episode (default: the first 32 bits of the SHA-256 of the policy's weights)"
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=text)
    add_json_argument(parser)
