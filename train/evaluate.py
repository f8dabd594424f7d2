"""Judge a trained policy: how well it follows its commands, how often it falls, what it asks of the motors.

By the mean action, from a seed that the weights give. Uses public names of ce_gym only, and no name of a robot or
task.

    python train/evaluate.py runs/mini_cheetah_velocity --transmission armature
    python train/evaluate.py policy.onnx --suites --pushes --crossing --json result.json
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from console import EPISODES, Parser, add_json_argument, print_result, run, whole
from crossing import cross, crossing_table
from effort import effort
from episodes import play
from pushes import push_envelope, push_table
from suites import everywhere, judge_suites, level_table, suite_table, weights_seed

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import WHERE, Policy, add_env_arguments, environment_of, load_policy

if TYPE_CHECKING:
    from stable_baselines3 import PPO

WEIGHTS_SEED = whole(0, 2**32 - 1)
"""Reads a seed of judging, which may be as large as 32 bits of a policy's weights."""


def load(
    path: str | Path,
    env: str | None = None,
    transmission: str | None = None,
    env_args: Iterable[tuple[str, Any]] = (),
) -> Policy:
    """Read a policy to judge; its record then names the environment to judge it in.

    Args:
        path: See `ce_gym.load_policy`.
        env: What the user's command line names; the environment of the record if None.
        transmission: Level that it will run on.
        env_args: Arguments of the environment that replace those of the record.

    Raises:
        PolicyError: If it cannot be used, or its environment is one that the user must name: see
            `ce_gym.policies.environment_of`.
    """
    policy = load_policy(path, transmission)
    chosen = {
        "env": environment_of(policy.record, env),
        "env_kwargs": {**policy.record["env_kwargs"], **dict(env_args)},
    }
    return replace(policy, record=policy.record | chosen)


def env_kwargs(record: dict[str, Any], transmission: str | None = None) -> dict[str, Any]:
    """Environment arguments a policy was trained with, on another transmission level if one is named."""
    kwargs = dict(record["env_kwargs"])
    return kwargs | {"transmission": transmission} if transmission else kwargs


def evaluate(
    model: PPO | Policy, env_id: str, *, episodes: int = 256, seed: int | None = None, **kwargs: Any
) -> dict[str, Any]:
    """Play one episode in each of `episodes` environments with the policy's mean action.

    Curricula are left out: a robot begins on any level of the ground, and may be given any command.

    Args:
        model: The policy.
        env_id: Registered environment id.
        episodes: Number of episodes, played side by side.
        seed: Of the first environment; None takes the one that the policy's weights give, see `suites.weights_seed`.
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        forward_error, lateral_error [m/s], yaw_rate_error [rad/s]: mean absolute difference between commanded and
        actual base velocity, in base coordinates, over every step of every episode; velocity_error [m/s]: the same of
        the length of the horizontal difference. falls, timed_out, diverged: fraction of episodes that ended early,
        that lasted to the end, and that were stopped because the state was no longer finite. episode_length [s],
        reward: means over episodes. episodes: their number. seed: what was used. levels, where the ground has some:
        errors, falls and number of episodes of each. commanded: whether the policy sees commands; errors say nothing of
        one that does not. Other entries are means of what the task reports itself, `metrics/...` and `reward/...`.
    """
    seed = weights_seed(model) if seed is None else seed
    envs = make_sb3_vec_env(env_id, episodes, seed, **everywhere(env_id, kwargs))
    try:
        native: Any = envs.envs.unwrapped
        blocks = getattr(native, "observation_structure", {"command": None})  # environments of others have none
        commanded = any("command" in block for block in blocks)
        return play(model, envs) | {"seed": seed, "commanded": commanded}
    finally:
        envs.close()


def report(result: dict[str, Any]) -> str:
    """The figures that matter, one per line; those of motors and pushes if they are there."""
    rows = _error_rows(result) if result["commanded"] else _own_rows(result)
    rows += [
        ("falls", f"{result['falls']:.1%}", f"of {result['episodes']} episodes, seed {result['seed']}"),
        ("time-outs", f"{result['timed_out']:.1%}", "on its feet to the end" if result["commanded"] else ""),
        ("episode length", f"{result['episode_length']:.1f} s", "mean"),
        ("reward per episode", f"{result['reward']:.2f}", ""),
    ]
    if result["diverged"]:
        rows.append(("diverged", f"{result['diverged']:.1%}", "stopped because numbers went astray"))
    lines = [f"{name:<20} {figure:<12} {note}".rstrip() for name, figure, note in rows + _effort_rows(result)]
    tables = [table(result[key]) for key, table in TABLES.items() if key in result]
    return "\n\n".join(["\n".join(lines), *tables])


