"""Judge one policy on every transmission level: what is lost where the gears differ from those it was trained on?

Uses public names of ce_gym only, and no name of a robot or task.

    python train/transfer.py runs/mini_cheetah_velocity/policy.zip
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from evaluate import EVALUATION_SEED, add_arguments, env_kwargs, evaluate
from policy_file import Policy, read_policy
from stable_baselines3 import PPO

LEVELS = ("exact", "coupled", "armature", "none")
"""Transmission levels, from what is kept in full to what is ignored."""

_COLUMNS = (
    ("forward [m/s]", "forward_error", ".3f"),
    ("lateral [m/s]", "lateral_error", ".3f"),
    ("yaw [rad/s]", "yaw_rate_error", ".3f"),
    ("falls", "falls", ".1%"),
    ("length [s]", "episode_length", ".1f"),
    ("reward", "reward", ".2f"),
)


def transfer(
    model: PPO | Policy, record: dict[str, Any], *, episodes: int = 256, seed: int = EVALUATION_SEED
) -> dict[str, dict[str, float]]:
    """Evaluate a policy on every level, with the same seeds, and return the result by level."""
    return {
        level: evaluate(model, record["env"], episodes=episodes, seed=seed, **env_kwargs(record, level))
        for level in LEVELS
    }


def table(results: dict[str, dict[str, float]], trained_on: str) -> str:
    """Mean absolute tracking errors, falls and returns, one line per level; a star marks the training level."""
    lines = ["evaluated on " + "".join(f"{title:>15}" for title, _, _ in _COLUMNS)]
    for level, result in results.items():
        name = level + (" *" if level == trained_on else "")
        lines.append(f"{name:<13}" + "".join(f"{result[key]:>15{form}}" for _, key, form in _COLUMNS))
    return "\n".join([*lines, "* trained on this level; errors are mean absolute, over every step"])


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Judge one policy on every transmission level.")
    add_arguments(parser)
    args = parser.parse_args(argv)
    try:
        model = read_policy(args.policy)
        results = transfer(model, model.record, episodes=args.episodes, seed=args.seed)
    except ValueError as error:
        print(f"transfer.py: {error}", file=sys.stderr)
        return 2
    print(json.dumps(results, indent=2) if args.json else table(results, model.record["transmission"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