TABLES = {"levels": level_table, "crossing": crossing_table, "suites": suite_table, "pushes": push_table}
"""What is shown below the figures, if it was judged."""


def _error_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """How well commands are followed."""
    return [
        ("forward speed error", f"{result['forward_error']:.3f} m/s", "mean absolute, over every step"),
        ("lateral speed error", f"{result['lateral_error']:.3f} m/s", ""),
        ("yaw rate error", f"{result['yaw_rate_error']:.3f} rad/s", ""),
        ("velocity error", f"{result['velocity_error']:.3f} m/s", "horizontal, mean length"),
    ]


def _own_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What the task reports itself."""
    return [(name, f"{figure:.3f}", "mean over episodes") for name, figure in own_figures(result).items()]


def own_figures(result: dict[str, Any]) -> dict[str, float]:
    """Return what the task reports itself, by its name in words."""
    found = {key: x for key, x in result.items() if key.startswith("metrics/")}
    return {key.removeprefix("metrics/").replace("_", " "): x for key, x in found.items()}


def _effort_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What the motors do, or nothing if nobody watched them."""
    found = result.get("effort")
    if not found:
        return []
    rows = [("power", f"{found['power']:.0f} W", f"of driving motors, at {found['speed']:.2f} m/s")]
    if found["cost_of_transport"] is not None:
        net = f"braking lost; {found['cost_of_transport_net']:.2f} if it is taken back"
        rows.append(("cost of transport", f"{found['cost_of_transport']:.2f}", net))
    for what in ("torque", "power"):
        if found[f"mean_{what}"] is not None:
            figures = f"{found[f'mean_{what}']:.0%}, {found[f'peak_{what}']:.0%}"
            rows.append((f"motor {what}", figures, f"of its limit, mean and peak ({found[f'peak_{what}_at']})"))
    return rows


def add_arguments(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Arguments shared by the programs that judge policies, apart from the policies and their environment."""
    parser.add_argument(
        "--episodes", type=EPISODES, default=episodes, metavar="N", help=f"episodes, side by side (default {episodes})"
    )
    text = "seed of the first episode (default: the first 32 bits of the SHA-256 of the policy's weights)"
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=text)
    add_json_argument(parser)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(
        description="Judge a trained policy: tracking errors, falls, what it asks of the motors, how hard it can be "
        "pushed. Torques and powers are those of sub-steps, as shares of what the motors can give."
    )
    parser.add_argument("policy", help=WHERE)
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic (default: as trained)"
    )
    parser.add_argument("--pushes", action="store_true", help="also push it, from all sides, harder and harder")
    text = "also judge it on commands that jump, standing, turning in place, going backwards, and pushed"
    parser.add_argument("--suites", action="store_true", help=text)
    text = "also count who walks 8 m straight ahead without a fall, by level of the ground"
    parser.add_argument("--crossing", action="store_true", help=text)
    add_env_arguments(parser)
    add_arguments(parser, episodes=2048)
    args = parser.parse_args(argv)
    return run("evaluate.py", lambda: _judge(args))


def _judge(args: argparse.Namespace) -> int:
    """Do everything that the command line asks for."""
    model = load(args.policy, args.env, args.transmission, args.env_args)
    kwargs = env_kwargs(model.record, args.transmission)
    result: dict[str, Any] = evaluate(model, model.record["env"], episodes=args.episodes, seed=args.seed, **kwargs)
    seed = result["seed"]
    if found := effort(model, episodes=min(args.episodes, 32), seed=seed, **kwargs):
        result["effort"] = found
    if args.suites:
        result["suites"] = judge_suites(model, args.episodes, seed, **kwargs)
    if args.crossing:
        result["crossing"] = cross(model, args.episodes, seed, **kwargs)
    if args.pushes:
        result["pushes"] = push_envelope(model, seed=seed, **kwargs)
    print_result(result, report(result), args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
